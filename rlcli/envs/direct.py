"""Direct workflow: a task is one class with the hooks and buffers of OmniIsaacGymEnvs.

A task derives its class from `DirectTask`; `DirectEnv` is the environment that calls the hooks.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from rlcli.config.schema import StrictModel, TaskConfig
from rlcli.envs.articulation import ArticulationView
from rlcli.envs.layout import Layout, TermLayout
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError, RlcliError, TaskError, short_error
from rlcli.managers.attribute_state import AttributeState
from rlcli.managers.termination import DIVERGED
from rlcli.random import stream
from rlcli.registry import load_object
from rlcli.scene.scene import Scene
from rlcli.sim.env_selection import IdSelection, Selection
from rlcli.sim.saved_tensors import require_matching_tensors, substate

_RESET = stream("direct.reset")


class DirectTask:
    """Base class of a direct task: rlcli makes the buffers (`obs_buf`, `rew_buf`, ...), and the hooks fill them.

    Order of a step: `pre_physics_step`, physics, `progress_buf += 1`, `get_observations`, `get_states`,
    `calculate_metrics`, `is_done`. If episodes ended, `reset` (or `reset_idx`) runs for their environments. Then
    `get_observations` and `get_states` run again, for all environments, but only the rows of those environments are
    used.
    """

    num_observations: ClassVar[int]
    """Number of columns of obs_buf, the observations of the policy."""
    num_actions: ClassVar[int]
    """Number of columns of the action."""
    num_states: ClassVar[int] = 0
    """Number of columns of states_buf, the observations of the critic; 0: none."""
    observation_names: ClassVar[tuple[str, ...]] = ()
    """Names of the columns of obs_buf, for messages and exports."""
    observation_units: ClassVar[tuple[str, ...]] = ()
    """Units of the columns of obs_buf."""
    action_names: ClassVar[tuple[str, ...]] = ()
    """What each column of the action drives, by name, for messages and exports."""
    action_limits: tuple[tuple[float, float], ...] = ()
    """Lowest and highest value of each column of the action: the action space for other libraries; empty: +-1."""
    motors: ClassVar[bool] = True
    """Whether every joint without an actuator gets a motor, so that the task can set any effort."""
    Params: type[StrictModel] = StrictModel
    """Pydantic model of the section `params:` in the YAML."""

    def __init__(self, env: DirectEnv, params: StrictModel) -> None:
        self.env = env
        self.cfg: TaskConfig = env.config
        """Configuration of the task."""
        self.params: Any = params
        """Values of the section `params:`, an object of `Params`."""
        self.num_envs = env.num_envs
        self.device = env.device
        self.step_dt = env.step_dt
        self.max_episode_length = env.max_episode_length
        n = self.num_envs
        self.obs_buf = torch.zeros(n, self.num_observations, device=self.device)
        """Observations of the policy. (num_envs, num_observations)"""
        self.states_buf = torch.zeros(n, self.num_states, device=self.device)
        """Observations of the critic. (num_envs, num_states)"""
        self.rew_buf = torch.zeros(n, device=self.device)
        """Rewards of this step. (num_envs,)"""
        self.reset_buf = torch.ones(n, dtype=torch.int64, device=self.device)
        """1 where an episode ends, from `is_done` to the end of the next `pre_physics_step`. (num_envs,) int64"""
        self.progress_buf = torch.zeros(n, dtype=torch.int64, device=self.device)
        """Steps of the running episode. (num_envs,) int64"""
        self.extras: dict[str, Any] = {}
        """Values and tensors to log, by name. The metric `Task/<name>` is their mean, once an iteration.

        `rlcli eval` reports the mean over the steps of each episode, then over episodes; a value without a row for each
        environment counts for all environments.
        """
        self.episode_metrics: dict[str, Tensor] = {}
        """Values of the running episodes, by name, (num_envs,) each.

        `Metrics/<name>` is the mean, over the episodes that end, of the values in their last step. Fill the dictionary
        in `post_reset`, and write to the tensors in place.
        """

    def set_up_scene(self, scene: Scene) -> None:
        """Register views with `scene.add`. `scene.spec` is the MjSpec before compilation."""

    def post_reset(self) -> None:
        """Look up indices and make buffers; called once, after the simulation is built."""

    def reset(self, selection: Selection) -> None:
        """Write start states; the selected environments are in their default state.

        Take random numbers from the selection and write through it: `entity.write_joint_positions(selection, ...)`,
        `selection.write(...)`. On a GPU this hook is captured in the CUDA graph of the step. A task defines this hook
        or `reset_idx`, not both.
        """

    def reset_idx(self, env_ids: Tensor) -> None:
        """Write start states like `reset`, for the environments `env_ids`, (n,) int64, sorted.

        Tasks of OmniIsaacGymEnvs define this hook instead of `reset`.
        """

    def pre_physics_step(self, actions: Tensor) -> None:
        """Apply the actions. actions (num_envs, num_actions)"""
        raise NotImplementedError

    def get_observations(self) -> Any:
        """Write the observations of the policy to obs_buf."""
        raise NotImplementedError

    def get_states(self) -> Any:
        """Write the observations of the critic to states_buf, if the task has any."""

    def calculate_metrics(self) -> None:
        """Write the rewards of this step to rew_buf."""
        raise NotImplementedError

    def is_done(self) -> None:
        """Set reset_buf to 1 where the task ends an episode; rlcli adds time-outs."""
        raise NotImplementedError

    def in_terms(self) -> dict[str, list[dict[str, Any]]] | None:
        """Describe the observation and the action by terms of `rlcli.mdp`, so that an export needs no task code.

        `observations` and `actions` are lists of terms like those of a YAML (`func`, its parameters, `scale`, `clip`),
        in the order of the columns, before `clip_observations` and after `clip_actions`. None: the task cannot be
        described by such terms. `rlcli export --verify` compares the values of the terms with those of the hooks.
        """
        return None

    def draws(self, env_ids: Tensor, name: str = "reset") -> IdSelection:
        """Return an object that draws random numbers for n environments: `draws(ids).uniform(-1, 1, (k,))` is (n, k).

        The numbers depend only on the seed, the environment, its episode and `name`.
        """
        ids, episodes = env_ids.cpu().numpy(), self.env.episode_index.cpu().numpy()
        device = None if self.device.type == "cpu" else self.device
        key = stream(f"direct.{name}")
        return IdSelection(ids, self.env.seed, episodes[ids], key, device, self.env.stream_ids)

    def selection(self, mask: Tensor, name: str) -> Selection | None:
        """Return a `Selection` of the environments where `mask` (num_envs,) is true, to draw random numbers for them.

        Return None if there is no such environment. The random numbers depend only on the seed, the environment, its
        episode, the step in that episode and `name`. A GPU never returns None, because a test of the mask would force a
        host sync.
        """
        env = self.env
        counters = env.episode_index * (self.max_episode_length + 1) + env.episode_length_buf
        selected = env.engine.select(mask, env.seed, counters)
        return None if selected is None else selected.stream(stream(f"direct.in_episode.{name}"))


class DirectEnv(VecEnv):
    """Environment of a `DirectTask`."""

    not_recorded: ClassVar[str | None] = None
    """Reason why a step of this class cannot be captured in a CUDA graph; None: there is no obstacle."""

    def _prepare_scene(self, scene: Scene) -> None:
        task_class = self._task_class()
        try:
            params = task_class.Params.model_validate(self.config.params)
        except ValueError as error:
            raise ConfigError([self.resolved.problem(("params",), " ".join(str(error).split()))]) from None
        self.task: DirectTask = task_class(self, params)
        self.task.set_up_scene(scene)
        if task_class.motors:
            scene.joints.add_motors()

    def _task_class(self) -> type[DirectTask]:
        """Import and return the class of the task."""
        source = self.resolved.source
        assert source.task is not None
        try:
            task_class = self._import_task(source.task)
        except RlcliError:
            raise
        except Exception as error:
            message = f"task '{source.name}' is broken: {source.task}: {short_error(error)}"
            raise TaskError(message) from error
        if not (isinstance(task_class, type) and issubclass(task_class, DirectTask)):
            raise TaskError(
                f"task '{source.name}' is broken: {source.task} is not a DirectTask; derive the class from DirectTask"
            )
        return task_class

    def _import_task(self, reference: str) -> Any:
        """Return the object that a reference such as `module:Class` names."""
        return load_object(reference)

    def _build_workflow(self) -> None:
        for view in self.views:
            if isinstance(view, ArticulationView):
                view.bind(self)
        task = self.task
        self._returns = torch.zeros(self.num_envs, device=self.device)
        self._fresh = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self._reset_in_step: Selection | None = None  # selection of the environments in `_fresh`
        self._return_field, self._fresh_field = self.engine.as_field(self._returns), self.engine.as_field(self._fresh)
        self._resets_by_selection = type(task).reset is not DirectTask.reset
        self._resets_by_id = type(task).reset_idx is not DirectTask.reset_idx
        self._reset_hook = task.reset_idx
        task.reset_idx = self._reset_stale  # type: ignore[method-assign]
        # three buffers in turn, so that consecutive observations share no memory
        self._obs = itertools.cycle([torch.zeros_like(task.obs_buf) for _ in range(3)])
        self._states = itertools.cycle([torch.zeros_like(task.states_buf) for _ in range(3)])
        self._rewards = itertools.cycle([torch.zeros_like(task.rew_buf) for _ in range(3)])
        self._final_obs = torch.zeros_like(task.obs_buf)
        self._final_states = torch.zeros_like(task.states_buf)
        self._obs_current = False
        self._obs_restored = False  # after a load, the buffers already have the observations after resets
        self._episode_causes: dict[str, Tensor] = {}
        self._observation_columns = [f"obs_buf[{i}]" for i in range(task.num_observations)]
        if len(task.observation_names) == task.num_observations:
            self._observation_columns = list(task.observation_names)
        task.post_reset()
        self._memory = AttributeState(task, excluded=("env", "cfg", "params"))

    def _make_layout(self) -> Layout:
        task = self.task
        names, size = task.observation_names, task.num_observations
        units = task.observation_units if len(task.observation_units) == size else ("",) * size
        clip, action_clip = _symmetric(self.config.clip_observations), _symmetric(self.config.clip_actions)
        action_clips = None if action_clip is None else (action_clip,) * task.num_actions
        terms: tuple[TermLayout, ...] = (TermLayout("obs_buf", size, clip=clip),)
        if len(names) == size:
            terms = tuple(TermLayout(name, 1, unit=unit, clip=clip) for name, unit in zip(names, units, strict=True))
        groups = {"policy": terms}
        if task.num_states:
            groups["critic"] = (TermLayout("states_buf", task.num_states, clip=clip),)
        actions = (TermLayout("actions", task.num_actions, task.action_names, clip=action_clips),)
        return Layout(groups, actions, self.step_dt, self.physics_dt, self.config.decimation)

    def stateful_objects(self) -> list[Any]:
        """Return the direct task, whose attributes a step may change."""
        return [self.task]

    def _extras(self) -> dict[str, Any]:
        """Return the task's `extras`, by name."""
        return self.task.extras

    def _extra_tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Yield the numbers and the tensors of the task's `extras`, without empty ones."""
        for name, value in self._extras().items():
            if isinstance(value, int | float):
                yield name, torch.tensor(float(value), dtype=torch.float64)
            elif isinstance(value, Tensor) and value.numel():
                yield name, value

    def metric_values(self) -> dict[str, Tensor]:
        """Return the numbers and the tensors of the task's `extras`, by the name of the metric, `Task/NAME`."""
        return {f"Task/{name}": value for name, value in self._extra_tensors()}

    def step_metrics(self) -> dict[str, Tensor]:
        """Return the values of the task's `extras` for each environment, by name. (num_envs,) each

        A number, or a tensor without a row for each environment, gives the same value for all environments.
        """
        found = {}
        for name, value in self._extra_tensors():
            rows = value.float() if value.shape[:1] == (self.num_envs,) else value.float().mean().expand(1, 1)
            found[name] = rows.reshape(len(rows), -1).mean(dim=1).expand(self.num_envs).to(self.device)
        return found

    def episode_dependencies(self) -> list[str]:
        """Return the parts of the task that make an episode depend on earlier ones, always with the task's class.

        The class may keep any state from one episode to the next.
        """
        return [*super().episode_dependencies(), f"the class {type(self.task).__name__}"]

    def _before_full_reset(self) -> None:
        self._obs_current = False

    def _apply_action(self, action: Tensor) -> None:
        bound = self.config.clip_actions
        self.task.pre_physics_step(action.clamp(-bound, bound) if bound is not None else action)
        self.task.reset_buf.zero_()
        self._fresh.zero_()
        self._reset_in_step = None

    def _compute_rewards_and_dones(self, diverged: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        task = self.task
        self._run_hooks()
        failed, truncated = self._compute_dones()
        self._episode_causes = {"time_out": truncated, "task": failed}
        reward = next(self._rewards).copy_(task.rew_buf)
        if diverged is not None:
            self._episode_causes[DIVERGED] = diverged
            failed = failed | diverged
            if self.config.divergence_reward is not None:
                reward.masked_fill_(diverged, self.config.divergence_reward)
            if not self.engine.asynchronous:  # on a GPU, `check` reports it later
                reward.masked_fill_(diverged & ~reward.isfinite(), 0.0)
        self._guard.require_finite(reward, "the reward")
        self._returns += reward
        self._obs_current = True
        return reward, failed, truncated

    def _run_hooks(self) -> None:
        """Call the hooks of the task that run after physics."""
        self.task.progress_buf += 1
        self._fill_buffers()
        self.task.calculate_metrics()
        self.task.is_done()

    def _compute_dones(self) -> tuple[Tensor, Tensor]:
        """Return where the task ended the episode, and where it timed out. (num_envs,) bool each"""
        failed = self.task.reset_buf != 0  # a copy, also of a bool buffer: time-outs set these flags later
        return failed, self.episode_length_buf >= self.max_episode_length

    def _compute_final_obs(self) -> dict[str, Tensor]:
        self._final_obs.copy_(self.task.obs_buf)
        if self.task.num_states:
            self._final_states.copy_(self.task.states_buf)
        return self._checked_group(self._final_obs, self._final_states, "last ")

    def _episode_returns_and_causes(self, ended: Selection) -> tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]:
        causes = {name: ended.read_view(fired) for name, fired in self._episode_causes.items()}
        return ended.read(self._return_field), {}, causes

    def _episode_metrics(self, ended: Selection) -> dict[str, Tensor]:
        return {name: ended.read(values).float() for name, values in self.task.episode_metrics.items()}

    def _reset_workflow(self, selection: Selection) -> None:
        task = self.task
        if self._resets_by_selection:
            task.reset(selection.stream(_RESET))
        if self._resets_by_id:
            ids = selection.env_ids()
            if len(ids):
                self._reset_hook(ids)
        self._mark_reset(selection)

    def _mark_reset(self, selection: Selection) -> None:
        """Set the task's buffers of environments that start a new episode, and mark these environments as reset."""
        selection.write(self.task.progress_buf, 0)
        selection.write(self.task.reset_buf, 1)
        selection.write(self._fresh_field, True)
        selection.write(self._return_field, 0.0)
        self._reset_in_step = selection if self._reset_in_step is None else self._reset_in_step.union(selection)

    def _compute_observations(self) -> dict[str, Tensor]:
        """Return the observations of the current state.

        `_compute_rewards_and_dones` has already computed the observations of running episodes; here they are computed
        again only for environments that were just reset.
        """
        task, obs, states = self.task, next(self._obs), next(self._states)
        if not self._obs_current:
            self._fill_buffers()
        pairs = [(task.obs_buf, obs), (task.states_buf, states)][: 2 if task.num_states else 1]
        for buffer, result in pairs:
            result.copy_(buffer)
        if self._reset_in_step is not None and self._obs_current and not self._obs_restored:
            self._fill_buffers()
            for buffer, result in pairs:
                self._reset_in_step.write(result, self._reset_in_step.read_view(buffer))
                buffer.copy_(result)
        self._obs_current, self._obs_restored = False, False
        return self._checked_group(obs, states)

    def _fill_buffers(self) -> None:
        task, bound = self.task, self.config.clip_observations
        task.get_observations()
        task.get_states()
        if bound is not None:
            task.obs_buf.clamp_(-bound, bound)
            if task.num_states:
                task.states_buf.clamp_(-bound, bound)

    def _checked_group(self, obs: Tensor, states: Tensor, which: str = "") -> dict[str, Tensor]:
        self._guard.require_finite(obs, f"the {which}observation", self._observation_columns)
        if self.task.num_states:
            self._guard.require_finite(states, f"the {which}state (states_buf)")
        return self._group(obs, states)

    def _group(self, obs: Tensor, states: Tensor) -> dict[str, Tensor]:
        return {"policy": obs, "critic": states} if self.task.num_states else {"policy": obs}

    def _reset_stale(self, env_ids: Tensor) -> None:
        """Reset environments when the task's own code calls `reset_idx`: this method replaces `reset_idx`.

        Tasks of OmniIsaacGymEnvs call `reset_idx` at the start of `pre_physics_step` where `reset_buf` is set. If the
        environment loop has just reset an environment, only its `reset_buf` is cleared; all others are reset.
        """
        stale = env_ids[~self._fresh[env_ids]]
        self.task.reset_buf[env_ids] = 0
        self.task.progress_buf[env_ids] = 0
        if len(stale):
            self._reset_hook(stale)
            self.episode_length_buf[stale] = 0

    def unsaved_state(self) -> list[str]:
        """Return the attributes of the task that cannot be saved."""
        return self._memory.unsaved()

    def _workflow_state(self) -> dict[str, Tensor]:
        own = {"_returns": self._returns.clone(), "_fresh": self._fresh.clone()}
        return {**own, **{f"task.{name}": value for name, value in self._memory.state_dict().items()}}

    def _load_workflow_state(self, state: Mapping[str, Tensor]) -> None:
        own = {
            f"task.{name}": value for name in _BUFFERS if isinstance(value := getattr(self.task, name, None), Tensor)
        }
        for name in _CONVERTED:  # `self.reset_buf = fallen` replaces the integers by booleans
            saved = state.get(name)
            if saved is not None and not saved.is_complex():
                own[name] = own[name].to(saved.dtype)
        require_matching_tensors(state, {**own, "_returns": self._returns, "_fresh": self._fresh}, "env: workflow")
        self._returns.copy_(state["_returns"])
        self._fresh.copy_(state["_fresh"])
        self._memory.load_state_dict(substate(state, "task."))
        self._obs_current, self._obs_restored = True, True


_BUFFERS = ("obs_buf", "states_buf", "rew_buf", "reset_buf", "progress_buf")
"""Buffers that the environment loop reads. Their shapes and types are checked when a checkpoint is loaded."""

_CONVERTED = ("task.rew_buf", "task.reset_buf", "task.progress_buf")
"""Buffers that a task may replace by tensors of another type: the environment loop converts their values."""


def _symmetric(bound: float | None) -> tuple[float, float] | None:
    return None if bound is None else (-bound, bound)
