"""A new task as a package of its own: the files that `rlcli new` writes.

They are templates in `rlcli/templates`: `common`, and a folder for each flavour. In their paths `package` stands for
the name of the Python package and `suite` for `tests`, a name that builders of wheels may leave out.
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
from importlib import metadata
from pathlib import Path

from rlcli import __version__
from rlcli.errors import MachineError, UsageError, listing, require_known
from rlcli.registry import TASKS, catalog, folder_task

FLAVOURS = ("yaml", "direct")
MAX_LENGTH = 64
_TEMPLATES = Path(__file__).parent / "templates"
_DEVICES = {"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(10))}
"""What Windows does not let a file be called."""
_FLAVOUR_TEXTS = {
    "yaml": {
        "code": "terms",
        "yaml_is": "the task: scene, actions, observations, rewards, ends, success, agents",
        "code_is": "terms of its own; those that rlcli has are named in the YAML alone",
        "schema_changes": "the parameters in `terms.py`",
    },
    "direct": {
        "code": "task",
        "yaml_is": "scene, parameters, success, agents",
        "code_is": "the task: one class, whose hooks fill its observations, rewards and ends",
        "schema_changes": "`Params` in `task.py`",
    },
}


def create(name: str, flavour: str, folder: Path | None = None) -> tuple[Path, list[str]]:
    """Write the package of a new task, whole or not at all.

    Returns:
        Its folder, and its files relative to that.

    Raises:
        UsageError: if the name cannot be a task's, a distribution's and a package's, or the folder holds something.
        MachineError: if the disk refuses.
    """
    require_known(flavour, FLAVOURS, "flavour", "flavours")
    check_name(name)
    folder = Path(name) if folder is None else folder
    _check_folder(folder)
    files = render(name, flavour)
    try:
        _write(folder, files, name.replace("-", "_"))
    except OSError as error:
        raise MachineError(f"cannot write {folder}: {error.strerror or error}", hint="--output FOLDER") from error
    return folder, sorted([*files, _SCHEMA])


def check_name(name: str) -> None:
    """Whether a task, a distribution and a Python package can have this name.

    Raises:
        UsageError: if one of them cannot.
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name):
        said = "small letters a-z, digits and single hyphens, and begins with a letter"
        raise UsageError(f"'{name}' is not a name for a task: that has {said}", hint=_instead(name))
    if len(name) > MAX_LENGTH:
        raise UsageError(f"'{name}' has {len(name)} characters; a name has at most {MAX_LENGTH}")
    package = name.replace("-", "_")
    for word, what in (
        (keyword.iskeyword(package), "a word of Python's own"),
        (package in sys.stdlib_module_names, "a module of Python's standard library"),
        (package in ("test", "tests", "site", "conftest"), "what folders of tests and modules are called"),
        (name in _DEVICES, "what Windows calls a device"),
    ):
        if word:
            raise UsageError(f"'{name}' cannot be a package: it is {what}", hint=f"{name}-task, for example")
    for entry in catalog(TASKS, hidden=True)[0]:
        if entry.name == name:
            owner = f"{entry.distribution} {entry.version}"
            raise UsageError(f"'{name}' is a task of {owner} already", hint=f"{name}-2, for example")
    installed = _installed(name)
    if installed is not None:
        raise UsageError(f"a package {installed} is installed already", hint=f"{name}-2, for example")
    place = _module_place(package)
    if place is not None:
        raise UsageError(f"there is a Python module '{package}' already: {place}", hint=f"{name}-2, for example")


def render(name: str, flavour: str) -> dict[str, str]:
    """The files of a new task: path within its folder -> text."""
    import jinja2

    package = name.replace("-", "_")
    version = ".".join(__version__.split(".")[:2])
    values = {"name": name, "package": package, "version": version, **_FLAVOUR_TEXTS[flavour]}
    # The texts are Python, TOML, XML and Markdown, and the values have been checked: nothing is to be escaped.
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


def _write(folder: Path, files: dict[str, str], package: str) -> None:
    """Write all beside the folder, and move it into its place when it is complete."""
    from rlcli.config.dump import json_schema
    from rlcli.config.load import extensions

    folder.absolute().parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}-", dir=folder.absolute().parent))
    try:
        made = temporary / "made"  # a folder that mkdtemp makes is its owner's alone
        for path, text in files.items():
            (made / path).parent.mkdir(parents=True, exist_ok=True)
            (made / path).write_text(text, encoding="utf-8", newline="\n")
        schema = json_schema(*extensions(folder_task(made / package)))
        (made / _SCHEMA).write_text(json.dumps(schema), encoding="utf-8")
        for left in made.rglob("__pycache__"):
            shutil.rmtree(left)
        if not folder.is_dir():
            os.replace(made, folder)
            return
        there = []
        try:
            for part in made.iterdir():
                there.append(folder / part.name)
                os.replace(part, there[-1])
        except BaseException:
            for moved in there:
                shutil.rmtree(moved) if moved.is_dir() else moved.unlink(missing_ok=True)
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _check_folder(folder: Path) -> None:
    if os.path.lexists(folder) and not folder.is_dir():
        raise UsageError(f"'{folder}' exists and is not a folder", hint="--output FOLDER")
    if folder.is_dir() and any(folder.iterdir()):
        inside = listing(sorted(path.name for path in folder.iterdir()), 5)
        raise UsageError(f"the folder '{folder}' holds files already ({inside})", hint="--output FOLDER")


def _instead(name: str) -> str | None:
    """The nearest name that can be one."""
    words = re.sub(r"([a-z0-9])([A-Z])", r"\1-\2", name)
    near = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-").lstrip("0123456789-")
    return f"did you mean '{near}'?" if near and near != name and name.isascii() else "my-arm, for example"


def _installed(name: str) -> str | None:
    """The distribution of this name, with its version."""
    try:
        return f"{name} {metadata.version(name)}"
    except metadata.PackageNotFoundError:
        return None
    except Exception:  # its metadata is malformed
        return name


def _module_place(package: str) -> str | None:
    try:
        found = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return None
    return found.origin if found is not None else None  # a folder without __init__.py has no origin
