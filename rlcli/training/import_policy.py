"""Import policies that Stable-Baselines3 (SB3) or RSL-RL has saved, for `rlcli import`.

The weights become a run with one checkpoint, which can be played, evaluated and exported.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from rlcli.config.dump import to_data, to_yaml
from rlcli.config.load import Resolved
from rlcli.deploy.env_description import describe
from rlcli.envs.make import make_env
from rlcli.errors import CheckpointError, one_line
from rlcli.machine.memory import available_memory
from rlcli.rl.optimizers import tensors_with_prefix
from rlcli.rl.policy import blank_policy, filled
from rlcli.rl.trainer import TrainerState
from rlcli.runs.provenance import environment_record
from rlcli.runs.run import create_run
from rlcli.runs.untrusted_weights import VEC_NORMALIZE_HINT, read_archive_file, read_member, read_tensors
from rlcli.training.checkpoint_writer import manifest_entries, write_checkpoint

_NORMALIZER_EPS = 1e-2
"""Number that RSL-RL adds to the standard deviation of observations before dividing by the sum."""
_MIN_STD = 1e-6
"""Smallest standard deviation of actions."""


@dataclass(slots=True)
class ImportedPolicy:
    """Policy of another library, converted to rlcli's format of saved policies."""

    spec: dict[str, Any]
    """Structure of the policy, the content of `policy.json`."""
    weights: dict[str, Tensor]
    """Weights by their names in a saved policy."""
    critic: dict[str, Tensor]
    """Weights of the critics by their original names; empty if the file has no critics."""
    algorithm: str
    """Algorithm of the training, derived from the names of the weights."""


def read_sb3(
    file: Path, *, activation: str | None = None, action_bound: float = 1.0, normalizer: Path | None = None
) -> ImportedPolicy:
    """Read a policy from a zip of Stable-Baselines3: PPO, A2C, SAC, TD3 or DDPG with an MlpPolicy.

    Args:
        file: file that `model.save` has written; only its member `policy.pth` is read.
        activation: activation of the hidden layers, which the file does not contain; None: the library's default.
        action_bound: bound of the actions in the training, which were within +-action_bound.
        normalizer: safetensors file with `mean` and `var` of `VecNormalize`; None: observations were not normalised.

    Raises:
        CheckpointError: if the file has another format, contains anything but tensors, or another kind of policy.
    """
    where = f"{file}: policy.pth"
    weights = _named_tensors(read_tensors(read_member(file, "policy.pth"), where), where)
    kinds = {
        "actor.latent_pi.": ("squashed-gaussian-mlp", "sac", "actor.latent_pi.", "actor.mu.", "relu"),
        "actor.mu.": ("deterministic-mlp", "td3", "actor.mu.", None, "relu"),
        "action_net.": ("gaussian-mlp", "ppo", "mlp_extractor.policy_net.", "action_net.", "tanh"),
    }
    prefix = next((p for p in kinds if any(name.startswith(p) for name in weights)), None)
    if prefix is None or ("action_net.weight" in weights and "log_std" not in weights):
        message = "must have a policy of PPO, A2C, SAC, TD3 or DDPG with continuous actions"
        raise CheckpointError(f"{file} {message}; {_some_names(weights)}")
    if any(name.startswith(("features_extractor.", "pi_features_extractor.", "actor.features")) for name in weights):
        raise CheckpointError(
            f"{file} has a features extractor with weights, such as a CNN;"
            " only an MlpPolicy with SB3's default extractor can be imported"
        )
    kind, algorithm, hidden, output, default = kinds[prefix]
    layers = _layers(weights, hidden, file)
    if output is not None:
        layers.append(_layer(weights, output.removesuffix("."), file))
    spec, actor = _mlp_policy(kind, layers, activation or default, action_bound, file)
    if kind == "gaussian-mlp":
        actor["log_std"] = weights["log_std"]
    elif kind == "squashed-gaussian-mlp":
        actor["log_std_head.weight"], actor["log_std_head.bias"] = _layer(weights, "actor.log_std", file)
    if normalizer is not None:
        actor |= _vec_normalize(normalizer)
        spec["normalize"] = True
    critics = ("mlp_extractor.value_net.", "value_net.", "critic.", "critic_target.")
    critic = {name: value for name, value in weights.items() if name.startswith(critics)}
    return _checked_policy(file, spec, actor, critic, algorithm)


def read_rsl_rl(file: Path, *, activation: str | None = None, action_bound: float | None = None) -> ImportedPolicy:
    """Read a policy from a checkpoint of RSL-RL, with its LSTM and observation normaliser if there are any.

    Args:
        file: `model_N.pt` of RSL-RL 2 or later.
        activation: activation of the hidden layers, which the file does not contain; None: elu.
        action_bound: value of `clip_actions`; None: actions were not clipped.

    Raises:
        CheckpointError: if the file has another format, contains anything but tensors, or another kind of policy.
    """
    where = str(file)
    saved = read_tensors(read_archive_file(file), where)
    if saved.get("actor_state_dict") is not None:  # version 5
        weights = _named_tensors(saved["actor_state_dict"], where)
        critic = _named_tensors(saved.get("critic_state_dict", {}), where)
        hidden, lstm, stats = "mlp.", "rnn.rnn.", tensors_with_prefix(weights, "obs_normalizer.")
        std = {"std": "distribution.std_param", "log_std": "distribution.log_std_param"}
    else:  # versions 2 to 4
        weights = _named_tensors(saved.get("model_state_dict"), where)
        critic = {name: value for name, value in weights.items() if name.startswith(("critic", "memory_c"))}
        hidden, lstm, stats = "actor.", "memory_a.rnn.", tensors_with_prefix(weights, "actor_obs_normalizer.")
        if not stats and "obs_norm_state_dict" in saved:
            stats = _named_tensors(saved["obs_norm_state_dict"], where)
        std = {"std": "std", "log_std": "log_std"}
    if not any(name.startswith(hidden) for name in weights):
        raise CheckpointError(f"{file} has no actor of RSL-RL; {_some_names(weights)}")
    layers = _layers(weights, hidden, file)
    spec, actor = _mlp_policy("gaussian-mlp", layers, activation or "elu", action_bound, file)
    actor["log_std"] = _log_std(weights, std, file)
    memory_spec, memory_weights = _lstm(weights, lstm, file)
    spec, actor = spec | memory_spec, actor | memory_weights
    if stats:
        actor |= _empirical_normalizer(stats, file)
        spec |= {"normalize": True, "normalize_clip": None}
    return _checked_policy(file, spec, actor, critic, "ppo")


def create_imported_run(
    imported: ImportedPolicy, resolved: Resolved, record: Mapping[str, Any], runs_dir: Path, name: str | None
) -> Path:
    """Create a run with one checkpoint that contains an imported policy; return its folder.

    Args:
        imported: the policy.
        resolved: configuration of the task and the agent.
        record: further entries of run.json; `imported` describes the file.
        runs_dir: the folder of runs.
        name: text to add to the name of the run's folder; None: no text.

    Raises:
        CheckpointError: if the policy does not fit the task, with a table of the differences.
        MachineError: if the run cannot be written.
    """
    with contextlib.closing(make_env(resolved.with_num_envs(1), seed=0)) as env:
        layout, deployment = env.layout, describe(env)
    sizes = {"observation_size": layout.size("policy"), "action_size": layout.action_size}
    differing = [(key, str(imported.spec[key]), str(size)) for key, size in sizes.items() if imported.spec[key] != size]
    if differing:
        rows = [("field", "in the file", f"of {resolved.source.name}"), *differing]
        table = [f"  {a:<18}{b:<14}{c}" for a, b, c in rows]
        raise CheckpointError(
            [f"the policy in {record['imported']['file']} does not fit {resolved.source.name}:", *table],
            hint="give the task the same observation and action columns in the same order; see `rlcli show TASK`",
        )
    entries = {
        "seed": 0,
        "device": "cpu",
        "task": resolved.source.record() | {"file": resolved.source.config.name},
        "agent": resolved.agent_name,
        "loggers": [],
        "init_from": None,
        **record,
        **environment_record(resolved, 1, 1),
    }
    run = create_run(runs_dir, resolved.source.name, name, to_yaml(to_data(resolved)), entries)
    manifest = {"iteration": 0, **manifest_entries(run, record["imported"]["form"], layout, deployment)}
    values = {"policy": imported.spec, "iteration": 0, "env_steps": 0}
    tensors = {"policy": imported.weights, "trainer": {f"critic.{n}": value for n, value in imported.critic.items()}}
    try:
        write_checkpoint(run.checkpoints, 0, TrainerState(tensors, values), manifest)
        run.update(state="finished", step=0, iteration=0)
    except BaseException:
        run.discard()
        raise
    run.unlock()
    return run.shown


def _named_tensors(saved: object, where: str) -> dict[str, Tensor]:
    """Return float32 copies of untrusted tensors, by name, after checks that they are dense, finite and not too large.

    `where` is the file, for messages.
    """
    if not isinstance(saved, Mapping):
        raise CheckpointError(
            f"{where} has no weights in model_state_dict or actor_state_dict; give a file model_N.pt of RSL-RL"
        )
    named: dict[str, Tensor] = {}
    total, limit = 0, available_memory() // 4  # [bytes]
    for name, value in saved.items():
        if not isinstance(name, str) or type(value) not in (Tensor, torch.nn.Parameter):
            raise CheckpointError(
                f"{where}: '{str(name)[:60]}' is not a tensor; save only the `state_dict()` of the policy"
            )
        if value.layout != torch.strided or value.device.type != "cpu" or value.is_complex() or value.is_quantized:
            layout, dtype = (str(part).removeprefix("torch.") for part in (value.layout, value.dtype))
            found = f"'{name[:60]}' is a {layout} {dtype} tensor on {value.device}"
            raise CheckpointError(f"{where}: {found}; save a dense, real CPU tensor instead")
        # a stride of 0 makes a large tensor of few numbers: its copy would fill the memory
        if value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise CheckpointError(f"{where}: '{name[:60]}' is an expanded view; save a copy: tensor.clone()")
        total += 4 * value.numel()  # several tensors may share the numbers of the file
        if total > limit:
            message = f"{where} has more than {limit:,} bytes, a quarter of the free memory"
            raise CheckpointError(message, hint="end other programs, or give a smaller policy")
        named[name] = value.detach().to(torch.float32).clone(memory_format=torch.contiguous_format)
        if not bool(named[name].isfinite().all()):
            raise CheckpointError(f"{where}: '{name[:60]}' contains NaN or infinity; choose an older file")
    return named


_Layer = tuple[Tensor, Tensor]
"""Weight (outputs, inputs) and bias (outputs,) of a linear layer."""


def _layers(weights: Mapping[str, Tensor], prefix: str, file: Path) -> list[_Layer]:
    """Return the linear layers of an `nn.Sequential` with activations between them, in the order of their indices."""
    numbers = {n.removeprefix(prefix).partition(".")[0] for n in weights if n.startswith(prefix)}
    if not all(number.isdecimal() and number.isascii() and len(number) < 4 for number in numbers):
        found = ", ".join(sorted(numbers))[:200]
        raise CheckpointError(
            f"{file}: the layers {prefix}* are named {found}; rename them to {prefix}0, {prefix}2, {prefix}4, ..."
        )
    if sorted(map(int, numbers)) != list(range(0, 2 * len(numbers), 2)):
        found = ", ".join(sorted(numbers, key=int))[:200]
        raise CheckpointError(f"{file}: only linear layers {prefix}0, 2, 4, ... can be imported, found {found}")
    return [_layer(weights, f"{prefix}{number}", file) for number in sorted(numbers, key=int)]


def _layer(weights: Mapping[str, Tensor], name: str, file: Path) -> _Layer:
    """Return the linear layer `name` of untrusted weights, after a check of its shapes."""
    weight, bias = weights.get(f"{name}.weight"), weights.get(f"{name}.bias")
    if weight is None or bias is None or weight.dim() != 2 or bias.shape != weight.shape[:1] or not weight.numel():
        shapes = ["missing" if value is None else tuple(value.shape) for value in (weight, bias)]
        found = f"{name}.weight: {shapes[0]}, {name}.bias: {shapes[1]}"
        expected = "weights must be (outputs, inputs) and biases (outputs,)"
        raise CheckpointError(f"{file}: {found}; {expected}; use linear layers with a bias")
    return weight, bias


def _mlp_policy(
    kind: str, layers: Sequence[_Layer], activation: str, action_bound: float | None, file: Path
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return the content of `policy.json` for a policy with these layers, and the weights of its actor."""
    if not layers:
        raise CheckpointError(f"{file} has no layers of a policy; choose another file")
    for (before, _), (after, _) in itertools.pairwise(layers):
        if after.shape[1] != len(before):
            message = f"a layer with {len(before)} outputs is followed by a layer with {after.shape[1]} inputs"
            raise CheckpointError(f"{file}: {message}; choose an undamaged file")
    spec = {
        "kind": kind,
        "observation_size": layers[0][0].shape[1],
        "action_size": len(layers[-1][0]),
        "hidden": [len(weight) for weight, _ in layers[:-1]],
        "activation": activation,
        "action_bound": action_bound,
    }
    actor: dict[str, Tensor] = {}
    for number, (weight, bias) in enumerate(layers):  # the modules with odd numbers are activations
        actor |= {f"actor.{2 * number}.weight": weight, f"actor.{2 * number}.bias": bias}
    return spec, actor


def _log_std(weights: Mapping[str, Tensor], names: Mapping[str, str], file: Path) -> Tensor:
    """Return the log standard deviation of the actions; `names` has the names of `std` and `log_std` in the file."""
    if names["log_std"] in weights:
        return weights[names["log_std"]]
    if names["std"] not in weights:
        message = f"{file}: a standard deviation that depends on the state cannot be imported"
        raise CheckpointError(f"{message}; train with one that does not depend on the state")
    return weights[names["std"]].clamp(min=_MIN_STD).log()


def _lstm(weights: Mapping[str, Tensor], prefix: str, file: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return (entries of `policy.json`, weights) of the LSTM in a file; both are empty if the file has no LSTM.

    The names of the LSTM's weights begin with `prefix`.
    """
    lstm: dict[str, Tensor] = {}
    for name, value in tensors_with_prefix(weights, prefix).items():
        kind, _, layer = name.rpartition("_l")
        if kind not in ("weight_ih", "weight_hh", "bias_ih", "bias_hh") or not (layer.isdecimal() and len(layer) < 3):
            raise CheckpointError(
                f"{file}: {prefix}{name[:60]} is not a weight of an LSTM; other RNNs cannot be imported"
            )
        lstm[f"memory.layers.{layer}.{kind}"] = value
    cells: list[int] = []
    while (recurrent := lstm.get(f"memory.layers.{len(cells)}.weight_hh")) is not None:
        # an LSTM has four gates: weight_hh is (4 x cells, cells)
        if recurrent.dim() != 2 or len(recurrent) != 4 * recurrent.shape[1] or not recurrent.numel():
            raise CheckpointError(f"{file}: the RNN is no LSTM; train a policy with an LSTM or without an RNN")
        cells.append(recurrent.shape[1])
    if not cells:
        return {}, lstm
    first = lstm.get("memory.layers.0.weight_ih")
    inputs = None if first is None or first.dim() != 2 else first.shape[1]
    return {"kind": "gaussian-lstm", "memory": cells, "observation_size": inputs}, lstm


def _empirical_normalizer(stats: Mapping[str, Tensor], file: Path) -> dict[str, Tensor]:
    """Convert RSL-RL's observation normaliser (divides by std + 1e-2) to rlcli's (divides by sqrt(var + 1e-8))."""
    mean, std = stats.get("_mean"), stats.get("_std")
    if mean is None or std is None or mean.shape != std.shape or mean.dim() != 2 or len(mean) != 1:
        raise CheckpointError(f"{file}: `_mean` and `_std` of the normaliser must have shape (1, observations)")
    deviation = std[0].double() + _NORMALIZER_EPS
    return _normalizer(mean[0], (deviation.square() - 1e-8).clamp(min=0.0), stats)


def _normalizer(mean: Tensor, var: Tensor, stats: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors of rlcli's observation normaliser; the number of samples is `count` in `stats`, else 0."""
    count = stats.get("count", torch.zeros(())).double().reshape(-1)[:1].sum()
    return {"normalizer.mean": mean.double(), "normalizer.var": var.double(), "normalizer.count": count}


def _vec_normalize(file: Path) -> dict[str, Tensor]:
    """Read the normaliser of SB3's `VecNormalize` from a safetensors file."""
    data = read_archive_file(file)
    if data[:1] == b"\x80" or file.suffix == ".pkl":
        message = f"{file} is a pickle, which rlcli does not open; --normalizer takes a .safetensors file"
        raise CheckpointError(message, hint=VEC_NORMALIZE_HINT)
    try:
        stats = safetensors.torch.load(data)
    except (SafetensorError, RuntimeError, ValueError, KeyError) as error:
        message = f"{file} is corrupt or not a safetensors file: {one_line(error)}"
        raise CheckpointError(message, hint=VEC_NORMALIZE_HINT) from None
    mean, var = stats.get("mean"), stats.get("var")
    if mean is None or var is None or mean.dim() != 1 or mean.shape != var.shape:
        message = f"{file} must contain 'mean' and 'var', each with one number per observation"
        raise CheckpointError(message, hint=VEC_NORMALIZE_HINT)
    return _normalizer(mean, var, stats)


def _checked_policy(
    file: Path, spec: dict[str, Any], weights: dict[str, Tensor], critic: dict[str, Tensor], algorithm: str
) -> ImportedPolicy:
    """Return the imported policy after a check that its structure is valid and its weights fit.

    Raises:
        CheckpointError: if they do not.
    """
    try:
        policy = filled(blank_policy(spec), weights)
    except CheckpointError as error:
        raise CheckpointError(f"the policy in {file} cannot be imported: {error.message}") from None
    return ImportedPolicy(policy.spec.model_dump(), weights, critic, algorithm)


def _some_names(weights: Mapping[str, Tensor]) -> str:
    """Return up to six names of the weights, for a message."""
    names = [name[:40] for name in list(weights)[:6]]
    return f"found weights: {', '.join(names)}" if names else "found no weights"
