"""A learner with non-finite values stops in that iteration, and names the first tensor in causal order."""

import math

import pytest
import torch
from support.diverging_worlds import LEARNERS, LEARNING_TASK, WHO, N, faults, machine
from support.fault_sizes import chosen

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import DivergedError
from rlcli.registry import find_task, load_object


@pytest.fixture(autouse=True)
def _one_torch_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def trainer_of(folder, name, *overrides):
    resolved = resolve(find_task(str(machine(folder, LEARNING_TASK))), agent=name, overrides=overrides)
    env = make_env(resolved, seed=3)
    make = load_object(resolved.trainer.trainer)
    trainer = make(env, resolved.agent, seed=5, device="cpu", torch_threads=1)
    trainer.start()
    for _ in range(3):  # past what an off-policy algorithm waits for
        trainer.iterate()
    return trainer


def module_of(trainer):
    return trainer.networks if hasattr(trainer, "networks") else trainer.model.policy


def parameters(trainer, part):
    """Return the trained parameters of the actor or the critic, from the inputs to the outputs."""
    named = [(name, p) for name, p in module_of(trainer).named_parameters() if p.requires_grad]
    words = {"actor": ("actor.", "mlp_extractor.policy_net", "action_net"),
             "critic": ("critic.", "mlp_extractor.value_net", "value_net")}[part]  # fmt: skip
    return [(name, p) for name, p in named if name.startswith(words) and "target" not in name]


def at(items, where):
    """Return the first, the middle or the last item."""
    items = list(items)
    return items[{"first": 0, "middle": len(items) // 2, "last": -1}[where]]


def poison(trainer, what, where):
    """Make one value non-finite, and return the name that the message must contain."""
    with torch.no_grad():
        if what == "normaliser":
            getattr(trainer, "collector", trainer).normalizer.var[at(range(4), where)] = math.nan
            return "the observation normaliser's var"
        if what in ("actor weight", "critic weight"):
            name, parameter = at(parameters(trainer, what.split()[0]), where)
            parameter.view(-1)[at(range(parameter.numel()), where)] = math.nan
            return f"weight '{name}'"
        if what == "log_std":
            dict(module_of(trainer).named_parameters())["log_std"][at(range(2), where)] = -math.nan
            return "weight 'log_std'"
    if what in ("actor gradient", "critic gradient"):
        name, parameter = at(parameters(trainer, what.split()[0]), where)

        def spoil(gradient):
            gradient = gradient.clone()
            gradient.view(-1)[at(range(gradient.numel()), where)] = math.nan
            return gradient

        if not hasattr(trainer, "learner"):
            parameter.register_hook(spoil)
            return f"the gradient of '{name}'"

        learner, closed_form = trainer.learner, trainer.learner.minibatch_gradient

        def spoilt(*batch):  # a closed-form gradient calls no hook
            result = closed_form(*batch)
            place = parameter.storage_offset() + at(range(parameter.numel()), where)
            learner.gradient[place] = math.nan
            return result

        learner.minibatch_gradient = spoilt
        return f"the gradient of '{name}'"
    if what == "advantage":  # rewards that are finite, and whose discounted sum is not
        who = {"first": WHO[0], "middle": WHO[1], "last": WHO[2]}[where]
        faults(trainer.env).update(reward=[who], value=3e38)
        return f"environment {who})"
    assert what == "loss"
    if hasattr(trainer, "networks"):
        key = {"first": "value_coef", "middle": "entropy_coef", "last": "clip_range"}[where]
        trainer.learner.config = trainer.config.model_copy(update={key: math.nan})
        return "surrogate" if where == "last" else "the loss"
    if hasattr(trainer.model, "replay_buffer"):
        trainer.model.gamma = math.nan
        return "Loss/critic"
    key = {"first": "vf_coef", "middle": "ent_coef", "last": "clip_range"}[where]
    setattr(trainer.model, key, (lambda _: math.nan) if key == "clip_range" else math.nan)
    return "the loss" if key != "clip_range" else "Loss/surrogate"


ON_POLICY = ("normaliser", "actor weight", "critic weight", "log_std", "actor gradient", "critic gradient", "advantage",
             "loss")  # fmt: skip
OFF_POLICY = ("normaliser", "actor weight", "actor gradient", "critic gradient", "loss")
WHERE = ("first", "middle", "last")
CASES = [
    (name, what, where)
    for name in LEARNERS
    for what in (OFF_POLICY if name in ("sb3-sac", "sb3-td3") else ON_POLICY)
    for where in WHERE
    if not (name == "sb3-a2c" and what == "loss")  # it says no more of its loss than what it is made of
]


@pytest.mark.parametrize(("name", "what", "where"), chosen(CASES, 9))
def test_first_tensor_that_is_not_finite_is_named(tmp_path, name, what, where):
    trainer = trainer_of(tmp_path, name, *(["agent.reward_scale=30"] if what == "advantage" else []))
    named = poison(trainer, what, where)
    with pytest.raises(DivergedError) as raised:
        trainer.iterate()
    assert named in raised.value.message
    assert "not finite" in raised.value.message
    assert "in iteration 4" in raised.value.message
    if what == "advantage":
        assert "the advantage" in raised.value.message or "the value's target" in raised.value.message
    assert raised.value.exit_code == 6
    if "gradient" in what or what in ("advantage", "loss"):  # found before anything was learned from it
        assert all(p.isfinite().all() for p in module_of(trainer).parameters())


@pytest.mark.parametrize("name", ["ppo", "sb3-ppo"])
def test_weight_made_non_finite_by_the_optimiser_is_named(tmp_path, name):
    trainer = trainer_of(tmp_path, name)
    if name == "ppo":
        trainer.learner.learning_rate.fill_(math.inf)
    else:
        trainer._learning_rate = math.inf
    with pytest.raises(DivergedError, match=r"weight|learning rate"):
        trainer.iterate()


@pytest.mark.parametrize("who", WHO)
def test_nonfinite_sample_does_not_reach_the_normaliser(tmp_path, who):
    trainer = trainer_of(tmp_path, "sb3-ppo")
    faults(trainer.env).update(observation=[who], value=math.inf)
    before = {name: value.clone() for name, value in trainer.normalizer.state_dict().items()}
    with pytest.raises(DivergedError, match=rf"observation 'policy.vel' \(seen\) .* environment {who}"):
        trainer.iterate()
    after = trainer.normalizer.state_dict()
    assert all(value.isfinite().all() for value in after.values())
    assert after["count"] == before["count"] + N, "of the one step that was in order"
