"""Hints for failed imports in a task's file."""

from __future__ import annotations

import sys

from rlcli.errors import did_you_mean, listing
from rlcli_isaaclab.namespace import SOURCE, SOURCE_PACKAGES, public_names


def import_hint(error: BaseException) -> str | None:
    """Return a hint for a failed import from Isaac Lab, or for a name that this package does not have.

    Return None if the error has another cause, or no similar name is known.
    """
    module = getattr(error, "name", None) or ""
    if isinstance(error, ModuleNotFoundError):
        return str(error).partition("; ")[2] or _ALL if module.partition(".")[0].startswith("isaaclab") else None
    if isinstance(error, AttributeError):
        if isinstance(error.obj, type) and error.name in getattr(error.obj, "__dataclass_fields__", ()):
            return _ON_OBJECTS.format(f"{error.obj.__name__}().{error.name}")
        module = str(getattr(error.obj, "__name__", ""))
        known = dir(error.obj) if module.startswith("rlcli_isaaclab.") and module != "rlcli_isaaclab.mdp" else []
        if not known:
            return None
        return did_you_mean(str(error.name), known) or f"it has {listing([n for n in known if n[0].isupper()], 40)}"
    if not isinstance(error, ImportError) or not module.startswith(("rlcli_isaaclab", "isaaclab")):
        return None
    name = str(error).partition("'")[2].partition("'")[0]
    if module.partition(".")[0] in SOURCE_PACKAGES and not module.startswith("isaaclab_tasks.utils") and not error.path:
        return _NO_FILES.format(module.partition(".")[0])
    known = dir(sys.modules[module]) if module in sys.modules else public_names(module)
    return "; ".join(filter(None, (_NEWER.format(name), did_you_mean(name, known) or _ALL)))


_ON_OBJECTS = "objects of a configclass have its settings, the class itself has none, as in Isaac Lab: write {}"
_NEWER = "Isaac Lab 2.3.2 has no '{}' (a newer or changed Isaac Lab may have it)"
_NO_FILES = (
    "the files of {} were not found, and a task derives from them: download and unzip Isaac Lab's wheel"
    f" (pip download --no-deps isaaclab==2.3.2.post1), and set {SOURCE} to its folder isaaclab/source"
)
_ALL = "docs/guides/isaac-lab.md and docs/reference/isaac-lab-terms.md list the names"
