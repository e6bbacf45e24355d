"""Two trainings with one seed: the same metrics, weights, optimisers, replay rows and environments, bit for bit."""

import json
import random
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from support.fault_sizes import amount, chosen
from support.same_bits import TASKS, other_work, place_of
from support.worlds import write

import rlcli_tasks
from rlcli.cli.app import main
from rlcli.config import strict_yaml
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
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


def built_in():
    """Return every built-in task with each of its agents whose trainer is built in."""
    names = json.loads(Path(rlcli_tasks.__file__).with_name("index.json").read_text())
    for name in names:
        agents = strict_yaml.load(find_task(name).config.read_bytes()).data["agents"]
        for agent, settings in agents.items():
            if agent != "default" and settings["trainer"] in ("ppo", "sb3"):
                yield name, agent


BUILT_IN = sorted(built_in())
CLOCK = "Perf/"


@pytest.fixture(autouse=True)
def _torch_threads():
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


def train(resolved, *, seed=3, threads=1, iterations=4):
    """Train some iterations; return the metrics of each, and every tensor, number and row of the state."""
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
    """Change the state of the process: generators, memory, threads."""
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
def test_trainings_with_one_seed_are_bit_identical(task, kind, tmp_path):
    first = train(configured(tmp_path, task, kind))
    kept = disturb()
    second = train(configured(tmp_path, task, kind, extra=", save_interval: 3"))
    require_same(first, second)
    assert train(configured(tmp_path, task, kind), seed=4)[0] != first[0], "the seed matters"
    del kept


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "threads"), chosen(list(product(["ppo", "sb3-ppo", "sac"], (2, 4))), 1))
def test_training_with_several_torch_threads_is_repeatable(kind, threads, tmp_path):
    size = "{hidden: [256, 256]}"
    wide = f", actor: {size}, critic: {size}" if kind == "ppo" else f", policy: {size}"
    resolved = configured(tmp_path, "ant-direct", kind, extra=wide, num_envs=64)
    first = train(resolved, threads=threads, iterations=2)
    for _ in range(amount(1, 2, 10)):
        kept = disturb()
        require_same(first, train(resolved, threads=threads, iterations=2))
        del kept


@pytest.mark.parametrize(("task", "agent"), chosen(BUILT_IN, 2))
def test_agents_of_built_in_tasks_train_bit_identical(task, agent):
    resolved = resolve(find_task(task), agent=agent, overrides=["scene.num_envs=32", "episode_length_s=0.4"])
    first = train(resolved, iterations=3)
    kept = disturb()
    require_same(first, train(resolved, iterations=3))
    del kept


@pytest.mark.parametrize(("kind", "threads"), chosen(list(product(["ppo", "sb3-ppo"], (2, 3, 8))), 1))
def test_engine_threads_do_not_change_the_training(kind, threads, tmp_path):
    one, more = (
        resolve(find_task("ant-direct"), agent="x", config_file=file, overrides=[f"sim.engine_threads={count}"])
        for file, count in ((agent_file(tmp_path, kind), 1), (agent_file(tmp_path, kind), threads))
    )
    require_same(train(one, iterations=3), train(more, iterations=3))


def agent_file(tmp_path, kind):
    file = tmp_path / "agent.yaml"
    file.write_text(f"scene: {{num_envs: 9}}\nagents: {{x: {{{KINDS[kind]}, max_iterations: 20}}}}\n")
    return file


GLOBAL_DRAWS = """
import random
import numpy as np
import torch
from rlcli.envs.direct import DirectTask


class Task(DirectTask):
    num_observations = 2
    num_actions = 1

    def post_reset(self):
        self.offset = np.random.uniform() + random.random() + float(torch.rand(1))

    def pre_physics_step(self, actions): ...

    def get_observations(self):
        self.obs_buf[:, 0] = self.offset
        self.obs_buf[:, 1] = torch.rand(self.num_envs)

    def calculate_metrics(self):
        self.rew_buf[:] = np.random.normal() + random.random()

    def is_done(self): ...
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", chosen(["ppo", "sb3-ppo", "sac"], 1))
def test_task_with_global_generators_trains_and_plays_identically(kind, tmp_path, capsys):
    """Use global generators, as tasks of other frameworks do; each process seeds them differently."""
    model = '<mujoco><worldbody><body><joint name="j"/><geom size="0.1"/></body></worldbody></mujoco>'
    yaml = (
        "decimation: 1\nepisode_length_s: 0.1\nsim: {dt: 0.01}\nscene: {num_envs: 4, entities: {r: {model: m.xml}}}\n"
    )
    folder = write(tmp_path / "drawing", f"{yaml}agents: {{x: {{{KINDS[kind]}, max_iterations: 3}}}}\n", task_py=GLOBAL_DRAWS, m_xml=model)  # fmt: skip # noqa: E501
    runs, figures = [], []
    for _ in range(2):
        np.random.seed(None)
        random.seed(None)
        torch.seed()
        assert main(["train", str(folder), "--runs-dir", str(tmp_path / "runs"), "-q", "--logger", "none"]) == 0
        runs.append(capsys.readouterr().out.strip())
        np.random.seed(None)
        random.seed(None)
        torch.seed()
        assert main(["eval", "--checkpoint", runs[0], "--episodes", "4", "--json", "-q"]) == 0
        figures.append(capsys.readouterr().out)
    assert main(["diff", *runs]) == 0, capsys.readouterr().out
    assert figures[0] == figures[1]
