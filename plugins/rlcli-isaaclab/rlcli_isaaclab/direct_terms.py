"""Terms of rlcli that call the hooks of a direct task. Each environment of rlcli has its own `DirectRLEnv`."""

from __future__ import annotations

import copy
import functools
import inspect
import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rlcli.config.term_signatures import Signature
from rlcli.errors import TaskError
from rlcli.managers.attribute_state import AttributeState
from rlcli.sim.env_selection import Selection
from rlcli_isaaclab.direct_env import DirectRLEnv, building
from rlcli_isaaclab.extras_log import ExtrasLog
from rlcli_isaaclab.missing_names import place_of
from rlcli_isaaclab.observation_noise import noise_model
from rlcli_isaaclab.runtime import facade_of
from rlcli_isaaclab.substeps import Substeps
from rlcli_isaaclab.task_fields import set_own_fields
from rlcli_isaaclab.user_files import adapt_to_device
from rlcli_isaaclab.utils.buffers import call_without_effects, set_tensors, tensors_of

_OWN_METRICS = ("Episode_Reward/reward", "Episode_Termination/terminated", "Episode_Termination/time_out")
"""Metrics that rlcli computes for each direct task."""


class HookTerm:
    """One hook of a direct task, such as `_get_rewards`, as a term of rlcli."""

    def __init__(self, hook: str, env_class: type, cfg: Any, shape: tuple[int, ...], reads_body_forces: bool) -> None:
        self.hook, self.env_class, self.cfg, self.shape = hook, env_class, cfg, shape
        self.__name__, self.__module__ = hook, env_class.__module__
        self.target = functools.partial(_bind, self)
        self.target.reads_body_forces = reads_body_forces  # type: ignore[attr-defined]

    def __deepcopy__(self, memo: Any) -> HookTerm:
        return self

    def __call__(self, *args: Any) -> Any:
        """Raise an error: this object only describes the term; the environment makes another one, which it calls."""
        raise TypeError(f"the term {self.hook} cannot be called before it is bound to an environment")

    def __rlcli_term__(self, name: str) -> Signature:
        """Return the signature of the term; `name` is the term's key in the task."""
        file = Path(inspect.getsourcefile(self.env_class) or "?")
        return Signature(
            name, self.__name__, True, file, 1, f"Hook of {self.env_class.__name__}.", (), target=self.target
        )


class DirectRunner:
    """Caller of the methods of the user's `DirectRLEnv`, such as `_get_rewards`, in the order of Isaac Lab's loop.

    The methods that a task implements are called hooks.
    """

    def __init__(self, managed: Any, term: HookTerm) -> None:
        self.managed = managed
        cfg = copy.deepcopy(term.cfg)
        cfg.scene.num_envs, cfg.sim.device = managed.num_envs, str(managed.device)
        cfg.sim.dt, cfg.decimation = managed.physics_dt, managed.config.decimation
        cfg.episode_length_s = managed.config.episode_length_s
        set_own_fields(cfg, managed.config.params)
        self.cfg = cfg
        self.phase = "build"
        self._substeps = Substeps(managed, "direct task", self)
        with building(managed):
            self.lab: DirectRLEnv = adapt_to_device(term.env_class, managed.device)(cfg)
        for asset in self.lab.scene.articulations.values():
            asset.start_wrenches(by_task=True)
        self._start_noise()
        facade_of(managed).extras = self.lab.extras  # events of the configuration get this object as `env`
        managed.task_log = self.log = ExtrasLog(lambda: self.lab.extras, _OWN_METRICS)
        self._memory = AttributeState(self.lab, excluded=("cfg", "managed", "sim", "scene", "rlcli_fire_resets"))
        self._observed: dict[str, Tensor] = {}

    def _start_noise(self) -> None:
        """Create the noise models, without biases of earlier episodes."""
        self.action_noise = noise_model(self.cfg.action_noise_model, self.managed)
        self.observation_noise = noise_model(self.cfg.observation_noise_model, self.managed)

    def apply(self) -> None:
        """Call `_apply_action`, and write the task's forces, before a physics step."""
        self.lab._apply_action()
        for asset in self.lab.scene.articulations.values():
            asset.apply_wrenches()

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the tensors of the task and of its noise models."""
        state = dict(self._memory.state_dict())
        for name, model in self._noise_models().items():
            state |= {f"{name}.{path}": value.clone() for path, value in tensors_of(model).items()}
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors returned by `state_dict`."""
        for name, model in self._noise_models().items():
            start = f"{name}."
            set_tensors(model, {p.removeprefix(start): v for p, v in state.items() if p.startswith(start)})
        names = tuple(f"{name}." for name in self._noise_models())
        self._memory.load_state_dict({path: value for path, value in state.items() if not path.startswith(names)})
        self.phase = "restored"

    def _noise_models(self) -> dict[str, Any]:
        return {"rlcli_action_noise": self.action_noise, "rlcli_observation_noise": self.observation_noise}

    def process(self, action: Tensor) -> None:
        """Call `_pre_physics_step` with the action and its noise, and `_apply_action` in the next physics steps."""
        self.lab._pre_physics_step(self.action_noise(action.clone()))
        self._substeps.start()

    def compute_dones(self) -> None:
        """Call `_get_dones`, except before the first reset, when the managers only check the shapes of values."""
        if self.phase == "build":
            return
        lab = self.lab
        terminated, time_outs = lab._get_dones()
        lab.reset_terminated[:], lab.reset_time_outs[:] = terminated, time_outs
        lab.reset_buf = lab.reset_terminated | lab.reset_time_outs
        self.phase = "done"

    def reset_envs(self, selection: Selection) -> None:
        """Call `_reset_idx` for the selected environments, and reset the noise models there.

        At a reset with a seed, noise models start anew: the biases of an additive noise would add up over its episodes.
        """
        if self.managed.common_step == 0:
            self._start_noise()
        ids = selection.env_ids()
        if len(ids):
            events, step = self.managed.event_manager, self.managed._counters.common_step
            self.lab.rlcli_fire_resets = lambda: events.fire_resets(selection, step)
            try:
                self.log.call_reset(lambda: self.lab._reset_idx(ids))
            finally:
                self.lab.rlcli_fire_resets = None
            self.observation_noise.reset(ids)
            self.action_noise.reset(ids)
        self.phase = "reset"

    def observe(self, group: str, shape: tuple[int, ...]) -> Tensor:
        """Return the observations of a group; `_get_observations` runs once per step, when `policy` is requested.

        If episodes end, the hook runs once more for their last observations; after `load_state_dict`, it runs for the
        observations of the restored state. After these additional calls, the state of the task and of torch's random
        generator is restored.

        Args:
            group: `policy` or `critic`.
            shape: shape of the group's observations.
        """
        if self.phase == "build":
            return torch.zeros(self.managed.num_envs, *_layout_of(shape), device=self.managed.device)
        if group == "policy":
            manager = self.managed.termination_manager
            is_last = self.phase == "done" and bool((manager.terminated | manager.time_outs).any())
            if is_last or self.phase == "restored":
                self._observed = call_without_effects([self.lab], self._call_observations)
            else:
                self._observed = self._call_observations()
                self.phase = "observed"
        return self._observed[group]

    def _call_observations(self) -> dict[str, Tensor]:
        found = dict(self.lab._get_observations())
        if self.cfg.state_space and "critic" not in found:
            found["critic"] = self.lab._get_states()
        found["policy"] = self.observation_noise(found["policy"])
        return {name: _in_layout(value).float().clone() for name, value in found.items() if isinstance(value, Tensor)}


def _layout_of(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape that rlcli gives an observation: an image has its channels first, all others are vectors."""
    return (shape[2], shape[0], shape[1]) if len(shape) == 3 else (math.prod(shape),)


def _in_layout(value: Tensor) -> Tensor:
    """Return an image (num_envs, h, w, c) with the channels first, and any other tensor as (num_envs, k)."""
    if value.dim() == 4:
        return value.movedim(-1, 1).contiguous()
    return value.flatten(1) if value.dim() > 2 else value


def runner_of(managed: Any, term: HookTerm) -> DirectRunner:
    """Return the `DirectRunner` of an environment of rlcli; the first call creates it."""
    if "_isaaclab_direct" not in vars(managed):
        try:
            vars(managed)["_isaaclab_direct"] = DirectRunner(managed, term)
        except ValueError as error:  # a term's ValueError is reported at the term; here it belongs to the task's code
            what = f"{place_of(error)}{type(error).__name__}: {error}"
            hint = getattr(error, "hint", None) or "correct the task's code at this line, or the model"
            raise TaskError(what, hint=hint) from error
    return vars(managed)["_isaaclab_direct"]


class _Hook:
    """Base class of terms that call a hook of a direct task."""

    def __init__(self, runner: DirectRunner, shape: tuple[int, ...]) -> None:
        self._runner, self._shape = runner, shape


class _Action(_Hook):
    unit = ""

    def __init__(self, runner: DirectRunner, shape: tuple[int, ...]) -> None:
        super().__init__(runner, shape)
        self.size = shape[0]
        self.elements = tuple(f"action[{i}]" for i in range(self.size))
        self.sinks = ("direct task",)

    def process(self, action: Tensor) -> None:
        """Call `_pre_physics_step` with the policy's action. (num_envs, a)"""
        self._runner.process(action)


class _Terminated(_Hook):
    def __call__(self) -> Tensor:
        self._runner.compute_dones()
        return self._runner.lab.reset_terminated.clone()


class _TimeOut(_Hook):
    def __call__(self) -> Tensor:
        return self._runner.lab.reset_time_outs.clone()


class _Reward(_Hook):
    def __call__(self) -> Tensor:
        if self._runner.phase == "build":
            return torch.zeros(self._runner.managed.num_envs, device=self._runner.managed.device)
        reward = self._runner.lab._get_rewards().float()
        is_column = reward.shape == (self._runner.managed.num_envs, 1)  # Isaac Lab's agent libraries accept it, too
        return reward[:, 0] if is_column else reward


class _Reset(_Hook):
    fires_resets = True
    """The other reset events run when `_reset_idx` of the task calls that of `DirectRLEnv`."""

    def __call__(self, selection: Selection) -> None:
        self._runner.reset_envs(selection)


class _Policy(_Hook):
    group = "policy"

    def __call__(self) -> Tensor:
        return self._runner.observe(self.group, self._shape)


class _Critic(_Policy):
    group = "critic"


_HOOKS: dict[str, type[_Hook]] = {
    "action": _Action,
    "policy": _Policy,
    "critic": _Critic,
    "reward": _Reward,
    "terminated": _Terminated,
    "time_out": _TimeOut,
    "reset": _Reset,
}


def _bind(term: HookTerm, env: Any) -> Any:
    return _HOOKS[term.hook](runner_of(env, term), term.shape)
