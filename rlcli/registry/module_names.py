"""Module names of tasks. A task's module has one name in `sys.modules` and may have another in the task's own files."""

import re

IMPORTED_NAME = "rlcli_folder_"
"""Start of the module names under which folders and files are imported whose own name is taken."""
OWN_NAMES: dict[str, str] = {}
"""Module name of an imported package or folder -> name under which its own files import it."""


def with_own_names(text: str) -> str:
    """Return a text in which modules of tasks have the names that their files use, not those in `sys.modules`."""
    for module, own in OWN_NAMES.items():
        text = text.replace(module, own) if module.startswith(IMPORTED_NAME) else text
    return re.sub(rf"{IMPORTED_NAME}task_[0-9a-f]{{16}}_(\w+)", r"\1", text)
