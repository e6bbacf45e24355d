"""Formulas of actuator models, with which a program without rlcli computes their efforts in every physics step."""

from collections.abc import Iterable
from typing import Any

import torch

from rlcli.deploy.formulas import Formula, field, given, numbers, op
from rlcli.envs.vec_env import VecEnv
from rlcli.managers.term_binding import BoundTerm
from rlcli.scene.actuators import ActuatorModel
from rlcli.scene.initial_state import values_by_joint

TARGET = "target/"
"""Prefix of the inputs for the targets that action terms computed in the last step of the environment."""
_LARGEST = 3e38
"""Number in place of infinity, which JSON does not have."""


def actuator_models(env: VecEnv, terms: Iterable[BoundTerm], controls: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Describe the actuator models of an environment as JSON data (`ActuatorModelRecord`).

    Args:
        env: the environment.
        terms: the action terms.
        controls: the description of each action term. Its key `closed`, as in each description of a formula, states
            whether the formula needs nothing from the task's code.
    """
    pairs = list(zip(terms, controls, strict=False))
    known = all(control["closed"] for control in controls)
    models = env.actuators.items()  # a direct task may add objects that compute other things in every physics step
    return [_describe(name, model, pairs, known) for name, model in models if isinstance(model, ActuatorModel)]


def has_nominal_gains(model: ActuatorModel, env_id: int) -> bool:
    """Return whether gains and effort limits in environment `env_id` equal those of the configuration and the formula.

    An event can have changed them.
    """
    return all(
        torch.equal(getattr(model, key)[env_id].cpu(), torch.tensor(_nominal(model, key)))
        for key in ("stiffness", "damping", "effort_limit")
    )


def _describe(
    name: str, model: ActuatorModel, pairs: list[tuple[BoundTerm, dict[str, Any]]], known: bool
) -> dict[str, Any]:
    config, limits = model.config, [None if x == torch.inf else x for x in _nominal(model, "effort_limit")]
    closed = known and model.controller is None and not any(config.delay)
    return {
        "name": name,
        "kind": config.kind if model.controller is None else "own",
        "joints": [model.entity.joint_names[joint] for joint in model.joints],
        "ctrl": model.controls,
        "stiffness": _nominal(model, "stiffness"),
        "damping": _nominal(model, "damping"),
        "effort_limit": limits,
        "saturation_effort": config.saturation_effort,
        "velocity_limit": None if config.velocity_limit is None else _nominal(model, "velocity_limit"),
        "delay": list(config.delay),
        "closed": closed,
        "value": _effort(model, pairs) if closed else None,
    }


def _nominal(model: ActuatorModel, key: str) -> list[float]:
    """Return a setting of the configuration as one number for each joint; infinity without a limit."""
    value = getattr(model.config, key)
    names = [model.entity.joint_names[joint] for joint in model.joints]
    values: list[float] = values_by_joint(torch.inf if value is None else value, names).expand(len(names)).tolist()
    return values


def _effort(model: ActuatorModel, pairs: list[tuple[BoundTerm, dict[str, Any]]]) -> Formula:
    """Return the formula of the controls of an actuator model; see `ActuatorModel` for the equations."""
    entity, k = model.entity, len(model.joints)
    position = field("qpos", entity.qpos_columns[model.joints])
    velocity = field("qvel", entity.dof_columns[model.joints])
    kp, kd, limit = (_nominal(model, key) for key in ("stiffness", "damping", "effort_limit"))
    default = entity.data.default_joint_pos[0, model.joints].tolist()
    effort = op("mul", kp, op("sub", _targets(model, pairs, "position", default), position))
    effort = op("add", effort, op("mul", kd, op("sub", _targets(model, pairs, "velocity", [0.0] * k), velocity)))
    effort = op("add", effort, _targets(model, pairs, "motor", [0.0] * k))
    high = [min(x, _LARGEST) for x in limit]
    effort = op("clip", effort, [-x for x in high], high)
    saturation = model.config.saturation_effort
    if saturation is not None:
        no_load = _nominal(model, "velocity_limit")
        fastest = [min(speed * (1.0 + x / saturation), _LARGEST) for speed, x in zip(no_load, limit, strict=True)]
        slope = [saturation / speed for speed in no_load]
        drop = op("mul", slope, op("clip", velocity, [-x for x in fastest], fastest))
        effort = op("clip", effort, op("sub", [-saturation], drop), op("sub", [saturation], drop))
    gear = torch.tensor(entity.engine.model.actuator_gear[model.controls, 0])
    return effort if bool((gear == 1.0).all()) else op("div", effort, numbers(gear))


def _targets(
    model: ActuatorModel, pairs: list[tuple[BoundTerm, dict[str, Any]]], kind: str, default: list[float]
) -> Formula:
    """Return the formula of the targets of one kind: position, velocity or motor (efforts).

    A joint that no action term drives has its number of `default`.
    """
    sources: list[Formula] = [[value] for value in default]
    for term, control in pairs:
        if term.instance.actuator == kind:
            for column, ctrl in enumerate(control["ctrl"]):
                if ctrl in model.controls:
                    sources[model.controls.index(ctrl)] = given(TARGET + term.name, [column])
    if not any(isinstance(source, dict) for source in sources):
        return default
    return sources[0] if len(sources) == 1 else op("cat", *sources)
