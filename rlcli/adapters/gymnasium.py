"""Gymnasium environments of a task: a `VectorEnv` of many environments, and an `Env` of one environment.

`rlcli.gym` registers them: `gym.make_vec("rlcli.gym:rlcli/cartpole", num_envs=8)`.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from rlcli.config.layers import leaves
from rlcli.config.load import Resolved, resolve
from rlcli.config.schema import TaskConfig
from rlcli.envs.make import make_env
from rlcli.envs.step_result import StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.registry import find_task
from rlcli.viewer.offscreen import Renderer

Floats = NDArray[np.float32]
"""Array of float32 numbers."""
Changes = Mapping[str, Any] | Iterable[str] | TaskConfig | Resolved | None
"""Changes of a task's configuration, or a whole configuration: see the argument `cfg` of `open_task`."""


def open_task(
    task: str, num_envs: int, cfg: Changes = None, *, agent: str | None = None, seed: int = 42, device: str = "cpu"
) -> VecEnv:
    """Return the environment of a task.

    Args:
        task: name or folder of the task.
        num_envs: number of environments.
        cfg: changes of the configuration: a mapping with dotted or nested keys, `{"episode_length_s": 3.0}`; or a list
            of overrides, `["episode_length_s=3.0"]`; or a whole configuration that replaces the task's own.
        agent: name of the agent whose changes of the task (its `task:` section) are applied; None: the default agent.
        seed: seed of all random numbers, until `reset` gets another one.
        device: cpu, cuda or cuda:N.
    """
    if isinstance(cfg, Resolved):
        cfg = cfg.task
    if isinstance(cfg, TaskConfig):
        scene = cfg.scene.model_copy(update={"num_envs": num_envs})
        source = find_task(task)
        return make_env(cfg.model_copy(update={"scene": scene}), seed=seed, device=device, root=source.root)
    if isinstance(cfg, str):
        raise TypeError(f"cfg is a string; pass a mapping or a list of overrides: [{cfg!r}]")
    changes = leaves(cfg) if isinstance(cfg, Mapping) and cfg else ()
    overrides = () if cfg is None or isinstance(cfg, Mapping) else tuple(cfg)
    flags = {".".join(map(str, path)): value for path, value in changes} | {"scene.num_envs": num_envs}
    resolved = resolve(find_task(task), agent=agent, device=device.partition(":")[0], overrides=overrides, flags=flags)
    return make_env(resolved, seed=seed, device=device)


class GymnasiumVectorEnv(gymnasium.vector.VectorEnv):
    """Gymnasium `VectorEnv` of a task; its observations are those of the policy (the observation group `policy`).

    Each step returns new arrays; observations are float32.

    The autoreset mode decides what `step` returns when an episode ends. The episodes are the same in each mode, because
    the start state of an episode depends only on the environment and the index of the episode:
    - SAME_STEP: `step` returns the first observation of the next episode; the last one is in `info["final_obs"]`;
    - NEXT_STEP: `step` returns the last observation; the next step ignores the action, has reward 0 and returns the
      first observation of the next episode;
    - DISABLED: `step` returns the last observation; `reset(options={"reset_mask": mask})` starts the next episode in
      the environments where the mask is true.

    Args:
        env: the environment.
        autoreset_mode: the mode, or its value as text: "SameStep", "NextStep", "Disabled".
        action_bound: the action space is [-action_bound, action_bound] if the task has no action limits of its own;
            None: unbounded.
        render_mode: "rgb_array" for images of the first environment; None for no images.
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
        if render_mode not in (None, "rgb_array"):
            raise ValueError(
                f"render_mode must be 'rgb_array' or None, found {render_mode!r}; to watch a policy, use `rlcli play`"
            )
        self.render_mode = render_mode
        self.single_observation_space = observation_space(env)
        self.single_action_space = action_space(env, action_bound)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.ended: NDArray[np.bool_] = np.zeros(self.num_envs, dtype=bool)
        """Whether an environment's episode has ended and no new one was started. (num_envs,) bool

        Always false in the mode SAME_STEP.
        """
        # The `VecEnv` resets an ended environment within the step. The first observation of the new episode is kept
        # here until Gymnasium's mode allows it to be returned.
        self._first: Floats | None = None
        self._last_obs: Floats | None = None
        self._camera = _Camera(env)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Start new episodes in all environments, or in those where `options["reset_mask"]` is true.

        Args:
            seed: one number for all environments, each of which derives its own random stream from the number; None:
                the seed stays, and the next episodes start.
            options: None, or a dict with `reset_mask`, an array (num_envs,) bool. Other keys are not read.

        Returns:
            Observations (num_envs, d) float32 and an empty dict. Where the mask is false, the observations are those
            of the last step.

        Raises:
            TypeError: if `seed` is not an integer.
            ValueError: if the mask has another shape, is true for an environment whose episode has not ended, or is
                passed before the first reset.
        """
        if seed is not None and not isinstance(seed, int | np.integer):
            raise TypeError(f"seed must be one number for all environments, found {seed!r}")
        super().reset(seed=seed)
        mask = (options or {}).get("reset_mask")
        # a mask of all environments is a full reset, unless all have ended and wait for their next episode
        if mask is not None and not (np.all(mask) and (seed is not None or not self.ended.all())):
            return self._start_episodes(np.asarray(mask, dtype=bool)), {}
        self.ended[:] = False
        self._last_obs = _policy_obs(self.env.reset(seed=seed))
        return self._last_obs.copy(), {}

    def step(
        self, actions: Floats
    ) -> tuple[Floats, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step all environments. actions (num_envs, a)

        Returns:
            Observations (num_envs, d) float32, rewards (num_envs,) float64, terminated and truncated (num_envs,) bool,
            and infos. The infos have `success` (num_envs,) bool of the ended episodes, if the task has success
            conditions; in the mode SAME_STEP they have Gymnasium's keys `final_obs` and `final_info`.

        Raises:
            RuntimeError: in mode DISABLED, if an episode has ended and no new one was started.
        """
        action = torch.as_tensor(np.asarray(actions, dtype=np.float32), device=self.env.device)
        waiting = self.ended.copy()
        if not waiting.any():
            result = self.env.step(action)
        elif self.mode is AutoresetMode.DISABLED:
            ids = np.flatnonzero(waiting).tolist()
            message = f"the episodes of environments {ids} have ended; call reset(options={{'reset_mask': mask}})"
            raise RuntimeError(message)
        else:
            result = self.env.step(action, torch.from_numpy(waiting).to(self.env.device))
        obs = _policy_obs(result.obs)
        terminated, truncated = (flags.cpu().numpy().copy() for flags in (result.terminated, result.truncated))
        infos = self._infos(result)
        if self.mode is AutoresetMode.SAME_STEP:
            infos = self._final_infos(result, infos)
        else:
            self.ended = terminated | truncated
            if self.ended.any():
                assert result.final_obs is not None
                self._first = obs
                obs = np.where(self.ended[:, None], _policy_obs(result.final_obs), obs)
        self._last_obs = obs
        return obs.copy(), result.reward.cpu().numpy().astype(np.float64), terminated, truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return a tuple with one image of the first environment, uint8 (height, width, 3).

        Return None if the environment was created without a `render_mode`.
        """
        return None if self.render_mode is None else (self._camera.image(),)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the environment."""
        self._camera.close()
        self.env.close()

    def _start_episodes(self, mask: NDArray[np.bool_]) -> Floats:
        """Start the next episode where the mask is true; return the observations of all environments. (num_envs, d)"""
        if mask.shape != (self.num_envs,):
            raise ValueError(f"reset_mask has shape {mask.shape}; pass shape {(self.num_envs,)}")
        running = np.flatnonzero(mask & ~self.ended).tolist()
        if self._last_obs is None:
            raise ValueError("no episode has started yet; call reset() without reset_mask first")
        if running:
            raise ValueError(f"set reset_mask to false for environments {running}: their episodes have not ended")
        if mask.any():
            assert self._first is not None
            self._last_obs = np.where(mask[:, None], self._first, self._last_obs)
            self.ended &= ~mask
        return self._last_obs.copy()

    def _infos(self, result: StepResult) -> dict[str, Any]:
        """Return the infos of a step: `success` of ended episodes, and `_success`, true where an episode ended.

        The dict is empty if no episode ended or the task has no success conditions.
        """
        if result.episodes is None or result.episodes.success is None:
            return {}
        ended = result.episodes.ended()
        assert ended.success is not None
        success, known = (np.zeros(self.num_envs, dtype=bool) for _ in range(2))
        ids = ended.ids.cpu().numpy()
        success[ids], known[ids] = ended.success.cpu().numpy(), True
        return {"success": success, "_success": known} if known.any() else {}

    def _final_infos(self, result: StepResult, infos: dict[str, Any]) -> dict[str, Any]:
        """Return the infos `final_obs` and `final_info` of ended episodes, in the form of Gymnasium's SAME_STEP.

        `infos` is the result of `_infos`, whose `success` becomes part of `final_info`.
        """
        if result.episodes is None or result.final_obs is None:
            return {}
        final = _policy_obs(result.final_obs)
        found: dict[str, Any] = {}
        for env_id in result.episodes.ended().ids.tolist():
            info = {"success": bool(infos["success"][env_id])} if "success" in infos else {}
            found = self._add_info(found, {"final_obs": final[env_id].copy(), "final_info": info}, env_id)
        return found


class GymnasiumEnv(gymnasium.Env):
    """Gymnasium `Env` of a task; its observations are those of the policy (the observation group `policy`).

    Args:
        env: a `VecEnv` with one environment.
        action_bound: the action space is [-action_bound, action_bound] if the task has no action limits of its own;
            None: unbounded.
        render_mode: "rgb_array" for images; None for no images.

    Raises:
        ValueError: if `env` has several environments, or for another `render_mode`.
    """

    metadata: dict[str, Any]

    def __init__(self, env: VecEnv, *, action_bound: float | None = 1.0, render_mode: str | None = None) -> None:
        if env.num_envs != 1:
            raise ValueError(f"GymnasiumEnv takes 1 environment, found {env.num_envs}; use GymnasiumVectorEnv")
        self._vector = GymnasiumVectorEnv(
            env, AutoresetMode.DISABLED, action_bound=action_bound, render_mode=render_mode
        )
        self.env = env
        self.metadata = _metadata(env)
        self.render_mode = render_mode
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Floats, dict[str, Any]]:
        """Start a new episode; return its first observation (d,) float32, and an empty dict. `options` is not read."""
        super().reset(seed=seed)
        starts_next = self._vector.ended[0] and seed is None  # the `VecEnv` has already reset the environment
        obs, _ = self._vector.reset(seed=seed, options={"reset_mask": [True]} if starts_next else None)
        return obs[0], {}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Step the environment. action (a,)

        Returns:
            Observation (d,) float32, reward, terminated, truncated, and infos: `success` of an ended episode, if the
            task has success conditions.

        Raises:
            RuntimeError: if the episode has ended and `reset` was not called.
        """
        if self._vector.ended[0]:
            raise RuntimeError("the episode has ended; call reset()")
        obs, reward, terminated, truncated, infos = self._vector.step(np.asarray(action)[None])
        info = {"success": bool(infos["success"][0])} if "success" in infos else {}
        return obs[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> NDArray[np.uint8] | None:
        """Return an image of the current state, uint8 (height, width, 3); None without a `render_mode`."""
        images = self._vector.render()
        return None if images is None else images[0]

    def close(self) -> None:
        """Close the environment."""
        self._vector.close()


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
    """Return a vector environment of a task; `gym.make_vec` calls this function.

    The arguments are those of `open_task` and `GymnasiumVectorEnv`; `settings` are `agent`, `seed` and `device`.
    """
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
    """Return a single environment of a task; `gym.make` calls this function.

    The arguments are those of `open_task` and `GymnasiumEnv`; `settings` are `agent`, `seed` and `device`.
    """
    return GymnasiumEnv(open_task(task, 1, cfg, **settings), action_bound=action_bound, render_mode=render_mode)


def observation_space(env: VecEnv) -> spaces.Box:
    """Return the unbounded observation space of one environment: the group `policy`, float32 (d,)."""
    return spaces.Box(-np.inf, np.inf, (env.layout.size("policy"),), np.float32)


def action_space(env: VecEnv, action_bound: float | None = 1.0) -> spaces.Box:
    """Return the action space of one environment, float32 (a,).

    The bounds are the attribute `action_limits` of a direct task; in other tasks -`action_bound` and `action_bound`, or
    none if `action_bound` is None.
    """
    limits = getattr(getattr(env, "task", None), "action_limits", ())
    size = env.layout.action_size
    if len(limits) == size:
        low, high = np.asarray(limits, dtype=np.float32).T
        return spaces.Box(low, high, dtype=np.float32)
    bound = np.inf if action_bound is None else action_bound
    return spaces.Box(-bound, bound, (size,), np.float32)


class _Camera:
    """Renderer of images of the first environment; OpenGL is initialised when the first image is rendered."""

    def __init__(self, env: VecEnv) -> None:
        self._env = env
        self._renderer: Renderer | None = None

    def image(self) -> NDArray[np.uint8]:
        """Render the current state. (height, width, 3)"""
        if self._renderer is None:
            self._renderer = Renderer(self._env.engine.model, self._env.config.viewer)
        return self._renderer.image(self._env)

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def _metadata(env: VecEnv) -> dict[str, Any]:
    return {"render_modes": ["rgb_array"], "render_fps": max(1, round(1.0 / env.step_dt))}


def _policy_obs(groups: Mapping[str, Tensor]) -> Floats:
    """Return a copy of the observation group `policy`. (num_envs, d)"""
    return np.array(groups["policy"].cpu().numpy())
