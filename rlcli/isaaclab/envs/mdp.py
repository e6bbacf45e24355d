"""Names as in `isaaclab.envs.mdp`: those of `rlcli.isaaclab.mdp`."""

from typing import Any

from rlcli.isaaclab import mdp
from rlcli.isaaclab.mdp import *  # noqa: F403
from rlcli.isaaclab.mdp import __all__ as __all__


def __getattr__(name: str) -> Any:
    return getattr(mdp, name)
