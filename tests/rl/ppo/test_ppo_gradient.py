"""Tests of the closed-form gradient against autograd on the same minibatch."""

import itertools
import warnings
from types import SimpleNamespace

import pytest
import torch
from support import worlds
from torch import nn

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import DivergedError
from rlcli.registry import find_task
from rlcli.rl import mlp
from rlcli.rl.mlp import Mlp, is_plain
from rlcli.rl.mlp_gradients import MlpGradients
from rlcli.rl.policy import ACTIVATIONS
from rlcli.rl.ppo.config import PpoConfig
from rlcli.rl.ppo.loss import minibatch_loss
from rlcli.rl.ppo.minibatch_gradient import AutogradGradient, ClosedFormGradient, Objective
from rlcli.rl.ppo.rollout_buffer import Samples
from rlcli.rl.ppo.trainer import PpoTrainer

AGENT = """
agents:
  ppo:
    {trainer: ppo, algorithm: ppo, max_iterations: 9, num_steps: 8, num_minibatches: 3, action_bound: null,
     actor: {hidden: [16, 12]}, critic: {hidden: [9]}}
"""
MODES = {
    "plain": ("agent.clip_value=null",),
    "clipped": ("agent.clip_value=clipped", "agent.clip_value_range=0.05"),
    "larger": ("agent.clip_value=larger", "agent.entropy_coef=0.01"),
    "scalar": ("agent.std=scalar", "agent.entropy_coef=0.02", "agent.clip_range=0.02"),
    "bounds": ("agent.bounds_coef=0.5", "agent.bounds_margin=0.3", "agent.value_coef=0.3"),
    "normalized": ("agent.normalize_observations=true", "agent.normalize_value=true", "agent.value_coef=2.0"),
    "minibatch": ("agent.normalize_advantage=minibatch",),
    "raw": ("agent.normalize_advantage=null", "agent.reward_scale=30.0"),
}


@pytest.fixture
def make_trainer(tmp_path):
    """Function that makes a trainer with a rollout; the critic has other observations than the actor."""
    task = str(worlds.critter(tmp_path, worlds.CRITTER_TASK + AGENT))

    def build(*overrides, threads=1):
        resolved = resolve(find_task(task), agent="ppo", overrides=["scene.num_envs=10", *overrides])
        trainer = PpoTrainer(make_env(resolved, seed=3), resolved.agent, seed=1, device="cpu", torch_threads=threads)
        trainer.start()
        trainer.collector.collect()
        trainer.collector.estimate_advantages()
        trainer.collector.rollout.fill_minibatches(trainer.learner.sample_order())
        return trainer

    return build


def perturb_weights(trainer, scale):
    """Add noise to the weights, so that they differ from those of the rollout."""
    weights, generator = trainer.learner.weights, torch.Generator().manual_seed(4)
    with torch.no_grad():
        weights.add_(scale * torch.randn(weights.shape, generator=generator))


def autograd_gradient(trainer):
    return AutogradGradient(trainer.networks, trainer.learner.gradient_and_kl)


def both_gradients(trainer, number):
    """Return (gradient with KL divergence, loss) in closed form, then by autograd."""
    learner, found = trainer.learner, []
    for gradient in (learner.minibatch_gradient, autograd_gradient(trainer)):
        result = learner.compute_gradient(gradient, trainer.collector.rollout.minibatches[number], number)
        found.append((learner.gradient_and_kl.clone(), result))
    return found


def require_equal_gradients(trainer):
    assert isinstance(trainer.learner.minibatch_gradient, ClosedFormGradient)
    for number in range(len(trainer.collector.rollout.minibatches)):
        (shared, result), (expected, theirs) = both_gradients(trainer, number)
        scale = expected[:-1].abs().max().item()
        assert scale > 1e-4
        torch.testing.assert_close(shared, expected, rtol=0, atol=1e-6 * max(scale, expected[-1].item()))
        for mine, other in zip(result, theirs, strict=True):
            torch.testing.assert_close(mine, other.detach(), rtol=1e-5, atol=1e-6)
            assert not mine.requires_grad


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_gradient_matches_autograd_for_activations_and_losses(make_trainer, activation, mode):
    networks = (f"agent.actor.activation={activation}", f"agent.critic.activation={activation}")
    trainer = make_trainer(*networks, *MODES[mode])
    perturb_weights(trainer, 0.03)
    require_equal_gradients(trainer)


@pytest.mark.parametrize("dialect", ["rsl_rl", "rl_games", "sb3"])
@pytest.mark.parametrize("critic", ["[critic]", "[policy]", "[policy, critic]"])
def test_gradient_matches_autograd_for_dialects_and_critics(make_trainer, dialect, critic):
    trainer = make_trainer(f"agent.dialect={dialect}", f"agent.critic_obs={critic}", "agent.critic.activation=relu")
    perturb_weights(trainer, 0.02)
    require_equal_gradients(trainer)


@pytest.mark.parametrize("by", [-30.0, -5.0, 5.0, 30.0])
def test_gradient_matches_autograd_for_extreme_ratios(make_trainer, by):
    trainer = make_trainer()
    for batch in trainer.collector.rollout.minibatches:
        batch.log_prob[::2] += by
    require_equal_gradients(trainer)


def test_gradient_matches_autograd_for_minibatches_of_one_sample(make_trainer):
    trainer = make_trainer("agent.minibatch_size=1", "scene.num_envs=2")
    perturb_weights(trainer, 0.03)
    require_equal_gradients(trainer)


def test_overflowing_ratio_is_a_divergence(make_trainer):
    trainer = make_trainer()
    trainer.collector.rollout.samples.log_prob.sub_(200.0)
    trainer.collector.rollout.fill_minibatches(trainer.learner.sample_order())
    with pytest.raises(DivergedError, match="is not finite"):
        trainer.learner.step(trainer.collector.rollout.minibatches[0], 0)


def test_update_matches_autograd_update(make_trainer):
    """Check a whole update, in which each step starts from the result of the previous step."""
    ends = []
    for way in ("closed form", "autograd"):
        trainer = make_trainer("agent.dialect=rsl_rl")
        if way == "autograd":
            trainer.learner.minibatch_gradient = autograd_gradient(trainer)
        before = trainer.learner.weights.detach().clone()
        torch.manual_seed(8)
        trainer.learner.optimize()
        ends.append(trainer.learner.weights.detach().clone())
    assert (ends[0] - before).abs().max().item() > 1e-3
    torch.testing.assert_close(ends[0], ends[1], rtol=1e-5, atol=1e-5)


# --- the objective alone, at the edges of its cases ---


def with_neighbours(values):
    """Return each value with the next smaller and the next larger float32."""
    middle = torch.tensor(values)
    away = torch.full_like(middle, torch.inf)
    return torch.cat([middle.nextafter(-away), middle, middle.nextafter(away)])


def edge_cases():
    """Return log ratios and value changes on, inside and outside their ranges, with advantages of both signs."""
    ratios = with_neighbours([0.8, 1.0, 1.2, 0.5, 3.0]).log()
    changes = with_neighbours([-0.2, 0.0, 0.2, -1.0, 1.0])
    rows = itertools.product(ratios.tolist(), changes.tolist(), (-1.5, 0.0, 2.0), (-0.7, -0.1, 0.0, 0.1, 1.3))
    return torch.tensor(list(rows)).unbind(dim=1)


@pytest.mark.parametrize("clip_value", [None, "clipped", "larger"])
@pytest.mark.parametrize("clip_value_range", [None, 0.2, 1.0])
def test_output_gradients_match_autograd_at_clipping_edges(clip_value, clip_value_range):
    log_ratio, change, advantage, miss = edge_cases()
    count = len(log_ratio)
    config = PpoConfig(trainer="ppo", max_iterations=1, clip_value=clip_value, clip_value_range=clip_value_range)
    mean = torch.zeros(count, 1, requires_grad=True)
    value = torch.full((count, 1), 0.25, requires_grad=True)
    std = torch.ones(1, requires_grad=True)
    action = torch.linspace(-2.0, 2.0, count)[:, None]
    log_prob = torch.distributions.Normal(0.0, 1.0).log_prob(action).squeeze(-1) - log_ratio
    old = 0.25 - change
    zeros = torch.zeros(count)
    batch = Samples(zeros, zeros, action, mean.detach(), log_prob, old, advantage, 0.25 + miss, zeros)
    networks = SimpleNamespace(
        value=lambda _: value.squeeze(-1),
        hidden=lambda _: mean,
        actor=[nn.Identity()],
        std=std,
        teller=None,
        mirror_error=lambda _: torch.zeros(()),
    )
    result = minibatch_loss(networks, config, batch, zeros, zeros, advantage, torch.ones(1))
    expected = torch.autograd.grad(result.loss, (mean, value, std))
    with torch.no_grad():
        objective = Objective(config, batch, advantage, std.detach(), torch.empty_like(batch.mean))
        of_mean, numbers = objective.mean_gradient(slice(0, count), mean.detach())
        of_value, _ = objective.value_gradient(slice(0, count), value.detach())
    of_std = numbers[3:4] / count
    for mine, theirs in zip((of_mean, of_value, of_std), expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=0, atol=1e-6 * theirs.abs().max().item())
    assert 0.0 < result.metrics[4].item() == pytest.approx(numbers[1].item() / count)


# --- networks alone ---


def make_mlp(activation, *widths):
    layers = []
    for inputs, outputs in itertools.pairwise(widths):
        layers += [nn.Linear(inputs, outputs), ACTIVATIONS[activation]()]
    return nn.Sequential(*layers[:-1])


def compute_gradients(actor, critic, rows, threads):
    """Return gradients of a smooth function of both outputs in closed form and by autograd in float64, and the sums."""
    generator = torch.Generator().manual_seed(rows)
    packed = torch.randn(rows, actor[0].in_features + critic[0].in_features + 1, generator=generator)
    obs, critic_obs = packed[:, : actor[0].in_features], packed[:, -critic[0].in_features :]
    parameters = [*actor.parameters(), *critic.parameters()]
    gradients = [torch.full_like(parameter, torch.nan) for parameter in parameters]

    def of_mean(_, mean):
        return mean.cos() / rows, torch.stack((mean.sin().sum(), torch.tensor(float(len(mean)))))

    def of_value(_, value):
        return value / rows, torch.tensor([float(len(value))])

    of_actor, of_critic = MlpGradients(actor, critic, gradients, rows, threads)(obs, critic_obs, of_mean, of_value)
    sums = torch.cat((of_actor[:2], of_critic[None]))
    twins = actor.double(), critic.double()
    loss = twins[0](obs.double()).sin().sum() + 0.5 * twins[1](critic_obs.double()).square().sum()
    expected = torch.autograd.grad(loss / rows, [*twins[0].parameters(), *twins[1].parameters()])
    actor.float(), critic.float()
    return gradients, expected, sums


@pytest.fixture(params=[True, False], ids=["AVX-512", "other"])
def processor_kind(request, monkeypatch):
    """Use the operations for a processor with AVX-512 or without, as far as this processor supports them."""
    monkeypatch.setattr(mlp, "_AVX512", request.param)
    monkeypatch.setattr(mlp, "_linear", mlp._onednn())


@pytest.mark.usefixtures("processor_kind")
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("rows", [1, 5, 8191, 8193, 20001])
def test_mlp_gradients_match_autograd_for_any_number_of_parts(activation, rows):
    torch.manual_seed(2)
    actor, critic = make_mlp(activation, 5, 130, 70, 2), make_mlp(activation, 3, 130, 1)
    gradients, expected, sums = compute_gradients(actor, critic, rows, 2)
    scale = max(gradient.abs().max().item() for gradient in expected)
    for mine, theirs in zip(gradients, expected, strict=True):
        torch.testing.assert_close(mine, theirs.float(), rtol=0, atol=1e-6 * scale)
    assert sums[1:].tolist() == [rows, rows]


def test_mlp_gradients_do_not_depend_on_threads():
    found = []
    for threads in (1, 2, 3, 5):
        torch.manual_seed(2)
        gradients, _, sums = compute_gradients(
            make_mlp("elu", 4, 32, 32, 1), make_mlp("elu", 4, 32, 32, 1), 30000, threads
        )
        found.append(torch.cat([part.flatten() for part in (*gradients, sums)]))
    assert all(torch.equal(found[0], other) for other in found[1:])


def test_smaller_minibatch_overwrites_larger_one():
    torch.manual_seed(2)
    actor, critic = make_mlp("tanh", 4, 8, 1), make_mlp("tanh", 4, 8, 1)
    found = []
    for largest in (20000, 3000):
        gradients = [torch.zeros_like(parameter) for parameter in (*actor.parameters(), *critic.parameters())]
        way = MlpGradients(actor, critic, gradients, largest, 2)
        for rows in (largest, 3000):
            obs = torch.randn(rows, 4, generator=torch.Generator().manual_seed(rows))
            way(
                obs, obs, lambda _, mean: (mean.clone(), torch.ones(1)), lambda _, value: (value.clone(), torch.ones(1))
            )
        found.append(torch.cat([gradient.flatten() for gradient in gradients]))
    torch.testing.assert_close(found[0], found[1], rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_nan_inputs_reach_the_gradient_without_warning(activation):
    torch.manual_seed(2)
    actor, critic = make_mlp(activation, 2, 4, 1), make_mlp(activation, 2, 4, 1)
    gradients = [torch.zeros_like(parameter) for parameter in (*actor.parameters(), *critic.parameters())]
    obs = torch.tensor([[torch.nan, 1.0], [torch.inf, 2.0], [-torch.inf, 1.0], [1e30, -1e30]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        slopes = [lambda _, outputs: (outputs.clone(), torch.ones(1))] * 2
        MlpGradients(actor, critic, gradients, 4, 1)(obs, obs, *slopes)
    assert not any(gradient.isfinite().all() for gradient in gradients)


def test_is_plain_accepts_only_known_layers():
    assert is_plain(make_mlp("elu", 3, 4, 1))
    assert not is_plain(nn.Sequential(nn.Linear(3, 4), nn.ELU(alpha=0.5), nn.Linear(4, 1)))
    assert not is_plain(nn.Sequential(nn.Linear(3, 4), nn.GELU(), nn.Linear(4, 1)))
    assert not is_plain(nn.Sequential(nn.Linear(3, 4), nn.ELU(), nn.Linear(4, 4), nn.Tanh(), nn.Linear(4, 1)))
    assert not is_plain(nn.Sequential(nn.Linear(3, 4, bias=False), nn.ELU(), nn.Linear(4, 1)))


@pytest.mark.usefixtures("processor_kind")
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("rows", [(), (1,), (7,), (3, 3000), (0,)])
def test_mlp_outputs_are_equal_with_and_without_autograd(activation, rows):
    torch.manual_seed(2)
    network = Mlp(*make_mlp(activation, 5, 130, 70, 2))
    seen = torch.randn(*rows, 9)[..., 2:7]
    expected = network(seen)
    assert expected.requires_grad
    with torch.no_grad():
        torch.testing.assert_close(network(seen), expected.detach(), rtol=0, atol=1e-6)
        torch.testing.assert_close(network[:-1](seen), network[:-1].double()(seen.double()).float(), rtol=0, atol=1e-6)


@pytest.mark.parametrize("model", ["Intel(R) Xeon(R) Platinum 8481C CPU @ 2.70GHz", "Neoverse-N1"])
def test_onednn_is_not_used_on_other_processors(model, monkeypatch):
    monkeypatch.setattr(mlp, "processor", lambda: {"model": model})
    assert mlp._onednn() is None


def test_other_layers_use_torch_operations():
    odd = Mlp(nn.Linear(3, 4), nn.GELU(), nn.Linear(4, 1))
    with torch.no_grad():
        assert torch.equal(odd(torch.ones(2, 3)), nn.Sequential(*odd)(torch.ones(2, 3)))


@pytest.mark.parametrize("override", ["agent.rnn={hidden: 4}", "agent.tell_coef=0.1"])
def test_other_networks_use_autograd(make_trainer, override):
    trainer = make_trainer(override)
    assert isinstance(trainer.learner.minibatch_gradient, AutogradGradient)
    assert trainer.iterate().metrics["Loss/value"] > 0.0


def test_training_does_not_depend_on_threads(make_trainer):
    ends = []
    for threads in (1, 3):
        trainer = make_trainer("scene.num_envs=600", "agent.num_minibatches=1", threads=threads)
        trainer.iterate()
        ends.append(trainer.learner.weights.detach().clone())
    assert torch.equal(*ends)


@pytest.mark.parametrize("rows", [100, 1500, 5003])
def test_outputs_of_many_samples_do_not_depend_on_threads(rows):
    torch.manual_seed(2)
    network = mlp.Mlp(nn.Linear(9, 512), nn.ELU(), nn.Linear(512, 64), nn.ELU(), nn.Linear(64, 3))
    inputs, found = torch.randn(rows, 9), []
    try:
        for threads in (1, 3):
            mlp.use_threads(threads)
            with torch.no_grad():
                found.append(network(inputs))
    finally:
        mlp.use_threads(1)
    assert torch.equal(*found)
    torch.testing.assert_close(found[0], network(inputs).detach(), rtol=1e-5, atol=1e-5)
