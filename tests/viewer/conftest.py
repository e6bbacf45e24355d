"""Fixture of a trained cartpole."""

import os
import subprocess
import sys

import pytest
from support.command_line import cli, empty_folder, weights


@pytest.fixture(scope="session")
def cartpole_run(tmp_path_factory):
    """Folder of a run whose policy balances the pole, with its earlier checkpoints."""
    runs = tmp_path_factory.mktemp("runs")
    words = ["train", "cartpole", "--runs-dir", str(runs), "--logger", "none", "-q", "agent.save_interval=10"]
    variables = {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    subprocess.run([sys.executable, "-m", "rlcli", *words], check=True, env=variables, stdout=subprocess.DEVNULL)
    (folder,) = runs.glob("*/*")
    return folder
