"""A whole task, with its simulation and its camera."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator

from rlcli.config.schema.base import Count, Number, Positive, StrictModel, Threads, Vec3, _FractionString
from rlcli.config.schema.scene import SceneConfig
from rlcli.config.schema.terms import (
    ActionConfig,
    CommandConfig,
    CurriculumConfig,
    EventConfig,
    ObservationGroupConfig,
    RewardConfig,
    SuccessConfig,
    TerminationConfig,
)


class SimConfig(StrictModel):
    """The simulation."""

    dt: Annotated[float, Field(gt=0, le=0.1), _FractionString()]
    """Physics time step [s]."""
    render_interval: Count = 1
    """Physics steps between two frames of a video; never less than one environment step."""
    gravity: Vec3 = (0.0, 0.0, -9.81)
    """Gravity in the world frame [m/s^2]."""
    integrator: Literal["euler", "rk4", "implicit", "implicitfast"] | None = None
    """MuJoCo's integrator; null takes the first entity's MJCF."""
    iterations: Count | None = None
    """Solver iterations; null takes the first entity's MJCF."""
    ls_iterations: Count | None = None
    """Line-search iterations of the solver; null takes the first entity's MJCF."""
    engine: Literal["auto", "batch", "warp"] = "auto"
    """What steps the worlds: auto is batch (MuJoCo's threads) on a CPU and warp (MuJoCo Warp) on a GPU."""
    engine_threads: Threads | None = None
    """Threads that step physics; null is every core this process may use."""
    forces_after_reset: bool = True
    """Compute accelerations and forces of a start state; false: they are 0 until an episode's first step, which saves
    a GPU that reads them a forward pass over all environments a step."""
    derived_fields: Literal["current", "substep"] = "current"
    """What is read of the fields that MuJoCo derives from the state (xpos, cvel, sensordata, ...): current is that of
    the state after the step; substep is what the last physics step left, which describes the state before it, and
    saves computing them anew: as one reads them after `mj_step`."""
    external_forces: bool = False
    """Compute `cfrc_ext`, the forces of contacts on bodies, after every step, as `mj_rnePostConstraint` does; they are
    0 in a start state. On a CPU it takes about 15 us for each environment that touches something."""
    max_velocity: Positive | None = None
    """Speed of a joint or a free body [m/s, rad/s] beyond which an environment counts as diverged, after an environment
    step; null: MuJoCo's own bound, 1e10. A contact that throws a body at a finite 1e6 m/s ruins a learner."""
    contacts_per_env: Count | None = None
    """Room for contacts that warp sets aside, an environment; null estimates it from the model."""
    constraints_per_env: Count | None = None
    """Room for constraint rows (limits, friction, contacts) likewise."""


class ViewerConfig(StrictModel):
    """Where the camera stands."""

    eye: Vec3 = (4.0, 4.0, 3.0)
    """Camera position [m], world frame of the environment shown."""
    lookat: Vec3 = (0.0, 0.0, 0.0)
    """Point the camera looks at [m]."""
    follow: str | None = None
    """Entity that the camera of pictures and videos goes along with, as far as its root is from where the entity's
    default state has it; null: the camera stands still."""
    width: Annotated[int, Field(ge=16, le=3840)] = 640
    """Picture width [pixels]."""
    height: Annotated[int, Field(ge=16, le=2160)] = 480
    """Picture height [pixels]."""


class TaskConfig(StrictModel):
    """A whole task. Manager-based tasks fill actions ... terminations, direct tasks `params`."""

    summary: str = ""
    """One line that says what the task is."""
    sim: SimConfig
    """Physics."""
    decimation: Count
    """Physics steps an environment step; step_dt = dt x decimation."""
    episode_length_s: Positive
    """Length of an episode [s]; it is truncated there."""
    scene: SceneConfig
    """Environments, ground, lights, robots."""
    viewer: ViewerConfig = ViewerConfig()
    """Camera of videos and windows."""
    actions: dict[str, ActionConfig | None] = {}
    """Action terms, in the order of the policy's output; null removes one."""
    commands: dict[str, CommandConfig | None] = {}
    """Command terms."""
    observations: dict[str, ObservationGroupConfig] = {}
    """Groups of observation terms; the policy reads the group `policy`."""
    events: dict[str, EventConfig | None] = {}
    """Event terms."""
    rewards: dict[str, RewardConfig | None] = {}
    """Reward terms."""
    terminations: dict[str, TerminationConfig | None] = {}
    """Termination terms."""
    curriculum: dict[str, CurriculumConfig | None] = {}
    """Curriculum terms."""
    success: SuccessConfig | None = None
    """What makes an episode a success in `eval`."""
    reward_dt_scaling: bool = True
    """Multiply manager-based rewards by step_dt, so that returns do not depend on the control rate."""
    divergence_reward: Number | None = None
    """Reward of the step in which an environment diverged; null: that of its last finite state, terminated."""
    params: dict[str, Any] = {}
    """Parameters of a direct task, checked by the task's own Params."""
    foreign: dict[str, dict[str, Any]] = {}
    """Key of another framework's format -> what only its environment reads. In a file the key stands at the top."""
    clip_actions: Positive | None = None
    """Direct tasks: actions are clamped to +-this before pre_physics_step."""
    clip_observations: Positive | None = None
    """Direct tasks: observations are clamped to +-this."""
    play: dict[str, Any] = {}
    """Patch of this configuration for play and eval."""
    agents: dict[str, Any] = {}
    """Name -> settings of a trainer; `default` names the one to use, by itself or by device."""

    @field_validator("episode_length_s")
    @classmethod
    def _at_least_one_step(cls, value: float, info: ValidationInfo) -> float:
        if "sim" in info.data and "decimation" in info.data:
            step_dt = info.data["sim"].dt * info.data["decimation"]
            if value < step_dt:
                raise ValueError(f"{value:g} s is shorter than one step (dt x decimation = {step_dt:g} s)")
        return value

    @field_validator("viewer")
    @classmethod
    def _something_to_follow(cls, value: ViewerConfig, info: ValidationInfo) -> ViewerConfig:
        scene = info.data.get("scene")
        if value.follow is not None and scene is not None and value.follow not in scene.entities:
            have = ", ".join(scene.entities)
            raise ValueError(f"follow: there is no entity '{value.follow}' in the scene; entities: {have}")
        return value

    @property
    def step_dt(self) -> float:
        """Control period [s]."""
        return self.sim.dt * self.decimation

    @property
    def max_episode_length(self) -> int:
        """Steps of an episode; the small slack absorbs rounding, so that 5 s at 1/60 s is 300 steps."""
        return math.ceil(self.episode_length_s / self.step_dt - 1e-6)
