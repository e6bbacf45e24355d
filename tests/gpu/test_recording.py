"""Tests that need an NVIDIA GPU: steps do not synchronise with it, and CUDA graphs replay the same work."""

import pytest
import torch

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task
from rlcli.rl.cuda_graph import Recording
from rlcli.rl.ppo.loss import minibatch_loss
from rlcli.rl.ppo.minibatch_gradient import AutogradGradient
from rlcli.rl.ppo.trainer import PpoTrainer

pytestmark = [
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs an NVIDIA GPU, and there is none here"),
    # torch warns once per process about the mode that these tests use
    pytest.mark.filterwarnings("ignore:Synchronization debug mode is a prototype feature"),
]


def environment(task, **flags):
    return make_env(
        resolve(find_task(task), device="cuda", flags={"scene.num_envs": 256, **flags}), seed=1, device="cuda"
    )


@pytest.mark.parametrize("task", ["cartpole", "ant-direct"])
def test_step_does_not_synchronize_with_device(task):
    env = environment(task, episode_length_s=0.5)
    action = torch.zeros(256, env.layout.action_size, device="cuda")
    env.reset()
    env.step(action)  # compiles
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(40):
            env.step(action)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    env.check()


@pytest.mark.parametrize("task", ["cartpole", "ant-direct"])
def test_captured_rollout_equals_eager_rollout(task):
    """Compare trajectories with a tolerance: physics on a GPU is not bit-identical."""
    finals = []
    for record in (False, True):
        env = environment(task, episode_length_s=0.5)
        obs = env.reset(seed=3)["policy"].clone()
        actions = torch.rand(8, 256, env.layout.action_size, device="cuda", generator=_generator()) * 0.2

        def work(env=env, obs=obs, actions=actions):
            for action in actions:
                obs.copy_(env.step(action).obs["policy"])

        run = Recording(work, torch.device("cuda"), env.stateful_objects()) if record else work
        for _ in range(6):  # 48 steps, in which all episodes end
            run()
        assert not record or run.refusal is None
        finals.append(obs.cpu())
        env.check()
    torch.testing.assert_close(finals[0], finals[1], rtol=1e-2, atol=2e-2)


def _generator():
    return torch.Generator("cuda").manual_seed(0)


def warnings_in(caplog):
    return [record.message for record in caplog.records if record.name.startswith("rlcli")]


class Counter:
    def __init__(self):
        self.total = torch.zeros((), device="cuda")
        self.steps = 0


def test_rebound_tensors_carry_over_between_replays():
    holder = Counter()

    def work():
        holder.total = holder.total + 1.0

    run = Recording(work, torch.device("cuda"), [holder])
    for _ in range(5):
        run()
    assert run.refusal is None
    assert holder.total.item() == 5.0


def test_synchronizing_work_runs_eagerly_with_warning(caplog):
    holder = Counter()

    def work():
        if holder.total.item() < 100.0:
            holder.total += 1.0

    run = Recording(work, torch.device("cuda"), [holder])
    for _ in range(3):
        run()
    assert holder.total.item() == 3.0
    (warning,) = warnings_in(caplog)
    assert "test_recording.py" in warning


def test_work_synchronizing_only_in_first_run_is_captured(caplog):
    holder, made = Counter(), []

    def work():
        if not made:  # like a constant that is made at its first use
            made.append(torch.tensor(2.0, device="cuda"))
        holder.total += made[0]

    run = Recording(work, torch.device("cuda"), [holder])
    for _ in range(5):
        run()
    assert holder.total.item() == 10.0
    assert not warnings_in(caplog)
    assert run._graph is not None


def test_changing_python_number_is_reported(caplog):
    holder = Counter()

    def work():
        holder.steps += 1
        holder.total += holder.steps

    run = Recording(work, torch.device("cuda"), [holder])
    for _ in range(3):
        run()
    assert holder.total.item() == 6.0
    assert "Counter.steps" in warnings_in(caplog)[0]


def trainer_of(**settings):
    resolved = resolve(
        find_task("cartpole"), agent="ppo", device="cuda",
        flags={"scene.num_envs": 512, "agent.max_iterations": 8, **settings},
    )  # fmt: skip
    env = make_env(resolved, seed=1, device="cuda")
    trainer = PpoTrainer(env, resolved.agent, seed=1, device="cuda", torch_threads=1)
    trainer.start()
    return trainer


@pytest.mark.parametrize("compiled", [False, True])
def test_training_captures_rollout_and_update(compiled, caplog):
    trainer = trainer_of(**{"agent.compile": compiled})
    reports = [trainer.iterate() for _ in range(8)]
    assert not warnings_in(caplog)
    assert all(report.metrics["Loss/learning_rate"] > 0 for report in reports)
    state = trainer.state()
    trainer.load(state)
    assert trainer.iterate().metrics["Train/mean_episode_length"] > 1.0
    assert torch.get_float32_matmul_precision() == "highest"


def test_compiled_minibatch_gradient_equals_eager():
    trainer = trainer_of(**{"agent.compile": True, "agent.tf32": False})
    trainer.iterate()
    trainer.collector.collect()
    trainer.collector.estimate_advantages()
    trainer.collector.rollout.fill_minibatches(trainer.learner.sample_order())
    found, learner = [], trainer.learner
    for loss in (learner.functions.loss, minibatch_loss):
        gradient = AutogradGradient(trainer.networks, learner.gradient_and_kl, loss)
        metrics = learner.compute_gradient(gradient, trainer.collector.rollout.minibatches[1], 1).metrics
        found.append((metrics.clone(), learner.gradient_and_kl.clone()))
    assert learner.functions.loss is not minibatch_loss
    torch.testing.assert_close(found[0], found[1], rtol=1e-4, atol=1e-5)


def test_task_with_env_ids_runs_eagerly_with_reason(caplog):
    settings = {"scene.num_envs": 64, "agent.max_iterations": 3}
    resolved = resolve(find_task("cartpole-direct"), agent="ppo", device="cuda", flags=settings)
    env = make_env(resolved, seed=1, device="cuda")
    trainer = PpoTrainer(env, resolved.agent, seed=1, device="cuda", torch_threads=1)
    trainer.start()
    for _ in range(3):
        trainer.iterate()
    (warning,) = warnings_in(caplog)
    assert "waits for the GPU" in warning
