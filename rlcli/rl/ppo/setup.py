"""Sizes and structure of the PPO trainer, from its configuration and the environment."""

from __future__ import annotations

import torch
from pydantic import ValidationError

from rlcli.envs.vec_env import VecEnv
from rlcli.rl.cnn import VisionSpec
from rlcli.rl.policy import PolicySpec
from rlcli.rl.ppo.config import PpoConfig
from rlcli.rl.trainer_base import agent_error

_WORTH_COMPILING = 40_000
"""Minibatches of a run from which compiling saves time on a GPU (docs/explanation/benchmarks.md)."""


def policy_spec(env: VecEnv, config: PpoConfig) -> PolicySpec:
    """Return the structure of the trained policy."""
    vision = vision_spec(env, config, ("policy",))
    if config.cnn is not None and vision is None:
        message = "no term of the observation group 'policy' is a picture"
        raise agent_error(env, ("cnn",), message, "an observation term like `image`, or cnn: null")
    return PolicySpec(
        kind="gaussian-lstm" if config.rnn else "gaussian-mlp" if vision is None else "gaussian-cnn",
        vision=vision,
        memory=[config.rnn.hidden] * config.rnn.layers if config.rnn else [],
        observation_size=env.layout.size("policy"),
        action_size=env.layout.action_size,
        hidden=list(config.actor.hidden),
        activation=config.actor.activation,
        action_bound=config.action_bound,
        normalize=config.normalize_observations,
    )


def vision_spec(env: VecEnv, config: PpoConfig, groups: tuple[str, ...]) -> VisionSpec | None:
    """Return the images in observation groups side by side; None without images or without a CNN.

    Raises:
        ConfigError: if the layers do not fit them.
    """
    if config.cnn is None:
        return None
    pictures, start = [], 0
    for term in (term for group in groups for term in env.layout.observations[group]):
        if len(term.shape) == 3:
            channels, *edges = term.shape
            pictures.append({"start": start, "shape": [term.history * channels, *edges], "steps": term.history})
        start += term.size
    if not pictures:
        return None
    cnn = config.cnn
    layers = {name: list(getattr(cnn, name)) for name in ("channels", "kernels", "strides")}
    try:
        return VisionSpec.model_validate({"pictures": pictures, "motion": cnn.motion, **layers})
    except ValidationError as error:
        message = error.errors(include_url=False)[0]["msg"].removeprefix("Value error, ")
        raise agent_error(
            env, ("cnn",), message, "smaller kernels or strides, fewer layers, or larger pictures"
        ) from None


def critic_groups(env: VecEnv, config: PpoConfig) -> tuple[str, ...]:
    """Return the observation groups of the critic.

    Raises:
        ConfigError: if the task has no such group.
    """
    have = env.layout.observations
    groups = config.critic_obs or (("critic",) if "critic" in have else ("policy",))
    for group in groups:
        if group not in have:
            raise agent_error(env, ("critic_obs",), f"no observation group '{group}'", f"groups: {', '.join(have)}")
    return groups


def minibatch_sizes(env: VecEnv, config: PpoConfig, total: int) -> list[int]:
    """Return the number of samples of each minibatch.

    Raises:
        ConfigError: if the rollout is too small for them.
    """
    rollout = f"a rollout holds num_steps x num_envs = {config.num_steps} x {env.num_envs} = {total} samples"
    whole = config.num_steps if config.rnn else 1  # samples that stay together
    parts = torch.arange(total // whole)
    if config.minibatch_size is not None:
        split = torch.split(parts, max(1, config.minibatch_size // whole))
    else:
        split = parts.tensor_split(config.num_minibatches)
    sizes = [len(part) * whole for part in split]
    if min(sizes) == 0:
        message = f"{config.num_minibatches} minibatches cannot be made: {rollout}"
    elif (config.normalize_advantage == "minibatch" and min(sizes) == 1) or (config.normalize_advantage and total == 1):
        message = f"advantages cannot be normalised over one sample: {rollout}"
    else:
        return sizes
    key = "num_minibatches" if config.minibatch_size is None else "minibatch_size"
    raise agent_error(env, (key,), message, "more environments, more num_steps, or fewer minibatches")


def compilation(config: PpoConfig, device: torch.device, steps_per_iteration: int) -> bool | str:
    """Return whether, and how, to compile the update: as configured, else on a GPU if the run is long enough."""
    if config.compile is not None or device.type != "cuda":
        return config.compile or False
    limits = []
    if config.max_iterations is not None:
        limits.append(config.max_iterations)
    if config.max_steps is not None:
        limits.append(config.max_steps // steps_per_iteration)
    parts = config.num_minibatches
    if config.minibatch_size is not None:
        parts = max(1, steps_per_iteration // config.minibatch_size)
    return min(limits) * config.num_epochs * parts >= _WORTH_COMPILING
