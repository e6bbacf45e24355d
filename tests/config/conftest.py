"""Fixtures: a small task in a folder, and the problems of its configuration."""

import textwrap

import pytest
from support.small_task import MODEL, TASK

from rlcli.config.load import resolve
from rlcli.errors import ConfigError
from rlcli.registry import folder_task


@pytest.fixture
def task(tmp_path):
    """task(yaml, terms.py=..., ...) -> the source of a new task folder."""

    def make(text=TASK, **files):
        folder = tmp_path / "small"
        folder.mkdir(exist_ok=True)
        (folder / "task.yaml").write_text(text, encoding="utf-8")
        (folder / "model.xml").write_text(MODEL)
        for name, content in files.items():
            (folder / f"{name}.py").write_text(textwrap.dedent(content))
        return folder_task(folder)

    return make


@pytest.fixture
def problems_of(task):
    """problems_of(yaml, overrides...) -> the problems of the configuration, as text."""

    def find(text, *overrides, files=None, **options):
        with pytest.raises(ConfigError) as caught:
            resolve(task(text, **(files or {})), overrides=overrides, **options)
        return [str(problem) for problem in caught.value.problems]

    return find
