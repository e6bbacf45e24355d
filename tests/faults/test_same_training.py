"""Two trainings with one seed: the same metrics, weights, optimisers, replay rows and environments, bit for bit."""

import random
from itertools import product

import numpy as np
import pytest
import torch
from fault_sizes import amount, chosen
from same_bits import TASKS, other_work, place_of

from rlcli.config.load import resolve
from rlcli.envs.vec_env import make_env
from rlcli.registry import find_task, load_object

OFF_POLICY = "train_freq: 4, gradient_steps: 3, learning_starts: 24, batch_size: 16, buffer_size: 256"
KINDS = {
    "ppo": "trainer: ppo, algorithm: ppo, num_steps: 8, num_minibatches: 2",
    "sb3-ppo": "trainer: sb3, algorithm: ppo, n_steps: 8, num_minibatches: 2",
    "a2c": "trainer: sb3, algorithm: a2c",
    "sac": f"trainer: sb3, algorithm: sac, {OFF_POLICY}",
    "td3": f"trainer: sb3, algorithm: td3, {OFF_POLICY}",
    "ddpg": f"trainer: sb3, algorithm: ddpg, {OFF_POLICY}",
}
BUILT_IN = [("cartpole", "sb3-ppo"), ("cartpole", "ppo"), ("cartpole-direct", "sb3-ppo"), ("cartpole-direct", "ppo"),
            ("ant-direct", "sb3-ppo")]  # fmt: skip
CLOCK = "Perf/"


@pytest.fixture(autouse=True)
def _torch_threads():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def train(resolved, *, seed=3, threads=1, iterations=4):
    """What some iterations leave: metrics of each, and every tensor, number and row of the state."""
    env = make_env(resolved, seed=seed)
    trainer = load_object(resolved.trainer.trainer)(env, resolved.agent, seed=seed, device="cpu", torch_threads=threads)
    trainer.start()
    metrics = []
    for _ in range(iterations):
        found = trainer.iterate().metrics
        metrics.append({name: value for name, value in found.items() if not name.startswith(CLOCK)})
    state = trainer.state()
    tensors = {f"{part}/{name}": v.clone() for part, named in state.tensors.items() for name, v in named.items()}
    for name, rows in state.logs.items():
        tensors |= {f"{name}/{column}": v.clone() for column, v in rows.read(rows.first, rows.stop).items()}
    return repr(metrics), tensors, repr(state.values)


def disturb():
    """Leave the process another one: generators, memory, threads."""
    for work in other_work().values():
        work()
    random.seed(1)
    np.random.seed(1)
    return [torch.empty(size) for size in (1, 17, 4097)]  # later tensors lie elsewhere


def require_same(first, second):
    assert first[0] == second[0], "metrics"
    assert first[1].keys() == second[1].keys()
    bits = [{n: v.contiguous().numpy().tobytes() for n, v in tensors.items()} for tensors in (first[1], second[1])]
    assert [name for name in bits[0] if bits[0][name] != bits[1][name]] == []
    assert first[2] == second[2]


def configured(tmp_path, task, kind, extra="", num_envs=6):
    settings = f"{KINDS[kind]}, max_iterations: 20{extra}"
    file = tmp_path / "agent.yaml"
    file.write_text(f"scene: {{num_envs: {num_envs}}}\nepisode_length_s: 0.2\nagents: {{x: {{{settings}}}}}\n")
    return resolve(find_task(str(place_of(task, tmp_path))), agent="x", config_file=file)


@pytest.mark.parametrize(("task", "kind"), chosen(list(product(TASKS, KINDS)), 5))
def test_two_trainings_with_one_seed_are_the_same(task, kind, tmp_path):
    first = train(configured(tmp_path, task, kind))
    kept = disturb()
    second = train(configured(tmp_path, task, kind, extra=", save_interval: 3"))
    require_same(first, second)
    assert train(configured(tmp_path, task, kind), seed=4)[0] != first[0], "the seed matters"
    del kept


@pytest.mark.parametrize(("kind", "threads"), chosen(list(product(["ppo", "sb3-ppo", "sac"], (2, 4))), 1))
def test_several_torch_threads_give_the_same_every_time(kind, threads, tmp_path):
    size = "{hidden: [256, 256]}"
    wide = f", actor: {size}, critic: {size}" if kind == "ppo" else f", policy: {size}"
    resolved = configured(tmp_path, "ant-direct", kind, extra=wide, num_envs=64)
    first = train(resolved, threads=threads, iterations=2)
    for _ in range(amount(1, 2, 10)):
        kept = disturb()
        require_same(first, train(resolved, threads=threads, iterations=2))
        del kept


@pytest.mark.parametrize(("task", "agent"), chosen(BUILT_IN, 2))
def test_the_agents_of_built_in_tasks_train_the_same_twice(task, agent):
    resolved = resolve(find_task(task), agent=agent, overrides=["scene.num_envs=32", "episode_length_s=0.4"])
    first = train(resolved, iterations=3)
    kept = disturb()
    require_same(first, train(resolved, iterations=3))
    del kept


@pytest.mark.parametrize(("kind", "threads"), chosen(list(product(["ppo", "sb3-ppo"], (2, 3, 8))), 1))
def test_engine_threads_change_nothing_in_training(kind, threads, tmp_path):
    one, more = (
        resolve(find_task("ant-direct"), agent="x", config_file=file, overrides=[f"sim.engine_threads={count}"])
        for file, count in ((agent_file(tmp_path, kind), 1), (agent_file(tmp_path, kind), threads))
    )
    require_same(train(one, iterations=3), train(more, iterations=3))


def agent_file(tmp_path, kind):
    file = tmp_path / "agent.yaml"
    file.write_text(f"scene: {{num_envs: 9}}\nagents: {{x: {{{KINDS[kind]}, max_iterations: 20}}}}\n")
    return file
