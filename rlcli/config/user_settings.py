"""Reader of the user's settings file, which has defaults for the command line.

A mistake in the file is reported with its line and column.
"""

import os
from typing import Any

from rlcli.errors import ConfigError, Problem
from rlcli.settings import settings_file


def read_settings() -> dict[str, Any]:
    """Return the user's settings by key; an empty mapping if there is no settings file.

    Raises:
        ConfigError: with every mistake, its line and column; also if the file that RLCLI_SETTINGS names does not exist.
    """
    file = settings_file()
    if file is None or (not os.path.lexists(file) and not os.environ.get("RLCLI_SETTINGS")):
        return {}
    from pydantic import ValidationError

    from rlcli.config import messages
    from rlcli.config.layers import document_origins, read
    from rlcli.config.user_settings_schema import UserSettings

    hint = "correct the file, or set RLCLI_SETTINGS=none to ignore it"
    try:
        document = read(file)
    except ConfigError as error:
        raise ConfigError(Problem(p.where, p.path, p.message, hint) for p in error.problems) from None
    origin = document_origins(document, str(file), "settings")
    try:
        return UserSettings.model_validate(document.data).model_dump(exclude_unset=True)
    except ValidationError as error:
        found = messages.problems(error, UserSettings, document.data, lambda path: origin(path).where)
        raise ConfigError(found) from None
