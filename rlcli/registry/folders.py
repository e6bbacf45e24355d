"""Tasks of no installed package: a folder with a YAML, or a configuration in a Python file or package."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from rlcli.errors import TaskError, listing
from rlcli.registry.source import TaskSource


def folder_task(folder: Path, file: str = "task.yaml") -> TaskSource:
    """A folder with a `task.yaml`, and optionally `terms.py` and `task.py` (a class `Task`).

    Or with a YAML in the form of OmniIsaacGymEnvs, whatever its name, and the Python file of the task's class. Without
    either the configuration is in Python: `TASK` in `task.py`, or what the package registers.
    """
    root = folder.resolve()
    config = root / file
    if (root / "run.json").exists():
        raise TaskError(f"'{folder}' is a run, not a task", hint=f"--checkpoint {folder}")
    if file == "task.yaml" and root.is_dir() and not config.is_file():
        config = _oige_config(root) or config
    if root.is_file():
        raise TaskError(f"'{folder}' is a file, not a task's folder", hint=f"did you mean '{folder.parent}'?")
    if not config.is_file() and file == "task.yaml":
        if _defines(root / "task.py", "TASK"):
            return python_task(f"{root / 'task.py'}:TASK", root.name)
        if (root / "__init__.py").is_file() and b"register(" in (root / "__init__.py").read_bytes():
            return python_task(str(root))
        classes = _environments(root)
        if len(classes) > 1:
            names = listing(f"{root.name}/{found}" for found in classes)
            raise TaskError(f"'{root}' holds several tasks", hint=f"name one: {names}")
        if classes:
            return python_task(f"{root / classes[0]}", root.name)
    if not config.is_file():
        found = listing(sorted(p.name for p in root.iterdir())) if root.is_dir() else "no such folder"
        raise TaskError(f"'{folder}' is not a task: it has no {file} ({found})")
    from rlcli.config import oige

    name = oige.task_name(config)
    if name is not None:
        return _oige_task(config.parent, config, name)
    terms, task = root / "terms.py", root / "task.py"
    return TaskSource(
        name=root.name,
        root=root,
        config=config,
        distribution=None,
        version=None,
        term_files=(terms,) if terms.is_file() else (),
        term_modules=(str(terms),) if terms.is_file() else (),
        task=f"{task}:Task" if task.is_file() else None,
        task_file=task if task.is_file() else None,
    )


def python_task(reference: str, name: str | None = None) -> TaskSource:
    """A task whose configuration is a Python object: `file.py:attribute`, or a package's `folder` or `folder:ID`.

    Of a package the configuration is the `TASK` of its `task.py`, or what it registered with gymnasium (as `ID`).

    Raises:
        TaskError: if there is no such file.
    """
    path, attribute = python_place(reference)
    if path.is_dir():
        file, label = path / "__init__.py", attribute or path.name
    else:
        file, label = path, path.stem
    if not file.is_file():
        raise TaskError(f"there is no file '{file}'")
    if file == path and not attribute:
        raise TaskError(f"'{reference}' does not say which object", hint=f"{reference}:TASK, for example")
    return TaskSource(
        name=name or re.sub(r"[^A-Za-z0-9_.-]", "-", label),
        root=file.parent,
        config=file,
        distribution=None,
        version=None,
        term_files=(),
        term_modules=(),
        task=None,
        task_file=None,
        python=f"{path}:{attribute}" if attribute else str(path),
    )


def python_place(reference: str) -> tuple[Path, str]:
    """The file or folder of a configuration in Python, links resolved, and the name in it ('' if it has none)."""
    place, _, attribute = reference.rpartition(":")
    if not place or Path(reference).exists():
        return Path(reference).resolve(), ""
    return Path(place).resolve(), attribute


def _oige_config(root: Path) -> Path | None:
    """The one YAML of a folder, or of its `cfg/task`, that has OmniIsaacGymEnvs' form; None if there is none."""
    from rlcli.config import oige

    files = sorted(root.glob("*.yaml")) or sorted(root.glob("cfg/task/*.yaml"))
    found = [file for file in files if oige.is_oige_file(file)]
    if len(found) > 1:
        names = listing(f"{root.name}/{file.relative_to(root)}" for file in found)
        raise TaskError(f"'{root}' holds several tasks", hint=f"name one file: {names}")
    return found[0] if found else None


def _oige_task(root: Path, config: Path, name: str) -> TaskSource:
    from rlcli.config import oige

    file: Path | None
    try:
        file, class_name = oige.find_class(oige.home(config), name)
    except LookupError as problem:
        if next(oige.home(config).rglob("*.py"), None) is not None:
            raise TaskError(f"'{config}' is not a task: {problem.args[0]}") from None
        file, class_name = None, f"{name}Task"  # the YAML can be checked without
    return TaskSource(
        name=root.name if config.name == "task.yaml" else config.stem,
        root=root,
        config=config,
        distribution=None,
        version=None,
        term_files=(),
        term_modules=(),
        task=f"{file or root / 'task.py'}:{class_name}",
        task_file=file,
    )


def _environments(root: Path) -> list[str]:
    """`file.py:Class` of a folder's environments in Isaac Lab's words, without what a file only builds upon."""
    files = sorted(root.glob("*.py")) if root.is_dir() else []
    classes = [
        (file.name, node.name, {ast.unparse(base).rpartition(".")[2] for base in node.bases})
        for file in files
        for node in _body(file)
        if isinstance(node, ast.ClassDef)
    ]
    kinds, before = {"ManagerBasedRLEnvCfg"}, 0
    while len(kinds) > before:
        before = len(kinds)
        kinds |= {name for _, name, bases in classes if bases & kinds}
    inner = {(file, base) for file, _, bases in classes for base in bases}
    return [
        f"{file}:{name}"
        for file, name, bases in classes
        if bases & kinds and (file, name) not in inner and not name.upper().endswith("_PLAY")
    ]


def _defines(file: Path, name: str) -> bool:
    """Whether a Python file has a top-level assignment or definition of this name."""
    for node in _body(file):
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if getattr(node, "name", None) == name or any(isinstance(t, ast.Name) and t.id == name for t in targets):
            return True
    return False


def _body(file: Path) -> list[ast.stmt]:
    try:
        return ast.parse(file.read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return []
