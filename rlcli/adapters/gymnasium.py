"""A task as Gymnasium wants it: a `VectorEnv` of many environments, and an `Env` of one.

`rlcli.gym` registers them: `gym.make_vec("rlcli.gym:rlcli/cartpole", num_envs=8)`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from rlcli.config.load import Resolved, resolve
from rlcli.config.schema import TaskConfig
from rlcli.envs.make import make_env
from rlcli.envs.step import StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.registry import find_task

if TYPE_CHECKING:
    from rlcli.viewer.offscreen import Renderer

Floats = NDArray[np.float32]
Changes = Mapping[str, Any] | Iterable[str] | TaskConfig | Resolved | None


def open_task(
    task: str, num_envs: int, cfg: Changes = None, *, agent: str | None = None, seed: int = 42, device: str = "cpu"
) -> VecEnv:
    """The environment of a task.

    Args:
        task: its name, or its folder.
        num_envs: environments.
        cfg: what to change: a mapping, `{"episode_length_s": 3.0}`, with dotted keys or nested; or a list of overrides,
            `["episode_length_s=3.0"]`; or a whole configuration in the task's place.
        agent: the agent whose patch of the task is applied; None: the default one.
        seed: of every random draw, until `reset` is given another.
        device: cpu, cuda or cuda:N.
    """
    if isinstance(cfg, Resolved):
        cfg = cfg.task
    if isinstance(cfg, TaskConfig):
        scene = cfg.scene.model_copy(update={"num_envs": num_envs})
        source = find_task(task)
        return make_env(cfg.model_copy(update={"scene": scene}), seed=seed, device=device, root=source.root)
    if isinstance(cfg, str):
        raise TypeError(f"cfg is a mapping or a list of overrides: [{cfg!r}]")
    changes = dict(_flat(cfg)) if isinstance(cfg, Mapping) else {}
    overrides = () if cfg is None or isinstance(cfg, Mapping) else tuple(cfg)
    flags = {**changes, "scene.num_envs": num_envs}
    resolved = resolve(find_task(task), agent=agent, device=device.partition(":")[0], overrides=overrides, flags=flags)
    return make_env(resolved, seed=seed, device=device)


def make_vector(
    task: str,
    num_envs: int = 1,
    cfg: Changes = None,
    *,
    autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    action_bound: float | None = 1.0,
    render_mode: str | None = None,
    **settings: Any,
) -> GymnasiumVectorEnv:
    """What `gym.make_vec` calls; see `open_task` and `GymnasiumVectorEnv` for the arguments."""
    env = open_task(task, num_envs, cfg, **settings)
    return GymnasiumVectorEnv(env, autoreset_mode, action_bound=action_bound, render_mode=render_mode)


def make_single(
    task: str,
    cfg: Changes = None,
    *,
    action_bound: float | None = 1.0,
    render_mode: str | None = None,
    **settings: Any,
) -> GymnasiumEnv:
    """What `gym.make` calls; see `open_task` and `GymnasiumEnv` for the arguments."""
    return GymnasiumEnv(open_task(task, 1, cfg, **settings), action_bound=action_bound, render_mode=render_mode)


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv):
    """The policy group of a `VecEnv`, as float32 arrays of their own in every step.

    In each mode an environment lives through the same episodes, since what starts one depends on its number alone:
    - SAME_STEP: the observation of an ended episode is the next one's first; its last is in `info["final_obs"]`;
    - NEXT_STEP: it is its last; the step after ignores the action, has reward 0 and gives the next one's first;
    - DISABLED: it is its last; `reset(options={"reset_mask": mask})` begins the next one where the mask holds.

    Args:
        env: the environment.
        autoreset_mode: which of them, or its value: "SameStep", "NextStep", "Disabled".
        action_bound: limits of the action space where the task has none; None for unbounded.
        render_mode: rgb_array, pictures of the first environment; None.
    """

    metadata: dict[str, Any]

    def __init__(
        self,
        env: VecEnv,
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        *,
        action_bound: float | None = 1.0,
        render_mode: str | None = None,
    ) -> None:
        self.env = env
        self.num_envs = env.num_envs
        self.mode = AutoresetMode(autoreset_mode)
        self.metadata = {**_metadata(env), "autoreset_mode": self.mode}
        self.render_mode = _known_mode(render_mode)
        self.single_observation_space = observation_space(env)
        self.single_action_space = action_space(env, action_bound)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._ended = np.zeros(self.num_envs, dtype=bool)
        self._first: Floats | None = None  # of the episodes that have begun where the last ones ended
        self._seen: Floats | None = None
        self._camera = _Camera(env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Begin new episodes: everywhere, or where `options["reset_mask"]` holds. (num_envs, d)

        A seed seeds every environment, each with its own stream.

        Raises:
            ValueError: for a mask that holds where no episode has ended.
        """
        if seed is not None and not isinstance(seed, int | np.integer):
            raise TypeError(f"seed is one number for all environments, which have a stream each; found {seed!r}")
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        if mask is not None and not (np.all(mask) and (seed is not None or not self._ended.all())):
            return self._begin(np.asarray(mask, dtype=bool)), {}
        self._ended[:] = False
        self._seen = _floats(self.env.reset(seed=seed))
        return self._seen.copy(), {}

    def step(
        self, actions: Floats
    ) -> tuple[Floats, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step all environments. actions (num_envs, a)

        Raises:
            RuntimeError: in mode DISABLED, if an episode has ended and no new one has begun.
        """
        action = torch.as_tensor(np.asarray(actions, dtype=np.float32), device=self.env.device)
        waiting = self._ended.copy()
        if not waiting.any():
            result = self.env.step(action)
        elif self.mode is AutoresetMode.DISABLED:
            ids = np.flatnonzero(waiting).tolist()
            raise RuntimeError(f"environments {ids} have ended: reset(options={{'reset_mask': mask}}) begins anew")
        else:
            result = self.env.step(action, torch.from_numpy(waiting).to(self.env.device))
        obs = _floats(result.obs)
        terminated, truncated = (flags.cpu().numpy().copy() for flags in (result.terminated, result.truncated))
        infos = self._infos(result)
        if self.mode is AutoresetMode.SAME_STEP:
            infos = self._final_infos(result, infos)
        else:
            self._ended = terminated | truncated
            if self._ended.any():
                assert result.final_obs is not None
                self._first = obs
                obs = np.where(self._ended[:, None], _floats(result.final_obs), obs)
        self._seen = obs
        return obs.copy(), result.reward.cpu().numpy().astype(np.float64), terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture of the first environment; None without a `render_mode`. (height, width, 3)"""
        return None if self.render_mode is None else (self._camera.picture(),)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environment."""
        self._camera.close()
        self.env.close()

    def _begin(self, mask: NDArray[np.bool_]) -> Floats:
        if mask.shape != (self.num_envs,):
            raise ValueError(f"reset_mask has shape {mask.shape}, expected {(self.num_envs,)}")
        running = np.flatnonzero(mask & ~self._ended).tolist()
        if running or self._seen is None:
            raise ValueError(f"reset_mask holds in environments {running}, whose episodes have not ended")
        if mask.any():
            assert self._first is not None
            self._seen = np.where(mask[:, None], self._first, self._seen)
            self._ended &= ~mask
        return self._seen.copy()

    def _infos(self, result: StepResult) -> dict[str, Any]:
        if result.episodes is None or result.episodes.success is None:
            return {}
        ended = result.episodes.ended()
        assert ended.success is not None
        success, known = (np.zeros(self.num_envs, dtype=bool) for _ in range(2))
        ids = ended.ids.cpu().numpy()
        success[ids], known[ids] = ended.success.cpu().numpy(), True
        return {"success": success, "_success": known} if known.any() else {}

    def _final_infos(self, result: StepResult, infos: dict[str, Any]) -> dict[str, Any]:
        if result.episodes is None or result.final_obs is None:
            return {}
        final = _floats(result.final_obs)
        found: dict[str, Any] = {}
        for world in result.episodes.ended().ids.tolist():
            own = {"success": bool(infos["success"][world])} if "success" in infos else {}
            found = self._add_info(found, {"final_obs": final[world].copy(), "final_info": own}, world)
        return found


class GymnasiumEnv(gymnasium.Env):
    """The policy group of a `VecEnv` of one environment.

    Args:
        env: the environment.
        action_bound: limits of the action space where the task has none; None for unbounded.
        render_mode: rgb_array, or None.
    """

    metadata: dict[str, Any]

    def __init__(self, env: VecEnv, *, action_bound: float | None = 1.0, render_mode: str | None = None) -> None:
        if env.num_envs != 1:
            raise ValueError(f"the environment has {env.num_envs} worlds; GymnasiumVectorEnv takes more than one")
        self.env = env
        self.metadata = _metadata(env)
        self.render_mode = _known_mode(render_mode)
        self.observation_space = observation_space(env)
        self.action_space = action_space(env, action_bound)
        self._first: Floats | None = None  # of the episode that has begun where the last one ended
        self._camera = _Camera(env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Begin a new episode. (d,)"""
        super().reset(seed=seed)
        first, self._first = self._first, None
        if first is None or seed is not None:
            first = _floats(self.env.reset(seed=seed))[0]
        return first.copy(), {}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Step. action (a,)

        Raises:
            RuntimeError: if the episode has ended and no new one has begun.
        """
        if self._first is not None:
            raise RuntimeError("the episode has ended: reset() begins a new one")
        actions = torch.as_tensor(np.asarray(action, dtype=np.float32), device=self.env.device)
        result = self.env.step(actions[None])
        obs, info = _floats(result.obs)[0], {}
        terminated, truncated = bool(result.terminated[0]), bool(result.truncated[0])
        if terminated or truncated:
            assert result.final_obs is not None
            self._first, obs = obs, _floats(result.final_obs)[0]
            if result.episodes is not None and result.episodes.success is not None:
                info["success"] = bool(result.episodes.success[0])
        return obs.copy(), float(result.reward[0]), terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """A picture; None without a `render_mode`. (height, width, 3)"""
        return None if self.render_mode is None else self._camera.picture()

    def close(self) -> None:
        """Close the environment."""
        self._camera.close()
        self.env.close()


def observation_space(env: VecEnv) -> spaces.Box:
    """Of the policy group of one environment."""
    return spaces.Box(-np.inf, np.inf, (env.layout.size("policy"),), np.float32)


def action_space(env: VecEnv, action_bound: float | None = 1.0) -> spaces.Box:
    """Of one environment: the direct task's `action_limits`, else +-action_bound."""
    limits = getattr(getattr(env, "task", None), "action_limits", ())
    size = env.layout.action_size
    if len(limits) == size:
        low, high = np.asarray(limits, dtype=np.float32).T
        return spaces.Box(low, high, dtype=np.float32)
    bound = np.inf if action_bound is None else action_bound
    return spaces.Box(-bound, bound, (size,), np.float32)


class _Camera:
    """Pictures of the first environment; what draws is opened with the first one."""

    def __init__(self, env: VecEnv) -> None:
        self._env = env
        self._renderer: Renderer | None = None

    def picture(self) -> NDArray[np.uint8]:
        """As the environment is now. (height, width, 3)"""
        if self._renderer is None:
            from rlcli.viewer.offscreen import Renderer

            self._renderer = Renderer(self._env.engine.model, self._env.config.viewer)
        return self._renderer.picture(self._env)

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _metadata(env: VecEnv) -> dict[str, Any]:
    return {"render_modes": ["rgb_array"], "render_fps": max(1, round(1.0 / env.step_dt))}


def _known_mode(render_mode: str | None) -> str | None:
    if render_mode not in (None, "rgb_array"):
        raise ValueError(f"render_mode is 'rgb_array' or None, found {render_mode!r}; `rlcli play` has viewers")
    return render_mode


def _floats(groups: Mapping[str, Tensor]) -> Floats:
    """The policy group, a copy."""
    return np.array(groups["policy"].cpu().numpy())


def _flat(changes: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in changes.items():
        if isinstance(value, Mapping) and value:
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
