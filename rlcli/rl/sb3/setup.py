"""Create the algorithm object of Stable-Baselines3 (SB3), and the structure of its policy, from an agent's settings."""

from __future__ import annotations

import math
from typing import Any

from rlcli.envs.environment_protocol import Environment
from rlcli.rl.optimizers import Adam
from rlcli.rl.policy import ACTIVATIONS, PolicySpec
from rlcli.rl.sb3.buffers import TorchReplayBuffer, TorchRolloutBuffer
from rlcli.rl.sb3.config import A2cConfig, OnPolicyConfig, PpoConfig, Sb3Config
from rlcli.rl.sb3.torch_algorithms import FastA2C, FastDDPG, FastPPO, FastSAC, FastTD3
from rlcli.rl.sb3.vec_env import Sb3VecEnv
from rlcli.rl.trainer_base import agent_error

_ON_POLICY = {"n_steps", "gae_lambda", "normalize_advantage", "ent_coef", "vf_coef", "max_grad_norm"}
_OFF_POLICY = {"buffer_size", "batch_size", "learning_starts", "tau"}
_ALGORITHMS: dict[str, tuple[type, str, set[str]]] = {
    "ppo": (FastPPO, "gaussian-mlp", {*_ON_POLICY, "n_epochs", "clip_range", "clip_range_vf"}),
    "a2c": (FastA2C, "gaussian-mlp", _ON_POLICY),
    "sac": (FastSAC, "squashed-gaussian-mlp", {*_OFF_POLICY, "ent_coef"}),
    "td3": (FastTD3, "deterministic-mlp", {*_OFF_POLICY, "policy_delay", "target_policy_noise", "target_noise_clip"}),
    "ddpg": (FastDDPG, "deterministic-mlp", _OFF_POLICY),
}
"""Algorithm -> class, kind of the policy, and settings that SB3's constructor has under the same names."""


def policy_spec(env: Environment, config: Sb3Config) -> PolicySpec:
    """Return the structure of the policy that is trained."""
    return PolicySpec(
        kind=_ALGORITHMS[config.algorithm][1],  # type: ignore[arg-type]
        observation_size=env.layout.size("policy"),
        action_size=env.layout.action_size,
        hidden=list(config.policy.hidden),
        activation=config.policy.activation,
        action_bound=config.action_bound,
        normalize=config.normalize_observations,
    )


def make_model(env: Environment, config: Sb3Config, seed: int, device: str) -> Any:
    """Return the algorithm object of SB3, such as `PPO`, with rlcli's buffers and adapter of the environment.

    Raises:
        ConfigError: if a rollout is too small for its minibatches.
    """
    algorithm, _, names = _ALGORITHMS[config.algorithm]
    hidden = list(config.policy.hidden)
    networks: dict[str, Any] = {"activation_fn": ACTIVATIONS[config.policy.activation], "net_arch": hidden}
    settings = config.model_dump(include={"learning_rate", "gamma", *names})
    if not isinstance(config, A2cConfig):  # A2C keeps SB3's RMSprop
        networks |= {"optimizer_class": Adam, "optimizer_kwargs": {"fused": True}}
    if isinstance(config, OnPolicyConfig):
        _require_batch(env, config)
        networks["net_arch"] = {"pi": hidden, "vf": hidden}
        networks |= {"log_std_init": math.log(config.policy.init_std), "ortho_init": config.policy.ortho_init}
        settings["rollout_buffer_class"] = TorchRolloutBuffer
    else:
        settings["replay_buffer_class"] = TorchReplayBuffer
    if isinstance(config, PpoConfig):
        networks["optimizer_kwargs"]["eps"] = 1e-5  # the epsilon of SB3's on-policy policies
        settings["batch_size"] = config.n_steps * env.num_envs  # the buffer itself makes the minibatches
    settings |= {"seed": seed, "device": device, "policy_kwargs": networks}
    model: Any = algorithm(policy="MlpPolicy", env=Sb3VecEnv(env, config.action_bound), **settings)
    model.exploration_noise = getattr(config, "exploration_noise", 0.0)
    if isinstance(config, PpoConfig):
        model.rollout_buffer.num_minibatches = config.num_minibatches
    return model


def _require_batch(env: Environment, config: OnPolicyConfig) -> None:
    """Check that a rollout has enough samples for its minibatches and for normalised advantages."""
    total = config.n_steps * env.num_envs
    rollout = f"a rollout holds n_steps x num_envs = {config.n_steps} x {env.num_envs} = {total} samples"
    minibatches = config.num_minibatches if isinstance(config, PpoConfig) else 1
    if total < minibatches:
        key, message = "num_minibatches", f"{minibatches} minibatches are too many: {rollout}"
    elif total == 1 and config.normalize_advantage:
        key, message = "n_steps", f"advantages cannot be normalised: {rollout}"
    else:
        return
    raise agent_error(env, (key,), message, "raise num_envs or n_steps, or use fewer minibatches")
