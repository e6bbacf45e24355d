"""Lookup of a robot's model file (MJCF) in a task's folder, in an installed package, or in a folder of the user.

A task file names a model as `FILE`, `TASK:FILE`, `package:PACKAGE/FILE` or `models:FILE`.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from rlcli.errors import MissingModelError, TaskError, listing
from rlcli.registry.entries import TASKS, find_entry
from rlcli.registry.locate_installed_tasks import installed_task, package_folders

MODELS = "RLCLI_MODELS"
"""Environment variable with the user's folders of robot models, separated like the folders of PATH."""


def model_file(root: Path, model: str) -> Path:
    """Return the path of the model file that a task in the folder `root` names by the text `model`.

    `FILE` is in the task's own folder; `TASK:FILE` in the folder of an installed task; `package:PACKAGE/FILE` in an
    installed package, which is not imported; `models:FILE` in a folder of the environment variable RLCLI_MODELS;
    `file:PATH` is any file, which only the user can name with `--model`. If ` | ` separates several alternatives, the
    first existing one is used.

    Raises:
        MissingModelError: if a model that the user must provide is not found.
        TaskError: if there is no such task or package, or the file is outside of its folder or cannot be opened.
    """
    with _system_errors(model):
        return _model_file(root, chosen_model(root, model))


def chosen_model(root: Path, model: str) -> str:
    """Return the first of the alternatives in `model`, separated by ` | `, whose file exists.

    A model without alternatives is returned without a check.

    Raises:
        MissingModelError: if none of the alternatives exists.
    """
    choices = [choice.strip() for choice in model.split(" | ")]
    if len(choices) == 1:
        return choices[0]
    reasons, hints = [], []
    for choice in choices:
        try:
            if _model_file(root, choice).is_file():
                return choice
            reasons.append(f"no file '{choice}' in {root}")
        except TaskError as error:
            reasons.append(error.message)
            hints.append(_install_hint(choice))
    raise MissingModelError(f"the model is not on this machine: {'; '.join(reasons)}", hint=", or ".join(hints) or None)


def existing_model_file(root: Path, model: str) -> Path:
    """Return the resolved path of a model file, like `model_file`, and check that it is an existing regular file.

    Args:
        root: folder of the task.
        model: text with which the task names the file.

    Raises:
        MissingModelError: if a model that the user must provide is not found.
        TaskError: if there is no such file, task or package, or the file is outside of its folder.
    """
    with _system_errors(model):
        file = model_file(root, model).resolve()
        if ":" not in model and not file.is_relative_to(root):
            raise TaskError(f"'{model}' lies outside the task's folder {root}; move the file into this folder")
        if file.exists() and not file.is_file():
            raise TaskError(f"'{model}' in {root} is not a regular file; put an MJCF in its place")
        if not file.exists():
            files = sorted(str(path.relative_to(root)) for path in root.rglob("*.xml") if path.is_file())
            raise TaskError(f"no file '{model}' in {root}", hint=f"MJCF files there: {', '.join(files) or 'none'}")
        return file


@contextlib.contextmanager
def _system_errors(model: str) -> Iterator[None]:
    """Turn errors about a model's path, such as a too long name or a null character, into a TaskError."""
    try:
        yield
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise TaskError(f"the model '{model}' cannot be opened: {reason}; correct the path") from None


def _install_hint(model: str) -> str:
    """Return the hint of a missing model: how the user can provide it (a folder, a package, a task)."""
    kind, _, file = model.partition(":")
    if kind == "models":
        return f"set {MODELS} to a folder that holds {file}"
    if kind == "package":
        return f"install the distribution that has the package {file.partition('/')[0]}"
    return f"install the package of the task {kind}"


def _model_file(root: Path, model: str) -> Path:
    task, _, file = model.rpartition(":")
    if not task:
        return root / model
    if task == "file":
        return Path(file)
    if task == "package":
        return _package_file(file)
    if task == "models":
        return _file_of_user_models(file)
    home = installed_task(find_entry(TASKS, task, what="task")).root
    return _inside(home, file, f"the folder {home} of task '{task}'")


def _inside(folder: Path, file: str, what: str) -> Path:
    if not (folder / file).resolve().is_relative_to(folder.resolve()):
        raise TaskError(f"'{file}' lies outside {what}; name a file inside this folder")
    return folder / file


def _menagerie_models(robot: str) -> list[Path]:
    """Return the folders that may have the model of a robot of MuJoCo Menagerie, such as `unitree_go1`.

    The robot's folder in MENAGERIE_ROOT comes first, then the folders that the package mujoco-menagerie has downloaded,
    the newest first.
    """
    if not robot or set(robot) & set("*?[]"):
        return []
    import platformdirs

    own = os.environ.get("MENAGERIE_ROOT")
    cache = Path(os.environ.get("MENAGERIE_CACHE_DIR") or platformdirs.user_cache_path("mujoco_menagerie", False))
    # the name of a downloaded folder is ROBOT-, then 16 digits of a hash
    marks = [mark for mark in (cache / "models").glob(f"{robot}-*/.complete") if mark.parent.name[:-17] == robot]
    newest = sorted(marks, key=lambda mark: mark.stat().st_mtime, reverse=True)
    return [*([Path(own) / robot] if own else []), *(mark.parent for mark in newest)]


def _file_of_user_models(file: str) -> Path:
    """Return a file from one of the folders of RLCLI_MODELS, else from the cache of the package mujoco-menagerie."""
    folders = [Path(os.path.expanduser(folder)) for folder in os.environ.get(MODELS, "").split(os.pathsep) if folder]
    for folder in folders:
        found = _inside(folder, file, f"the folder {folder} of {MODELS}")
        if found.is_file():
            return found
    robot, _, inner = file.partition("/")
    for folder in _menagerie_models(robot):
        found = _inside(folder, inner, f"the folder {folder}")
        if found.is_file():
            return found
    reason = f"no file '{file}' in {listing(map(str, folders))} of {MODELS}" if folders else f"{MODELS} is not set"
    raise MissingModelError(reason, hint=_install_hint(f"models:{file}"))


def _package_file(model: str) -> Path:
    """Return a file of an installed package by `PACKAGE/FILE`."""
    package, _, file = model.partition("/")
    folders = package_folders(package)
    if not folders:
        hint = f"if you trust its authors, install the distribution that has the package '{package}'"
        raise TaskError(f"no Python package '{package}' is installed", hint=hint if package.isidentifier() else None)
    folder = next((folder for folder in folders if (folder / file).is_file()), folders[0])
    path = _inside(folder, file, f"the package '{package}' in {folder}")
    if not path.is_file():
        raise TaskError(f"no file '{file}' in the package '{package}' in {folder}; correct the name")
    return path
