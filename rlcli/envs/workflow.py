"""Hooks that the environment loop calls and the two workflows (manager-based and direct) implement.

The class is the abstract base of `VecEnv`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

import torch
from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.envs.layout import Layout
from rlcli.scene.scene import Scene
from rlcli.scene.terrain import Terrain
from rlcli.sim.env_selection import Selection
from rlcli.sim.markers import Marker


class Workflow(Environment):
    """Hooks that the environment loop calls and the manager-based and the direct workflow implement.

    `VecEnv`, the environment loop, calls the hooks whose names begin with an underscore; the other methods are for
    users of the environment.
    """

    terrain: Terrain | None

    # --- construction, in this order ---

    @abstractmethod
    def _prepare_scene(self, scene: Scene) -> None:
        """Add what the workflow needs, such as actuators, to the scene before it is compiled."""

    def _bind_terms(self) -> None:
        """Resolve the names of the configuration, once entities exist."""

    @abstractmethod
    def _build_workflow(self) -> None:
        """Build the managers of a manager-based task, or finish the setup of a direct task."""

    @abstractmethod
    def _make_layout(self) -> Layout:
        """Return the layout of the observation and action columns."""

    # --- a step, in this order ---

    @abstractmethod
    def _apply_action(self, action: Tensor) -> None:
        """Turn the policy's action into controls. action (num_envs, a)"""

    @abstractmethod
    def _compute_rewards_and_dones(self, diverged: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return reward, terminated and truncated of the step, before any reset. (num_envs,) each"""

    @abstractmethod
    def _compute_final_obs(self) -> dict[str, Tensor]:
        """Return the last observations of the episodes, before any reset."""

    @abstractmethod
    def _episode_returns_and_causes(self, ended: Selection) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        """Return (returns, reward terms, causes) of the episodes that end, as in `Episodes`. (n,) each"""

    def _episode_metrics(self, ended: Selection) -> dict[str, Tensor]:
        """Return `Episodes.metrics` of the episodes that end. (n,) each"""
        return {}

    def _reward_terms(self) -> Tensor:
        """Return the reward of the step by term. (terms, num_envs)"""
        return torch.zeros(0, self.num_envs, device=self.device)

    def _before_reset(self, ended: Selection) -> None:
        """Update the curriculum with the episodes that end, before their environments are reset."""

    @abstractmethod
    def _reset_workflow(self, selection: Selection) -> None:
        """Write the start states of new episodes, and clear the state of the old ones."""

    def _update_commands_and_events(self) -> None:
        """Update commands and run interval events, after resets and before observations."""

    @abstractmethod
    def _compute_observations(self) -> dict[str, Tensor]:
        """Return the observations of the current state."""

    # --- outside of a step ---

    def _before_full_reset(self) -> None:
        """Prepare for a reset of all environments."""

    def _raise_for_term(self, what: str) -> None:
        """Raise a `DivergedError` that names the term with the value that is not finite; return if it is unknown.

        Args:
            what: the quantity that is not finite, such as `the reward`.
        """

    def _restore_observations(self) -> dict[str, Tensor]:
        """Return the observations of a state that has just been loaded."""
        return self._compute_observations()

    def metric_values(self) -> dict[str, Tensor]:
        """Return the tensors of the newest step whose means are logged, by name; they may have any shape.

        The tensors are the `extras` of a direct task, or the values of the curriculum.
        """
        return {}

    @abstractmethod
    def _workflow_state(self) -> dict[str, Tensor]:
        """Return copies of the state that the workflow keeps from step to step."""

    @abstractmethod
    def _load_workflow_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `_workflow_state`."""

    def episode_dependencies(self) -> list[str]:
        """Return parts of the configuration that make an episode depend on earlier ones, such as `scene.terrain`."""
        terrain = ["scene.terrain"] if self.terrain is not None else []
        return terrain + (["keep_state_at_reset"] if self.config.keep_state_at_reset else [])

    def markers(self) -> list[Marker]:
        """Return the shapes that viewers show beside the bodies. Only viewers call this method."""
        return []
