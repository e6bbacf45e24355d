"""Playback of a policy during its training."""

import logging
import os
import signal
import subprocess
import sys
import time

import pytest
import torch

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli.rl.action_functions import zero_policy
from rlcli.runs.run import open_run
from rlcli.viewer.checkpoints import RunCheckpoints
from rlcli.viewer.playback import Playback

WORDS = ["train", "cartpole", "--logger", "none", "-q", "--max-iterations", "5000", "scene.num_envs=4"]
WORDS += ["sim.engine_threads=1", "agent.torch_threads=1", "agent.save_interval=1"]


@pytest.mark.slow
def test_playback_follows_checkpoints_of_running_training(tmp_path, caplog):
    torch.set_num_threads(1)
    variables = {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    command = [sys.executable, "-m", "rlcli", *WORDS, "--runs-dir", str(tmp_path)]
    training = subprocess.Popen(command, env=variables, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        end = time.monotonic() + 240
        while not list(tmp_path.glob("*/*/checkpoints/*/manifest.json")):
            assert time.monotonic() < end
            time.sleep(0.1)
        (folder,) = tmp_path.glob("*/*")
        env = make_env(resolve(find_task("cartpole"), overrides=["scene.num_envs=2", "sim.engine_threads=1"]))
        caplog.set_level(logging.INFO, "rlcli.viewer")
        playback = Playback(env, zero_policy(env), RunCheckpoints(open_run(folder), env), None, max_advance_s=60.0)
        playback.set_follow(True)
        played = set()
        while len(played) < 4:
            assert time.monotonic() < end, caplog.messages
            assert training.poll() is None
            playback.refresh_checkpoints()
            playback.advance(0.05)
            played.add(playback.view.checkpoint)
        steps = playback.steps
        assert steps > 0
        assert all(message.startswith("now playing step ") for message in caplog.messages)
    finally:
        training.send_signal(signal.SIGINT)
        training.wait(timeout=240)
