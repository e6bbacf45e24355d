"""Environments in several processes: the same bits as in one, and clear errors."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
import torch
from support.sharded_runs import both, differences, same, step_differences

from rlcli.config.load import resolve
from rlcli.envs.observers import StepObserver
from rlcli.envs.shard_range import split
from rlcli.envs.sharding import worker_pool
from rlcli.envs.sharding.env import ShardedEnv
from rlcli.envs.sharding.state import join_states, split_state
from rlcli.envs.sharding.training_env import make_training_env
from rlcli.envs.sharding.worker_count import number_of_workers
from rlcli.errors import ConfigError, DivergedError, MachineError, TaskError
from rlcli.registry import find_task

pytestmark = pytest.mark.processes
TASKS = [
    *("ant", "ant-direct", "ball-balance", "biped-velocity", "cart-double-pendulum", "cartpole", "cartpole-direct"),
    *("crazyflie", "hand-reorient", "humanoid", "humanoid-direct", "ingenuity", "lift-cube", "open-drawer"),
    *("quadcopter", "quadruped-flat", "quadruped-rough", "reach", "reach-ik"),
]
TASK = """
summary: A cart with noise, delays, a terrain curriculum, timers of all environments and pushes.
decimation: 2
episode_length_s: 0.3
sim: {dt: 0.01, engine_threads: 2}
scene:
  num_envs: 9
  terrain:
    kind: generator
    patch: [2.0, 2.0]
    rows: 3
    columns: 2
    resolution: 0.5
    sub_terrains: {flat: {kind: flat}}
  entities: {robot: {model: model.xml}}
actions: {push: {func: joint_effort, joints: [slide], scale: 30.0}}
observations:
  policy:
    pos: {func: joint_pos_rel, noise: {kind: uniform, low: -0.1, high: 0.1}, delay: {steps: [0, 3], redraw: 0.3}}
    vel: {func: joint_vel_rel, history: 3}
events:
  mass: {func: randomize_body_mass, mode: startup, bodies: [block], range: [0.5, 2.0]}
  start: {func: reset_joints_by_offset, mode: reset, position: [-1.0, 1.0], velocity: [-1.0, 1.0]}
  damp: {func: randomize_joint_damping, mode: interval, interval_range_s: [0.03, 0.08], operation: set,
         range: [0.0, 5.0]}
  gust: {func: randomize_joint_damping, mode: interval, interval_range_s: [0.05, 0.2], operation: set,
         range: [1.0, 9.0], global_time: true}
rewards: {alive: {func: is_alive, weight: 1.0}, own: {func: own_reward, weight: 0.5}}
terminations:
  time_out: {func: time_out, time_out: true}
  far: {func: too_far, limit: 1.0}
curriculum: {weight: {func: interpolate, address: rewards.alive.weight, to: 0.5, end: 40}}
success:
  near: {func: joint_error, joints: [slide], at_most: 0.5}
  right: {func: joint_error, joints: [slide], target: 0.2, at_most: 0.5, hold_s: 0.2}
"""
TERMS = """
import torch
from torch import Tensor
from rlcli.envs.managed import ManagedEnv
from rlcli.task import Entity


def own_reward(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    '''Negative squared position. (num_envs,)'''
    return -entity.data.joint_pos[:, 0].square()


def too_far(env: ManagedEnv, *, entity: Entity = "robot", limit: float) -> Tensor:
    '''Position beyond the limit. (num_envs,) bool'''
    return entity.data.joint_pos[:, 0].abs() > limit
"""
MODEL = """
<mujoco><worldbody><body name="block">
  <joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="1" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    (folder / "task.yaml").write_text(TASK)
    (folder / "terms.py").write_text(TERMS)
    (folder / "model.xml").write_text(MODEL)
    return str(folder)


def resolved(name, *overrides):
    return resolve(find_task(name), overrides=overrides)


@pytest.mark.parametrize(("total", "shards"), [(7, 1), (7, 3), (8, 4), (4096, 16), (9, 2)])
def test_split_covers_all_envs_with_two_sizes(total, shards):
    found = split(total, shards)
    assert [shard.first for shard in found] == [sum(s.count for s in found[:n]) for n in range(shards)]
    assert sum(shard.count for shard in found) == total
    assert shards == 1 or found[0].count < found[-1].count
    assert max(s.count for s in found) - min(s.count for s in found) <= 2


def test_split_refuses_shards_of_one():
    with pytest.raises(ValueError, match="5 environments are too few for 3 workers"):
        split(5, 3)


def test_state_is_split_and_joined_by_shape():
    shards = split(6, 2)
    state = {"rows": torch.arange(12).view(6, 2), "terms": torch.arange(18).view(3, 6), "global": torch.ones(2)}
    parts = [{"rows": (s.count, 2), "terms": (3, s.count), "global": (2,)} for s in shards]
    present = {name: [torch.Size(part[name]) for part in parts] for name in state}
    assert same(join_states(split_state(state, present, shards)), state)


def test_own_task_with_terrain_noise_and_timers_has_bits_of_one_process(folder):
    found, ended = differences(resolved(folder), workers=3, steps=80)
    assert found == []
    assert ended > 20


@pytest.mark.parametrize("task", ["hand-reorient", "quadruped-rough"])
def test_built_in_task_has_bits_of_one_process(task):
    found, _ = differences(resolved(task, "scene.num_envs=7", "episode_length_s=0.4"), workers=2, steps=50)
    assert found == []


@pytest.mark.slow
@pytest.mark.parametrize("workers", [2, 3, 8])
@pytest.mark.parametrize("task", TASKS)
def test_every_built_in_task_has_bits_of_one_process(task, workers):
    length = "episode_length_s=0.9"
    found, ended = differences(resolved(task, "scene.num_envs=19", length), workers, steps=200)
    assert found == []
    assert ended > 19


def test_loaded_state_continues_with_other_numbers_of_workers(folder):
    with both(resolved(folder), 3) as (alone, sharded):
        alone.reset(seed=1)
        action = torch.ones(9, 1)
        for _ in range(20):
            alone.step(action)
        state = alone.state_dict()
        assert same(sharded.load_state_dict(state), alone.load_state_dict(state))
        assert same(sharded.state_dict(), state)
        assert step_differences(alone.step(action), sharded.step(action)) == []


def test_lengths_written_by_a_trainer_reach_all_workers(folder):
    with both(resolved(folder), 2) as (alone, sharded):
        for env in (alone, sharded):
            env.reset(seed=1)
            env.episode_length_buf.copy_(torch.arange(9) + 5)
        for _ in range(12):
            assert step_differences(alone.step(torch.zeros(9, 1)), sharded.step(torch.zeros(9, 1))) == []


class Recorder(StepObserver):
    """Observer that copies what it is given, and reads the engine during the step."""

    def __init__(self, env):
        self.env, self.seen = env, []

    def after_physics(self):
        self.seen.append(self.env.engine.field("qpos").clone())

    def on_step(self, record):
        ids = [] if record.episodes is None else record.episodes.ids.tolist()
        tensors = (*record.obs.values(), record.action, record.reward, record.reward_terms)
        self.seen.append([tensor.clone() for tensor in tensors])
        self.seen.append(ids)
        self.seen += [torch.from_numpy(self.env.engine.state_row(number)) for number in ids]
        self.seen += [self.env.engine.recorded_calls(number)[-1].state.tolist() for number in ids]


def test_observers_see_steps_of_one_process(folder):
    with both(resolved(folder), 3) as (alone, sharded):
        recorders = [Recorder(alone), Recorder(sharded)]
        for env, recorder in zip((alone, sharded), recorders, strict=True):
            env.observers.add(recorder)
            env.reset(seed=2)
            for _ in range(30):
                env.step(torch.ones(9, 1))
        one, several = (recorder.seen for recorder in recorders)
        assert len(one) == len(several)
        for a, b in zip(one, several, strict=True):
            assert len(a) == len(b)
            assert all(same(x, y) for x, y in zip(a, b, strict=True))
        assert any(isinstance(part, list) and part and isinstance(part[0], int) for part in one)


def test_bad_action_is_refused_before_any_process_steps(folder):
    with both(resolved(folder), 2) as (_, sharded):
        sharded.reset(seed=1)
        bad = torch.zeros(9, 1)
        bad[7] = torch.nan
        with pytest.raises(DivergedError, match="action is not finite in 1 of 9 environments, first in environment 7"):
            sharded.step(bad)
        assert sharded.step(torch.zeros(9, 1)).reward.isfinite().all()
        with pytest.raises(ValueError, match=r"shape \(9, 2\); pass shape \(9, 1\)"):
            sharded.step(torch.zeros(9, 2))


def test_error_of_a_worker_is_raised_and_ends_the_environment(folder):
    with both(resolved(folder), 2) as (_, sharded):
        sharded.reset(seed=1)
        sharded.call_all(_break_reward)
        with pytest.raises(DivergedError, match=r"reward .* of the environments 0 to 3, first in environment 0"):
            sharded.step(torch.zeros(9, 1))
        with pytest.raises(RuntimeError, match="a step was interrupted"):
            sharded.step(torch.zeros(9, 1))


def _break_reward(env):
    env.reward_manager.compute = _nan_reward.__get__(env.reward_manager)


def _nan_reward(manager, diverged, terminated):
    return torch.full_like(terminated, torch.nan, dtype=torch.float32)


def _steps(env, count):
    for _ in range(count):
        env.step(torch.zeros(9, 1))


def test_killed_worker_is_one_error(folder):
    env = ShardedEnv(resolved(folder), workers=3)
    env.reset(seed=1)
    first, second = env._workers
    os.kill(second.pid, signal.SIGKILL)
    with pytest.raises(MachineError, match=r"worker process 2 .* was ended by SIGKILL") as caught:
        _steps(env, 3)
    assert "scene.workers" in caught.value.hint
    env.close()
    assert first.has_ended()


def test_wrong_model_is_one_configuration_error(folder):
    with pytest.raises(ConfigError, match=r"no joint .*'nowhere'"):
        ShardedEnv(resolved(folder, "actions.push.joints=[nowhere]"), workers=2)


def test_workers_import_no_file_of_the_current_folder(folder, tmp_path):
    for name in ("json", "numpy", "torch", "rlcli", "signal"):
        (tmp_path / f"{name}.py").write_text("open('executed', 'w').close(); raise SystemExit('executed')")
    code = (
        "import sys; sys.path.remove('') if '' in sys.path else None\n"
        "from rlcli.config.load import resolve\nfrom rlcli.registry import find_task\n"
        "from rlcli.envs.sharding.env import ShardedEnv\n"
        f"env = ShardedEnv(resolve(find_task({folder!r})), workers=2)\n"
        "env.reset(seed=1); print(env.workers); env.close()"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.stdout == "2\n", done.stderr
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    ("task", "overrides", "cores", "expected"),
    [
        ("cartpole", ["scene.num_envs=1024"], 1, 1),
        ("cartpole", ["scene.num_envs=1024"], 16, 1),
        ("cartpole", ["scene.num_envs=2048"], 16, 4),
        ("cartpole", ["scene.num_envs=4096"], 2, 1),
        ("quadruped-flat", [], 8, 4),
        ("quadruped-flat", [], 16, 8),
        ("quadruped-flat", ["scene.workers=3"], 16, 3),
        ("cartpole-camera", ["scene.num_envs=4096"], 16, 1),
        ("cartpole", ["scene.num_envs=100"], 16, 1),
    ],
)
def test_number_of_workers(task, overrides, cores, expected):
    found = number_of_workers(resolved(task, f"sim.engine_threads={cores}", *overrides), "cpu")
    assert found == expected


def test_training_beside_others_gets_one_worker(monkeypatch):
    monkeypatch.setenv("RLCLI_ONE_WORKER", "1")
    assert number_of_workers(resolved("quadruped-flat", "sim.engine_threads=8"), "cpu") == 1


def test_own_code_gets_several_workers_only_if_they_are_set(folder):
    many = ["scene.num_envs=4096", "sim.engine_threads=8"]
    assert number_of_workers(resolved(folder, *many), "cpu") == 1
    assert number_of_workers(resolved(folder, *many, "scene.workers=2"), "cpu") == 2


@pytest.mark.parametrize(
    ("overrides", "device", "message"),
    [
        (["scene.workers=5", "scene.num_envs=9"], "cpu", "9 environments are too few"),
        (["scene.workers=2"], "cuda", "a GPU steps all environments at once"),
    ],
)
def test_impossible_number_of_workers_is_a_configuration_error(folder, overrides, device, message):
    with pytest.raises(ConfigError, match=message):
        make_training_env(resolved(folder, *overrides), seed=1, device=device)


def test_error_in_a_call_leaves_no_reply_unread(folder):
    with both(resolved(folder), 2) as (alone, sharded):
        for env in (alone, sharded):
            env.reset(seed=1)
            with pytest.raises(ValueError, match="'nothing' is not an MjData field"):
                env.engine.field("nothing")
        assert same(alone.engine.field("qpos"), sharded.engine.field("qpos"))


def test_random_numbers_of_a_global_generator_are_refused_while_the_task_is_built(tmp_path):
    (tmp_path / "task.yaml").write_text(TASK)
    (tmp_path / "model.xml").write_text(MODEL)
    (tmp_path / "terms.py").write_text(TERMS + "\nSIZE = torch.rand(1)\n")
    with pytest.raises(TaskError, match="global random generator of torch"):
        ShardedEnv(resolved(str(tmp_path)), workers=2)


def test_state_of_all_environments_that_differs_is_refused(folder):
    with both(resolved(folder), 2) as (_, sharded):
        sharded.reset(seed=1)
        sharded.state_dict()
        sharded.call_one(8, _count_a_step)
        with pytest.raises(TaskError, match=r"common_step.* differs between the worker processes"):
            sharded.state_dict()


def _count_a_step(env, row):
    env._counters.common_step += 1


@pytest.fixture
def three():
    env = ShardedEnv(resolve(find_task("cartpole"), overrides=["scene.num_envs=6"]), workers=3)
    yield env
    env.close()


def test_worker_that_does_not_answer_is_named_once(three, monkeypatch, caplog):
    monkeypatch.setattr(worker_pool, "_SILENT_S", 0.3)
    pid = [process.pid for process in three._workers][1]
    for _ in range(2):
        os.kill(pid, signal.SIGSTOP)
        threading.Timer(1.0, os.kill, (pid, signal.SIGCONT)).start()
        three.step(torch.zeros(6, 1))
    (message,) = [record.getMessage() for record in caplog.records if "has not answered" in record.getMessage()]
    assert f"worker process 2 of the environment (pid {pid}) has not answered for 0.3 s" in message
    assert f"kill -CONT {pid}" in message


def test_stopped_workers_end_with_the_environment(three):
    pids = [process.pid for process in three._workers]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    begin = time.monotonic()
    three.close()
    assert time.monotonic() - begin < 4
    assert not any(os.path.exists(f"/proc/{pid}") for pid in pids)


@pytest.mark.parametrize("call", ["step", "state"])
def test_signal_ends_the_wait_for_stopped_workers_at_once(three, call):
    for process in three._workers:
        os.kill(process.pid, signal.SIGSTOP)
    previous = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.setitimer(signal.ITIMER_REAL, 1.0)
    try:
        with pytest.raises(KeyboardInterrupt):
            three.step(torch.zeros(6, 1)) if call == "step" else three.state_dict()
    finally:
        signal.signal(signal.SIGALRM, previous)
    with pytest.raises(RuntimeError, match="interrupted"):
        three.state_dict()
