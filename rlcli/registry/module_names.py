"""Names of task modules for messages: a module may have another name in `sys.modules` than in the task's own files.

Several task folders may have a `task.py`; each is imported under a unique name.
"""

import re

IMPORTED_NAME = "rlcli_folder_"
"""Prefix of the module names of imported task folders and files whose own name is already in use."""
OWN_NAMES: dict[str, str] = {}
"""Module name of an imported package or folder -> name under which its own files import it."""


def with_own_names(text: str) -> str:
    """Return an error's text in which modules of tasks have the names that their files use, not those in `sys.modules`.

    Python's ` (unknown location)` is left out: a module that a plugin replaces has no file.
    """
    text = text.replace(" (unknown location)", "")
    for module, own in OWN_NAMES.items():
        text = text.replace(module, own) if module.startswith(IMPORTED_NAME) else text
    return re.sub(rf"{IMPORTED_NAME}task_[0-9a-f]{{16}}_(\w+)", r"\1", text)
