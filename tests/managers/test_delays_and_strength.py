"""Delays of actions in steps and seconds, and the strength and limits of actuators of every kind."""

import numpy as np
import pytest
import torch

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli.registry import find_task

PD = (
    "scene.entities.robot.actuators="
    "{legs: {kind: pd, joints: ['.*'], stiffness: 20.0, damping: 0.5, effort_limit: 5.0}}"
)


def make(task, *overrides, num_envs=4):
    return make_env(resolve(find_task(task), overrides=[f"scene.num_envs={num_envs}", *overrides]))


def controls(*overrides, steps=6):
    """Controls of the cart for the actions 1, 2, 3 ... (steps, num_envs)"""
    env = make("cartpole", *overrides)
    env.reset(seed=0)
    found = []
    for step in range(steps):
        env.step(torch.full((4, 1), step + 1.0))
        found.append(env.engine.field("ctrl")[:, 0].clone())
    return torch.stack(found)


@pytest.mark.parametrize("delay", ["{steps: 2}", "{steps: [2, 2]}", "{seconds: 0.03333333333}"])
def test_fixed_action_delay(delay):
    direct, delayed = controls(), controls(f"actions.joint_effort.delay={delay}")
    assert bool((delayed[:2] == 0.0).all())
    assert torch.equal(delayed[2:], direct[:-2])


def test_action_delay_is_drawn_per_episode():
    direct, delayed = controls(steps=8), controls("actions.joint_effort.delay={steps: [0, 3]}", steps=8)
    lags = [next(lag for lag in range(4) if torch.equal(delayed[lag:, e], direct[: 8 - lag, e])) for e in range(4)]
    assert len(set(lags)) > 1
    assert controls("actions.joint_effort.delay={steps: [0, 3], redraw: 1.0}", steps=8).diff(dim=0).min() < 0.0


def test_no_delay_keeps_bits():
    assert torch.equal(controls(), controls("actions.joint_effort.delay={steps: 0}"))


def test_delayed_actions_are_restored():
    first = make("cartpole", "actions.joint_effort.delay={steps: [1, 3]}")
    first.reset(seed=0)
    for _ in range(5):
        first.step(torch.rand(4, 1))
    again = make("cartpole", "actions.joint_effort.delay={steps: [1, 3]}")
    again.reset(seed=7)
    again.load_state_dict(first.state_dict())
    for _ in range(4):
        action = torch.rand(4, 1)
        left, right = first.step(action.clone()), again.step(action)
        assert torch.equal(left.obs["policy"], right.obs["policy"])


@pytest.mark.parametrize(
    ("delay", "message"),
    [
        ("{seconds: 0.02}", "not a multiple of the control period of 0.0166667 s; give 0.0166667 or 0.0333333"),
        ("{seconds: [0.1, 0.05]}", "the delay is 0.1 to 0.05 s"),
        ("{}", "a delay has either steps or seconds: give one of the two"),
        ("{steps: 1, seconds: 1.0}", "a delay has either steps or seconds: give one of the two"),
        ("{steps: [3, 1]}", "the lower end 3 is above the upper end 1"),
        ("{steps: -1}", "expected a whole number >= 0"),
    ],
)
def test_wrong_delay_is_refused(delay, message):
    with pytest.raises(ConfigError, match=message):
        make("cartpole", f"actions.joint_effort.delay={delay}")


def test_strength_scales_effort():
    event = "events.weak={func: randomize_actuator_strength, mode: reset, range: [0.5, 0.9]}"
    forces = []
    for overrides in ([], [event]):
        env = make("cartpole", *overrides)
        env.reset(seed=0)
        env.step(torch.full((4, 1), 0.5))
        forces.append(env.engine.field("qfrc_actuator")[:, 0].clone())
    factors = forces[1] / forces[0]
    assert len(np.unique(factors.numpy().round(6))) == 4
    assert bool(((factors >= 0.5) & (factors <= 0.9)).all())


@pytest.mark.parametrize("kind", [(), (PD,)], ids=["own", "model"])
def test_effort_limits_of_every_actuator(kind):
    event = "events.limit={func: randomize_effort_limit, mode: reset, range: [0.5, 0.9]}"
    env = make("quadruped-flat", *kind, event)
    env.reset(seed=0)
    if kind:
        (model,) = env.entities["robot"].actuators
        limits, original = model.effort_limit, 5.0
    else:
        limits = env.engine.expand("actuator_forcerange").view(4, -1)[:, 1::2]
        original = torch.as_tensor(env.engine.model.actuator_forcerange[:, 1])
    factors = limits / original
    assert bool(((factors >= 0.5) & (factors <= 0.9)).all())
    assert len(factors.flatten().unique()) > 8


def test_strength_refuses_second_change_of_same_fields():
    weak = "{func: randomize_actuator_strength, mode: reset, range: [0.5, 0.9]}"
    limit = "{func: randomize_effort_limit, mode: reset, range: [0.5, 0.9]}"
    with pytest.raises(ConfigError, match=r"events\.b changes the same fields"):
        make("quadruped-flat", f"events.a={weak}", f"events.b={limit}")


def test_unknown_key_of_term_lists_its_keys():
    with pytest.raises(ConfigError, match="unknown key 'range'; allowed: damping"):
        make("quadruped-flat", "events.a={func: randomize_pd_gains, mode: reset, range: [0.5, 0.9]}")
