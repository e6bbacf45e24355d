"""Import of policies that other libraries saved: their weights alone, as a run with one checkpoint."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from rlcli.config.dump import to_data, to_yaml
from rlcli.deploy.env_description import describe
from rlcli.envs.make import make_env
from rlcli.errors import CheckpointError, one_line
from rlcli.machine import available_memory
from rlcli.rl.optimizers import below
from rlcli.rl.policy import blank_policy, filled
from rlcli.rl.trainer import TrainerState
from rlcli.runs.provenance import environment_record
from rlcli.runs.run import create_run
from rlcli.runs.torch_archive import VEC_NORMALIZE_HINT, read_archive_file, read_member, read_tensors
from rlcli.training.checkpoint_writer import write_checkpoint

if TYPE_CHECKING:
    from rlcli.config.load import Resolved

_NORMALIZER_EPS = 1e-2
"""RSL-RL adds this to the standard deviation."""
_MIN_STD = 1e-6


@dataclass(slots=True)
class ImportedPolicy:
    """Policy of another library: its description and its weights, under the names of a saved policy."""

    spec: dict[str, Any]
    weights: dict[str, Tensor]
    critic: dict[str, Tensor] = field(default_factory=dict)
    """Weights of the critics, under their original names."""
    algorithm: str = ""
    """The algorithm that trained it, by the names of the weights."""


def read_sb3(
    file: Path, *, activation: str | None = None, action_bound: float = 1.0, normalizer: Path | None = None
) -> ImportedPolicy:
    """Read a policy from a zip of Stable-Baselines3: PPO, A2C, SAC, TD3 or DDPG with an MlpPolicy.

    Args:
        file: the file of `model.save`; only `policy.pth` in it is read.
        activation: of the hidden layers, which the file does not hold; None: the library's default.
        action_bound: the actions that it was trained with lie within +-this.
        normalizer: `mean` and `var` of its VecNormalize, as safetensors.

    Raises:
        CheckpointError: if it is not such a file, holds something else than tensors, or another kind of policy.
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
        raise CheckpointError(
            f"{file} holds no policy of PPO, A2C, SAC, TD3 or DDPG with continuous actions; {_some(weights)}"
        )
    if any(name.startswith(("features_extractor.", "pi_features_extractor.", "actor.features")) for name in weights):
        raise CheckpointError(f"{file} holds a policy with a features extractor of its own; MlpPolicy alone is read")
    kind, algorithm, hidden, output, usual = kinds[prefix]
    layers = _layers(weights, hidden, file, step=2)
    if output is not None:
        layers.append(_layer(weights, output.removesuffix("."), file))
    taken = _as_actor(layers, file)
    if kind == "gaussian-mlp":
        taken["log_std"] = weights["log_std"]
    elif kind == "squashed-gaussian-mlp":
        weight, bias = _layer(weights, "actor.log_std", file)
        taken |= {"log_std_head.weight": weight, "log_std_head.bias": bias}
    spec = _spec(kind, layers, activation or usual, action_bound)
    if normalizer is not None:
        taken |= _vec_normalize(normalizer)
        spec["normalize"] = True
    critics = ("mlp_extractor.value_net.", "value_net.", "critic.", "critic_target.")
    return _whole(file, spec, taken, {n: v for n, v in weights.items() if n.startswith(critics)}, algorithm)


def read_rsl_rl(file: Path, *, activation: str | None = None, action_bound: float | None = None) -> ImportedPolicy:
    """Read a policy from a checkpoint of RSL-RL, with its LSTM and its empirical normalisation if it has them.

    Args:
        file: `model_N.pt` of version 2 and later.
        activation: of the hidden layers, which the file does not hold; None: elu.
        action_bound: the value of `clip_actions`; None: actions were not clipped.

    Raises:
        CheckpointError: if it is not such a file, holds something else than tensors, or another kind of policy.
    """
    where = str(file)
    saved = read_tensors(read_archive_file(file), where)
    actor = saved.get("actor_state_dict")
    if actor is not None:  # version 5
        weights, critic = _named_tensors(actor, where), _named_tensors(saved.get("critic_state_dict", {}), where)
        hidden, memory_of, stats = "mlp.", "rnn.rnn.", below(weights, "obs_normalizer.")
        std = {"std": "distribution.std_param", "log_std": "distribution.log_std_param"}
    else:  # versions 2 to 4
        weights = _named_tensors(saved.get("model_state_dict"), where)
        critic = {name: value for name, value in weights.items() if name.startswith(("critic", "memory_c"))}
        hidden, memory_of = "actor.", "memory_a.rnn."
        stats = below(weights, "actor_obs_normalizer.")
        if not stats and "obs_norm_state_dict" in saved:
            stats = _named_tensors(saved["obs_norm_state_dict"], where)
        std = {"std": "std", "log_std": "log_std"}
    if not any(name.startswith(hidden) for name in weights):
        raise CheckpointError(f"{file} holds no actor of RSL-RL; {_some(weights)}")
    layers = _layers(weights, hidden, file, step=2)
    taken = _as_actor(layers, file)
    taken["log_std"] = _log_std(weights, std, file)
    cells, inputs = _lstm(weights, memory_of, taken, file)
    spec = _spec("gaussian-lstm" if cells else "gaussian-mlp", layers, activation or "elu", action_bound)
    if cells:
        spec |= {"memory": cells, "observation_size": inputs}
    if stats:
        taken |= _empirical(stats, file)
        spec |= {"normalize": True, "normalize_clip": None}
    return _whole(file, spec, taken, critic, "ppo")


def as_run(
    imported: ImportedPolicy, resolved: Resolved, record: Mapping[str, Any], runs_dir: Path, name: str | None
) -> Path:
    """Create a run with one checkpoint: the policy, for the task and the agent of a configuration.

    Args:
        imported: what was read.
        resolved: the task and the agent.
        record: further entries of run.json.
        runs_dir: the folder of runs.
        name: part of the run folder's name.

    Raises:
        CheckpointError: if the policy is not one for this task, with a table of what differs.
        MachineError: if the disk refuses.
    """
    task = resolved.task
    one = task.model_copy(update={"scene": task.scene.model_copy(update={"num_envs": 1})})
    env = make_env(replace(resolved, task=one), seed=0)
    layout, deployment = env.layout, describe(env)
    env.close()
    sizes = {"observation_size": layout.size("policy"), "action_size": layout.action_size}
    differing = [(key, str(imported.spec[key]), str(size)) for key, size in sizes.items() if imported.spec[key] != size]
    if differing:
        rows = [("field", "in the file", f"of {resolved.source.name}"), *differing]
        table = "\n".join(f"  {a:<18}{b:<14}{c}" for a, b, c in rows)
        raise CheckpointError(
            f"{record['imported']['file']} holds no policy for {resolved.source.name}:\n{table}",
            hint="columns must be the same, in the same order; rlcli show TASK says which the task has",
        )
    assert resolved.agent is not None
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
    manifest = {
        **{key: run.record[key] for key in ("task", "agent", "seed")},
        "iteration": 0,
        "trainer": record["imported"]["form"],
        "layout": layout.record(),
        "deployment": deployment,
        "versions": {"rlcli": run.record["rlcli"], **run.record["versions"]},
    }
    values = {"policy": imported.spec, "iteration": 0, "env_steps": 0}
    tensors = {"policy": imported.weights, "trainer": {f"critic.{n}": value for n, value in imported.critic.items()}}
    try:
        write_checkpoint(run.checkpoints, 0, TrainerState(tensors, values), manifest)
        run.update(state="finished", step=0, iteration=0)
    except BaseException:
        run.discard()
        raise
    run.unlock()
    return run.folder


def _named_tensors(saved: object, where: str) -> dict[str, Tensor]:
    """Return float32 copies of named tensors; check that none has more numbers than the file."""
    if not isinstance(saved, Mapping):
        raise CheckpointError(f"{where} holds no weights where they should be")
    named: dict[str, Tensor] = {}
    total, most = 0, available_memory() // 4
    for name, value in saved.items():
        if not isinstance(name, str) or type(value) not in (Tensor, torch.nn.Parameter):
            raise CheckpointError(f"{where}: '{str(name)[:60]}' is no tensor")
        if value.layout != torch.strided or value.device.type != "cpu" or value.is_complex() or value.is_quantized:
            raise CheckpointError(f"{where}: '{name[:60]}' is a tensor of an uncommon kind")
        if value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise CheckpointError(f"{where}: '{name[:60]}' claims {value.numel():,} numbers, and the file has fewer")
        total += 4 * value.numel()  # several may share what the file holds
        if total > most:
            raise CheckpointError(f"{where} holds tensors of more than {most:,} bytes")
        named[name] = value.detach().to(torch.float32).clone(memory_format=torch.contiguous_format)
        if not bool(named[name].isfinite().all()):
            raise CheckpointError(f"{where}: '{name[:60]}' holds values that are not finite")
    return named


_Layer = tuple[Tensor, Tensor]


def _layers(weights: Mapping[str, Tensor], prefix: str, file: Path, *, step: int) -> list[_Layer]:
    """Return the linear layers below a prefix, in the order of their numbers."""
    numbers = {n.removeprefix(prefix).partition(".")[0] for n in weights if n.startswith(prefix)}
    if not all(number.isdecimal() and number.isascii() and len(number) < 4 for number in numbers):
        raise CheckpointError(
            f"{file}: {prefix}* are no layers one after the other: {', '.join(sorted(numbers))[:200]}"
        )
    if sorted(map(int, numbers)) != list(range(0, step * len(numbers), step)):
        raise CheckpointError(f"{file}: layers of {prefix}* are missing, or are no linear ones")
    return [_layer(weights, f"{prefix}{number}", file) for number in sorted(numbers, key=int)]


def _layer(weights: Mapping[str, Tensor], name: str, file: Path) -> _Layer:
    weight, bias = weights.get(f"{name}.weight"), weights.get(f"{name}.bias")
    if weight is None or bias is None or weight.dim() != 2 or bias.shape != weight.shape[:1] or not weight.numel():
        raise CheckpointError(f"{file}: {name} is no linear layer with a bias")
    return weight, bias


def _as_actor(layers: Sequence[_Layer], file: Path) -> dict[str, Tensor]:
    for (before, _), (after, _) in itertools.pairwise(layers):
        if after.shape[1] != len(before):
            raise CheckpointError(f"{file}: a layer gives {len(before)} numbers, and the next takes {after.shape[1]}")
    if not layers:
        raise CheckpointError(f"{file} holds no layers")
    return {
        f"actor.{2 * number}.{name}": value
        for number, layer in enumerate(layers)
        for name, value in zip(("weight", "bias"), layer, strict=True)
    }


def _spec(kind: str, layers: Sequence[_Layer], activation: str, action_bound: float | None) -> dict[str, Any]:
    return {
        "kind": kind,
        "observation_size": layers[0][0].shape[1],
        "action_size": len(layers[-1][0]),
        "hidden": [len(weight) for weight, _ in layers[:-1]],
        "activation": activation,
        "action_bound": action_bound,
    }


def _log_std(weights: Mapping[str, Tensor], names: Mapping[str, str], file: Path) -> Tensor:
    if names["log_std"] in weights:
        return weights[names["log_std"]]
    if names["std"] not in weights:
        raise CheckpointError(f"{file}: the deviation of its actions depends on the state; that is not read")
    return weights[names["std"]].clamp(min=_MIN_STD).log()


def _lstm(
    weights: Mapping[str, Tensor], prefix: str, taken: dict[str, Tensor], file: Path
) -> tuple[list[int], int | None]:
    """Put the cells of an LSTM into `taken`; return their sizes and the number of inputs of the first layer."""
    cells: list[int] = []
    inputs: int | None = None
    for name, value in weights.items():
        if not name.startswith(prefix):
            continue
        kind, _, layer = name.removeprefix(prefix).rpartition("_l")
        if kind not in ("weight_ih", "weight_hh", "bias_ih", "bias_hh") or not (layer.isdecimal() and len(layer) < 3):
            raise CheckpointError(f"{file}: {name[:60]} is nothing that a memory has")
        taken[f"memory.layers.{layer}.{kind}"] = value
    while (recurrent := taken.get(f"memory.layers.{len(cells)}.weight_hh")) is not None:
        if recurrent.dim() != 2 or len(recurrent) != 4 * recurrent.shape[1] or not recurrent.numel():
            raise CheckpointError(f"{file}: its memory is no LSTM; others are not read")
        cells.append(recurrent.shape[1])
    if cells:
        first = taken.get("memory.layers.0.weight_ih")
        inputs = None if first is None or first.dim() != 2 else first.shape[1]
    return cells, inputs


def _empirical(stats: Mapping[str, Tensor], file: Path) -> dict[str, Tensor]:
    """Convert the normalizer: RSL-RL divides by std + 1e-2, a saved policy by sqrt(var + 1e-8)."""
    mean, std = stats.get("_mean"), stats.get("_std")
    if mean is None or std is None or mean.shape != std.shape or mean.dim() != 2 or len(mean) != 1:
        raise CheckpointError(f"{file}: its normaliser has no mean and deviation of each observation")
    deviation = std[0].double() + _NORMALIZER_EPS
    return _normalizer(mean[0], (deviation.square() - 1e-8).clamp(min=0.0), stats)


def _normalizer(mean: Tensor, var: Tensor, stats: Mapping[str, Tensor]) -> dict[str, Tensor]:
    count = stats.get("count", torch.zeros(())).double().reshape(-1)[:1].sum()
    return {"normalizer.mean": mean.double(), "normalizer.var": var.double(), "normalizer.count": count}


def _vec_normalize(file: Path) -> dict[str, Tensor]:
    data = read_archive_file(file)
    if data[:1] == b"\x80" or file.suffix == ".pkl":
        raise CheckpointError(f"{file} is a pickle; it is not opened", hint=VEC_NORMALIZE_HINT)
    try:
        stats = safetensors.torch.load(data)
    except (SafetensorError, RuntimeError, ValueError, KeyError) as error:
        raise CheckpointError(
            f"{file} is corrupt, or no safetensors file: {one_line(error)}", hint=VEC_NORMALIZE_HINT
        ) from None
    mean, var = stats.get("mean"), stats.get("var")
    if mean is None or var is None or mean.dim() != 1 or mean.shape != var.shape:
        raise CheckpointError(f"{file} has no 'mean' and 'var' of each observation", hint=VEC_NORMALIZE_HINT)
    return _normalizer(mean, var, stats)


def _whole(
    file: Path, spec: dict[str, Any], weights: dict[str, Tensor], critic: dict[str, Tensor], algorithm: str
) -> ImportedPolicy:
    """Return the policy; check that it can be built."""
    try:
        if math.isnan(spec["action_bound"] or 0.0):
            raise CheckpointError("the action bound is no number")
        policy = filled(blank_policy(spec), weights)
    except CheckpointError as error:
        raise CheckpointError(f"{file} holds no policy that can be taken over: {error.message}") from None
    return ImportedPolicy(policy.spec.model_dump(), weights, critic, algorithm)


def _some(weights: Mapping[str, Tensor]) -> str:
    names = [name[:40] for name in list(weights)[:6]]
    return f"its weights: {', '.join(names)}" if names else "it has no weights"
