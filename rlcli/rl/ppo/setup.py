"""Derive the structure of policy and CNN, the critic's observation groups and minibatch sizes of the PPO trainer.

The functions check the trainer's settings against the environment.
"""

from __future__ import annotations

import math

import torch
from pydantic import ValidationError

from rlcli.envs.environment_protocol import Environment
from rlcli.envs.mirror import MirrorMaps, mirror_maps
from rlcli.rl.cnn import CnnSpec
from rlcli.rl.policy import PolicySpec
from rlcli.rl.ppo.config import PpoConfig
from rlcli.rl.trainer_base import agent_error

_WORTH_COMPILING = 40_000
"""Number of minibatch updates in a run above which compiling them saves time on a GPU.

It is measured in docs/explanation/benchmarks.md.
"""


def policy_spec(env: Environment, config: PpoConfig) -> PolicySpec:
    """Return the structure of the policy that is trained.

    Raises:
        ConfigError: if the agent has a CNN, but no observation term of the policy is an image.
    """
    vision = cnn_spec(env, config, ("policy",))
    if config.cnn is not None and vision is None:
        message = "no term of the observation group 'policy' is an image"
        raise agent_error(env, ("cnn",), message, "add a term like `image`, or set cnn: null")
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


def cnn_spec(env: Environment, config: PpoConfig, groups: tuple[str, ...]) -> CnnSpec | None:
    """Return the CNN over the images in concatenated observation groups; None without images or without a CNN.

    Raises:
        ConfigError: if the layers do not fit the images.
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
    try:
        return CnnSpec.model_validate({"pictures": pictures, **config.cnn.model_dump()})
    except ValidationError as error:
        message = error.errors(include_url=False)[0]["msg"].removeprefix("Value error, ")
        hint = "use smaller kernels or strides, fewer layers, or larger images"
        raise agent_error(env, ("cnn",), message, hint) from None


def critic_groups(env: Environment, config: PpoConfig) -> tuple[str, ...]:
    """Return the names of the critic's observation groups: `critic_obs`, or `critic` if the task has it, else `policy`.

    Raises:
        ConfigError: if the task does not have a group of `critic_obs`.
    """
    available = env.layout.observations
    groups = config.critic_obs or (("critic",) if "critic" in available else ("policy",))
    for group in groups:
        if group not in available:
            hint = f"groups: {', '.join(available)}"
            raise agent_error(env, ("critic_obs",), f"no observation group '{group}'", hint)
    return groups


def task_mirror(env: Environment, config: PpoConfig) -> MirrorMaps | None:
    """Return the maps from observations and actions to their mirror images, on the environment's device.

    Return None if the agent does not use the symmetry of the robot.

    Raises:
        ConfigError: if the robot, a reward or an observation of the task is not symmetric.
    """
    if config.symmetry is None:
        return None
    groups = dict.fromkeys(("policy", *critic_groups(env, config)))
    maps = mirror_maps(env.resolved, groups, tolerance=config.symmetry.tolerance)
    observations = {group: each.to(env.device) for group, each in maps.observations.items()}
    return MirrorMaps(observations, maps.action.to(env.device))


def minibatch_sizes(env: Environment, config: PpoConfig, total: int) -> list[int]:
    """Return the number of samples of each minibatch of a rollout of `total` samples.

    Raises:
        ConfigError: if the rollout has too few samples for the minibatches or for normalised advantages.
    """
    rollout = f"a rollout holds num_steps x num_envs = {config.num_steps} x {env.num_envs} = {total} samples"
    whole = config.num_steps if config.rnn else 1  # number of samples that must stay in one minibatch
    parts = torch.arange(total // whole)
    if config.minibatch_size is not None:
        split = torch.split(parts, max(1, config.minibatch_size // whole))
    else:
        split = parts.tensor_split(config.num_minibatches)
    sizes = [len(part) * whole for part in split]
    if min(sizes) == 0:
        message = f"{config.num_minibatches} minibatches are too many: {rollout}"
    elif (config.normalize_advantage == "minibatch" and min(sizes) == 1) or (config.normalize_advantage and total == 1):
        message = f"advantages cannot be normalised over one sample: {rollout}"
    else:
        return sizes
    key = "num_minibatches" if config.minibatch_size is None else "minibatch_size"
    raise agent_error(env, (key,), message, "raise num_envs or num_steps, or use fewer minibatches")


def compile_mode(config: PpoConfig, device: torch.device, steps_per_iteration: int) -> bool | str:
    """Return whether updates are compiled: True, False or `tuned` (`PpoConfig.compile`).

    If the setting is null, updates are compiled on a GPU in runs with at least `_WORTH_COMPILING` minibatch updates.
    """
    if config.compile is not None or device.type != "cuda":
        return config.compile or False
    iterations = config.max_iterations or math.inf
    if config.max_steps is not None:
        iterations = min(iterations, config.max_steps // steps_per_iteration)
    parts = config.num_minibatches
    if config.minibatch_size is not None:
        parts = max(1, steps_per_iteration // config.minibatch_size)
    return iterations * config.num_epochs * parts >= _WORTH_COMPILING
