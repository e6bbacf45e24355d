"""Plugin that runs tasks of OmniIsaacGymEnvs, and the names that such tasks import: `from rlcli_oige import ...`.

If this package does not have a name, it searches the Python files beside the importing file and below the folder of the
task's YAML. So a task can also import its own shared modules and view classes from here. Nothing is imported before a
name is used: the check of a task's YAML does not import torch.
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
    if name == "omni":
        return importlib.import_module(f"{__name__}.replacement_modules").find(name)
    vocabulary = importlib.import_module(f"{__name__}.vocabulary")
    if name in vocabulary.NAMES:
        return getattr(vocabulary, name)
    name_lookup = importlib.import_module(f"{__name__}.name_lookup")
    if name == "__all__":  # `import *` also exports names of the task's other files that the importing file uses
        return [*vocabulary.NAMES, *name_lookup.used_names(vocabulary.NAMES)]
    return name_lookup.find(name, vocabulary.NAMES)
