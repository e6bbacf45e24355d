"""Replacement for the package `isaaclab` for tasks that rlcli runs: configuration classes, environments and terms.

Every name can be imported from here, and from a submodule with the same name as in Isaac Lab:
`from rlcli_isaaclab import configclass` or `from rlcli_isaaclab.utils import configclass`.
A submodule is imported when one of its names is first used.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rlcli_isaaclab.vocabulary import *  # noqa: F403


def __getattr__(name: str) -> Any:
    if name.startswith("_") and name != "__all__":
        raise AttributeError(name)
    if importlib.util.find_spec(f"{__name__}.{name}") is not None:
        return importlib.import_module(f"{__name__}.{name}")
    return getattr(importlib.import_module(f"{__name__}.vocabulary"), name)


def __dir__() -> list[str]:
    names: list[str] = importlib.import_module(f"{__name__}.vocabulary").__all__
    return names
