"""Tools of the benchmarks: alternating subprocesses, failing peers, and commands that end at a call."""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

REPOSITORY = Path(__file__).parents[2]
BENCHMARKS = REPOSITORY / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import sides  # noqa: E402
from plain_cartpole import PlainCartpole  # noqa: E402

from rlcli.config.load import resolve  # noqa: E402
from rlcli.envs.make import make_env  # noqa: E402
from rlcli.registry import find_task  # noqa: E402

CHILD = f"""
import sys, time
sys.path.insert(0, {str(BENCHMARKS)!r})
from sides import serve

def double(number):
    print("not an answer")
    return 2 * number

def fail():
    raise ValueError("no such thing")

def sleep():
    time.sleep(60)

def end():
    print("I am leaving", file=sys.stderr)
    raise SystemExit(3)

def start():
    import subprocess
    return subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]).pid

serve({{"double": double, "fail": fail, "sleep": sleep, "end": end, "start": start}})
"""


@pytest.fixture
def child(tmp_path, monkeypatch):
    monkeypatch.setattr(sides, "LOGS", tmp_path)
    script = tmp_path / "child.py"
    script.write_text(CHILD)
    with sides.opened(sides.Side("child", [sys.executable, str(script)])) as (side,):
        yield side


def test_closed_side_ends_its_subprocesses(child):
    started = child("start")
    assert Path(f"/proc/{started}").exists()
    child.close()
    child.close()
    deadline = time.monotonic() + 10
    while running(started) and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not running(started)


def running(process):
    """Return whether a process runs; a zombie process does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_side_returns_results_and_ignores_prints(child):
    assert [child("double", number=n) for n in (1, 2, 3)] == [2, 4, 6]


def test_side_reports_exception_and_continues(child):
    with pytest.raises(sides.Failed, match="ValueError: no such thing"):
        child("fail")
    assert child("double", number=4) == 8


def test_ended_side_is_reported_with_its_output(child):
    with pytest.raises(sides.Failed, match="ended: I am leaving"):
        child("end")


def test_side_is_ended_after_timeout(child):
    assert child("double", number=1) == 2
    with pytest.raises(sides.Failed, match="did not answer sleep within"):
        child("sleep", timeout=0.2)
    with pytest.raises(sides.Failed, match="ended"):
        child("double", number=1)


def test_blocks_alternate():
    order = []

    def block(name, cost):
        def run(steps):
            order.append(name)
            return cost * steps

        return run

    found = sides.alternate({"a": block("a", 1.0), "b": block("b", 2.0)}, {"a": 5, "b": 3}, repeats=3)
    assert order == ["a", "b"] * 3
    assert found == {"a": [1.0] * 3, "b": [2.0] * 3}
    assert sides.ratio(found["b"], found["a"]) == {"ratio": 2.0, "ratio_min": 2.0, "ratio_max": 2.0}


@pytest.mark.parametrize("cost", [1e-6, 0.003, 5.0])
def test_block_length_reaches_requested_time(cost):
    steps = sides.steps_for(lambda n: 1e-5 + cost * n, 1.0)
    assert steps == 1 if cost > 1 else 0.8 < steps * cost < 1.2


def test_command_ends_after_first_call_of_method(tmp_path):
    (tmp_path / "library.py").write_text(
        "print('loaded')\nclass Thing:\n    def work(self, n):\n        print('working', n, flush=True)\n"
    )
    (tmp_path / "command.py").write_text(
        "import sys\n\ndef main():\n    print(sys.argv[1:], flush=True)\n    from library import Thing\n"
        "    for n in range(int(sys.argv[1])):\n        Thing().work(n)\n"
    )

    def run(times):
        program = [sys.executable, str(BENCHMARKS / "first_call.py"), "library:Thing.work", "command:main", times]
        environment = {**sides.child_environment(), "PYTHONPATH": str(tmp_path)}
        return subprocess.run(program, capture_output=True, text=True, env=environment)

    done = run("3")
    assert done.returncode == 0
    assert done.stdout.splitlines() == ["['3']", "loaded", "working 0"]
    done = run("0")
    assert done.returncode != 0
    assert "library:Thing.work was not called" in done.stderr


def test_failed_command_is_reported_with_message():
    with pytest.raises(sides.Failed, match="exit 1: SystemError: broken"):
        sides.wall([sys.executable, "-c", "raise SystemError('broken')"])


def test_plain_cartpole_equals_task():
    env = make_env(resolve(find_task("cartpole"), flags={"scene.num_envs": 4}), seed=0)
    env.reset(seed=0)
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    plain = [PlainCartpole() for _ in range(env.num_envs)]

    def begin(world):
        plain[world].reset()
        plain[world].data.qpos[:], plain[world].data.qvel[:] = qpos[world].numpy(), qvel[world].numpy()

    for world in range(env.num_envs):
        begin(world)
    rng, ended = np.random.default_rng(0), {"terminated": 0, "truncated": 0}
    for step in range(700):
        push = 1.0 if step < 150 else 0.0  # out of bounds at first, then to the end of their time
        action = rng.uniform(-1.0, 1.0, (env.num_envs, 1)).astype(np.float32) + np.float32(push)
        result = env.step(torch.from_numpy(action))
        for world, each in enumerate(plain):
            obs, reward, terminated, truncated, _ = each.step(action[world])
            assert (terminated, truncated) == (bool(result.terminated[world]), bool(result.truncated[world]))
            seen = result.final_obs if terminated or truncated else result.obs
            np.testing.assert_allclose(seen["policy"][world].numpy(), obs, rtol=0, atol=1e-5)
            np.testing.assert_allclose(float(result.reward[world]), reward, rtol=0, atol=1e-5)
            if terminated or truncated:
                ended["terminated"] += terminated
                ended["truncated"] += truncated
                begin(world)
    assert min(ended.values()) > 0
