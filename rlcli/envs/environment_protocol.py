"""Protocol `Environment`: the interface of environments for trainers, evaluations and recorders.

Environments in one process (`VecEnv`) and in several processes (`ShardedEnv`) have this interface.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import torch
from torch import Tensor

from rlcli.config.load import Resolved
from rlcli.config.schema import TaskConfig
from rlcli.envs.layout import Layout
from rlcli.envs.observers import Observers
from rlcli.envs.step_result import StepResult
from rlcli.sim.engine import EngineView

if TYPE_CHECKING:
    from rlcli.envs.vec_env import VecEnv


class Environment(Protocol):
    """`num_envs` copies of a task that are stepped together, in one process (`VecEnv`) or in several (`ShardedEnv`)."""

    resolved: Resolved
    """Resolved configuration of the task and the agent, with the origin of each value."""
    config: TaskConfig
    """Configuration of the task: `resolved.task`."""
    seed: int
    """Seed of all random numbers."""
    device: torch.device
    """Device of all tensors."""
    num_envs: int
    """Number of environments."""
    step_dt: float
    """Control period [s]."""
    physics_dt: float
    """Period of a physics step [s]."""
    max_episode_length: int
    """Number of steps after which an episode times out."""
    layout: Layout
    """Layout of the observation and action columns."""
    final_obs_of: str
    """Which episodes have valid rows in `StepResult.final_obs`: `finished` (all that ended), or only `truncated`."""
    seconds: dict[str, float]
    """Time spent since the start [s]: `step` (whole environment steps) and `physics` (the physics in them)."""
    observers: Observers
    """Objects that are called at fixed points of each step, such as recorders."""
    episode_length_buf: Tensor
    """Steps of the running episode. (num_envs,) int64"""
    episode_index: Tensor
    """Index of the running episode, from 0; the random numbers depend on it. (num_envs,) int64"""
    default_state: dict[str, Tensor]
    """Joint state at the start of episodes, before reset events. qpos (nq,), qvel (nv,)"""
    engine: EngineView
    """The physics engine, as observers, recorders and reports see it."""
    _playing: bool = True

    @property
    def local(self) -> VecEnv:
        """The environments that this process steps, with their terms and managers.

        With several processes, these are the environments of the first shard.
        """

    @property
    def workers(self) -> int:
        """Number of processes that step the environments."""
        return 1

    def reset(self, seed: int | None = None, *, episode: int = 0) -> dict[str, Tensor]:
        """Start a new episode everywhere, and return observations by group. (num_envs, d) float32

        Args:
            seed: seed of all random numbers from now on, as in a new environment; None: the random streams continue.
            episode: with a seed, the index of the episode that begins, to repeat it without the earlier ones. The
                episode is the same as in a whole run only if `episode_dependencies()` is empty.
        """

    def step(self, action: Tensor, restart: Tensor | None = None) -> StepResult:
        """Apply one action for `decimation` physics steps.

        Args:
            action: one row for each environment. (num_envs, a) float32
            restart: environments that skip the step and return to the start of their running episode, with reward 0.
                (num_envs,) bool

        Raises:
            DivergedError: for an action, observation or reward that is not finite. A diverged simulation is not
                an error: it ends the episode of its environment.
        """

    def compute_success(self) -> Tensor | None:
        """Return where all conditions of success hold in the current state; None without conditions. (num_envs,)"""

    def check(self) -> None:
        """Raise the pending `DivergedError` of the steps since the last call; on a CPU, `step` has raised the error."""

    @property
    def common_step(self) -> int:
        """Number of steps since the start or the last reset with a seed, the same in all environments."""

    @property
    def causes(self) -> dict[str, int]:
        """Number of diverged simulations since the start, by cause: see `Divergence.cause`."""

    @property
    def divergences(self) -> int:
        """Number of simulations that diverged since the start."""
        return sum(self.causes.values())

    @property
    def calls_per_step(self) -> int:
        """Number of engine calls in an environment step: 1, or `decimation` with actuator models."""
        return self.config.decimation if self.local.actuators else 1

    @property
    def reward_names(self) -> list[str]:
        """Names of the reward terms, in the order of `StepRecord.reward_terms`; empty for a task without terms."""
        return []

    def extras(self) -> dict[str, float]:
        """Return the values to log, by the names of the metrics.

        The values are the means of a direct task's `extras` or of the curriculum's values, and the number of
        divergences since the last call, by cause.
        """

    def step_metrics(self) -> dict[str, Tensor]:
        """Return the values that a direct task wrote to `extras` in this step, by name. (num_envs,) each

        The values describe the state before resets; evaluations and `StepObserver.on_step` read them. The metrics of
        command terms are in `Episodes.metrics`.
        """
        return {}

    def reset_metrics(self) -> dict[str, Tensor]:
        """Return the values that a task logged about the episodes that ended in this step, by name. (num_envs,) each"""
        return {}

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of everything that the next steps depend on; call it between two steps."""

    def load_state_dict(self, state: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Restore the state returned by `state_dict()`; return its observations by group, (num_envs, d) each.

        Raises:
            KeyError: if a tensor is missing.
            ValueError: if a tensor has another shape or type, because it was saved from a different environment.
        """

    def unsaved_state(self) -> list[str]:
        """Return the names of attributes that `state_dict` cannot save; if there are none, a resumed run is exact."""
        return []

    def stateful_objects(self) -> list[Any]:
        """Return the objects whose attributes a step may change: terms that are classes, or the direct task.

        A CUDA graph of the step must include these attributes.
        """
        return []

    def episode_dependencies(self) -> list[str]:
        """Return the parts of the configuration that make an episode depend on earlier ones, such as `scene.terrain`.

        If the list is empty, an episode can be repeated from its seed and index alone.
        """

    def is_playing(self) -> bool:
        """Return False while the environment is paused; `step` then raises an error."""
        return self._playing

    def pause(self, paused: bool = True) -> None:
        """Pause the environment, so that `step` raises an error; with `paused=False`, end the pause."""
        self._playing = not paused

    def close(self) -> None:
        """Close the engine, the sensors that render, and the worker processes."""
