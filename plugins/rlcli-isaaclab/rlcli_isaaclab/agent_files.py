"""Reader of agents in YAML files of rl_games, skrl and Stable-Baselines3, as settings of the trainer `ppo`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from rlcli.config.strict_yaml import MAX_BYTES
from rlcli.errors import ConfigError, Problem
from rlcli.formats import Note, Status
from rlcli.machine.plain_files import read_plain
from rlcli.rl.ppo.rl_games_file import WITHOUT_EFFECT, RlGamesReader
from rlcli_isaaclab.dump_yaml import read
from rlcli_isaaclab.settings import Node, Report


def read_agent(file: Path, library: str, notes: list[Note]) -> dict[str, Any] | None:
    """Return the settings of `ppo` for an agent file; None if files of `library` cannot be read.

    Keys that are not translated exactly are appended to `notes`.

    Raises:
        ConfigError: if the file cannot be read, or rlcli has no counterpart of the agent.
    """
    reader = next((read for name, read in _READERS.items() if library == name or library.startswith(f"{name}-")), None)
    if reader is None:
        return None
    data = read(file)
    report = Report()
    try:
        config = reader(Node(_numbers(data), (), report))
        report.finish(data)
    except ConfigError as error:
        tree = yaml.compose(read_plain(file, MAX_BYTES), yaml.SafeLoader)
        at = [f"{file}:{_line(tree, p.path)}" for p in error.problems]
        problems = zip(at, error.problems, strict=True)
        raise ConfigError([Problem(where, p.path, p.message, p.hint) for where, p in problems]) from None
    notes += [Note(str(file), *_text(note)) for note in report.user_notes()]
    return {"trainer": "ppo", "algorithm": "ppo", **config}


def _line(node: yaml.Node, path: str) -> int:
    """Return the line of the key `a.b.c` below a YAML node; if there is no such key, the line of its parent."""
    line = node.start_mark.line + 1
    for part in path.split("."):
        pairs = node.value if isinstance(node, yaml.MappingNode) else []
        found = next(((key, value) for key, value in pairs if str(key.value) == part), None)
        if found is None:
            break
        line, node = found[0].start_mark.line + 1, found[1]
    return line


def _text(note: Note) -> tuple[Any, ...]:
    return note.key, note.status, note.text


def _numbers(value: Any) -> Any:
    """Return data in which strings such as `1e-4`, which PyYAML does not read as numbers, are numbers."""
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


_WITHOUT_EFFECT = {*WITHOUT_EFFECT, "load_checkpoint", "load_path", "regularizer", "initializer", "d2rl"}


class _ReportSink:
    """Receiver of the results of `RlGamesReader`: settings of the agent in `data`, notes and mistakes in `report`."""

    def __init__(self, report: Report) -> None:
        self.report = report
        self.data: dict[str, Any] = {}

    def put(self, target: tuple[str | int, ...], value: Any, source: tuple[str | int, ...]) -> None:
        """Store a setting of the agent under its key, the first element of `target`."""
        self.data[str(target[0])] = value

    def note(self, path: tuple[str | int, ...], status: Status, text: str = "") -> None:
        """Record how a key was translated. Keys that change nothing are not reported to the user."""
        status = "default" if status == "ignored" and path[-1] in _WITHOUT_EFFECT else status
        self.report.entries[tuple(map(str, path))] = (status, text)

    def problem(self, path: tuple[str | int, ...], message: str, hint: str | None = None) -> None:
        """Record a mistake."""
        self.report.problem(tuple(map(str, path)), message, hint)


def _read_rl_games(top: Node) -> dict[str, Any]:
    sink = _ReportSink(top.report)
    RlGamesReader(sink, is_strict=False).read(top.data.get("params"))
    top.mark_mapped("pbt")
    return sink.data


_SEPARATE = "rlcli cannot share layers between actor and critic: each has a network of its own"


def _mark_false(node: Node, key: str, why: str) -> None:
    """Report a key as approximated if its value is false, because rlcli always behaves as if the value were true."""
    if node.data.get(key) is False:
        node.report.entries[(*node.key, key)] = ("approximated", why)


def _no_counterpart(value: object, why: str = "") -> str:
    """Return the message for a setting whose value rlcli cannot represent, or which has no value."""
    return "the key has no value" if value is None else f"'{value}' has no counterpart in rlcli{why}"


def _cnn(layers: list[tuple[int, int, int]]) -> dict[str, Any]:
    channels, kernels, strides = zip(*layers, strict=True)
    return {"channels": list(channels), "kernels": list(kernels), "strides": list(strides)}


def _read_skrl(top: Node) -> dict[str, Any]:
    agent, models = top.node("agent"), top.node("models")
    if agent.get("class") != "PPO":
        top.report.problem(("agent", "class"), _no_counterpart(agent.get("class")), "rlcli reads PPO")
    policy, value = models.node("policy"), models.node("value")
    if policy.get("class") != "GaussianMixin":
        why = ", whose actions are continuous"
        top.report.problem((*policy.key, "class"), _no_counterpart(policy.get("class"), why), "write GaussianMixin")
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
    interval = agent.node("experiment").get("checkpoint_interval")  # [steps]; "auto": ten checkpoints
    if isinstance(interval, int) and interval > 0:
        found["save_interval"] = math.ceil(interval / rollouts)
    if agent.get("value_clip"):
        found["clip_value_range"] = agent.get("value_clip")
    if cnn:
        found["cnn"] = cnn
    _mark_false(agent, "time_limit_bootstrap", "rlcli always bootstraps at a time-out")
    agent.mark_mapped("state_preprocessor_kwargs", "value_preprocessor_kwargs", "random_timesteps", "learning_starts")
    agent.mark_mapped("kl_threshold", "experiment", "mixed_precision", "learning_rate_scheduler_kwargs")
    for model in (policy, value):
        model.mark_mapped("class", "clip_actions", "clip_log_std", "min_log_std", "max_log_std", "output", "network")
    top.mark_mapped("seed", "memory", "trainer")
    models.mark_mapped("separate")
    _mark_false(models, "separate", _SEPARATE)
    return found


def _skrl_network(model: Node) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return (settings of the MLP, settings of the CNN or {}) for one of skrl's models, such as `policy`."""
    hidden: list[int] = []
    convolutions: list[tuple[int, int, int]] = []
    activation = "elu"
    for container in model.get("network") or []:
        if container.get("type") not in (None, "linear"):
            what = f"a network part of type '{container['type']}' has no counterpart in rlcli"
            model.report.problem(
                model.key, what, "write type: linear; rlcli reads only linear networks and conv2d layers"
            )
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
        top.report.problem(("policy",), _no_counterpart(top.get("policy")), "write MlpPolicy")
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
    if isinstance(found["learning_rate"], str):  # `lin_3e-4` falls linearly to 0
        found["learning_rate"], found["schedule"] = float(found["learning_rate"].removeprefix("lin_")), "linear"
    why = "SB3 scales rewards; rlcli's normalize_value normalises the critic's targets, so it is not set"
    top.note("ignored", "normalize_value", why)
    for key in ("clip_obs", "target_kl", "squash_output"):
        top.note("ignored", key, "rlcli's ppo has no such setting")
    policy.note("ignored", "squash_output", "actions are not squashed")
    policy.mark_mapped("ortho_init")
    top.mark_mapped("seed", "device", "policy_kwargs")
    return found


_READERS: dict[str, Callable[[Node], Mapping[str, Any]]] = {
    "rl-games": _read_rl_games,
    "skrl": _read_skrl,
    "sb3": _read_sb3,
}
