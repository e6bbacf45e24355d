"""Replacement for the library `toml`, with which packages of Isaac Lab tasks read their version."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any


def load(file: Any) -> dict[str, Any]:
    """Return the content of a TOML file, given by its path."""
    return tomllib.loads(Path(file).read_text(encoding="utf-8"))


loads = tomllib.loads
