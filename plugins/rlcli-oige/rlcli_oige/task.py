"""`RLTask`, the base class of OmniIsaacGymEnvs' tasks, and the objects that it receives: settings and environment."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from rlcli.envs.direct import DirectTask
from rlcli.errors import TaskError, did_you_mean, listing
from rlcli_oige.articulation_view import ArticulationView
from rlcli_oige.cameras import Writer
from rlcli_oige.prim_paths import BASE, ZERO
from rlcli_oige.randomization import Randomizer
from rlcli_oige.scene_objects import GroundPlane
from rlcli_oige.stage import Prim, Stage
from rlcli_oige.user_code import Counterpart
from rlcli_oige.views import RigidPrimView, XFormPrimView

if TYPE_CHECKING:
    from rlcli_oige.env import OigeEnv

SIM_DEFAULTS: Mapping[str, Any] = {
    "gravity": [0.0, 0.0, -9.81], "dt": 1.0 / 60.0, "rendering_dt": -1.0, "substeps": 1, "use_gpu_pipeline": False,
    "add_ground_plane": True, "add_distant_light": True, "use_fabric": False, "enable_scene_query_support": False,
    "enable_cameras": False, "disable_contact_processing": False,
    "default_physics_material": {"static_friction": 1.0, "dynamic_friction": 1.0, "restitution": 0.0},
}  # fmt: skip
ACTOR_DEFAULTS: Mapping[str, Any] = {
    "override_usd_defaults": False, "make_kinematic": -1, "enable_self_collisions": -1, "enable_gyroscopic_forces": -1,
    "solver_position_iteration_count": -1, "solver_velocity_iteration_count": -1, "sleep_threshold": -1,
    "stabilization_threshold": -1, "max_depenetration_velocity": -1, "density": -1, "mass": -1, "contact_offset": -1,
    "rest_offset": -1,
}  # fmt: skip


class SimConfig(Counterpart):
    """The task's YAML, with evaluated interpolations, and the methods by which OmniIsaacGymEnvs' tasks read it."""

    def __init__(self, config: dict[str, Any] | None = None) -> None:
        self._config = {} if config is None else config
        self._cfg = self._config.get("task", {})
        self._sim_params = copy.deepcopy(dict(SIM_DEFAULTS))
        sim = self._cfg.get("sim", {})
        self._sim_params.update({key: sim[key] for key in self._sim_params if key in sim})
        self._physx_params = dict(sim.get("physx", {}))

    @property
    def config(self) -> dict[str, Any]:
        """All settings; those of the task are under `task`."""
        return self._config

    @property
    def task_config(self) -> dict[str, Any]:
        """The task's YAML."""
        return self._cfg

    @property
    def sim_params(self) -> dict[str, Any]:
        """`sim:` of the YAML, with defaults."""
        return self._sim_params

    @property
    def physx_params(self) -> dict[str, Any]:
        """`sim.physx:` of the YAML."""
        return self._physx_params

    def get_physics_params(self) -> dict[str, Any]:
        """Return `sim:` and `sim.physx:` in one dict."""
        return {**self._sim_params, **self._physx_params}

    def parse_actor_config(self, actor_name: str) -> dict[str, Any]:
        """Return the settings of an actor (robot or object) in `sim:` of the YAML; -1 means the value of its model."""
        settings = self._cfg.get("sim", {}).get(actor_name, {})
        return {**ACTOR_DEFAULTS, **{key: value for key, value in settings.items() if key in ACTOR_DEFAULTS}}

    def apply_articulation_settings(self, name: str, prim: Prim, cfg: Mapping[str, Any]) -> None:
        """Store an actor's settings at its prim. The model takes the settings when the scene is complete."""
        for key, value in cfg.items():
            if value is not None and not (isinstance(value, int | float) and value == -1):
                prim.settings[key] = value

    def apply_rigid_body_settings(
        self, name: str, prim: Prim, cfg: Mapping[str, Any], is_articulation: bool = False
    ) -> None:
        """Store an actor's settings at its prim, as `apply_articulation_settings` does."""
        self.apply_articulation_settings(name, prim, cfg)

    def apply_rigid_shape_settings(self, name: str, prim: Prim, cfg: Mapping[str, Any]) -> None:
        """Store an actor's settings at its prim, as `apply_articulation_settings` does."""
        self.apply_articulation_settings(name, prim, cfg)

    def make_kinematic(self, name: str, prim: Prim, cfg: Any = None, value: Any = None) -> None:
        """Make a body kinematic: a kinematic body moves only when the task sets its pose."""
        prim.settings["make_kinematic"] = self._value(name, "make_kinematic", value)

    def set_density(self, name: str, prim: Prim, value: float | None = None) -> None:
        """Set the density of all geoms of an actor [kg/m^3]; None: the density in the YAML."""
        prim.settings["density"] = self._value(name, "density", value)

    def set_mass(self, name: str, prim: Prim, value: float | None = None) -> None:
        """Set the total mass of an actor [kg]; None: the mass in the YAML."""
        prim.settings["mass"] = self._value(name, "mass", value)

    def set_position_iteration(self, name: str, prim: Prim, value: float | None = None) -> None:
        """Do nothing: MuJoCo has no such setting. The setters of other PhysX settings below are this function too."""

    set_velocity_iteration = set_articulation_position_iteration = set_position_iteration
    set_articulation_velocity_iteration = set_max_depenetration_velocity = set_position_iteration
    set_sleep_threshold = set_stabilization_threshold = set_gyroscopic_forces = set_position_iteration
    set_articulation_sleep_threshold = set_articulation_stabilization_threshold = set_position_iteration
    set_contact_offset = set_rest_offset = set_position_iteration

    def _value(self, name: str, key: str, value: Any) -> Any:
        return self.parse_actor_config(name)[key] if value is None else value


class SceneRegistry(Counterpart):
    """Registry of a task's views and objects by name; it is the argument `scene` of `set_up_scene`."""

    def __init__(self) -> None:
        self.views: dict[str, XFormPrimView] = {}
        self.objects: dict[str, Any] = {}

    @property
    def articulated_views(self) -> dict[str, ArticulationView]:
        """Registered views of robots."""
        return {name: view for name, view in self.views.items() if isinstance(view, ArticulationView)}

    @property
    def rigid_prim_views(self) -> dict[str, RigidPrimView]:
        """Registered views of bodies."""
        return {name: view for name, view in self.views.items() if isinstance(view, RigidPrimView)}

    @property
    def _scene_registry(self) -> SceneRegistry:
        return self

    def add(self, item: Any) -> Any:
        """Register a view or an object under its name.

        Raises:
            TaskError: if another view has that name.
        """
        if not isinstance(item, XFormPrimView):
            self.objects[getattr(item, "name", str(id(item)))] = item
            return item
        if item.name in self.views and self.views[item.name] is not item:
            raise TaskError(f"two views have the name '{item.name}'", hint="give each view of the scene its own name")
        self.views[item.name] = item
        return item

    def object_exists(self, name: str) -> bool:
        """Return whether a name is registered."""
        return name in self.views or name in self.objects

    def get_object(self, name: str) -> Any:
        """Return the object with a name.

        Raises:
            TaskError: if there is none.
        """
        found = {**self.objects, **self.views}
        if name not in found:
            raise TaskError(
                f"the scene has no view '{name}'", hint=did_you_mean(name, found) or f"names: {listing(found)}"
            )
        return found[name]

    def remove_object(self, name: str, registry_only: bool = False) -> None:
        """Remove the view or object with a name from the registry."""
        self.views.pop(name, None)
        self.objects.pop(name, None)

    def add_default_ground_plane(self, *args: Any, **kwargs: Any) -> GroundPlane:
        """Return a ground plane. `sim.add_ground_plane` of the YAML decides whether the scene has one."""
        return GroundPlane()

    add_ground_plane = add_default_ground_plane


class SimulationContext(Counterpart):
    """Simulation that a task may step by itself, within `pre_physics_step`."""

    _env: OigeEnv

    def step(self, render: bool = True) -> None:
        """Simulate one physics step."""
        self._env.step_inside_action()


class World(SimulationContext):
    """Simulation, with the methods of Isaac Sim's World that tasks call."""

    def __init__(self, env: OigeEnv) -> None:
        self._env = env
        self.scene = SceneRegistry()

    def is_playing(self) -> bool:
        """Return whether the simulation runs; False while a viewer has paused it."""
        return self._env.is_playing()

    def is_stopped(self) -> bool:
        """Return False: a task's simulation never stops."""
        return False

    @property
    def stage(self) -> Stage:
        """The stage, with the prims of the scene."""
        return self._env.stage

    def play(self) -> None:
        """Continue after a pause."""
        self._env.pause(False)

    def pause(self) -> None:
        """Pause the simulation."""
        self._env.pause(True)

    def render(self) -> None:
        """Do nothing: viewers render by themselves."""

    def get_physics_dt(self) -> float:
        """Return the physics time step [s]."""
        return self._env.physics_dt

    def get_rendering_dt(self) -> float:
        """Return the time between two frames [s]."""
        return self._env.step_dt

    def get_physics_context(self) -> World:
        """Return the simulation itself."""
        return self

    @property
    def prim_path(self) -> str:
        """Path of the prim that holds the settings of the physics."""
        return "/physicsScene"

    @property
    def current_time_step_index(self) -> int:
        """Physics steps since the start."""
        return self._env.common_step * self._env.config.decimation


class EnvHandle(Counterpart):
    """Object that tasks read as `self._env`: the environment with the attributes of OmniIsaacGymEnvs."""

    def __init__(self, env: OigeEnv) -> None:
        self.runner = env
        self.world = self._world = World(env)
        self.num_envs = env.num_envs
        self.render_enabled = self._render = False
        self.simulation_app = None

    @property
    def task(self) -> RLTask:
        """The task that runs in the environment."""
        return self.runner.task

    _task = task

    @property
    def sim_frame_count(self) -> int:
        """Physics steps since the start."""
        return self.world.current_time_step_index

    def render(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing: viewers render by themselves."""

    create_viewport_render_product = render


class RLTask(DirectTask):
    """Base class of tasks written for OmniIsaacGymEnvs.

    A subclass sets `_num_observations`, `_num_actions` and, for privileged observations of the critic, `_num_states`
    before it calls this constructor.

    OmniIsaacGymEnvs has one flag, `reset_buf`, for termination and time-out. rlcli's environment has two. Where
    `progress_buf >= _max_episode_length - 1`, the environment calls `is_done` again with `progress_buf` at 1. If
    `reset_buf` is then 0, the episode was truncated (time-out); otherwise the episode was terminated.
    """

    _num_observations: int
    _num_actions: int

    def __init__(self, name: str, env: EnvHandle, offset: Any = None) -> None:
        self.name = name
        self._offset = offset
        self._env = env
        self.env = env.runner
        for attribute in ("_num_observations", "_num_actions"):
            if not isinstance(getattr(self, attribute, None), int):
                what = f"{type(self).__name__} does not set {attribute}"
                raise TaskError(what, hint=f"set self.{attribute} before calling RLTask.__init__")
        if not hasattr(self, "_num_states"):
            self._num_states = 0
        if not hasattr(self, "_num_agents"):
            self._num_agents = 1
        settings = env.runner.settings
        if not hasattr(self, "_cfg"):
            self._cfg = settings
        if not hasattr(self, "_task_cfg"):
            self._task_cfg = settings["task"]
        self._num_envs = env.num_envs
        self._device = str(env.runner.device)
        self.rl_device = self._device
        self._rand_seed = self._cfg.get("seed", 42)
        self.test = bool(self._cfg.get("test", False))
        self.is_extension = False
        self.enable_cameras = bool(self._task_cfg.get("sim", {}).get("enable_cameras", False))
        if self.enable_cameras:
            self.rep = env.runner.replicator
            self.PytorchListener, self.PytorchWriter = self.rep.listener, Writer
        self.control_frequency_inv = env.runner.config.decimation
        bounds = env.runner.config
        self.clip_obs = np.inf if bounds.clip_observations is None else bounds.clip_observations
        self.clip_actions = np.inf if bounds.clip_actions is None else bounds.clip_actions
        self._dr_randomizer = Randomizer(env.runner)
        self.dr = self._dr_randomizer.dr
        self.randomize_actions = self.randomize_observations = False
        self.cleanup()

    def cleanup(self) -> None:
        """Create the buffers, such as `obs_buf`, with their initial values."""
        n, device = self._num_envs, self._device
        self.obs_buf = torch.zeros(n, self._num_observations, device=device)
        self.states_buf = torch.zeros(n, self._num_states, device=device)
        self.rew_buf = torch.zeros(n, device=device)
        self.reset_buf = torch.ones(n, dtype=torch.int64, device=device)
        self.progress_buf = torch.zeros(n, dtype=torch.int64, device=device)
        self.extras: dict[str, Any] = {}

    @property
    def num_envs(self) -> int:  # type: ignore[override]
        """Number of environments."""
        return self._num_envs

    @property
    def num_observations(self) -> int:  # type: ignore[override]
        """Number of columns of obs_buf."""
        return self._num_observations

    @property
    def num_actions(self) -> int:  # type: ignore[override]
        """Number of actions."""
        return self._num_actions

    @property
    def num_states(self) -> int:  # type: ignore[override]
        """Number of columns of states_buf, the privileged observations of the critic."""
        return self._num_states

    @property
    def num_agents(self) -> int:
        """Number of agents, 1."""
        return self._num_agents

    @property
    def device(self) -> str:  # type: ignore[override]
        """Device of the tensors."""
        return self._device

    @property
    def default_base_env_path(self) -> str:
        """Parent path of all environments."""
        return BASE

    @property
    def default_zero_env_path(self) -> str:
        """Path of the first environment."""
        return ZERO

    @property
    def world(self) -> World:
        """The simulation, with the methods of Isaac Sim's World."""
        return self._env.world

    @property
    def scene(self) -> SceneRegistry:
        """The registry of the task's views and objects by name."""
        return self._env.world.scene

    @property
    def cfg(self) -> dict[str, Any]:  # type: ignore[override]
        """All settings; those of the task are under `task`."""
        return self._cfg

    def set_up_scene(
        self,
        scene: Any,
        replicate_physics: bool = True,
        collision_filter_global_paths: Any = (),
        filter_collisions: bool = True,
        copy_from_source: bool = False,
    ) -> None:
        """Place the environments on the grid. A subclass's `set_up_scene` calls this after it created its robots."""
        runner = self._env.runner
        self._env_pos = runner.place_environments(getattr(self, "_env_spacing", runner.config.scene.env_spacing))

    def initialize_views(self, scene: Any) -> None:
        """Set the positions of the environments. rlcli does not call this: `set_up_scene` creates the views."""
        self._env_pos = self._env.runner.grid

    def set_initial_camera_params(self, camera_position: Any = (10, 10, 3), camera_target: Any = (0, 0, 0)) -> None:
        """Do nothing: the YAML's `viewport:` sets the camera."""

    def set_is_extension(self, is_extension: bool) -> None:
        """Store whether the task runs as an extension of Isaac Sim; rlcli does not use the flag."""
        self.is_extension = is_extension

    def get_states(self) -> Any:
        """Fill and return states_buf, for a task with privileged observations of the critic; here only return it."""
        return self.states_buf

    def get_extras(self) -> Any:
        """Fill `extras`, the values that the trainer logs."""

    def reset(self, selection: Any = None) -> None:
        """Set the reset flags `reset_buf` of all environments; `selection` has no effect."""
        self.reset_buf = torch.ones_like(self.reset_buf)

    def post_physics_step(self) -> tuple[Tensor, Tensor, Tensor, dict[str, Any]]:
        """Call the hooks that follow physics, for tasks that call this method. rlcli's environment does not use it."""
        self.progress_buf[:] += 1
        if self.world.is_playing():
            self.get_observations()
            self.get_states()
            self.calculate_metrics()
            self.is_done()
            self.get_extras()
        return self.obs_buf, self.rew_buf, self.reset_buf, self.extras
