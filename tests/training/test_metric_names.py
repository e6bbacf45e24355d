"""Tests that all trainers report the same metrics, and that reward terms add up to the return."""

import pytest
import torch

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import OWN, TRAINERS, catalog, find_task, load_entry, load_object
from rlcli.trainers import TrainerSpec
from rlcli.training.loop import _with_rates

OFF_POLICY = "train_freq: 32, gradient_steps: 1, learning_starts: 24, batch_size: 16, buffer_size: 512"
AGENTS = {
    "ppo ppo": "trainer: ppo, algorithm: ppo, num_steps: 32, max_iterations: 2",
    "sb3 ppo": "trainer: sb3, algorithm: ppo, n_steps: 32, num_minibatches: 2, max_iterations: 2",
    "sb3 a2c": "trainer: sb3, algorithm: a2c, n_steps: 32, max_iterations: 2",
    **{
        f"sb3 {name}": f"trainer: sb3, algorithm: {name}, max_iterations: 2, {OFF_POLICY}"
        for name in ("sac", "td3", "ddpg")
    },
}
ALGORITHM_METRICS = ("Loss/", "Policy/")
"""Prefixes of metrics that differ between algorithms."""
EXPECTED = {
    "Train/mean_reward", "Train/mean_episode_length", "Train/success_rate", "Episode_Reward/alive",
    "Episode_Reward/terminating", "Episode_Reward/pole_pos", "Episode_Reward/cart_vel", "Episode_Reward/pole_vel",
    "Episode_Termination/time_out", "Episode_Termination/cart_out_of_bounds", "Perf/total_fps",
    "Perf/collection_time", "Perf/learning_time", "Perf/physics_share", "Perf/task_share", "Perf/policy_share",
    "Perf/update_share", "Success/pole", "Success_Value/pole",
}  # fmt: skip
LENGTH_S = 0.2


@pytest.fixture(autouse=True)
def _one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def first_iteration(tmp_path, agent):
    """Return the metrics of a first iteration in which episodes end."""
    file = tmp_path / "agent.yaml"
    file.write_text(
        f"scene: {{num_envs: 6}}\nepisode_length_s: {LENGTH_S}\nsim: {{engine_threads: 1}}\n"
        f"agents: {{x: {{{AGENTS[agent]}}}}}\n"
    )
    resolved = resolve(find_task("cartpole"), agent="x", config_file=file)
    env = make_env(resolved, seed=3)
    trainer = load_object(resolved.trainer.trainer)(env, resolved.agent, seed=3, device="cpu", torch_threads=1)
    trainer.start()
    report = trainer.iterate()
    env.close()
    return _with_rates(report, trainer.steps_per_iteration)


def test_every_built_in_algorithm_is_covered():
    specs = {entry.name: load_entry(entry, TrainerSpec) for entry in catalog(TRAINERS)[0] if entry.distribution == OWN}
    assert {*AGENTS} == {f"{trainer} {algorithm}" for trainer, spec in specs.items() for algorithm in spec.algorithms}


@pytest.mark.parametrize("agent", AGENTS)
def test_metric_names_are_equal_and_terms_sum_to_the_return(tmp_path, agent):
    metrics = first_iteration(tmp_path, agent)
    assert {name for name in metrics if not name.startswith(ALGORITHM_METRICS)} == EXPECTED
    terms = sum(value for name, value in metrics.items() if name.startswith("Episode_Reward/"))
    assert terms * LENGTH_S == pytest.approx(metrics["Train/mean_reward"], rel=1e-6)
    assert metrics["Train/mean_reward"] != 0.0
