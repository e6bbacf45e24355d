"""Reader of the user's settings file."""

from __future__ import annotations

import os
from typing import Any

from rlcli.errors import ConfigError, Problem
from rlcli.settings import settings_file


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
    from rlcli.config.settings_schema import UserSettings

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
