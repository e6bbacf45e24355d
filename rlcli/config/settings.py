"""The user's own settings: preferences of the command line, for every folder and task; never a part of a task.

They stand in `settings.yaml` in the platform's folder for configurations. A flag comes before an environment variable,
that before this file, and the file before the default. Python programs that use the library are not touched by it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rlcli.errors import ConfigError, Problem

NO_FILE = "none"
"""What RLCLI_SETTINGS says to leave every settings file alone."""


def settings_file() -> Path | None:
    """The file that would be read, whether it is there or not; None where RLCLI_SETTINGS is `none`."""
    named = os.environ.get("RLCLI_SETTINGS", "").strip()
    if named:
        return None if named == NO_FILE else Path(named).expanduser()
    import platformdirs

    return Path(platformdirs.user_config_dir("rlcli", appauthor=False, roaming=True)) / "settings.yaml"


def read_settings() -> dict[str, Any]:
    """What the file sets, by key; nothing if there is no file.

    Raises:
        ConfigError: with every mistake, at its line and column; also if RLCLI_SETTINGS names a file that is not there.
    """
    file = settings_file()
    if file is None or (not os.path.lexists(file) and not os.environ.get("RLCLI_SETTINGS")):
        return {}
    from pydantic import ValidationError

    from rlcli.config import messages
    from rlcli.config.layers import marked, read
    from rlcli.config.preferences import UserSettings

    hint = "mend it, or RLCLI_SETTINGS=none leaves it out"
    try:
        document = read(file)
    except ConfigError as error:
        raise ConfigError(Problem(p.where, p.path, p.message, hint) for p in error.problems) from None
    origin = marked(document, str(file), "settings")
    try:
        return UserSettings.model_validate(document.data).model_dump(exclude_unset=True)
    except ValidationError as error:
        found = messages.problems(error, UserSettings, document.data, lambda path: origin(path).where)
        raise ConfigError(found) from None


_applied: Mapping[str, Any] = {}


@contextmanager
def applied(settings: Mapping[str, Any]) -> Iterator[None]:
    """Let `setting` answer from these."""
    global _applied
    before, _applied = _applied, settings
    try:
        yield
    finally:
        _applied = before


def setting(key: str) -> Any:
    """What the user prefers; None where nothing is said, and outside of the command line."""
    return _applied.get(key)
