"""Access to the user's settings of the command line, which apply in all folders and are never part of a task.

The file `settings.yaml` is in the platform's folder for user configuration; `rlcli.config.user_settings` reads the
file. Precedence: flag, environment variable, settings file, default. Programs that import the library ignore the file.
"""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NO_FILE = "none"
"""Value of the environment variable RLCLI_SETTINGS that means: read no settings file."""


def settings_file() -> Path | None:
    """Return the path of the settings file, which may not exist; None if RLCLI_SETTINGS is `none`."""
    named = os.environ.get("RLCLI_SETTINGS", "").strip()
    if named:
        return None if named == NO_FILE else Path(os.path.expanduser(named))
    import platformdirs

    return Path(platformdirs.user_config_dir("rlcli", appauthor=False, roaming=True)) / "settings.yaml"


_current: Mapping[str, Any] = {}
"""Key -> value of the settings in use."""


@contextmanager
def use_settings(settings: Mapping[str, Any]) -> Iterator[None]:
    """Make `setting` return the values of `settings` (key -> value) inside a `with` block."""
    global _current
    before, _current = _current, settings
    try:
        yield
    finally:
        _current = before


def setting(key: str) -> Any:
    """Return a setting of the user; None if the settings file does not have the key, or rlcli is used as a library."""
    return _current.get(key)
