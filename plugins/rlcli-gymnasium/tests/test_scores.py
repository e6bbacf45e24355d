"""Comparison with the scores of rl-zoo3: the reward of v3, and the table."""

import json
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from test_parity import begin, ours

BENCHMARKS = Path(__file__).parents[3] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import gym_scores  # noqa: E402

V4 = {
    "gym-ant": "Ant-v4",
    "gym-half-cheetah": "HalfCheetah-v4",
    "gym-hopper": "Hopper-v4",
    "gym-swimmer": "Swimmer-v4",
    "gym-walker2d": "Walker2d-v4",
}
"""Gymnasium no longer has v3; v4 has the same rewards with MuJoCo's own bindings."""


@pytest.mark.filterwarnings("ignore:.*out of date")
@pytest.mark.parametrize("task", V4)
def test_v3_return_equals_older_gymnasium_task(task):
    env = ours(task, *gym_scores.V3_OVERRIDES.get(task, []))
    theirs = gymnasium.make(V4[task])
    env.reset()
    begin(theirs, env, 0)
    rng = np.random.default_rng(5)
    paid, failed = [0.0, 0.0], False
    for _ in range(200):
        action = rng.uniform(-1.0, 1.0, theirs.action_space.shape).astype(np.float32)
        result = env.step(torch.from_numpy(np.tile(action, (4, 1))))
        _, reward, failed, _, _ = theirs.step(action)
        paid[0] += float(env.task.reward[0])
        paid[1] += float(reward)
        assert bool(result.terminated[0]) == failed
        if failed:
            paid[0] += gym_scores.V3_FAILURE_PAYS[task]
            break
    assert paid[0] == pytest.approx(paid[1], abs=1e-6)
    assert failed or task not in ("gym-hopper", "gym-walker2d")


def test_run_with_other_overrides_has_another_name():
    settings = [[], ["agent.gamma=0.98"], ["agent.gamma=0.99"], ["agent.gamma=0.99", "agent.lam=0.9"]]
    assert len({gym_scores.run_name(1, "", overrides) for overrides in settings}) == len(settings)
    assert gym_scores.run_name(1, "-a", []) == "seed1-a"


def test_table_has_medians_and_reached_goals():
    def row(seed, v3, v5):
        counts = {name: {"mean": mean, "std": 1.0, "low": 0.0, "high": 0.0} for name, mean in (("v3", v3), ("v5", v5))}
        return {"task": "gym-hopper", "seed": seed, "failed": 0.5, "length": 800.0, **counts}

    (entry,) = gym_scores.tabulate([row(1, 2000.0, 1999.5), row(2, 2500.0, 2499.5), row(3, 3000.0, 2999.5)])
    assert entry["v3"] == {"median": 2500.0, "low": 2000.0, "high": 3000.0}
    assert entry["v5"]["median"] == 2499.5
    assert entry["reached"]
    (entry,) = gym_scores.tabulate([row(1, 2000.0, 2000.0), row(2, 2400.0, 2400.0), row(3, 3000.0, 3000.0)])
    assert not entry["reached"]


def test_scores_replace_only_marked_block_of_page(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("above\n<!-- scores -->\nold\n<!-- end scores -->\nbelow\n")
    gym_scores.put(page, "new")
    assert page.read_text() == "above\n<!-- scores -->\nnew\n<!-- end scores -->\nbelow\n"
    page.write_text("no marks\n")
    with pytest.raises(SystemExit):
        gym_scores.put(page, "new")
    assert page.read_text() == "no marks\n"


@pytest.mark.slow
def test_one_command_trains_evaluates_and_writes_scores(tmp_path):
    output = tmp_path / "scores.json"
    command = [
        sys.executable,
        str(BENCHMARKS / "gym_scores.py"),
        "--tasks",
        "gym-hopper",
        "--seeds",
        "1",
        "2",
        "-j",
        "2",
    ]
    command += ["--steps", "1024", "--episodes", "3", "--runs-dir", str(tmp_path / "runs"), "--output", str(output)]
    done = subprocess.run([*command, "agent.num_epochs=1"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("`gym-hopper`") == 3
    document = json.loads(output.read_text())
    assert [run["seed"] for run in document["runs"]] == [1, 2]
    for run in document["runs"]:
        assert run["v3"]["mean"] == pytest.approx(run["v5"]["mean"] + run["failed"])
    again = subprocess.run([*command, "agent.num_epochs=1"], capture_output=True, text=True)
    assert " s\n" not in again.stderr, "what is finished is not trained again"
    assert json.loads(output.read_text())["runs"] == document["runs"]
