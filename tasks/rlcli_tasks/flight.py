"""Base class of the direct tasks that fly from point to point.

The methods of the class can also run as a CUDA graph on a GPU: they read no value back, select environments by masks
instead of indices, and write tensors that are kept between steps in place.
"""

from __future__ import annotations

from typing import Any

import torch
from pydantic import Field

from rlcli.config.schema import StrictModel
from rlcli.envs.direct import DirectTask
from rlcli.sim.env_selection import Selection


class FlightTask(DirectTask):
    """Base class of tasks that hover at a target, which jumps to another point every `target_period` steps.

    A subclass's `Params` add the box from which targets are sampled: `target_low` and `target_high` [m].
    """

    class Params(StrictModel):
        """Parameters that all flight tasks have, set in the section `params:` of their YAML."""

        target_period: int = Field(
            500, gt=0, description="Number of environment steps between two changes of the target."
        )
        start_offset: float = Field(
            0.3, ge=0, description="Largest absolute initial offset from the default position, along each axis [m]."
        )
        max_distance: float = Field(
            5.0, gt=0, description="An episode fails if the robot is farther than this from the target [m]."
        )

    params: Any

    def post_reset(self) -> None:
        """Create constants, and buffers that the other methods write in place."""
        params, n = self.params, self.num_envs
        self.robot, self.goal = self.env.entities["robot"], self.env.entities["target"]
        self.target_low = torch.tensor(params.target_low, device=self.device)
        self.target_high = torch.tensor(params.target_high, device=self.device)
        phases = -(-self.max_episode_length // params.target_period)
        self.targets = torch.zeros(n, phases, 3, device=self.device)
        """Targets of the current episode, in order of time. (num_envs, targets, 3) [m]"""
        self.target = torch.zeros(n, 3, device=self.device)
        """Current target. (num_envs, 3) [m]"""
        self.to_target = torch.zeros(n, 3, device=self.device)
        """Vector from the robot to the target in the world frame, set by `get_observations`. (num_envs, 3) [m]"""
        self.distance = torch.zeros(n, device=self.device)
        self.extras["distance"] = self.distance  # distance to the target [m]

    def reset(self, selection: Selection) -> None:
        """Put the robot near its default position, level and at rest, and sample the targets of the episode."""
        offset, phases = self.params.start_offset, self.targets.shape[1]
        default = selection.read_view(self.robot.data.default_root_state)
        self.robot.write_root_pose(
            selection, default[:, :3] + selection.uniform(-offset, offset, (3,)), default[:, 3:7]
        )
        targets = selection.uniform(self.target_low, self.target_high, (phases, 3))
        selection.write(self.targets, targets)
        selection.write(self.target, targets[:, 0])
        self.goal.write_root_pose(selection, targets[:, 0], selection.read(self.goal.data.default_root_state[:, 3:7]))

    def move_target(self) -> None:
        """Set `target` to the target of the next step, and show it in the viewer."""
        phase = (self.progress_buf // self.params.target_period).clamp_(max=self.targets.shape[1] - 1)
        torch.gather(self.targets, 1, phase.view(-1, 1, 1).expand(-1, 1, 3), out=self.target.unsqueeze(1))
        self.env.engine.field("mocap_pos")[:, self.goal.mocap].copy_(self.target)
