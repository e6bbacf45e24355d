"""Replacement for the module `isaaclab.envs.mdp`, with the names of `rlcli_isaaclab.mdp`."""

from typing import Any

from rlcli_isaaclab import mdp
from rlcli_isaaclab.mdp import *  # noqa: F403
from rlcli_isaaclab.mdp import __all__ as __all__


def __getattr__(name: str) -> Any:
    return getattr(mdp, name)
