"""Fixture with the files of a cartpole task written for Isaac Lab."""

import sys

import pytest
from cartpole_files import write
from support.own_session import own_console, own_state

__all__ = ["own_console", "own_state"]


@pytest.fixture
def package(tmp_path):
    """Return package(name, **files) -> folder. Content for an existing name replaces a file; a new name adds one."""
    known = set(sys.modules)

    def make(name="balance", **files):
        folder = write(tmp_path / name)
        for file, content in files.items():
            (folder / f"{file}.py").write_text(content, encoding="utf-8")
        return folder

    yield make
    for module in set(sys.modules) - known:
        if module.split(".")[0] in ("balance", "other"):
            del sys.modules[module]
    import gymnasium

    gymnasium.registry.pop("Template-Cartpole-v0", None)
