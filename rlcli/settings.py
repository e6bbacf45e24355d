"""The user's preferences of the command line, for every folder and task; never a part of a task.

They stand in `settings.yaml` in the platform's folder for configurations; `rlcli.config.settings_file` reads that file.
A flag comes before an environment variable, that before this file, and the file before the default. Programs that use
the library are not affected by it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NO_FILE = "none"
"""What RLCLI_SETTINGS says to leave every settings file alone."""


def settings_file() -> Path | None:
    """The file that would be read, whether it is there or not; None where RLCLI_SETTINGS is `none`."""
    named = os.environ.get("RLCLI_SETTINGS", "").strip()
    if named:
        return None if named == NO_FILE else Path(named).expanduser()
    import platformdirs

    return Path(platformdirs.user_config_dir("rlcli", appauthor=False, roaming=True)) / "settings.yaml"


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
