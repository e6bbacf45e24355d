"""Generator of the files that `rlcli new` writes: a Python package with a new task.

The templates are in `rlcli/templates`: the folder `common`, and a folder for each flavour (kind of task). In the paths
of templates, `package` stands for the name of the Python package, and `suite` for `tests`, because some wheel builders
exclude folders named `tests`.
"""

from __future__ import annotations

import importlib.util
import json
import keyword
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from rlcli import __version__
from rlcli.errors import MachineError, UsageError, listing, require_known
from rlcli.registry import TASKS, catalog, folder_task

if TYPE_CHECKING:
    from rlcli.scaffold_robot import RobotTask

FLAVOURS = ("yaml", "direct")
"""Kinds of tasks: manager-based, in YAML; or a direct task, as a Python class."""
MAX_LENGTH = 64
"""Largest length of a task's name [characters]."""
_TEMPLATES = Path(__file__).parent / "templates"
_DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))}
"""File names that Windows reserves for devices."""


def create(
    name: str, flavour: str, folder: Path | None = None, robot: RobotTask | None = None
) -> tuple[Path, list[str]]:
    """Write the package of a new task; if an error occurs, write nothing.

    Args:
        name: name of the task.
        flavour: kind of the task: `yaml` (manager-based task) or `direct`; ignored with `robot`.
        folder: folder of the package; None: a folder with the task's name.
        robot: model and YAML of a task for a robot of the user (`rlcli new --robot`); None: a task with a sample robot.

    Returns:
        The folder of the package, and its files relative to that folder.

    Raises:
        UsageError: for an unknown flavour; if the name is not valid for a task, a distribution and a Python package; or
            if the folder is not empty.
        MachineError: if the files cannot be written.
    """
    if robot is None:
        require_known(flavour, FLAVOURS, "flavour", "flavours")
    check_name(name)
    folder = Path(name) if folder is None else folder
    _check_folder(folder)
    from rlcli.config.dump import to_yaml

    package = name.replace("-", "_")
    assets: dict[str, Path] = {}
    if robot is None:
        files = render(name, flavour)
    else:
        files = render(name, "robot", robot.task["summary"], has_pose=robot.has_pose)
    if robot is not None:
        files |= {f"{package}/model.xml": robot.model, f"{package}/task.yaml": to_yaml(robot.task)}
        assets = {f"{package}/{place}": origin for place, origin in robot.assets.items()}
    try:
        _write(folder, files, package, assets)
    except OSError as error:
        raise MachineError(f"cannot write {folder}: {error.strerror or error}", hint="try --output FOLDER") from error
    return folder, sorted([*files, *assets, _SCHEMA])


def check_name(name: str) -> None:
    """Check that a new task, its distribution and its Python package can have a name.

    Raises:
        UsageError: if the name is not valid or already in use.
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name):
        rule = "a task name has only letters a-z, digits and single hyphens, and starts with a letter"
        raise UsageError(f"'{name}' is not a valid task name: {rule}", hint=_suggest_name(name))
    if len(name) > MAX_LENGTH:
        raise UsageError(f"'{name}' has {len(name)} characters; use at most {MAX_LENGTH}")
    package = name.replace("-", "_")
    for reserved, reason in (
        (keyword.iskeyword(package), "a keyword of Python"),
        (package in sys.stdlib_module_names, "a module of Python's standard library"),
        (package in ("test", "tests", "site", "conftest"), "a usual name of test folders and modules"),
        (name in _DEVICES, "the name of a device on Windows"),
    ):
        if reserved:
            raise UsageError(f"'{name}' cannot name a package: it is {reason}", hint=f"use {name}-task, for example")
    owners = [f"{entry.distribution} {entry.version}" for entry in catalog(TASKS, hidden=True)[0] if entry.name == name]
    distribution, module = _installed_version(name), _module_file(package)
    if owners:
        message = f"{owners[0]} already has a task '{name}'"
    elif distribution is not None:
        message = f"a package {distribution} is already installed"
    elif module is not None:
        message = f"a Python module '{package}' already exists: {module}"
    else:
        return
    raise UsageError(message, hint=f"use {name}-2, for example")


def render(name: str, flavour: str, summary: str = "", *, has_pose: bool = True) -> dict[str, str]:
    """Return the texts of all files of a new package: path within the package's folder -> text.

    Args:
        name: name of the task.
        flavour: folder of templates, such as `yaml`.
        summary: one line that describes the task.
        has_pose: whether the robot's MJCF has a default pose.
    """
    import jinja2

    package = name.replace("-", "_")
    version = ".".join(__version__.split(".")[:2])
    values = {"name": name, "package": package, "version": version, "flavour": flavour}
    values |= {"summary": summary, "has_pose": "yes" if has_pose else ""}
    # No escaping: the texts are Python, TOML, XML and Markdown, and `check_name` has checked the values.
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, keep_trailing_newline=True, autoescape=False)
    names = {"package": package, "suite": "tests", "gitignore": ".gitignore"}
    files = {}
    for root in (_TEMPLATES / "common", _TEMPLATES / flavour):
        for template in sorted(root.rglob("*.jinja")):
            parts = template.relative_to(root).with_suffix("").parts
            path = "/".join(names.get(part, part) for part in parts)
            files[path] = environment.from_string(template.read_text(encoding="utf-8")).render(values)
    return files


_SCHEMA = "task.schema.json"
"""Name of the file with the JSON Schema of the task, for editors."""


def _write(folder: Path, files: dict[str, str], package: str, assets: Mapping[str, Path]) -> None:
    """Write all files of a new package, and the JSON Schema of its task.

    The files are written to a temporary folder beside the target folder, and moved when all of them are complete.

    Args:
        folder: the target folder.
        files: path within the folder -> text.
        package: name of the Python package.
        assets: path within the folder -> file to copy, such as a mesh.
    """
    from rlcli.config.dump import json_schema
    from rlcli.config.load import extensions

    folder.absolute().parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.absolute().parent))
    try:
        made = temporary / "made"  # a subfolder, because the folder of mkdtemp has mode 0700
        for path, text in files.items():
            (made / path).parent.mkdir(parents=True, exist_ok=True)
            (made / path).write_text(text, encoding="utf-8", newline="\n")
        for path, origin in assets.items():
            (made / path).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(origin, made / path)
        schema = json_schema(*extensions(folder_task(made / package)))
        (made / _SCHEMA).write_text(json.dumps(schema), encoding="utf-8")
        for cache in made.rglob("__pycache__"):
            shutil.rmtree(cache)
        if not folder.is_dir():
            os.replace(made, folder)
            return
        moved = []
        try:
            for part in made.iterdir():
                moved.append(folder / part.name)
                os.replace(part, moved[-1])
        except BaseException:
            for part in moved:
                shutil.rmtree(part) if part.is_dir() else part.unlink(missing_ok=True)
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _check_folder(folder: Path) -> None:
    """Check that a folder does not exist or is empty.

    Raises:
        UsageError: if not.
    """
    if os.path.lexists(folder) and not folder.is_dir():
        raise UsageError(f"'{folder}' exists and is not a folder", hint="give another --output FOLDER")
    if folder.is_dir() and any(folder.iterdir()):
        inside = listing(sorted(path.name for path in folder.iterdir()), 5)
        raise UsageError(f"the folder '{folder}' is not empty ({inside})", hint="give another --output FOLDER")


def _suggest_name(name: str) -> str | None:
    """Return the hint for an invalid task name: a similar valid name, or an example."""
    words = re.sub(r"([a-z0-9])([A-Z])", r"\1-\2", name)
    near = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-").lstrip("0123456789-")
    return f"did you mean '{near}'?" if near and near != name and name.isascii() else "use my-arm, for example"


def _installed_version(name: str) -> str | None:
    """Return name and version of the installed distribution with a name; None if it is not installed."""
    try:
        return f"{name} {metadata.version(name)}"
    except metadata.PackageNotFoundError:
        return None
    except Exception:  # the metadata of the installed distribution is malformed
        return name


def _module_file(package: str) -> str | None:
    """Return the file of an installed Python module or package; None if there is no such module."""
    try:
        found = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return None
    return found.origin if found is not None else None  # a folder without __init__.py has no origin
