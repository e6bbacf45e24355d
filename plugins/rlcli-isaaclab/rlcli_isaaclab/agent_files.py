"""Agents in YAML files of rl_games, skrl and Stable-Baselines3, as settings of the trainer `ppo`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from rlcli.config.strict_yaml import MAX_BYTES
from rlcli.errors import ConfigError, Problem
from rlcli.formats import Note
from rlcli.machine import read_plain
from rlcli_isaaclab.settings import Node, Report


def read_agent(file: Path, library: str, notes: list[Note]) -> dict[str, Any] | None:
    """Return the settings of an agent file; None if its library is not read. Append what is not mapped to `notes`.

    Raises:
        ConfigError: if the file cannot be read, or rlcli has no counterpart of the agent.
    """
    reader = next((read for name, read in _READERS.items() if library == name or library.startswith(f"{name}-")), None)
    if reader is None:
        return None
    try:
        data = yaml.safe_load(read_plain(file, MAX_BYTES))
    except (OSError, yaml.YAMLError, RecursionError) as error:
        raise ConfigError([Problem(str(file), "", f"cannot be read: {' '.join(str(error).split())}")]) from None
    if not isinstance(data, dict):
        raise ConfigError([Problem(str(file), "", "the top level must be a mapping (key: value)")])
    report = Report()
    try:
        config = reader(Node(_numbers(data), (), report))
        report.finish(data)
    except ConfigError as error:
        raise ConfigError([Problem(str(file), p.path, p.message, p.hint) for p in error.problems]) from None
    notes += [Note(str(file), *_text(note)) for note in report.user_notes()]
    return {"trainer": "ppo", "algorithm": "ppo", **config}


def _text(note: Note) -> tuple[Any, ...]:
    return note.key, note.status, note.text


def _numbers(value: Any) -> Any:
    """Return text such as `1e-4`, which YAML 1.1 does not read as a number, as a number."""
    if isinstance(value, dict):
        return {str(key): _numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_numbers(item) for item in value]
    if isinstance(value, str) and value[:1].isdigit():
        try:
            return float(value)
        except ValueError:
            return value
    return value


_RL_GAMES_SCHEDULES = {
    "adaptive": "adaptive", "linear": "linear", **dict.fromkeys(("constant", "identity", "fixed", "None"), "constant")
}  # fmt: skip


def _read_rl_games(top: Node) -> dict[str, Any]:
    params = top.node("params")
    network, config, space = params.node("network"), params.node("config"), params.node("network").node("space")
    for key, wanted in (("algo", "a2c_continuous"), ("model", "continuous_a2c_logstd")):
        name = params.node(key).get("name")
        if name != wanted:
            top.report.problem(("params", key), f"'{name}' has no counterpart in rlcli", f"rlcli reads '{wanted}'")
    mlp = network.node("mlp")
    mlp.skip("d2rl", "initializer", "regularizer")
    if mlp.data.get("d2rl"):
        top.report.problem(mlp.key, "d2rl networks have no counterpart in rlcli", "write d2rl: False")
    shape = {"hidden": mlp.require("units"), "activation": mlp.get("activation", "elu")}
    continuous = space.node("continuous")
    std = continuous.node("sigma_init").get("val", 0.0)
    space.skip("continuous")
    if continuous.data.get("fixed_sigma") is False:
        continuous.note("approximated", "fixed_sigma", "the standard deviation never depends on the state")
    schedule = config.get("lr_schedule") or "constant"
    if schedule not in _RL_GAMES_SCHEDULES:
        top.report.problem((*config.key, "lr_schedule"), f"unknown schedule '{schedule}'", "write adaptive or linear")
    kl = schedule == "adaptive"
    clip = config.get("clip_value", False)
    found: dict[str, Any] = {
        "dialect": "rl_games",
        "num_steps": config.require("horizon_length"),
        "max_iterations": config.require("max_epochs"),
        "minibatch_size": config.require("minibatch_size"),
        "num_epochs": config.require("mini_epochs"),
        "gamma": config.require("gamma"),
        "lam": config.require("tau"),
        "learning_rate": config.require("learning_rate"),
        "clip_range": config.require("e_clip"),
        "entropy_coef": config.get("entropy_coef", 0.0),
        "bounds_coef": config.get("bounds_loss_coef", 0.0),
        "normalize_observations": bool(config.get("normalize_input", False)),
        "normalize_value": bool(config.get("normalize_value", False)),
        "normalize_advantage": "batch" if config.get("normalize_advantage", False) else None,
        "value_coef": 0.5 * config.get("critic_coef", 2.0),
        "clip_value": "larger" if clip else None,
        "reward_scale": config.node("reward_shaper").get("scale_value", 1.0),
        "max_grad_norm": config.get("grad_norm", 1.0) if config.get("truncate_grads", False) else None,
        "schedule": _RL_GAMES_SCHEDULES.get(schedule, "constant"),
        "desired_kl": config.get("kl_threshold", 0.008) if kl else None,
        "kl_grain": {"standard": "epoch", "standard_epoch": "iteration"}.get(config.get("schedule_type"), "minibatch"),
        "actor": shape,
        "critic": dict(shape),
        "init_std": math.exp(std),
    }
    if config.get("save_frequency"):
        found["save_interval"] = config.get("save_frequency")
    _rl_games_parts(network, config, found)
    bound = params.node("env").get("clip_actions")
    found["action_bound"] = float(bound) if bound is not None and math.isfinite(bound) else None
    if found["action_bound"] not in (None, 1.0) and config.get("clip_actions", True):
        params.node("env").note("approximated", "clip_actions", "actions are clipped to the bound, not scaled by it")
    params.node("env").note("ignored", "clip_observations", "observations are not clipped")
    config.skip("name", "env_name", "device", "device_name", "ppo", "print_stats", "score_to_win", "save_best_after")
    config.skip("num_actors", "multi_gpu", "player", "full_experiment_name", "seq_len", "seq_length", "grad_norm")
    config.skip(
        "kl_threshold", "value_bootstrap", "use_diagnostics", "games_to_track", "mixed_precision", "clip_actions"
    )
    params.skip("seed", "load_checkpoint", "load_path", "algo", "model", "player")
    network.skip("name", "separate")
    _mark_false(config, "value_bootstrap", "rlcli always bootstraps at a time-out")
    _mark_false(network, "separate", _SEPARATE)
    top.skip("pbt")
    return found


_SEPARATE = "actor and critic are always separate networks"


def _mark_false(node: Node, key: str, why: str) -> None:
    """Report a setting that rlcli does not have if it is false."""
    if node.data.get(key) is False:
        node.report.entries[(*node.key, key)] = ("approximated", why)


def _rl_games_parts(network: Node, config: Node, found: dict[str, Any]) -> None:
    """Read the parts of a network besides its MLP, and the central value."""
    if "rnn" in network:
        rnn = network.node("rnn")
        if rnn.get("name") != "lstm":
            network.report.problem(rnn.key, f"'{rnn.get('name')}' has no counterpart in rlcli", "write name: lstm")
        found["rnn"] = {"hidden": rnn.get("units", 64), "layers": rnn.get("layers", 1)}
        rnn.skip("before_mlp")
        _mark_false(rnn, "before_mlp", "the RNN is always before the MLP")
        rnn.note("approximated", "concat_input", "the MLP receives only the RNN's output, not the observations")
        rnn.note("approximated", "layer_norm", "rlcli has no layer normalization")
    if "cnn" in network:
        cnn = network.node("cnn")
        layers = cnn.get("convs") or []
        if any(layer.get("padding", 0) for layer in layers):
            network.report.problem((*cnn.key, "convs"), "rlcli's convolutions have no padding", "write padding: 0")
        found["cnn"] = _cnn([(c["filters"], c["kernel_size"], c["strides"]) for c in layers])
        cnn.skip("type", "initializer", "regularizer", "activation")
    if "central_value_config" in config:
        config.note("approximated", "central_value_config", "the critic's network and schedule are those of the policy")


def _cnn(layers: list[tuple[int, int, int]]) -> dict[str, Any]:
    channels, kernels, strides = zip(*layers, strict=True)
    return {"channels": list(channels), "kernels": list(kernels), "strides": list(strides)}


def _read_skrl(top: Node) -> dict[str, Any]:
    agent, models = top.node("agent"), top.node("models")
    if agent.get("class") != "PPO":
        top.report.problem(("agent", "class"), f"'{agent.get('class')}' has no counterpart in rlcli", "rlcli reads PPO")
    policy, value = models.node("policy"), models.node("value")
    if policy.get("class") != "GaussianMixin":
        what = f"'{policy.get('class')}' has no counterpart in rlcli, whose actions are continuous"
        top.report.problem(policy.key, what, "rlcli reads GaussianMixin")
    actor, cnn = _skrl_network(policy)
    critic, _ = _skrl_network(value)
    rollouts = agent.require("rollouts") or 1
    scheduler = agent.get("learning_rate_scheduler")
    if scheduler not in (None, "KLAdaptiveLR"):
        top.report.problem(
            ("agent", "learning_rate_scheduler"), f"'{scheduler}' has no counterpart in rlcli", "write KLAdaptiveLR"
        )
    found: dict[str, Any] = {
        "num_steps": rollouts,
        "max_iterations": max(1, math.ceil(top.node("trainer").get("timesteps", 100_000) / rollouts)),
        "num_epochs": agent.require("learning_epochs"),
        "num_minibatches": agent.require("mini_batches"),
        "gamma": agent.require("discount_factor"),
        "lam": agent.require("lambda"),
        "learning_rate": agent.require("learning_rate"),
        "schedule": "adaptive" if scheduler == "KLAdaptiveLR" else "constant",
        "desired_kl": agent.node("learning_rate_scheduler_kwargs").get("kl_threshold", 0.008) if scheduler else None,
        "kl_grain": "epoch",
        "learning_rate_range": [1e-6, 1e-2],
        "clip_range": agent.require("ratio_clip"),
        "clip_value": "clipped" if agent.get("clip_predicted_values", False) else None,
        "entropy_coef": agent.get("entropy_loss_scale", 0.0),
        "value_coef": agent.get("value_loss_scale", 1.0),
        "max_grad_norm": agent.get("grad_norm_clip", 0.0) or None,
        "reward_scale": agent.get("rewards_shaper_scale", 1.0),
        "normalize_observations": agent.get("state_preprocessor") == "RunningStandardScaler",
        "normalize_value": agent.get("value_preprocessor") == "RunningStandardScaler",
        "actor": actor,
        "critic": critic,
        "init_std": math.exp(policy.get("initial_log_std", 0.0)),
    }
    if agent.get("value_clip"):
        found["clip_value_range"] = agent.get("value_clip")
    if cnn:
        found["cnn"] = cnn
    _mark_false(agent, "time_limit_bootstrap", "rlcli always bootstraps at a time-out")
    agent.skip("state_preprocessor_kwargs", "value_preprocessor_kwargs", "random_timesteps", "learning_starts")
    agent.skip("kl_threshold", "experiment", "mixed_precision", "learning_rate_scheduler_kwargs")
    for model in (policy, value):
        model.skip("class", "clip_actions", "clip_log_std", "min_log_std", "max_log_std", "output", "network")
    top.skip("seed", "memory", "trainer")
    models.skip("separate")
    _mark_false(models, "separate", _SEPARATE)
    return found


def _skrl_network(model: Node) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the MLP and the CNN of a model: a chain of containers, the last of which is the MLP."""
    hidden: list[int] = []
    convolutions: list[tuple[int, int, int]] = []
    activation = "elu"
    for container in model.get("network") or []:
        if container.get("type") not in (None, "linear"):
            model.report.problem(model.key, f"a {container['type']} has no counterpart in rlcli", "write an MLP")
        for layer in container.get("layers") or []:
            if isinstance(layer, dict) and "conv2d" in layer:
                conv = layer["conv2d"]
                convolutions.append((conv["out_channels"], conv["kernel_size"], conv["stride"]))
            elif isinstance(layer, dict) and "linear" in layer:
                hidden.append(layer["linear"])
            elif isinstance(layer, int | float):
                hidden.append(int(layer))
        if isinstance(container.get("activations"), str):
            activation = container["activations"]
    if not hidden:
        model.report.problem(model.key, "the network has no MLP that rlcli can read", "write layers: [N, ...]")
    return {"hidden": hidden or [1], "activation": activation}, _cnn(convolutions) if convolutions else {}


def _read_sb3(top: Node) -> dict[str, Any]:
    policy = top.node("policy_kwargs")
    if top.get("policy") != "MlpPolicy":
        top.report.problem(("policy",), f"'{top.get('policy')}' is not read", "rlcli reads MlpPolicy")
    arch = policy.get("net_arch", [64, 64])
    shapes = arch if isinstance(arch, dict) else {"pi": arch, "vf": arch}
    activation = str(policy.get("activation_fn", "nn.Tanh")).rpartition(".")[2].lower()
    found: dict[str, Any] = {
        "dialect": "sb3",
        "max_steps": int(top.require("n_timesteps")),
        "num_steps": top.get("n_steps", 2048),
        "minibatch_size": top.get("batch_size", 64),
        "num_epochs": top.get("n_epochs", 10),
        "gamma": top.get("gamma", 0.99),
        "lam": top.get("gae_lambda", 0.95),
        "learning_rate": top.get("learning_rate", 3e-4),
        "clip_range": top.get("clip_range", 0.2),
        "entropy_coef": top.get("ent_coef", 0.0),
        "value_coef": top.get("vf_coef", 0.5),
        "max_grad_norm": top.get("max_grad_norm", 0.5),
        "normalize_observations": bool(top.get("normalize_input", False)),
        "actor": {"hidden": shapes["pi"], "activation": activation},
        "critic": {"hidden": shapes["vf"], "activation": activation},
        "init_std": math.exp(policy.get("log_std_init", 0.0)),
    }
    if isinstance(found["learning_rate"], str):  # `lin_3e-4`: it decreases over the training
        found["learning_rate"], found["schedule"] = float(found["learning_rate"].removeprefix("lin_")), "linear"
    for key in ("normalize_value", "clip_obs", "target_kl", "squash_output"):
        top.note("ignored", key, "rlcli's PPO has no such setting here")
    policy.note("ignored", "squash_output", "actions are not squashed")
    policy.skip("ortho_init")
    top.skip("seed", "device", "policy_kwargs")
    return found


_READERS: dict[str, Callable[[Node], Mapping[str, Any]]] = {
    "rl-games": _read_rl_games,
    "skrl": _read_skrl,
    "sb3": _read_sb3,
}
