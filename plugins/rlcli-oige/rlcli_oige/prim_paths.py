"""Paths of USD prims (objects of a scene), and the expressions by which views select prims."""

from __future__ import annotations

import re

from rlcli.errors import TaskError

BASE = "/World/envs"
ZERO = f"{BASE}/env_0"


def path_pattern(expression: str) -> re.Pattern[str]:
    """Return a view's `prim_paths_expr` as a regular expression. `.*` and `*` match within one part of the path.

    Raises:
        TaskError: if the text is not a regular expression.
    """
    steps = str(expression).rstrip("/").split("/")
    steps = ["[^/]*" if step == "*" else step.replace(".*", "[^/]*") for step in steps]
    try:
        return re.compile("/".join(steps))
    except re.error as error:
        raise TaskError(
            f"'{expression}' is not a valid regular expression of prim paths; correct it: {error}"
        ) from None
