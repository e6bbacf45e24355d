"""`rlcli import oige`: a task of OmniIsaacGymEnvs as a folder of rlcli's own; its class stays its class."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

from rlcli.config import oige
from rlcli.config.dump import to_yaml
from rlcli.config.imported import Imported
from rlcli.config.layers import read
from rlcli.config.notes import Note
from rlcli.errors import ConfigError, Problem, TaskError, UsageError

_IMPORT = re.compile(r"^(\s*)from\s+(?:omni|pxr|omniisaacgymenvs)(?:\.[\w.]+)?\s+import\s+(.*)$")
_MODULE = re.compile(r"^(\s*)import\s+(carb|omni|pxr)\b[\w.]*\s*$")


def convert(files: list[Path], output: Path | None) -> Imported:
    """Write `task.yaml` and, with their import lines changed, the Python files that lie beside the task's YAML.

    Args:
        files: the task's YAML and, optionally, the rl_games YAML of its agent; without one, `<Task>PPO.yaml`
            beside it is taken.
        output: folder to write to.

    Raises:
        UsageError: for more files, or a folder that holds a task already.
        ConfigError: with everything in the files that cannot be.
    """
    if len(files) > 2:
        raise UsageError(f"found {len(files)} files", hint="rlcli import oige TASK.yaml [TRAINPPO.yaml]")
    source = files[0]
    document = read(source)
    if not oige.is_oige(document.data):
        message = "is not a task of OmniIsaacGymEnvs: it has no env: and sim:"
        raise ConfigError([Problem(str(source), "", message)])
    name = str(document.data.get("name") or source.stem)
    folder = output or Path(_kebab(name))
    target = folder / "task.yaml"
    if target.exists():
        raise UsageError(f"{target} exists", hint="-o another folder")
    class_file, class_name = _class(source.parent, name)
    found = oige.translate(
        document,
        str(source),
        class_file=class_file,
        class_name=class_name,
        agent_file=files[1] if len(files) == 2 else oige.agent_file(source),
    )
    folder.mkdir(parents=True, exist_ok=True)
    written = [target]
    plain = json.loads(json.dumps({**_ordered(found.data), **found.agents}))  # nothing twice: YAML would make anchors
    target.write_text(to_yaml(plain), encoding="utf-8")
    written += _models(found.data["oige"]["mjcf"], source.parent, folder)
    messages = []
    if class_file is None:
        messages.append(f"put the Python file of {name}Task into {folder}: it is the task's logic")
    elif source.parent.resolve() != folder.resolve():
        written += _code(source.parent, folder)
    return Imported(folder, written, sorted(found.notes, key=_place), messages)


def changed_imports(text: str) -> str:
    """The source of a task with its import lines, and nothing else, changed to `rlcli.oige`."""
    lines = []
    for line in text.splitlines():
        if match := _IMPORT.match(line):
            line = f"{match[1]}from rlcli.oige import {match[2]}"
        elif match := _MODULE.match(line):
            line = f"{match[1]}from rlcli.oige import {'omni' if match[2] == 'pxr' else match[2]}"
        lines.append(line)
    return "\n".join(lines) + "\n"


def _class(folder: Path, name: str) -> tuple[Path | None, str | None]:
    try:
        return oige.find_class(folder, name)
    except LookupError:
        return None, None


def _ordered(data: dict[str, Any]) -> dict[str, Any]:
    first = ("summary", "sim", "decimation", "episode_length_s", "scene", "viewer", "clip_actions", "clip_observations")
    return {**{key: data[key] for key in first if key in data}, **data}


def _models(models: dict[str, Any], source: Path, folder: Path) -> list[Path]:
    written = []
    for entry in models.values():
        file, target = source / entry["model"], folder / entry["model"]
        if not file.is_file():
            raise TaskError(f"no file '{file}', which mjcf: names")
        if file.resolve() != target.resolve():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)
            written.append(target)
    return written


def _code(source: Path, folder: Path) -> list[Path]:
    written = []
    for file in sorted(source.glob("*.py")):
        target = folder / file.name
        target.write_text(changed_imports(file.read_text(encoding="utf-8")), encoding="utf-8")
        written.append(target)
    return written


def _place(note: Note) -> tuple[str, int]:
    file, line, _ = note.where.rsplit(":", 2)
    return file, int(line)


def _kebab(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|_", "-", name).lower()
