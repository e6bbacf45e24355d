"""Translate an rl_games configuration (its mapping `params`) into settings of the trainer `ppo`.

Tasks of Isaac Lab and OmniIsaacGymEnvs have such configurations. Settings that the file does not mention get the
defaults of rl_games, through the setting `dialect: rl_games`. The module does not import torch.
"""

from __future__ import annotations

import math
import pathlib
from collections.abc import Mapping
from typing import Any, Protocol

from rlcli.config.strict_yaml import Path, load
from rlcli.errors import did_you_mean, listing
from rlcli.formats import Status


class Sink(Protocol):
    """Interface of the object that receives settings, notes and mistakes while a configuration is read.

    `source` and `path` are places in the file, as keys: ("params", "config", "gamma"). `target` is a key of `ppo`.
    """

    def put(self, target: Path, value: Any, source: Path, /) -> None:
        """Store the value of the key `target` of `ppo`, which comes from the place `source` in the file."""

    def note(self, path: Path, status: Status, text: str = "", /) -> None:
        """Record how the key at the place `path` was translated: exactly, approximately, or not at all."""

    def problem(self, path: Path, message: str, hint: str | None = None, /) -> None:
        """Record a mistake at the place `path`: what is wrong, and as the hint what to do."""


_KEYS = load(pathlib.Path(__file__).with_name("rl_games_keys.yaml").read_bytes()).data
_DIRECT: dict[str, str] = _KEYS["settings"]
WITHOUT_EFFECT: dict[str, str] = _KEYS["without_effect"]
"""Key of `params.config` that changes nothing in rlcli -> reason."""
_KL_GRAINS = {"legacy": "minibatch", "standard": "epoch", "standard_epoch": "iteration"}
_SCHEDULES = {
    "adaptive": "adaptive", "linear": "linear", "constant": "constant", "identity": "constant", "fixed": "constant"
}  # fmt: skip
_HANDLED = (
    "reward_shaper", "normalize_advantage", "lr_schedule", "kl_threshold", "grad_norm", "truncate_grads",
    "critic_coef", "clip_value", "value_bootstrap", "schedule_type", "clip_actions", "central_value_config",
    "minibatch_size",
)  # fmt: skip
_REQUIRED = (
    *("gamma", "tau", "learning_rate", "horizon_length", "minibatch_size", "mini_epochs", "e_clip", "max_epochs"),
)
_ACTIVATIONS = ("elu", "relu", "tanh", "silu")
_MAX_ABS_LOG_STD = 20


class RlGamesReader:
    """Reader of the mapping `params` of an rl_games configuration.

    Args:
        sink: receives the settings, notes and mistakes.
        is_strict: whether a key that rl_games does not have is a mistake; if not, the key is noted as ignored.
    """

    def __init__(self, sink: Sink, *, is_strict: bool) -> None:
        self.put, self.note, self.problem = sink.put, sink.note, sink.problem
        self._is_strict = is_strict

    def read(self, params: Any) -> None:
        """Translate the mapping `params` into settings of `ppo`, notes and mistakes, which the sink receives."""
        if not isinstance(params, Mapping) or not isinstance(params.get("config"), Mapping):
            message = "a configuration of rl_games needs the mapping params: {algo, model, network, config}"
            self.problem(("params",), message, "add the missing keys")
            return
        for key, value in {"trainer": "ppo", "algorithm": "ppo", "dialect": "rl_games"}.items():
            self.put((key,), value, ("params",))
        self._params(params)
        self._network(params.get("network"))
        self._config(params["config"])
        if "env" in params:
            self._env(params["env"], params["config"])

    def _report_unknown_key(self, at: Path, hint: str | None = None) -> None:
        if self._is_strict:
            self.problem(at, f"unknown key '{at[-1]}'", hint or "remove the key")
        else:
            self.note(at, "ignored", "rlcli has no such setting")

    def _env(self, env: Any, config: Mapping[str, Any]) -> None:
        """Read the mapping `env`: settings of the wrapper through which Isaac Lab gives an environment to rl_games."""
        at = ("params", "env")
        bound = env.get("clip_actions") if isinstance(env, Mapping) else None
        bound = float(bound) if isinstance(bound, int | float) and math.isfinite(bound) else None
        self.put(("action_bound",), bound, (*at, "clip_actions"))
        for key in env if isinstance(env, Mapping) else ():
            if key == "clip_actions" and bound not in (None, 1.0) and config.get("clip_actions", True):
                self.note((*at, key), "approximated", "actions are clipped to the bound, not scaled by it")
            elif key == "clip_actions":
                self.note((*at, key), "mapped", "action_bound")
            elif key == "clip_observations":
                self.note((*at, key), "ignored", "observations are not clipped")
            else:
                self.note((*at, key), "ignored", "rlcli has no such setting")

    def _params(self, params: Mapping[str, Any]) -> None:
        known: dict[str, tuple[Status, str]] = {
            "seed": ("mapped", "--seed"),
            "load_checkpoint": ("ignored", "use --init-from or --resume"),
            "load_path": ("ignored", "use --init-from or --resume"),
        }
        for key, value in params.items():
            at = ("params", key)
            if key in known:
                self.note(at, *known[key])
            elif key in ("algo", "model"):
                name = value.get("name") if isinstance(value, Mapping) else value
                wanted = {"algo": "a2c_continuous", "model": "continuous_a2c_logstd"}[key]
                if name != wanted:
                    self.problem(at, _no_counterpart(name), f"expected '{wanted}'")
                else:
                    self.note(at, "mapped", "trainer ppo")
            elif key not in ("network", "config", "env"):
                self._report_unknown_key(at, did_you_mean(key, ("seed", "algo", "model", "network", "config", *known)))

    def _network(self, network: Any) -> None:
        at = ("params", "network")
        if not isinstance(network, Mapping):
            self.problem(at, "expected a mapping; write mlp: {units: [...], activation: NAME}")
            return
        for key, value in network.items():
            if key == "name":
                self.note((*at, key), "mapped", "an actor and a critic, the only kind of network in rlcli")
            elif key == "separate":
                if value:
                    self.note((*at, key), "mapped", "actor and critic have separate networks, as always in rlcli")
                else:
                    text = "rlcli cannot share layers between actor and critic: each has a network of its own"
                    self.note((*at, key), "approximated", text)
            elif key == "mlp":
                self._mlp((*at, key), value)
            elif key == "space":
                self._space((*at, key), value)
            elif key == "rnn":
                self._rnn((*at, key), value)
            elif key == "cnn":
                self._cnn((*at, key), value, network.get("mlp"))
            else:
                self._report_unknown_key((*at, key), "keys: name, separate, space, mlp, rnn, cnn")

    def _mlp(self, at: Path, mlp: Any) -> None:
        if not isinstance(mlp, Mapping):
            self.problem(at, "expected a mapping; write {units: [...], activation: NAME}")
            return
        shape: dict[str, Any] = {}
        for key, value in mlp.items():
            if key == "units":
                shape["hidden"] = value
                self.note((*at, key), "mapped", "actor.hidden, critic.hidden")
            elif key == "activation":
                if value not in _ACTIVATIONS:
                    self.problem((*at, key), f"unknown activation '{value}'", f"known: {listing(_ACTIVATIONS)}")
                shape["activation"] = value
                self.note((*at, key), "mapped", "actor.activation, critic.activation")
            elif key == "d2rl" and value:
                self.problem((*at, key), "d2rl networks are not supported; remove this key")
            elif key == "initializer":
                self.note((*at, key), "mapped", "the key `init` of ppo")
            elif key == "d2rl":
                self.note((*at, key), "ignored", "d2rl is off, and rlcli has no d2rl networks")
            elif key == "regularizer":
                self.note((*at, key), "ignored", "rlcli has no weight regulariser")
            else:
                self._report_unknown_key((*at, key))
        for network in ("actor", "critic"):
            self.put((network,), dict(shape), at)

    def _space(self, at: Path, space: Any) -> None:
        kinds = space if isinstance(space, Mapping) else {}
        continuous = kinds.get("continuous")
        if not isinstance(continuous, Mapping):
            self.problem(at, f"only continuous action spaces are supported, found {listing(kinds)}; write `continuous`")
            return
        for key, value in continuous.items():
            inner = (*at, "continuous", key)
            if key == "sigma_init":
                log_std = value.get("val", 0) if isinstance(value, Mapping) else 0
                if not isinstance(log_std, int | float) or abs(log_std) > _MAX_ABS_LOG_STD:
                    self.problem(inner, f"val: expected a number between -{_MAX_ABS_LOG_STD} and {_MAX_ABS_LOG_STD}")
                    continue
                self.put(("init_std",), math.exp(log_std), inner)
                self.note(inner, "mapped", "the key `init_std` of ppo")
            elif key == "fixed_sigma" and value is not True:
                self.note(inner, "approximated", "the standard deviation never depends on the state")
            else:
                self.note(inner, "mapped")

    def _rnn(self, at: Path, rnn: Any) -> None:
        if not isinstance(rnn, Mapping) or rnn.get("name") != "lstm":
            self.problem(at, "only LSTMs are supported; write {name: lstm, units: N, layers: N}")
            return
        self.put(("rnn",), {"hidden": rnn.get("units", 64), "layers": rnn.get("layers", 1)}, at)
        for key, value in rnn.items():
            is_exact = key in ("name", "units", "layers") or (key == "before_mlp" and value is True) or not value
            text = "rnn" if is_exact else f"rlcli's LSTM has no setting '{key}'"
            self.note((*at, key), "mapped" if is_exact else "approximated", text)

    def _cnn(self, at: Path, cnn: Any, mlp: Any) -> None:
        convs = cnn.get("convs") if isinstance(cnn, Mapping) else None
        if not isinstance(convs, list) or not convs or not all(isinstance(layer, Mapping) for layer in convs):
            hint = "write {type: conv2d, convs: [{filters: 32, kernel_size: 8, strides: 4, padding: 0}, ...]}"
            self.problem(at, "expected the type conv2d and a list `convs` with its layers", hint)
            return
        if cnn.get("type") != "conv2d":
            self.problem((*at, "type"), _no_counterpart(cnn.get("type")), "expected 'conv2d'")
        for number, layer in enumerate(convs):
            if layer.get("padding", 0) != 0:
                self.problem(
                    (*at, "convs", number, "padding"), "rlcli's convolutions have no padding", "write padding: 0"
                )
        layers = {"channels": "filters", "kernels": "kernel_size", "strides": "strides"}
        self.put(("cnn",), {name: [layer.get(key) for layer in convs] for name, key in layers.items()}, at)
        for key, value in cnn.items():
            other = key == "activation" and isinstance(mlp, Mapping) and value != mlp.get("activation")
            if other:
                self.note((*at, key), "approximated", "the convolutions have the activation of the MLP")
            else:
                ignored = key in ("initializer", "regularizer")
                self.note((*at, key), "ignored" if ignored else "mapped", "" if ignored else "cnn")

    def _config(self, config: Mapping[str, Any]) -> None:
        at = ("params", "config")
        for key in _REQUIRED:
            if config.get(key) is None:
                self.problem(at, f"missing '{key}'; add the key with a value")
        for key, value in config.items():
            if key in _DIRECT:
                self.put((_DIRECT[key],), value, (*at, key))
                self.note((*at, key), "mapped", _DIRECT[key])
            elif key in WITHOUT_EFFECT:
                self.note((*at, key), "ignored", WITHOUT_EFFECT[key])
            elif key not in _HANDLED:
                self._report_unknown_key((*at, key), did_you_mean(key, [*_DIRECT, *_HANDLED, *WITHOUT_EFFECT]))
        self._special(at, config)

    def _special(self, at: Path, config: Mapping[str, Any]) -> None:
        def mapped(key: str, target: str, value: Any, text: str = "") -> None:
            if key in config:
                self.put((target,), value, (*at, key))
                self.note((*at, key), "approximated" if text else "mapped", text or target)

        shaper = config.get("reward_shaper")
        scale = shaper.get("scale_value", 1.0) if isinstance(shaper, Mapping) else 1.0
        mapped("reward_shaper", "reward_scale", scale)
        if isinstance(shaper, Mapping) and set(shaper) - {"scale_value"}:
            others = listing(sorted(set(shaper) - {"scale_value"}))
            self.problem((*at, "reward_shaper"), f"only scale_value is supported; remove {others}")
        mapped("critic_coef", "value_coef", 0.5 * _number(config.get("critic_coef"), 2.0))
        mapped("clip_value", "clip_value", "larger" if config.get("clip_value") else None)
        mapped("normalize_advantage", "normalize_advantage", "batch" if config.get("normalize_advantage") else None)
        norm = config.get("grad_norm", 1.0) if config.get("truncate_grads", False) else None
        self.put(("max_grad_norm",), norm, (*at, "grad_norm"))
        for key in ("grad_norm", "truncate_grads"):
            if key in config:
                self.note((*at, key), "mapped", "max_grad_norm")
        self._schedule(at, config)
        if "value_bootstrap" in config:
            if config["value_bootstrap"]:
                self.note((*at, "value_bootstrap"), "mapped", "bootstrap")
            else:
                self.note((*at, "value_bootstrap"), "approximated", "rlcli always bootstraps at a time-out")
        if "clip_actions" in config:
            mapped("clip_actions", "action_bound", 1.0 if config["clip_actions"] else None)
        if "central_value_config" in config:
            text = "the critic observes the group `critic`; its network and learning rate are those of the actor"
            self.note((*at, "central_value_config"), "approximated", text)

    def _schedule(self, at: Path, config: Mapping[str, Any]) -> None:
        schedule = config.get("lr_schedule") or "constant"
        if str(schedule) == "None":
            schedule = "constant"
        if not isinstance(schedule, str) or schedule not in _SCHEDULES:
            self.problem((*at, "lr_schedule"), f"unknown schedule '{schedule}'", f"known: {listing(_SCHEDULES)}")
            return
        self.put(("schedule",), _SCHEDULES[schedule], (*at, "lr_schedule"))
        adaptive = schedule == "adaptive"
        self.put(("desired_kl",), config.get("kl_threshold", 0.008) if adaptive else None, (*at, "kl_threshold"))
        for key in ("lr_schedule", "kl_threshold"):
            if key in config:
                used = adaptive or key == "lr_schedule"
                self.note((*at, key), "mapped" if used else "ignored", "schedule" if used else "not adaptive")
        if "schedule_type" in config:
            grain = _KL_GRAINS.get(str(config["schedule_type"]))
            if grain is None:
                self.problem((*at, "schedule_type"), "unknown schedule_type", f"known: {listing(_KL_GRAINS)}")
            self.put(("kl_grain",), grain, (*at, "schedule_type"))
            self.note((*at, "schedule_type"), "mapped", "kl_grain")


def _no_counterpart(value: object) -> str:
    """Return the message for an rl_games setting that has no value, or a value without a counterpart in rlcli."""
    return "the key has no value" if value is None else f"'{value}' has no counterpart in rlcli"


def _number(value: Any, default: float) -> float:
    return value if isinstance(value, int | float) else default
