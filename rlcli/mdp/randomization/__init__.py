"""Randomisation of the model: every environment gets masses, friction, gains, ... of its own.

Every term draws anew from the value that the compiled model has, so that what was drawn before never adds up:
`operation: add` is original + draw, `scale` original x draw, `set` the draw itself. `range` is `[low, high]` of the
distributions uniform and loguniform, and `[mean, std]` of gaussian; a list of pairs gives one to each axis, and a
curriculum may move them. Axes are drawn each for itself, and so are the elements, unless `shared` gives all of
them one draw. What cannot be negative is kept from it.
"""

from rlcli.mdp.randomization.actuators import *
from rlcli.mdp.randomization.bodies import *
from rlcli.mdp.randomization.geoms import *
from rlcli.mdp.randomization.joints import *
