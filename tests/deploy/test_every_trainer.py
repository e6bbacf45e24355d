"""Policies of all trainers and algorithms: exported in all formats without the simulator, and verified."""

import json
import subprocess
import sys

import pytest

from rlcli.cli.app import main
from rlcli.deploy.export import FORMATS
from rlcli.registry import OWN, TRAINERS, catalog
from rlcli.rl.sb3.config import SPEC

OFF_POLICY = (
    "agents:\n  tried: {trainer: sb3, algorithm: NAME, max_iterations: 3, train_freq: 4, learning_starts: 64,"
    " gradient_steps: 1, batch_size: 32, buffer_size: 1000, torch_threads: 1, policy: {hidden: [8]}}\n"
)
ON_POLICY = (
    "agents:\n  tried: {trainer: sb3, algorithm: NAME, max_iterations: 2, n_steps: 4, torch_threads: 1,"
    " normalize_observations: true, policy: {hidden: [8]}}\n"
)
SB3 = ["ppo", "a2c", "sac", "td3", "ddpg"]
OTHERS = {
    "ppo": ("cartpole", "ppo", []),
    "ppo with a memory": ("cartpole", "ppo", ["agent.rnn={hidden: 8, layers: 2}"]),
    "rsl-rl": ("cartpole", "rsl-rl", []),
    "rsl-rl with a memory": (
        "cartpole",
        "rsl-rl",
        ["agent.policy.class_name=ActorCriticRecurrent", "agent.policy.rnn_hidden_dim=8"],
    ),
    "rl-games": ("cartpole-direct", "rl-games", ["agent.params.config.minibatch_size=64"]),
    "rl-games sac": ("ant-direct", "rl-games-sac", ["agent.params.config.batch_size=32"]),
    "ant": ("ant-direct", "sb3-ppo", []),
}
BLOCKED = ["mujoco", "gymnasium", "stable_baselines3", "rsl_rl", "rl_games", "rlcli_tasks", "rlcli_rsl_rl"]
EXPORT = """
import importlib.abc, sys
class Blocker(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {blocked!r}:
            raise ModuleNotFoundError(f"No module named '{{name}}'", name=name)
sys.meta_path.insert(0, Blocker())
from rlcli.cli.app import main
for format_, output in zip(sys.argv[2::2], sys.argv[3::2]):
    code = main(["export", "--checkpoint", sys.argv[1], "--format", format_, "--output", output, "-q"])
    if code:
        sys.exit(code)
"""


def test_all_sb3_algorithms_are_covered():
    assert {*SB3} == {*SPEC.algorithms}


def test_every_built_in_trainer_is_covered():
    built_in = {entry.name for entry in catalog(TRAINERS)[0] if entry.distribution == OWN}
    assert built_in <= {"sb3", *OTHERS}


@pytest.mark.slow
@pytest.mark.parametrize("label", [*(f"sb3 {name}" for name in SB3), *OTHERS])
def test_policy_exports_in_all_formats_and_verifies(tmp_path, capfd, label):
    if label in OTHERS:
        task, agent, overrides = OTHERS[label]
        chosen = [*overrides, "--agent", agent]
    else:
        name = label.removeprefix("sb3 ")
        file = tmp_path / "agent.yaml"
        file.write_text((ON_POLICY if name in ("ppo", "a2c") else OFF_POLICY).replace("NAME", name))
        task, chosen = "cartpole", ["--config", str(file), "--agent", "tried"]
    asked = [
        "--num-envs",
        "32",
        "--max-iterations",
        "3",
        "--logger",
        "none",
        "-q",
        "--runs-dir",
        str(tmp_path / "runs"),
    ]
    assert main(["train", task, *chosen, *asked]) == 0, capfd.readouterr().err
    (run,) = (tmp_path / "runs" / task).iterdir()
    files = [part for f, suffix in FORMATS.items() for part in (f, str(tmp_path / f"policy{suffix}"))]
    command = [sys.executable, "-B", "-c", EXPORT.format(blocked=BLOCKED), str(run), *files]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stderr
    capfd.readouterr()
    output = str(tmp_path / "verified" / "policy.py")
    asked = ["--format", "numpy", "--output", output, "--verify", "--episodes", "16", "--json", "-q"]
    code = main(["export", "--checkpoint", str(run), *asked])
    verified = json.loads(capfd.readouterr().out)["verified"]
    assert code == 0, verified
    assert verified["closed_by_task"] == []


@pytest.mark.parametrize(
    ("task", "chosen", "says"),
    [
        ("cartpole", ["--agent", "sb3-ppo", "agent.algorithm=dqn"], "dqn"),
        ("cartpole", ["--agent", "ppo", "agent.rnn={type: gru}"], "gru"),
        ("cartpole", ["--agent", "rsl-rl", "agent.policy.rnn_type=gru"], "gru"),
    ],
)
def test_unexportable_policy_is_rejected_before_training(tmp_path, capfd, task, chosen, says):
    assert main(["train", task, *chosen, "--runs-dir", str(tmp_path)]) in (2, 3)
    assert says in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []
