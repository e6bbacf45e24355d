"""What code without rlcli must know to be the environment of a policy: kept in checkpoints, written into exports."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch

from rlcli.config.schema import ActionConfig, ObservationConfig
from rlcli.config.term_signatures import params_model
from rlcli.deploy.formulas import Formula, control_formula, given, observation_formula, op
from rlcli.envs.direct import DirectEnv
from rlcli.errors import ConfigError, Problem
from rlcli.managers.term import BoundTerm

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv
    from rlcli.envs.vec_env import VecEnv

_UNKNOWN = "observation/"
"""What the caller must say where there is no formula."""


def describe(env: VecEnv) -> dict[str, Any]:
    """Plain JSON: joints, actuators, start state, and a formula for every observation and control that has one.

    Raises:
        ConfigError: if a direct task describes itself in terms that do not fit it.
    """
    observations, controls = _direct(env) if isinstance(env, DirectEnv) else _managed(env)  # type: ignore[arg-type]
    commands = getattr(env, "command_manager", None)
    return {
        "joints": _joints(env),
        "actuators": _actuators(env),
        "observations": observations,
        "controls": controls,
        "commands": [
            {"name": term.name, "func": term.config.func, "size": term.instance.command.shape[1]}
            for term in (commands.terms if commands is not None else [])
        ],
        "start": {name: np.asarray(values, dtype=float).tolist() for name, values in env.default_state.items()},
        "forces_after_reset": env.engine.forces_after_reset,
        "derived": env.config.sim.derived_fields,
    }


def _managed(env: ManagedEnv) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    groups = {}
    for group in env.config.observations:
        edge, terms = 0, []
        for pipeline in env.observation_manager.pipelines(group):
            value = _prepared(env, pipeline.term, pipeline.width)
            terms.append(_term_observation(pipeline.term, edge, pipeline.width, pipeline.history, value))
            edge += pipeline.size
        groups[group] = terms
    return groups, _controls(env, env.action_manager.terms)


def _direct(env: DirectEnv) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    task, said = env.task, env.task.in_terms()
    groups = {
        group: [_observation(name, f"{type(task).__name__}.{hook}", {}, (0, width), 1, None)]
        for group, name, hook, width in (
            ("policy", "obs_buf", "get_observations", task.num_observations),
            ("critic", "states_buf", "get_states", task.num_states),
        )
        if width
    }
    hook = f"{type(task).__name__}.pre_physics_step"
    unknown = {"name": "actions", "func": hook, "ctrl": [], "actuators": [], "closed": False, "value": None}
    if said is None:
        return groups, [unknown]
    bound = {
        section: [_bound(env, section, number, entry) for number, entry in enumerate(said.get(section, []))]
        for section in ("observations", "actions")
    }
    env._binder.raise_problems()
    edge, terms = 0, []
    for term in bound["observations"]:
        width = _width(env, term)
        terms.append(_term_observation(term, edge, width, 1, _prepared(env, term, width, env.config.clip_observations)))
        edge += width
    if edge != task.num_observations:
        message = f"{type(task).__name__}.in_terms() has {edge} columns of {task.num_observations}"
        raise ConfigError([Problem("observations", "observations", message)])
    groups["policy"] = terms
    return groups, _controls(env, bound["actions"])


def _bound(env: DirectEnv, section: str, number: int, entry: Mapping[str, Any]) -> BoundTerm:
    path = (section, f"{entry['func']}_{number}")
    signature = env.resolved.vocabulary.find(section, entry["func"])
    if signature is None:
        raise ConfigError([Problem(section, ".".join(path), f"no term '{entry['func']}'")])
    checked = params_model(signature, section).model_validate(dict(entry), strict=False)
    base = ObservationConfig if section == "observations" else ActionConfig
    term = env._binder.bind(section, path, base.model_construct(**dict(checked)))
    env._binder.raise_problems()
    assert term is not None
    return term


def _width(env: DirectEnv, term: BoundTerm) -> int:
    """Columns of a term; what the past decides has a width of its own."""
    return env.task.num_actions if term.config.func == "last_action" else int(term.call().shape[1])


def _observation(
    name: str, func: str, params: Mapping[str, Any], columns: tuple[int, int], history: int, value: Formula | None
) -> dict[str, Any]:
    return {
        "name": name,
        "func": func,
        "params": _plain(params),
        "columns": list(columns),
        "history": history,
        "closed": value is not None,
        "value": given(_UNKNOWN + name) if value is None else value,
    }


def _term_observation(term: BoundTerm, edge: int, width: int, history: int, value: Formula | None) -> dict[str, Any]:
    columns = edge, edge + width * history
    return _observation(term.name, term.config.func, term.config.params, columns, history, value)


def _controls(env: VecEnv, terms: Iterable[BoundTerm]) -> list[dict[str, Any]]:
    """Return the description of each action term; their columns of the action lie side by side."""
    controls, edge = [], 0
    for term in terms:
        controls.append(_control(env, term, (edge, edge + term.instance.size)))
        edge += term.instance.size
    return controls


def _control(env: VecEnv, term: BoundTerm, columns: tuple[int, int]) -> dict[str, Any]:
    ctrl, value = control_formula(env, term, columns) or ([], None)
    if value is not None and isinstance(env, DirectEnv):  # there `command` is the action, within its clip
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


def _prepared(env: VecEnv, term: BoundTerm, width: int, bound: float | None = None) -> Formula | None:
    """A term's value with all that is done to it but noise, bias, delay and history."""
    value, config = observation_formula(env, term), term.config
    assert isinstance(config, ObservationConfig)
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


def _plain(value: object) -> Any:
    """As JSON."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)


def _joints(env: VecEnv) -> list[dict[str, Any]]:
    """All hinges and slides of all entities, and the gains of what drives them."""
    model, rows = env.engine.model, []
    for name, entity in env.entities.items():
        gains: dict[int, tuple[float, float]] = {}
        for kind in ("motor", "position", "velocity"):
            for column, actuator in entity.actuators_of(kind):
                held = kind == "position", kind != "motor"
                parts = (model.actuator_gainprm[actuator, 0], -model.actuator_biasprm[actuator, 2])
                gains[column] = tuple(float(v) + 0.0 if is_ else 0.0 for v, is_ in zip(parts, held, strict=True))  # type: ignore[assignment]
        for drive in entity.actuators:
            for i, column in enumerate(drive.joints):
                gains[column] = float(drive.stiffness[0, i]), float(drive.damping[0, i])
        for column, joint in enumerate(entity.joint_names):
            stiffness, damping = gains.get(column, (None, None))
            rows.append(
                {
                    "name": joint,
                    "entity": name,
                    "qpos": int(entity.qpos_columns[column]),
                    "dof": int(entity.dof_columns[column]),
                    "default": float(entity.data.default_joint_pos[0, column]),
                    "stiffness": stiffness,
                    "damping": damping,
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
