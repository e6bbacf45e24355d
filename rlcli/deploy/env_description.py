"""Description of an environment for programs without rlcli: joints, actuators, formulas of observations and controls.

Checkpoints and exported files contain the description.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from pydantic_core import to_jsonable_python

from rlcli.config.schema import ActionConfig, ObservationConfig
from rlcli.config.term_signatures import params_model
from rlcli.deploy.actuator_formulas import actuator_models
from rlcli.deploy.formulas import Formula, control_formula, given, observation_formula, op
from rlcli.envs.direct import DirectEnv
from rlcli.envs.managed import ManagedEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError, Problem
from rlcli.managers.term_binding import BoundTerm

_INPUT = "observation/"
"""Prefix of the inputs for observation terms without a formula."""


def describe(env: VecEnv) -> dict[str, Any]:
    """Describe an environment as JSON data: its joints, actuators, start state, and formulas (`DeploymentRecord`).

    Raises:
        ConfigError: if the terms of a direct task's `in_terms` do not fit the task.
    """
    parts = _describe_direct(env) if isinstance(env, DirectEnv) else _describe_managed(env)  # type: ignore[arg-type]
    observations, terms = parts
    controls = _controls(env, terms)
    if isinstance(env, DirectEnv) and not terms:
        hook = f"{type(env.task).__name__}.pre_physics_step"
        controls = [{"name": "actions", "func": hook, "ctrl": [], "actuators": [], "closed": False, "value": None}]
    commands = getattr(env, "command_manager", None)
    return {
        "joints": _joints(env),
        "actuators": _actuators(env),
        "observations": observations,
        "controls": controls,
        "actuator_models": actuator_models(env, terms, controls),
        "commands": [
            {"name": term.name, "func": term.config.func, "size": term.instance.command.shape[1]}
            for term in (commands.terms if commands is not None else [])
        ],
        "start": {name: np.asarray(values, dtype=float).tolist() for name, values in env.default_state.items()},
        "forces_after_reset": env.engine.forces_after_reset,
        "derived": env.config.sim.derived_fields,
    }


def _describe_managed(env: ManagedEnv) -> tuple[dict[str, Any], list[BoundTerm]]:
    """Return the observation terms of a manager-based environment as JSON data, by group, and its action terms."""
    groups = {}
    for group in env.config.observations:
        begin, terms = 0, []
        for pipeline in env.observation_manager.pipelines(group):
            term, width = pipeline.term, pipeline.width
            value = _processed_formula(env, term, width)
            name, func, params = term.name, term.config.func, term.config.params
            terms.append(_observation(name, func, params, begin, width, pipeline.history, value))
            begin += pipeline.size
        groups[group] = terms
    return groups, env.action_manager.terms


def _describe_direct(env: DirectEnv) -> tuple[dict[str, Any], list[BoundTerm]]:
    """Return the observations of a direct task as JSON data, by group, and its actions as terms.

    A direct task has formulas, and actions as terms, only if its method `in_terms` returns terms of `rlcli.mdp`.
    """
    task, in_terms = env.task, env.task.in_terms()
    groups = {
        group: [_observation(name, f"{type(task).__name__}.{hook}", {}, 0, width)]
        for group, name, hook, width in (
            ("policy", "obs_buf", "get_observations", task.num_observations),
            ("critic", "states_buf", "get_states", task.num_states),
        )
        if width
    }
    if in_terms is None:
        return groups, []
    bound = {
        section: [_bind(env, section, number, entry) for number, entry in enumerate(in_terms.get(section, []))]
        for section in ("observations", "actions")
    }
    env._binder.raise_problems()
    begin, terms = 0, []
    for term in bound["observations"]:
        # `last_action` reads the action manager, which a direct task does not have
        is_last_action = term.config.func == "last_action"
        width = task.num_actions if is_last_action else int(term.call().shape[1])
        value = _processed_formula(env, term, width, env.config.clip_observations)
        terms.append(_observation(term.name, term.config.func, term.config.params, begin, width, value=value))
        begin += width
    if begin != task.num_observations:
        found = f"has {begin} observation columns, but the task has {task.num_observations}"
        message = f"{type(task).__name__}.in_terms() {found}; list all terms in order"
        raise ConfigError([Problem("observations", "observations", message)])
    groups["policy"] = terms
    return groups, bound["actions"]


def _bind(env: DirectEnv, section: str, number: int, entry: Mapping[str, Any]) -> BoundTerm:
    """Check one entry of the terms that a direct task returns in `in_terms`, and bind it to the environment.

    Args:
        env: the environment.
        section: `observations` or `actions`.
        number: index of the entry.
        entry: `func`, the name of a term of `rlcli.mdp`, and the term's parameters.
    """
    path = (section, f"{entry['func']}_{number}")
    signature = env.resolved.vocabulary.find(section, entry["func"])
    if signature is None:
        raise ConfigError([Problem(section, ".".join(path), f"no term '{entry['func']}'; `rlcli terms` lists all")])
    checked = params_model(signature, section).model_validate(dict(entry), strict=False)
    base = ObservationConfig if section == "observations" else ActionConfig
    term = env._binder.bind(section, path, base.model_construct(**dict(checked)))
    env._binder.raise_problems()
    assert term is not None
    return term


def _observation(
    name: str, func: str, params: dict[str, Any], begin: int, width: int, history: int = 1, value: Formula | None = None
) -> dict[str, Any]:
    return {
        "name": name,
        "func": func,
        "params": to_jsonable_python(params, fallback=str),
        "columns": [begin, begin + width * history],
        "history": history,
        "closed": value is not None,
        "value": given(_INPUT + name) if value is None else value,
    }


def _controls(env: VecEnv, terms: Iterable[BoundTerm]) -> list[dict[str, Any]]:
    """Return a description (name, columns, formula, ...) of each action term; terms use consecutive columns."""
    controls, begin = [], 0
    for term in terms:
        controls.append(_control(env, term, (begin, begin + term.instance.size)))
        begin += term.instance.size
    return controls


def _control(env: VecEnv, term: BoundTerm, columns: tuple[int, int]) -> dict[str, Any]:
    ctrl, value = control_formula(env, term, columns) or ([], None)
    # the task's `command` is the clipped action: scale and offset are applied here
    if value is not None and isinstance(env, DirectEnv):
        action = term.instance
        effort = op("mul", given("command", range(*columns)), _row(action._scale, action.size))
        if bool(torch.as_tensor(action._offset).any()):
            effort = op("add", effort, _row(action._offset, action.size))
        value = op("mul", effort, value["of"][1]) if "op" in value else effort
    return {
        "name": term.name,
        "func": term.config.func,
        "ctrl": ctrl,
        "actuators": [env.engine.model.actuator(a).name for a in ctrl],
        "closed": value is not None,
        "value": value,
    }


def _processed_formula(env: VecEnv, term: BoundTerm, width: int, bound: float | None = None) -> Formula | None:
    """Return the formula of an observation term with its modifiers, clip and scale; None if the term has no formula.

    The formula omits noise, bias, delay and history.

    Args:
        env: the environment.
        term: the term.
        width: number of columns of the term.
        bound: limit of the absolute value; None: no limit.
    """
    value, config = observation_formula(env, term), term.config
    assert isinstance(config, ObservationConfig)
    # a curriculum may change a tunable number, so it cannot be a constant of the formula
    if value is None or any((*term.path, key) in env._binder.tunable for key in ("scale", "clip")):
        return None
    for number, modifier in enumerate(config.modifiers):
        step: dict[str, Any] = modifier.model_dump()
        if step["kind"] == "clip":
            value = op("clip", value, *([float(end)] for end in step["bounds"]))
        elif step["kind"] == "scale":
            value = op("mul", value, _row(step["factor"], width))
        elif step["kind"] == "bias":
            value = op("add", value, _row(step["offset"], width))
        else:
            # an integrator is the filter of the trapezoidal rule: y[n] = y[n-1] + dt / 2 (x[n] + x[n-1])
            half = 0.5 * env.step_dt
            b, a = (step["b"], step["a"]) if step["kind"] == "digital_filter" else ([half, half], [-1.0])
            key = ".".join(map(str, (*term.path, number)))
            value = {"op": "filter", "of": [value], "b": list(b), "a": list(a), "key": key}
    if config.clip is not None:
        value = op("clip", value, *([float(end)] for end in config.clip))
    if config.scale is not None:
        value = op("mul", value, _row(config.scale, width))
    return value if bound is None else op("clip", value, [-bound], [bound])


def _row(values: float | Sequence[float] | torch.Tensor, width: int) -> Formula:
    row = torch.as_tensor(values, dtype=torch.float32)
    return list((row[0] if row.dim() == 2 else row).expand(width).tolist())


def _joints(env: VecEnv) -> list[dict[str, Any]]:
    """Describe all hinge and slide joints of all entities, with the stiffness and damping of their actuators."""
    model, rows = env.engine.model, []
    for name, entity in env.entities.items():
        gains: dict[int, tuple[float, float]] = {}
        for kind in ("motor", "position", "velocity"):
            for column, actuator in entity.actuators_of(kind):
                # MuJoCo's position actuator: force = kp (ctrl - q) - kv q', with gainprm[0] = kp and biasprm[2] = -kv
                stiffness = float(model.actuator_gainprm[actuator, 0]) if kind == "position" else 0.0
                # 0.0 - x, because -x would be -0.0 for x = 0
                damping = 0.0 - float(model.actuator_biasprm[actuator, 2]) if kind != "motor" else 0.0
                gains[column] = stiffness, damping
        for actuator_model in entity.actuators:
            for i, column in enumerate(actuator_model.joints):
                gains[column] = float(actuator_model.stiffness[0, i]), float(actuator_model.damping[0, i])
        for column, joint in enumerate(entity.joint_names):
            gain = gains.get(column, (None, None))
            rows.append(
                {
                    "name": joint,
                    "entity": name,
                    "qpos": int(entity.qpos_columns[column]),
                    "dof": int(entity.dof_columns[column]),
                    "default": float(entity.data.default_joint_pos[0, column]),
                    "stiffness": gain[0],
                    "damping": gain[1],
                }
            )
    return rows


def _actuators(env: VecEnv) -> list[dict[str, Any]]:
    model = env.engine.model
    return [
        {
            "name": mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, a) or f"actuator {a}",
            "range": [float(end) for end in model.actuator_ctrlrange[a]] if model.actuator_ctrllimited[a] else None,
        }
        for a in range(model.nu)
    ]
