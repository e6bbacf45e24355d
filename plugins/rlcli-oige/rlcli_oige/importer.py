"""Conversion for `rlcli import oige`: a task of OmniIsaacGymEnvs becomes a task folder of rlcli.

The code of the task's Python class is kept, except for its import lines.
"""

from __future__ import annotations

import ast
import json
import re
import shutil
from pathlib import Path
from typing import Any

from rlcli.config.dump import to_yaml
from rlcli.config.layers import read
from rlcli.errors import ConfigError, Problem, TaskError, UsageError
from rlcli.formats import Imported, Note
from rlcli_oige import task_yaml
from rlcli_oige.hydra_defaults import compose
from rlcli_oige.task_class import find_class, parse_file

_IMPORT = re.compile(r"^(\s*)from\s+(?:omni|pxr|omniisaacgymenvs)(?:\.[\w.]+)?\s+import\s+(.*)$")
_VOCABULARY = [Path(__file__).parent / name for name in ("vocabulary.py", "maths.py", "rotations.py")]
_DEFINED = (ast.ClassDef, ast.FunctionDef)
_WORDS = (*_DEFINED, ast.Constant)
_MODULE = re.compile(r"^(\s*)import\s+(carb|omni|pxr)\b[\w.]*\s*$")


_LONGEST_NAME = 100
"""Maximum length of a task's name."""


def convert(files: list[Path], output: Path | None) -> Imported:
    """Write a folder with `task.yaml` and the Python files of the task's class, with changed import lines.

    Args:
        files: the task's YAML and, optionally, the rl_games YAML of its agent; the default is `<Task>PPO.yaml`
            beside the task's YAML.
        output: folder to write; None: a folder with the task's name.

    Raises:
        UsageError: for more than two files, or if the folder contains a task already.
        ConfigError: with every mistake in the files.
    """
    if len(files) > 2:
        raise UsageError(
            f"expected one or two files, found {len(files)}", hint="rlcli import oige TASK.yaml [TRAINPPO.yaml]"
        )
    source = files[0]
    document = compose(read(source), source, str(source))
    if not task_yaml.is_oige(document.data):
        message = (
            "this YAML is not a task of OmniIsaacGymEnvs, because it has no keys env and sim; give cfg/task/NAME.yaml"
        )
        raise ConfigError([Problem(str(source), "", message)])
    name = str(document.data.get("name") or source.stem)
    # the name becomes the name of a class and of a folder
    if not (name.isidentifier() and name.isascii() and len(name) <= _LONGEST_NAME):
        message = f"'{name[:_LONGEST_NAME]}' is not a valid name of a Python class; use letters, digits and _"
        raise ConfigError([Problem(str(source), "name", message)])
    folder = output or Path(_kebab(name))
    target = folder / "task.yaml"
    if target.exists():
        raise UsageError(f"{target} exists", hint="choose another folder with -o")
    class_file, class_name = _find_class(task_yaml.home(source), name)
    found = task_yaml.translate(
        document,
        str(source),
        class_file=class_file,
        class_name=class_name,
        agent_file=files[1] if len(files) == 2 else task_yaml.agent_file(source),
    )
    folder.mkdir(parents=True, exist_ok=True)
    written = [target]
    # copy objects that occur twice: PyYAML would write anchors and aliases for them
    plain = json.loads(json.dumps({**_ordered(found.data), **found.agents}))
    target.write_text(to_yaml(plain), encoding="utf-8")
    written += _copy_models(found.data["oige"]["mjcf"], source.parent, folder)
    messages = []
    if class_file is None:
        messages.append(f"put the Python file of {name}Task into {folder}: it contains the task's logic")
    elif source.parent.resolve() != folder.resolve():
        written += _copy_code(class_file, task_yaml.home(source), folder)
    return Imported(folder, written, sorted(found.notes, key=_position), messages)


def changed_imports(text: str) -> str:
    """Return a task's source with its import lines changed to `rlcli_oige`; all other lines stay."""
    lines = []
    for line in text.splitlines():
        if match := _IMPORT.match(line):
            line = f"{match[1]}from rlcli_oige import {match[2]}"
        elif match := _MODULE.match(line):
            line = f"{match[1]}from rlcli_oige import {'omni' if match[2] == 'pxr' else match[2]}"
        lines.append(line)
    return "\n".join(lines) + "\n"


def _find_class(folder: Path, name: str) -> tuple[Path | None, str | None]:
    try:
        return find_class(folder, name)
    except LookupError:
        return None, None


def _ordered(data: dict[str, Any]) -> dict[str, Any]:
    first = ("summary", "sim", "decimation", "episode_length_s", "scene", "viewer", "clip_actions", "clip_observations")
    return {**{key: data[key] for key in first if key in data}, **data}


def _copy_models(models: dict[str, Any], source: Path, folder: Path) -> list[Path]:
    written = []
    for entry in models.values():
        file, target = source / entry["model"], folder / entry["model"]
        if not target.resolve().is_relative_to(folder.resolve()):
            what = f"the key `mjcf` names the model '{entry['model']}', which is outside of the task's folder {source}"
            raise TaskError(what, hint="move the model into the folder, and correct its path in the key")
        if not file.is_file():
            raise TaskError(f"the key `mjcf` names the file '{file}', which does not exist; correct the path")
        if file.resolve() != target.resolve():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
            written.append(target)
    return written


def _copy_code(class_file: Path, home: Path, folder: Path) -> list[Path]:
    """Copy the Python files of a task: those beside its YAML, or those of a package that its class uses."""
    beside = sorted(home.glob("*.py"))
    written = []
    for file in beside if class_file in beside else _used_files(class_file, home):
        target = folder / file.relative_to(home)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(changed_imports(file.read_text(encoding="utf-8")), encoding="utf-8")
        written.append(target)
    return written


def _used_files(start: Path, home: Path) -> list[Path]:
    """Return a file, and the files of its package whose classes and functions it imports, directly or not.

    Names that `rlcli_oige` defines count as imported from there, not from a file of the package.
    """
    words = [node for file in _VOCABULARY for node in ast.walk(parse_file(file))]
    own = {getattr(node, "name", getattr(node, "value", None)) for node in words if isinstance(node, _WORDS)}
    deepest_first = sorted(home.rglob("*.py"), key=lambda file: (-len(file.parts), file))[-500:]
    trees = {file: parse_file(file) for file in deepest_first}
    owner = {node.name: file for file in trees for node in trees[file].body if isinstance(node, _DEFINED)}
    found = [start]
    for file in found:
        imports = [node for node in ast.walk(trees[file]) if isinstance(node, ast.ImportFrom)]
        names = [alias.name for node in imports for alias in node.names]
        if "*" in names:
            names += [node.id for node in ast.walk(trees[file]) if isinstance(node, ast.Name)]
        found += dict.fromkeys(owner[n] for n in names if n in owner and n not in own and owner[n] not in found)
    return found


def _position(note: Note) -> tuple[str, int]:
    file, line, _ = note.where.rsplit(":", 2)
    return file, int(line)


def _kebab(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|_", "-", name).lower()
