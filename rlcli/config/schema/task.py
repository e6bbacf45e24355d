"""Schema of a whole task file, of the section `sim` (physics) and of the section `viewer` (camera).

Sections with terms, such as `rewards`, are described in `rlcli.config.schema.terms`.
"""

import math
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationInfo, field_validator

from rlcli.config.schema.base import (
    Count,
    Number,
    Positive,
    Seconds,
    StrictModel,
    Threads,
    Vec3,
    _FractionString,
    _Limits,
)
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

_Acceleration = Annotated[float, _FractionString(), _Limits(-1e4, 1e4)]
_Iterations = Annotated[Count, Field(le=100_000)]


class SimConfig(StrictModel):
    """Settings of the physics: time step, engine, solver and precision."""

    dt: Annotated[float, Field(gt=0, le=0.1), _FractionString(), _Limits(1e-9, 0.1)]
    """Physics time step [s]."""
    render_interval: Count = 1
    """Physics steps between two frames of a video. Videos have at most one frame for each environment step."""
    gravity: tuple[_Acceleration, _Acceleration, _Acceleration] = (0.0, 0.0, -9.81)
    """Gravity in the world frame [m/s^2]."""
    integrator: Literal["euler", "rk4", "implicit", "implicitfast"] | None = None
    """MuJoCo's integrator; null: the integrator in the MJCF of the first entity."""
    iterations: _Iterations | None = None
    """Largest number of solver iterations; null: the number in the MJCF of the first entity."""
    ls_iterations: _Iterations | None = None
    """Largest number of line-search iterations of the solver; null: the number in the MJCF of the first entity."""
    engine: Literal["auto", "batch", "warp"] = "auto"
    """Physics engine. batch: MuJoCo on CPU threads; warp: MuJoCo Warp on a GPU; auto: batch on a CPU, warp on a GPU."""
    engine_threads: Threads | None = None
    """Number of CPU threads that step the physics; null: one for each core that this process may use."""
    forces_after_reset: bool = True
    """true: compute accelerations and forces also for the start state of an episode; false: they are 0 until the first
    step. If terms read accelerations or forces on a GPU, false saves one mj_forward of all environments per step."""
    derived_fields: Literal["current", "substep"] = "current"
    """State that MuJoCo's derived fields (xpos, cvel, sensordata, ...) belong to. current: the state after the
    environment step; substep: the state before the last physics step, as after `mj_step`. substep is faster, because
    the fields are not computed again."""
    external_forces: bool = False
    """true: compute `cfrc_ext`, the contact forces on bodies, after every step, as `mj_rnePostConstraint` does. The
    forces are 0 in a start state. On a CPU this takes about 15 us for each environment that has contacts."""
    max_velocity: Positive | None = None
    """Speed of a joint or a free body [m/s or rad/s] above which an environment counts as diverged; checked after every
    environment step. null: MuJoCo's own limit, 1e10. A lower limit also catches large finite speeds, such as 1e6 m/s
    after a bad contact, which would spoil the training."""
    contacts_per_env: Count | None = None
    """Number of contacts for each environment that warp allocates memory for; null: estimated from the model."""
    constraints_per_env: Count | None = None
    """Number of constraint rows (limits, friction, contacts) for each environment that warp allocates memory for; null:
    estimated from the model."""


class ViewerConfig(StrictModel):
    """Camera of viewers, images and videos."""

    eye: Vec3 = (4.0, 4.0, 3.0)
    """Position of the camera [m], world frame of the environment that is shown."""
    lookat: Vec3 = (0.0, 0.0, 0.0)
    """Point at which the camera looks [m], in the frame of `eye`."""
    follow: str | None = None
    """Entity that the camera of images and videos follows: the camera moves by the displacement of the entity's root
    from its default position. null: the camera does not move."""
    width: Annotated[int, Field(ge=16, le=3840)] = 640
    """Image width [pixels]."""
    height: Annotated[int, Field(ge=16, le=2160)] = 480
    """Image height [pixels]."""


class TaskConfig(StrictModel):
    """A whole task. Manager-based tasks have sections of terms (actions to curriculum), direct tasks have `params`."""

    summary: str = ""
    """One line that describes the task."""
    sim: SimConfig
    """Settings of the physics."""
    decimation: Annotated[Count, Field(le=10_000)]
    """Number of physics steps in an environment step; step_dt = dt x decimation."""
    episode_length_s: Seconds
    """Largest length of an episode [s]; longer episodes are truncated."""
    scene: SceneConfig
    """Environments, ground, lights, robots and objects."""
    viewer: ViewerConfig = ViewerConfig()
    """Camera of viewers, images and videos."""
    actions: dict[str, ActionConfig | None] = {}
    """Action terms, in the order of the policy's output. null removes a term."""
    commands: dict[str, CommandConfig | None] = {}
    """Command terms: goals for the policy, such as a target velocity."""
    observations: dict[str, ObservationGroupConfig] = {}
    """Groups of observation terms. The group `policy` is the input of the policy."""
    events: dict[str, EventConfig | None] = {}
    """Event terms: changes of environments at the start, at resets or at intervals."""
    rewards: dict[str, RewardConfig | None] = {}
    """Reward terms. The reward of a step is their weighted sum."""
    terminations: dict[str, TerminationConfig | None] = {}
    """Termination terms. An episode ends when one of them is true."""
    curriculum: dict[str, CurriculumConfig | None] = {}
    """Curriculum terms: changes of the task during training, such as its difficulty."""
    success: dict[str, SuccessConfig | None] = {}
    """Conditions of success, by name; an episode succeeds if it ends by time-out and each of them held in its last
    `hold_s` seconds."""
    reward_dt_scaling: bool = True
    """true: rewards of manager-based tasks are multiplied by step_dt, so that returns do not depend on the control
    rate."""
    keep_state_at_reset: bool = False
    """true: an episode starts in the last state of the previous episode, which reset events change, as in Isaac Lab;
    false: in the default state. The first episodes after a reset of all environments start in the default state."""
    divergence_reward: Number | None = None
    """Reward of the step in which an environment diverged; null: the reward of its last finite state. The episode is
    terminated."""
    params: dict[str, Any] = {}
    """Parameters of a direct task, checked by the class `Params` of the task."""
    foreign: dict[str, dict[str, Any]] = {}
    """Settings of task files in another framework's format that only the environment of this format reads: key of the
    format -> settings. In a file the key of the format, such as `oige`, is at the top level, without `foreign`."""
    clip_actions: Positive | None = None
    """Direct tasks: actions are clamped to +-`clip_actions` before pre_physics_step; null: not clamped."""
    clip_observations: Positive | None = None
    """Direct tasks: observations are clamped to +-`clip_observations`; null: not clamped."""
    play: dict[str, Any] = {}
    """Changes of this configuration for play and eval."""
    agents: dict[str, Any] = {}
    """Name -> settings of a trainer. The key `default` names the default agent, or the default agent for each
    device."""

    @field_validator("episode_length_s")
    @classmethod
    def _at_least_one_step(cls, value: float, info: ValidationInfo) -> float:
        if "sim" in info.data and "decimation" in info.data:
            step_dt = info.data["sim"].dt * info.data["decimation"]
            if value < step_dt:
                raise ValueError(
                    f"{value:g} s is shorter than one step (dt x decimation = {step_dt:g} s); write a larger number"
                )
        return value

    @field_validator("viewer")
    @classmethod
    def _check_followed_entity(cls, value: ViewerConfig, info: ValidationInfo) -> ViewerConfig:
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
        """Largest number of steps in an episode. A tolerance absorbs rounding: 5 s at 1/60 s are 300 steps."""
        return math.ceil(self.episode_length_s / self.step_dt - 1e-6)
