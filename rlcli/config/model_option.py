"""Reader of the option `--model`, with which users give MJCF files for tasks of other frameworks.

Such tasks name USD or URDF files of their robots, which rlcli cannot simulate; the option gives MJCF files instead.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path as FilePath
from typing import Any

from rlcli.config.layers import leaves, read
from rlcli.config.strict_yaml import Path
from rlcli.errors import Problem, TaskError, UsageError
from rlcli.registry.formats import Format
from rlcli.registry.models import model_file

MODELS = "models"
"""First key of the overrides that `--model` becomes."""
OPTIONAL = "optional"
"""Key that marks a model from `--model FILE.yaml`: its name need not exist in the task's scene."""


def read_models(words: Iterable[str]) -> dict[str, Any]:
    """Return the MJCF file of each robot or object, by its name, from the values of `--model`.

    A value is `NAME=FILE`, or a YAML file with `{NAME: FILE}`. FILE is the path of an MJCF file, or `TASK:FILE` for a
    file of an installed task. Paths in a YAML file are relative to that file. A YAML file may also have `NAME: {model:
    FILE, gains: {GROUP: {stiffness: S, damping: D}}}`, with PD gains for actuators that the task describes by a neural
    network.

    Raises:
        ConfigError: if a YAML file cannot be read, or is not such a mapping.
        UsageError: if a model file does not exist.
    """
    found: dict[str, Any] = {}
    for word in words:
        name, equals, value = word.partition("=")
        folder = FilePath.cwd() if equals else FilePath(word).parent
        entries = {name: value} if equals else read(FilePath(word)).data
        for key, entry in entries.items():
            settings = entry if isinstance(entry, Mapping) else {"model": entry}
            try:
                file = model_file(folder, str(settings.get("model")))
            except TaskError as error:
                raise UsageError(f"--model {word}: {error.message}", hint=error.hint) from None
            if not key or not file.is_file():
                hint = "write --model NAME=FILE.xml, or --model FILE.yaml with a mapping {NAME: FILE.xml}"
                raise UsageError(f"--model {word}: there is no file '{settings.get('model')}'", hint=hint)
            path = str(file.resolve())
            given = {**settings, "model": path} if "gains" in settings else path
            found[key] = given if equals else {**settings, "model": path, OPTIONAL: True}
    return found


def given_settings(recorded: Mapping[str, Any], changes: Mapping[Path, Any]) -> tuple[dict[str, Any], dict[Path, Any]]:
    """Return the settings that the user must supply for a task in Python whose file has no value for them.

    Args:
        recorded: the configuration that a run has stored; empty without a run.
        changes: path -> value of the changes from the command line.

    Returns:
        Name of a robot or object -> its MJCF file (as from `read_models`), and path of a setting -> its value: the
        values that the run has stored, then the changes.
    """
    models = recorded_models(recorded) | {str(path[-1]): value for path, value in changes.items() if path[0] == MODELS}
    return models, {path: value for path, value in leaves(recorded) if path} | dict(changes)


def recorded_models(task: Mapping[str, Any]) -> dict[str, Any]:
    """Return the models and gains that a run has stored in its configuration, in the form of `read_models`."""
    entities = (task.get("scene") or {}).get("entities") or {}
    return {
        name: {"model": entity["model"], "gains": entity.get("actuators") or {}}
        for name, entity in entities.items()
        if isinstance(entity, Mapping) and entity.get("model")
    }


def model_path(path: Path, form: Format | None, problems: list[Problem]) -> Path:
    """Return the path of the key that `--model NAME=FILE` sets in a task's data; an empty path if it sets no key.

    `--model` sets no key in a format whose reader receives the models directly. For a task in rlcli's own format, which
    names its model files itself, `--model` is a mistake.

    Args:
        path: `("models", NAME)`.
        form: the format of the task; None: rlcli's own format.
        problems: the list to which the mistake is added.
    """
    name = ".".join(map(str, path[1:]))
    if form is None:
        hint = f"set scene.entities.{name}.model"
        problems.append(
            Problem(
                f"--model {name}",
                "",
                "the option is for tasks of other frameworks; this task names its model files itself",
                hint,
            )
        )
    keys = form.spec.models.split(".") if form is not None and form.spec.models else ()
    return tuple(name if key == "{name}" else key for key in keys)
