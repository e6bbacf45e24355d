"""Models of robots that a user gives for task files of other frameworks: `--model NAME=FILE`, or a YAML file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from rlcli.config.layers import read
from rlcli.errors import UsageError

MODELS = "models"
"""First key of the overrides that `--model` becomes."""


def read_models(words: Iterable[str]) -> dict[str, Path]:
    """Return the MJCF file of each robot or object: of `NAME=FILE`, or of a YAML file `{NAME: FILE}`.

    The paths in a YAML file are relative to that file.

    Raises:
        ConfigError: if a YAML file cannot be read, or is not such a mapping.
        UsageError: if a model file does not exist.
    """
    found: dict[str, Path] = {}
    for word in words:
        name, equals, value = word.partition("=")
        entries = {name: Path(value)} if equals else {}
        if not equals:
            entries = {key: Path(word).parent / str(file) for key, file in read(Path(word)).data.items()}
        for key, file in entries.items():
            if not key or not file.is_file():
                hint = "write --model NAME=FILE.xml, or --model FILE.yaml with a mapping {NAME: FILE.xml}"
                raise UsageError(f"--model {word}: there is no file '{file}'", hint=hint)
            found[key] = file.resolve()
    return found
