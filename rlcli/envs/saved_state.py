"""Functions that save and restore the state of an environment between two steps.

Checkpoints, recordings and crash dumps contain this state.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from rlcli.sim.saved_tensors import require_matching_tensors, substate

if TYPE_CHECKING:
    from rlcli.envs.vec_env import VecEnv


class _Stateful(Protocol):
    def state_dict(self) -> dict[str, Tensor]: ...

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None: ...


def save_state(env: VecEnv) -> dict[str, Tensor]:
    """Return copies of everything that the next steps of an environment depend on."""
    return _state_without_workflow(env) | {f"workflow.{name}": value for name, value in env._workflow_state().items()}


def load_state(env: VecEnv, state: Mapping[str, Tensor]) -> None:
    """Restore the state returned by `save_state`.

    Raises:
        KeyError: if a tensor is missing.
        ValueError: if a tensor has another shape or type, because it was saved from a different environment.
    """
    require_matching_tensors(state, _state_without_workflow(env), "env")
    env._counters.load_state_dict(state)
    env.seed = int(state["seed"])
    env._guard.load_quarantined(state.get("set_aside"))
    env.engine.load_state_dict(substate(state, "engine."))
    env.sim.refresh()
    env.sim.save_good_state()
    for prefix, part in _parts(env).items():
        part.load_state_dict(substate(state, prefix))
    env._load_workflow_state(substate(state, "workflow."))


def _state_without_workflow(env: VecEnv) -> dict[str, Tensor]:
    state = env._counters.state_dict()
    state |= {"seed": torch.tensor(env.seed), "set_aside": env._guard.quarantined.clone()}
    for prefix, part in {"engine.": env.engine, **_parts(env)}.items():
        state.update({f"{prefix}{name}": value for name, value in part.state_dict().items()})
    return state


def _parts(env: VecEnv) -> dict[str, _Stateful]:
    """Return the actuator models, the terrain and the sensors, by the prefix of their keys in the saved state."""
    parts: dict[str, _Stateful] = {f"actuator.{name}.": model for name, model in env.actuators.items()}
    if env.terrain is not None:
        parts["terrain."] = env.terrain
    return parts | {f"sensors.{name}.": sensor for name, sensor in env.sensors.items()}
