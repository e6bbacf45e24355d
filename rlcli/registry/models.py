"""The file of a robot's model: in a task's folder, another task's, a package's, or one of the user's."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

from rlcli.errors import MissingModelError, TaskError, listing
from rlcli.registry.entries import TASKS, find_entry
from rlcli.registry.packages import installed_task

MODELS = "RLCLI_MODELS"
"""Environment variable: folders in which the user keeps models of robots, as PATH lists its folders."""


def model_file(root: Path, model: str) -> Path:
    """Where a task in `root` finds a model.

    In its own folder; as `TASK:FILE` in that of an installed task; as `package:PACKAGE/FILE` in an installed package,
    which is not imported; as `models:FILE` in a folder that the environment variable RLCLI_MODELS names. Of several
    with ` | ` between them it is the first that is there.

    Raises:
        MissingModelError: if a model that the user is to have is nowhere.
        TaskError: if there is no such task or package, or the file is not in its folder.
    """
    return _model_file(root, chosen_model(root, model))


def chosen_model(root: Path, model: str) -> str:
    """Of alternatives with ` | ` between them the first that is there; a single one as it is.

    Raises:
        MissingModelError: if none is there.
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


def _install_hint(model: str) -> str:
    """What makes a model available."""
    kind, _, file = model.partition(":")
    if kind == "models":
        return f"set {MODELS} to a folder that holds {file}"
    if kind == "package":
        return f"install the package {file.partition('/')[0]}, which carries it"
    return f"install the task {kind}"


def _model_file(root: Path, model: str) -> Path:
    task, _, file = model.rpartition(":")
    if not task:
        return root / model
    if task == "package":
        return _package_file(file)
    if task == "models":
        return _file_of_user_models(file)
    home = installed_task(find_entry(TASKS, task, what="task")).root
    return _inside(home, file, f"the folder {home} of task '{task}'")


def _inside(folder: Path, file: str, what: str) -> Path:
    if not (folder / file).resolve().is_relative_to(folder.resolve()):
        raise TaskError(f"'{file}' lies outside {what}")
    return folder / file


def _file_of_user_models(file: str) -> Path:
    """A file in one of the folders that the user keeps models in."""
    named = [Path(place).expanduser() for place in os.environ.get(MODELS, "").split(os.pathsep) if place]
    for place in named:
        found = _inside(place, file, f"the folder {place} of {MODELS}")
        if found.is_file():
            return found
    where = f"no file '{file}' in {listing(map(str, named))} of {MODELS}" if named else f"{MODELS} is not set"
    raise MissingModelError(where, hint=_install_hint(f"models:{file}"))


def _package_file(model: str) -> Path:
    """A file in a package, by `PACKAGE/FILE`."""
    package, _, file = model.partition("/")
    try:
        found = importlib.util.find_spec(package) if package.isidentifier() else None
    except (ImportError, ValueError):
        found = None
    places = [Path(place) for place in (found.submodule_search_locations or ())] if found else []
    if not places:
        raise TaskError(f"no Python package '{package}' is installed", hint="write package:PACKAGE/FILE")
    place = next((place for place in places if (place / file).is_file()), places[0])
    path = _inside(place, file, f"the package '{package}' in {place}")
    if not path.is_file():
        raise TaskError(f"no file '{file}' in the package '{package}' in {place}")
    return path
