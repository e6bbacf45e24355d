"""Lookup of the MJCF that replaces a USD or URDF file of a task."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rlcli.config.strict_yaml import MAX_BYTES, YamlError
from rlcli.errors import TaskError
from rlcli.machine.plain_files import read_plain
from rlcli.registry.models import MODELS
from rlcli_isaaclab.dump_yaml import parse

MODEL_MAP = "models.yaml"
"""Name of the file that maps entities, or ends of USD paths, to MJCF files in the same folder."""

USD_TO_MJCF: dict[str, str] = {
    "Robots/Classic/Cartpole/cartpole.usd": "cartpole:cartpole.xml",
    "Robots/Cartpole/cartpole.usd": "cartpole:cartpole.xml",
    "Robots/IsaacSim/Ant/ant_instanceable.usd": "ant-direct:ant.xml",
    "Robots/Ant/ant_instanceable.usd": "ant-direct:ant.xml",
}
"""End of a USD path -> MJCF: a file relative to the task's folder, or `TASK:FILE` of an installed task."""


def map_usd(usd: str, mjcf: str) -> None:
    """Set the MJCF that replaces the USD files whose path ends in `usd`. Call this before making the configuration."""
    USD_TO_MJCF[usd] = mjcf


@dataclass(slots=True)
class GivenModels:
    """Models that the user gives with `--model` and in files `models.yaml`."""

    files: dict[str, str] = field(default_factory=dict)
    """Entity, or end of a USD path -> MJCF."""
    gains: dict[str, Any] = field(default_factory=dict)
    """Entity -> group of actuators -> stiffness and damping that replace an actuator network."""


def given_models(root: Path, asked: Mapping[str, Any]) -> GivenModels:
    """Return the models that the user gives with the option `--model` (`asked`) and in files `models.yaml`.

    Files `models.yaml` are searched for in the task's folder, in the folders above it that belong to its package, and
    in the folders of RLCLI_MODELS. For each name, `--model` takes precedence, then the first file.

    Raises:
        TaskError: if a file is not YAML, is not a mapping from names to a model's file or to a mapping with `model`
            and `gains`, or names a file that does not exist.
    """
    found = GivenModels()
    for name, value in asked.items():
        model = value["model"] if isinstance(value, Mapping) else value
        _add(found, name, value, "file:" if Path(model).is_absolute() else "")
    for folder, prefix in _folders(root):
        file = folder / MODEL_MAP
        if not file.is_file():
            continue
        try:
            content = parse(read_plain(file, MAX_BYTES)) or {}
        except OSError as error:
            raise TaskError(f"{file} cannot be read: {error.strerror or error}; check the path") from None
        except YamlError as error:
            raise TaskError(
                f"{file}:{error.line}:{error.column}: not YAML: {error.message}", hint="write NAME: FILE.xml"
            ) from None
        if not isinstance(content, Mapping):
            raise TaskError(f"{file}: expected lines NAME: FILE.xml", hint="for example robot: robot.xml")
        for name, value in content.items():
            model = value.get("model") if isinstance(value, Mapping) else value
            if not isinstance(model, str):
                raise TaskError(f"{file}: {name}: expected an MJCF file", hint="for example robot: robot.xml")
            if ":" not in model and not (folder / model).is_file():
                raise TaskError(f"{file}: {name}: there is no file '{model}' in {folder}", hint="correct the path")
            _add(found, str(name), value, prefix)
    return found


def _add(found: GivenModels, name: str, value: Any, prefix: str) -> None:
    """Add the model, and the gains, that a line of `models.yaml` gives for a name, unless the name has a model already.

    `prefix` is put before the path of the model.
    """
    model = value["model"] if isinstance(value, Mapping) else value
    if isinstance(value, Mapping):
        found.gains.setdefault(name, value.get("gains") or {})
    found.files.setdefault(name, model if ":" in model else f"{prefix}{model}")


def model_hint(entity: str) -> str:
    """Return a hint for the user: how to give the model of an entity."""
    return f"give a model: --model {entity}=FILE.xml, or --model {MODEL_MAP} with lines {entity}: FILE.xml"


def mjcf_of(usd: str, root: Path, given: Mapping[str, str], entity: str) -> str:
    """Return the MJCF of an entity: the user's file, else `usd` if it is an `.xml` file, else a known model's file.

    Args:
        usd: path of the model in the task's files, usually of a USD file.
        root: the folder of the task, which is searched for `NAME.xml`.
        given: the entity's name, or the end of a model's path -> the MJCF that the user gives for it.
        entity: the entity's name.

    Raises:
        TaskError: if no MJCF is known for the entity.
    """
    path = usd.replace("\\", "/")
    for end, mjcf in [(entity, given[entity])] if entity in given else given.items():
        if end == entity or is_end_of(end, path):
            return mjcf
    if path.endswith(".xml"):
        return usd
    for end, mjcf in USD_TO_MJCF.items():
        if is_end_of(end, path):
            return mjcf
    file = f"{Path(path).stem}.xml"
    for folder, prefix in _folders(root):
        if (folder / file).is_file():
            return f"{prefix}{file}"
    raise TaskError(f"no MJCF model is known for '{path.rsplit('/', 1)[-1]}'", hint=model_hint(entity))


def is_end_of(end: str, path: str) -> bool:
    """Return whether a path ends with the folders and the file of `end`, such as `folder/robot.usd`."""
    return f"/{path}".replace("\\", "/").endswith(f"/{end.lstrip('/')}")


def _folders(root: Path) -> Iterator[tuple[Path, str]]:
    """Yield the folders of a task's models, each with the prefix that their files have in a configuration."""
    yield root, ""
    folder = root
    while (folder / "__init__.py").is_file() and (folder.parent / "__init__.py").is_file():
        folder = folder.parent
        yield folder, f"{os.path.relpath(folder, root)}/"
    for name in os.environ.get(MODELS, "").split(os.pathsep):
        if name:
            yield Path(name).expanduser(), "models:"
