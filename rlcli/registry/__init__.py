"""Search for installed tasks, trainers and formats (readers of other frameworks' task files) by name, and their import.

The names come from the metadata of installed packages; a plugin is imported only when it is used.
"""

from rlcli.registry.entries import (
    FORMATS,
    OWN,
    TASKS,
    TRAINERS,
    Broken,
    Entry,
    catalog,
    find_entry,
    malformed_metadata_ignored,
    plugins_chosen_by,
    unknown_wanted,
    unreadable_distributions,
)
from rlcli.registry.find import find_task, task_source
from rlcli.registry.formats import is_framework
from rlcli.registry.local_tasks import folder_task, python_config, python_place, python_task
from rlcli.registry.locate_installed_tasks import (
    installed_task,
    is_offered,
    package_folder,
    packaged_task,
    task_of_file,
)
from rlcli.registry.models import chosen_model, model_file
from rlcli.registry.plugin_imports import load_entry
from rlcli.registry.task_imports import import_file, load_module, load_object
from rlcli.registry.task_location import TaskSource

__all__ = [
    "FORMATS",
    "OWN",
    "TASKS",
    "TRAINERS",
    "Broken",
    "Entry",
    "TaskSource",
    "catalog",
    "chosen_model",
    "find_entry",
    "find_task",
    "folder_task",
    "import_file",
    "installed_task",
    "is_framework",
    "is_offered",
    "load_entry",
    "load_module",
    "load_object",
    "malformed_metadata_ignored",
    "model_file",
    "package_folder",
    "packaged_task",
    "plugins_chosen_by",
    "python_config",
    "python_place",
    "python_task",
    "task_of_file",
    "task_source",
    "unknown_wanted",
    "unreadable_distributions",
]
