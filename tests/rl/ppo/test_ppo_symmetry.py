"""Tests of `symmetry`: mirrored samples, mirror loss, exact resume, and agents that cannot use it."""

import pytest
import torch
from support import mirrored_robot

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli.registry import find_task
from rlcli.rl.ppo.minibatch_gradient import AutogradGradient, ClosedFormGradient
from rlcli.rl.ppo.trainer import PpoTrainer

LOSS_ONLY = "agent.symmetry={augment: false, mirror_coef: 10.0}"


@pytest.fixture
def make_trainer(tmp_path):
    task = find_task(mirrored_robot.write(tmp_path))

    def build(*overrides):
        resolved = resolve(task, agent="ppo", overrides=overrides)
        trainer = PpoTrainer(make_env(resolved, seed=3), resolved.agent, seed=1, device="cpu", torch_threads=1)
        trainer.start()
        return trainer

    return build


def test_minibatches_hold_samples_and_their_mirror_images(make_trainer):
    trainer = make_trainer()
    collector, learner = trainer.collector, trainer.learner
    before = {name: value.clone() for name, value in collector.normalizer.state_dict().items()}
    collector.collect()
    collector.estimate_advantages()
    collector.complete_images()
    rollout, maps = collector.rollout, collector.mirror
    collector.normalizer.load_state_dict(before)
    torch.testing.assert_close(
        rollout.images.obs, collector.normalizer(maps.observations["policy"](collector.raw_obs["policy"]))
    )
    rollout.fill_minibatches(learner.sample_order())
    assert [len(batch.target) for batch in rollout.minibatches] == [32, 32, 32]
    for batch in rollout.minibatches:
        own, image = batch.action.chunk(2)
        assert image.equal(maps.action(own))
        for name in ("target", "advantage", "log_prob"):
            own, image = getattr(batch, name).chunk(2)
            assert image.equal(own)
    order = torch.cat([batch.target.chunk(2)[0] for batch in rollout.minibatches])
    assert order.sort()[0].equal(rollout.samples.target.flatten().sort()[0])


def test_closed_form_gradient_of_mirrored_samples(make_trainer):
    trainer = make_trainer()
    trainer.iterate()
    learner = trainer.learner
    assert isinstance(learner.minibatch_gradient, ClosedFormGradient)
    batch = learner.collector.rollout.minibatches[0]
    closed = learner.compute_gradient(learner.minibatch_gradient, batch, 0)
    gradient = learner.gradient_and_kl.clone()
    auto = learner.compute_gradient(AutogradGradient(learner._networks, learner.gradient_and_kl), batch, 0)
    torch.testing.assert_close(gradient, learner.gradient_and_kl, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(closed.metrics, auto.metrics, rtol=1e-4, atol=1e-6)


def test_mirror_loss_makes_the_policy_symmetric(make_trainer):
    """The loss of the samples is that of the agent without symmetry: only the mirror loss is added."""
    (_, plain), (trainer, mirrored) = (
        (trainer := make_trainer(setting), [trainer.iterate().metrics for _ in range(8)])
        for setting in ("agent.symmetry={augment: true}", LOSS_ONLY)
    )
    assert mirrored[-1]["Loss/mirror"] < 0.3 * plain[-1]["Loss/mirror"]
    batch, rows = trainer.collector.rollout.minibatches[0], 16
    learner = trainer.learner
    alone = learner.compute_gradient(learner.minibatch_gradient, batch, 0).metrics
    with torch.no_grad():
        value = trainer.networks.value(batch.critic_obs[:rows])
        batch.target[rows:] = 1e6  # targets of the mirror images are not used
    assert value.shape == (rows,)
    assert learner.compute_gradient(learner.minibatch_gradient, batch, 0).metrics.equal(alone)


@pytest.mark.parametrize("setting", ["agent.symmetry={}", LOSS_ONLY])
def test_resume_is_exact(make_trainer, setting):
    trainer, other = make_trainer(setting), make_trainer(setting)
    trainer.iterate()
    saved = trainer.state()
    trainer.iterate()
    other.load(saved)  # also the generators of random numbers
    other.iterate()
    expected, found = trainer.state().tensors, other.state().tensors
    for group in ("policy", "trainer"):
        assert all(value.equal(found[group][name]) for name, value in expected[group].items())


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("agent.rnn={hidden: 4}", "symmetry needs networks without cnn and rnn"),
        ("agent.symmetry={augment: false}", "symmetry has no effect: set augment: true or mirror_coef above 0"),
    ],
)
def test_agents_that_cannot_use_symmetry(make_trainer, setting, message):
    with pytest.raises(ConfigError, match=message):
        make_trainer(setting)
