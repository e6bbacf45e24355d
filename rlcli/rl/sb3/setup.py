"""SB3's algorithm and the policy's structure, from the configuration and the environment."""

from __future__ import annotations

import math
from typing import Any

from rlcli.envs.vec_env import VecEnv
from rlcli.rl.optimizers import Adam
from rlcli.rl.policy import ACTIVATIONS, PolicySpec
from rlcli.rl.sb3.algorithms import FastA2C, FastDDPG, FastPPO, FastSAC, FastTD3
from rlcli.rl.sb3.buffers import TorchReplayBuffer, TorchRolloutBuffer
from rlcli.rl.sb3.config import (
    A2cConfig,
    DdpgConfig,
    OffPolicyConfig,
    OnPolicyConfig,
    PpoConfig,
    SacConfig,
    Sb3Config,
    Td3Config,
)
from rlcli.rl.sb3.vec_env import Sb3VecEnv
from rlcli.rl.trainer_base import agent_error

_ON_POLICY = {"n_steps", "gae_lambda", "normalize_advantage", "ent_coef", "vf_coef", "max_grad_norm"}
_OFF_POLICY = {"buffer_size", "batch_size", "learning_starts", "tau"}
"""Settings that are passed to SB3's constructors under their own names."""


def policy_spec(env: VecEnv, config: Sb3Config) -> PolicySpec:
    """Return the structure of the trained policy."""
    kind = {"sac": "squashed-gaussian-mlp", "td3": "deterministic-mlp", "ddpg": "deterministic-mlp"}
    return PolicySpec(
        kind=kind.get(config.algorithm, "gaussian-mlp"),  # type: ignore[arg-type]
        observation_size=env.layout.size("policy"),
        action_size=env.layout.action_size,
        hidden=list(config.policy.hidden),
        activation=config.policy.activation,
        action_bound=config.action_bound,
        normalize=config.normalize_observations,
    )


def make_model(env: VecEnv, config: Sb3Config, seed: int, device: str) -> Any:
    """Return SB3's algorithm.

    Raises:
        ConfigError: if a rollout is too small for its minibatches.
    """
    common: dict[str, Any] = {
        "policy": "MlpPolicy",
        "env": Sb3VecEnv(env, config.action_bound),
        "seed": seed,
        "device": device,
        **config.model_dump(include={"learning_rate", "gamma"}),
    }
    # SB3's Adam with a fused step; A2C keeps its RMSprop
    adam = {"fused": True} if isinstance(config, OffPolicyConfig) else {"fused": True, "eps": 1e-5}
    networks: dict[str, Any] = {
        "activation_fn": ACTIVATIONS[config.policy.activation],
        "optimizer_kwargs": None if isinstance(config, A2cConfig) else adam,
    }
    if not isinstance(config, A2cConfig):
        networks["optimizer_class"] = Adam
    if isinstance(config, OffPolicyConfig):
        return _make_off_policy(config, common, {**networks, "net_arch": list(config.policy.hidden)})
    assert isinstance(config, OnPolicyConfig)
    networks |= {
        "net_arch": {"pi": list(config.policy.hidden), "vf": list(config.policy.hidden)},
        "log_std_init": math.log(config.policy.init_std),
        "ortho_init": config.policy.ortho_init,
    }
    common |= {
        "rollout_buffer_class": TorchRolloutBuffer,
        "policy_kwargs": networks,
        **config.model_dump(include=_ON_POLICY),
    }
    total = config.n_steps * env.num_envs
    _require_batch(env, config, total)
    if isinstance(config, A2cConfig):
        return FastA2C(**common)
    assert isinstance(config, PpoConfig)
    model = FastPPO(
        **common,
        batch_size=total,  # the buffer divides it, whatever the number of environments
        **config.model_dump(include={"n_epochs", "clip_range", "clip_range_vf"}),
    )
    model.rollout_buffer.num_minibatches = config.num_minibatches
    return model


def _make_off_policy(config: OffPolicyConfig, common: dict[str, Any], networks: dict[str, Any]) -> Any:
    common = {
        **common,
        "policy_kwargs": networks,
        "replay_buffer_class": TorchReplayBuffer,
        **config.model_dump(include=_OFF_POLICY),
    }
    if isinstance(config, SacConfig):
        model: Any = FastSAC(**common, ent_coef=config.ent_coef)
        model.exploration_noise = 0.0
        return model
    if isinstance(config, Td3Config):
        own = config.model_dump(include={"policy_delay", "target_policy_noise", "target_noise_clip"})
        model = FastTD3(**common, **own)
    else:
        model = FastDDPG(**common)
    assert isinstance(config, Td3Config | DdpgConfig)
    model.exploration_noise = config.exploration_noise
    return model


def _require_batch(env: VecEnv, config: OnPolicyConfig, total: int) -> None:
    rollout = f"a rollout holds n_steps x num_envs = {config.n_steps} x {env.num_envs} = {total} samples"
    minibatches = config.num_minibatches if isinstance(config, PpoConfig) else 1
    if total < minibatches:
        key, message = "num_minibatches", f"{minibatches} minibatches cannot be made: {rollout}"
    elif total == 1 and config.normalize_advantage:
        key, message = "n_steps", f"advantages cannot be normalised: {rollout}"
    else:
        return
    raise agent_error(env, (key,), message, "more environments, more n_steps, or fewer minibatches")
