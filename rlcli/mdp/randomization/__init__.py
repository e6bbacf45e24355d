"""Event terms that randomise the model: masses, friction, gains, ... differ between environments.

Each sample is relative to the value in the compiled model, so repeated samples do not add up. `operation: add` gives
original + sample, `scale` gives original x sample, `set` gives the sample itself. `range` is `[low, high]` for the
distributions `uniform` and `loguniform`, and `[mean, std]` for `gaussian`. A list of pairs has one pair for each axis.
A curriculum may change ranges. Each axis of each element (body, geom, joint, ...) gets a sample of its own; with
`shared` all elements get the same samples.
Values that cannot be negative are clipped.
"""

from rlcli.mdp.randomization.actuators import *
from rlcli.mdp.randomization.bodies import *
from rlcli.mdp.randomization.geoms import *
from rlcli.mdp.randomization.joints import *
