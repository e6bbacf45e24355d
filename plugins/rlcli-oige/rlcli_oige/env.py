"""`OigeEnv`: the environment of rlcli that runs a task class written for OmniIsaacGymEnvs."""

from __future__ import annotations

import copy
import inspect
import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from rlcli.envs.build import grid
from rlcli.envs.direct import DirectEnv
from rlcli.envs.layout import Layout
from rlcli.errors import DependencyError, TaskError, pip_install
from rlcli.machine.device_names import on_cpu
from rlcli.registry import import_file, is_framework
from rlcli.scene.scene import Scene
from rlcli.sim.env_selection import Selection
from rlcli_oige.articulation_view import ArticulationView
from rlcli_oige.cameras import Replicator
from rlcli_oige.replacement_modules import refuse
from rlcli_oige.stage import Stage, current_stage
from rlcli_oige.task import EnvHandle, RLTask, SimConfig
from rlcli_oige.task_keys import MOVED_KEYS, ROOT_SETTINGS
from rlcli_oige.task_yaml import is_oige_file
from rlcli_oige.user_code import error_location
from rlcli_oige.views import RigidPrimView

_LOG = logging.getLogger(__name__)
_FORCE_METHODS = ("get_measured_joint_forces", "get_force_sensor_forces", "get_net_contact_forces")
_GRAVITY_METHODS = ("disable_gravities",)
_IMAGE_DIMS = 4
_TINY_GRAVITY_COMPENSATION = 1e-30


_HOOKS = (
    *("__init__", "set_up_scene", "post_reset", "pre_physics_step", "post_physics_step", "get_observations"),
    *("get_states", "calculate_metrics", "is_done", "reset_idx", "get_extras"),
)


def _on_cpu(task_class: type) -> type:
    """Return a subclass of a task class in whose hooks the device `cuda` means the CPU."""
    own = [hook for hook in _HOOKS if getattr(task_class, hook) is not getattr(RLTask, hook, None)]
    members = {hook: on_cpu(getattr(task_class, hook)) for hook in own}
    return type(task_class.__name__, (task_class,), {**members, "__module__": task_class.__module__})


class OigeEnv(DirectEnv):
    """Environment that runs an `RLTask`, a task class of OmniIsaacGymEnvs.

    Differences from rlcli's direct tasks: the one reset flag of the task is split into terminated and truncated,
    observations are clipped after the rewards are computed, and external forces act for one step.
    """

    task: RLTask
    not_recorded: ClassVar[str | None] = "tasks in OmniIsaacGymEnvs' form run step by step on a GPU"

    def _prepare_scene(self, scene: Scene) -> None:
        source, config = self.resolved.source, self.config
        task_class = self._task_class()
        if self.device.type == "cpu" and "cuda" in Path(inspect.getfile(task_class)).read_text(encoding="utf-8"):
            task_class = _on_cpu(task_class)
        if not issubclass(task_class, RLTask):
            hint = "its YAML has OmniIsaacGymEnvs' form: derive the class from rlcli_oige.RLTask"
            raise TaskError(f"task '{source.name}' is broken: {source.task} is not an RLTask", hint=hint)
        self.block = config.foreign["oige"]
        self.grid = grid(self.num_envs, config.scene.env_spacing).to(self.device)
        self.stage = Stage(self.block.get("mjcf", {}), source.root, self.grid)
        self.settings = self._settings()
        self.forces_applied = True
        self._spacing_factor = 1.0
        self._steps_inside, self._told_steps_inside = 0, False
        self._queued_forces: list[tuple[RigidPrimView, Tensor, Tensor]] = []
        self.replicator = Replicator(self)
        self.handle = EnvHandle(self)
        np.random.seed(self.seed)  # some tasks make their terrain with numpy
        with current_stage(self.stage):
            try:
                name = str(self.block.get("name", source.name))
                self.task = task_class(name=name, sim_config=SimConfig(self.settings), env=self.handle)  # type: ignore[call-arg]
            except KeyError as error:
                raise TaskError(
                    f"task '{source.name}' is broken: {task_class.__name__} reads the key {error}, which is missing",
                    hint=f"add it to {source.label}",
                ) from error
            self.task.set_up_scene(self.handle.world.scene)
            if not hasattr(self.task, "_env_pos"):
                what = f"{task_class.__name__}.set_up_scene does not call RLTask.set_up_scene"
                raise TaskError(what, hint="add super().set_up_scene(scene)")
            self.stage.attach(scene, joint_forces=self._mentions(_FORCE_METHODS))
        if type(self.task).post_physics_step is not RLTask.post_physics_step:
            _LOG.warning(
                "%s has its own post_physics_step: what it adds to observations after get_observations is missing in"
                " the first observation of an episode, and a failure in the last step counts as a time-out",
                task_class.__name__,
            )
        self.replicator.add_to(scene)
        if self._mentions(_GRAVITY_METHODS):  # MuJoCo skips it if no body of the compiled model has it
            scene.spec.bodies[-1].gravcomp = scene.spec.bodies[-1].gravcomp or _TINY_GRAVITY_COMPENSATION
        scene.joints.add_motors()
        _set_ground_material(scene, self.block.get("sim", {}).get("default_physics_material") or {})

    def _settings(self) -> dict[str, Any]:
        """Return all settings as tasks read them; values that rlcli keeps under other keys are copied back."""
        config = self.config
        task = copy.deepcopy({key: value for key, value in self.block.items() if key != "mjcf"})
        env, sim = task.setdefault("env", {}), task.setdefault("sim", {})
        env.update(
            numEnvs=self.num_envs,
            envSpacing=config.scene.env_spacing,
            controlFrequencyInv=config.decimation,
            episodeLength=self.max_episode_length,
            maxEpisodeLength=self.max_episode_length,
        )
        for key, bound in (("clipActions", config.clip_actions), ("clipObservations", config.clip_observations)):
            if bound is not None:
                env[key] = bound
        sim.update(dt=config.sim.dt, gravity=list(config.sim.gravity), add_ground_plane=config.scene.ground is not None)
        sim["add_distant_light"] = config.scene.lights.distant is not None
        if any(path[0] == "viewport" for path in MOVED_KEYS) and "viewport" in task:
            task["viewport"].update(camera_position=list(config.viewer.eye), camera_target=list(config.viewer.lookat))
        device = str(self.device)
        return {
            **copy.deepcopy(dict(ROOT_SETTINGS)),
            "task_name": task.get("name", ""),
            "num_envs": self.num_envs,
            "seed": self.seed,
            "sim_device": device,
            "rl_device": device,
            "pipeline": self.device.type.replace("cuda", "gpu"),
            "task": task,
        }

    def _mentions(self, names: tuple[str, ...]) -> bool:
        """Return whether the task's code may call one of these methods.

        The source text of the files with the task's class and its views' classes is searched for the names.
        """
        kinds = [type(self.task), *(type(view) for view in self.handle.world.scene.views.values())]
        files = {
            function.__code__.co_filename
            for kind in kinds
            for base in kind.__mro__
            if not is_framework(base.__module__)
            for function in vars(base).values()
            if hasattr(function, "__code__")
        }
        texts = [Path(file).read_text(encoding="utf-8") for file in files if Path(file).is_file()]
        return any(name in text for name in names for text in texts)

    def _build_workflow(self) -> None:
        self.env_origins = self.env_origins * self._spacing_factor
        for view in self.handle.world.scene.views.values():
            view.bind(self)
        if self.engine.model.nsensor:
            self.engine.field("sensordata")  # create it before the first reset: forces of an initial state are then 0
        for attribute in ("_max_episode_length", "max_episode_length"):
            length = getattr(self.task, attribute, None)
            if length is None:
                continue
            if self._class_sets_length():
                self.max_episode_length = int(length)
            elif int(length) != self.max_episode_length:
                setattr(self.task, attribute, self.max_episode_length)
            break
        self._post_physics_is_own = type(self.task).post_physics_step is not RLTask.post_physics_step
        with current_stage(self.stage):
            for view in self.handle.world.scene.views.values():
                view.initialize(None)
            super()._build_workflow()
        self._resets_by_id = True
        self._randomizer = self.task._dr_randomizer
        self._randomizer.start()
        # OmniIsaacGymEnvs' reset applies zero actions: attributes that pre_physics_step creates exist at an observation
        with torch.random.fork_rng(devices=[]):
            self.task.pre_physics_step(torch.zeros(self.num_envs, self.task.num_actions, device=self.device))
            if self._post_physics_is_own:
                self._run_hooks()
        self._log_ignored()

    def _class_sets_length(self) -> bool:
        """Return whether the task's class sets the episode length: true unless the user has set `episode_length_s`."""
        origin = self.resolved.layers.origin(("episode_length_s",))
        return origin is not None and origin.layer == "task" and is_oige_file(self.resolved.source.config)

    def _import_task(self, reference: str) -> Any:
        """Import the class of the task by `FILE.py:CLASS`; its file may belong to a package."""
        file, _, name = reference.rpartition(":")
        path = Path(file)
        top = next((folder for folder in path.parents if folder.name == "omniisaacgymenvs"), None)
        if top is not None:
            refuse(".".join((top.name, *path.relative_to(top).with_suffix("").parts)), path)
        if not (path.parent / "__init__.py").is_file():
            return super()._import_task(reference)
        try:
            return getattr(import_file(path), name)
        except ModuleNotFoundError as error:
            message = f"{error_location(error) or path}: the task imports '{error.name}', which is not installed"
            raise DependencyError(message, hint=pip_install(str(error.name).partition(".")[0])) from error

    def place_environments(self, spacing: float) -> Tensor:
        """Set the distance of the environments on the grid [m], and return their positions. (num_envs, 3)"""
        if spacing != self.config.scene.env_spacing:
            self._spacing_factor = spacing / self.config.scene.env_spacing
            self.grid.copy_(self.grid * self._spacing_factor)
        return self.grid

    def step_inside_action(self) -> None:
        """Simulate one physics step of all environments, for a task that steps the simulation in `pre_physics_step`."""
        self.engine.step(1)
        self.sim.refresh()
        self._steps_inside += 1

    def _log_ignored(self) -> None:
        """Log the calls of the task that have no effect, once."""
        for found, log, what in (
            (self.stage.lost, _LOG.warning, "not simulated"),
            (self.stage.ignored, _LOG.info, "ignored"),
        ):
            if found:
                log("%s: %s", what, "; ".join(f"{name} [{reason}]" for name, reason in found.items()))
                found.clear()

    def queue_forces(self, view: RigidPrimView, rows: Tensor, forces: Tensor) -> None:
        """Store forces of the domain randomisation, which act in the next step.

        Forces that the task sets in that step replace them.

        Args:
            view: the view of the bodies.
            rows: rows of the view.
            forces: forces at the centres of mass, world frame. (rows, 3) [N]
        """
        self._queued_forces.append((view, rows, forces))

    def contact_force(self, body: int) -> Tensor:
        """Return the sum of the contact forces on a body in the last substep, world frame. (num_envs, 3) [N]"""
        external = self.sim.derived_field("cfrc_ext")[:, body, 3:]
        return external - self.sim.derived_field("xfrc_applied")[:, body, :3]

    def _extras(self) -> dict[str, Any]:
        """Return the task's `extras` as one flat dict."""
        flat: dict[str, Any] = {}
        for name, value in self.task.extras.items():
            flat.update(value if isinstance(value, dict) else {name: value})
        return flat

    def _episode_metrics(self, ended: Selection) -> dict[str, Tensor]:
        """Return an empty dict: OmniIsaacGymEnvs' tasks log only to `extras`."""
        return {}

    def _apply_action(self, action: Tensor) -> None:
        if self.forces_applied:  # forces act for one step
            self.engine.field("xfrc_applied").zero_()
            self.forces_applied = False
        for view, rows, forces in self._queued_forces:
            view.apply_forces(forces, rows)
        self._queued_forces.clear()
        self._steps_inside = 0
        super()._apply_action(self._randomizer.add_action_noise(action))
        if self._steps_inside and not self._told_steps_inside:
            self._told_steps_inside = True
            seconds = (self.config.decimation + self._steps_inside) * self.physics_dt
            text = "pre_physics_step simulates %d physics steps of its own: a step lasts %g s, and not step_dt = %g s"
            _LOG.warning(text, self._steps_inside, seconds, self.step_dt)

    def _compute_rewards_and_dones(self, diverged: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        result = super()._compute_rewards_and_dones(diverged)
        self._randomizer.after_step()
        return result

    def _run_hooks(self) -> None:
        if not self._post_physics_is_own:
            super()._run_hooks()
            return
        self.task.reset_idx = lambda env_ids: None  # type: ignore[method-assign]  # the environment resets later
        try:
            self.task.post_physics_step()
        finally:
            self.task.reset_idx = self._reset_stale  # type: ignore[method-assign]

    def _compute_dones(self) -> tuple[Tensor, Tensor]:
        self.task.get_extras()
        failed, timed_out = self._split_reset_flags()
        return failed, timed_out | (self.episode_length_buf >= self.max_episode_length)

    def _split_reset_flags(self) -> tuple[Tensor, Tensor]:
        """Split `reset_buf` of the task; return where the episode is terminated and where it is truncated.

        Both are (num_envs,) bool. The docstring of `RLTask` has the rule.
        """
        task = self.task
        done = task.reset_buf != 0
        length = getattr(task, "_max_episode_length", self.max_episode_length)
        late = done & (task.progress_buf >= int(length) - 1)
        if not bool(late.any()):
            return done, late
        if self._post_physics_is_own:  # its flags cannot be computed again
            return done & ~late, late
        # evaluate is_done again as if the episode had just begun: flags that are still set do not depend on the time
        flags, progress = task.reset_buf.clone(), task.progress_buf.clone()
        task.reset_buf.zero_()
        task.progress_buf.masked_fill_(late, 1)
        task.is_done()
        failed = task.reset_buf != 0
        task.reset_buf.copy_(flags)
        task.progress_buf.copy_(progress)
        late &= ~failed
        return done & ~late, late

    def _compute_final_obs(self) -> dict[str, Tensor]:
        super()._compute_final_obs()
        return self._group(*self._add_noise_and_clip(self._final_obs, self._final_states))

    def _reset_workflow(self, selection: Selection) -> None:
        ids = selection.env_ids()
        for view in self.handle.world.scene.views.values():
            if isinstance(view, ArticulationView):
                view.clear_targets(ids)
        self._randomizer.before_reset(ids)
        if len(ids):
            self._reset_hook(ids)
            self._randomizer.after_reset(ids)
        self._mark_reset(selection)

    def _compute_observations(self) -> dict[str, Tensor]:
        obs = super()._compute_observations()["policy"]
        states = self._last_states
        return self._group(*self._add_noise_and_clip(obs, states))

    def _group(self, obs: Tensor, states: Tensor) -> dict[str, Tensor]:
        self._last_states = states
        if obs.dim() == _IMAGE_DIMS:  # (num_envs, columns, rows, channels), as rl_games expects images
            obs = obs.permute(0, 3, 1, 2).flatten(1)
        return super()._group(obs, states)

    def _make_layout(self) -> Layout:
        layout, obs = super()._make_layout(), self.task.obs_buf
        if obs.dim() == _IMAGE_DIMS:
            policy = replace(layout.observations["policy"][0], shape=(obs.shape[3], obs.shape[1], obs.shape[2]))
            layout = replace(layout, observations={**layout.observations, "policy": (policy,)})
        return layout

    def _add_noise_and_clip(self, obs: Tensor, states: Tensor) -> tuple[Tensor, Tensor]:
        """Add noise and clip, in place. Rewards were computed before, from exact values."""
        self._randomizer.add_observation_noise(obs)
        bound = self.config.clip_observations
        if bound is not None:
            obs.clamp_(-bound, bound)
            states.clamp_(-bound, bound)
        return obs, states

    def _fill_buffers(self) -> None:
        self.task.get_observations()
        self.task.get_states()

    def _workflow_state(self) -> dict[str, Tensor]:
        state = super()._workflow_state()
        for view in self.handle.world.scene.views.values():
            if isinstance(view, ArticulationView):
                state |= {f"view.{view.name}.{key}": table.clone() for key, table in view.tables().items()}
        state |= {f"randomizer.{name}": value for name, value in self._randomizer.state_dict().items()}
        state["torch_random"] = torch.get_rng_state()
        return state

    def _load_workflow_state(self, state: Mapping[str, Tensor]) -> None:
        views = self.handle.world.scene.views
        plain = {}
        for name, value in state.items():
            if name.startswith("view."):
                view, _, key = name.removeprefix("view.").rpartition(".")
                found = views.get(view)
                if isinstance(found, ArticulationView):
                    found.tables()[key].copy_(value)
            elif name.startswith("randomizer."):
                continue
            elif name == "torch_random":
                torch.set_rng_state(value.cpu())
            else:
                plain[name] = value
        super()._load_workflow_state(plain)
        prefix = "randomizer."
        randomizer_state = {n.removeprefix(prefix): value for n, value in state.items() if n.startswith(prefix)}
        self._randomizer.load_state_dict(randomizer_state)
        self.forces_applied = True


def _set_ground_material(scene: Scene, material: Mapping[str, Any]) -> None:
    """Apply the YAML's `default_physics_material` (friction, restitution) to contacts with the ground."""
    geom = scene.spec.geom("ground") if scene.config.ground is not None else None
    if geom is None or not material:
        return
    geom.priority = 1  # contacts take friction and solref from the ground
    restitution = float(material.get("restitution", 0.0))
    if restitution > 0.0:  # damping ratio of a spring-damper with this coefficient of restitution
        decay = math.log(min(restitution, 0.99))
        geom.solref = [0.02, -decay / math.hypot(math.pi, decay)]
