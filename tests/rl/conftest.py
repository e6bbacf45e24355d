"""Environments for the tests of training."""

from pathlib import Path

import pytest
import torch
from scheduled_task import MODEL, TASK, YAML

from rlcli.config.load import resolve
from rlcli.envs.vec_env import make_env
from rlcli.registry import find_task


@pytest.fixture(autouse=True)
def _one_torch_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def scheduled(tmp_path: Path) -> str:
    """A task folder whose episodes end on schedule."""
    folder = tmp_path / "scheduled"
    folder.mkdir()
    for name, text in (("task.yaml", YAML), ("task.py", TASK), ("model.xml", MODEL)):
        (folder / name).write_text(text)
    return str(folder)


@pytest.fixture
def make():
    """Task and overrides -> (environment, agent configuration)."""

    def build(task: str, *overrides: str, seed: int = 3):
        resolved = resolve(find_task(task), overrides=overrides)
        return make_env(resolved, seed=seed), resolved.agent

    return build
