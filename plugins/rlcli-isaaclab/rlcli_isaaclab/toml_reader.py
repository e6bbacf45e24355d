"""The function `load` of the package `toml`, with which packages of Isaac Lab read their version."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any


def load(file: Any) -> dict[str, Any]:
    """Read a TOML file."""
    return tomllib.loads(Path(file).read_text(encoding="utf-8"))


loads = tomllib.loads
