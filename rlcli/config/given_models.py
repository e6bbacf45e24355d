"""Models of robots that a user gives for task files of other frameworks: `--model NAME=FILE`, or a YAML file."""

from collections.abc import Iterable
from pathlib import Path as FilePath

from rlcli.config.layers import read
from rlcli.config.strict_yaml import Path
from rlcli.errors import Problem, UsageError
from rlcli.registry.formats import Format

MODELS = "models"
"""First key of the overrides that `--model` becomes."""


def read_models(words: Iterable[str]) -> dict[str, FilePath]:
    """Return the MJCF file of each robot or object: of `NAME=FILE`, or of a YAML file `{NAME: FILE}`.

    The paths in a YAML file are relative to that file.

    Raises:
        ConfigError: if a YAML file cannot be read, or is not such a mapping.
        UsageError: if a model file does not exist.
    """
    found: dict[str, FilePath] = {}
    for word in words:
        name, equals, value = word.partition("=")
        entries = {name: FilePath(value)} if equals else {}
        if not equals:
            entries = {key: FilePath(word).parent / str(file) for key, file in read(FilePath(word)).data.items()}
        for key, file in entries.items():
            if not key or not file.is_file():
                hint = "write --model NAME=FILE.xml, or --model FILE.yaml with a mapping {NAME: FILE.xml}"
                raise UsageError(f"--model {word}: there is no file '{file}'", hint=hint)
            found[key] = file.resolve()
    return found


def model_path(path: Path, form: Format | None, problems: list[Problem]) -> Path:
    """Return the key of a task's data that an override `models.NAME` sets.

    If the task's format has no such key, add a problem and return an empty path.
    """
    name = ".".join(map(str, path[1:]))
    if form is None or not form.spec.models:
        hint = f"set scene.entities.{name}.model"
        problems.append(Problem(f"--model {name}", "", "this task names its models itself", hint))
        return ()
    return tuple(name if key == "{name}" else key for key in form.spec.models.split("."))
