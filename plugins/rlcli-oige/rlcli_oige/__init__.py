"""OmniIsaacGymEnvs' vocabulary, flat: change a task's import lines to `from rlcli_oige import ...`, and it runs here.

A name that is not one of these is looked for in the Python files beside the file that imports it, and below the folder
of the task's YAML: a task's shared modules and view classes are imported from here too. Nothing is imported before a
name is used: a task's YAML is read without torch.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rlcli_oige.vocabulary import *  # noqa: F403


def __getattr__(name: str) -> Any:
    if name.startswith("__") and name != "__all__":
        raise AttributeError(name)
    if importlib.util.find_spec(f"{__name__}.{name}") is not None:
        return importlib.import_module(f"{__name__}.{name}")
    if name == "torch_utils":
        return sys.modules[__name__]
    vocabulary = importlib.import_module(f"{__name__}.vocabulary")
    if name in vocabulary.NAMES:
        return getattr(vocabulary, name)
    neighbours = importlib.import_module(f"{__name__}.neighbours")
    if name == "__all__":  # `import *` gives a task's file what it uses of its neighbours, too
        return [*vocabulary.NAMES, *neighbours.used(vocabulary.NAMES)]
    return neighbours.find(name, vocabulary.NAMES)
