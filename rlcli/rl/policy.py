"""Policies as they are saved, played and exported: networks from raw observations to the actions of `env.step`.

A policy includes the normalisation of observations. In training, trainers use faster networks with the same weights.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from torch import Tensor, nn

from rlcli.config import messages
from rlcli.config.schema import Positive, Width
from rlcli.errors import CheckpointError
from rlcli.rl.cnn import Cnn, CnnSpec

ACTIVATIONS: dict[str, type[nn.Module]] = {"elu": nn.ELU, "relu": nn.ReLU, "tanh": nn.Tanh, "silu": nn.SiLU}
_LOG_STD_RANGE = (-20.0, 2.0)
_MAX_BYTES = 2**31
_OTHER = "export the policy again, or use another checkpoint"
_LogStd = Annotated[float, Field(ge=-80, le=80)]
"""Log standard deviation; the limits keep the standard deviation in the range of float32."""
Layers = Annotated[list[Width], Field(max_length=100)]
"""Width of each layer."""


class PolicySpec(BaseModel):
    """Structure of a policy: everything but its weights.

    The kinds are:

    - `gaussian-mlp`: a mean and a state-independent standard deviation; actions are clipped to the bound;
    - `gaussian-lstm`: `gaussian-mlp` behind an LSTM;
    - `gaussian-cnn`: `gaussian-mlp` behind a CNN over the images of the observation;
    - `squashed-gaussian-mlp`: mean and standard deviation depend on the state; actions are tanh times the bound;
    - `deterministic-mlp`: actions are tanh times the bound.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    kind: Literal["gaussian-mlp", "gaussian-lstm", "gaussian-cnn", "squashed-gaussian-mlp", "deterministic-mlp"] = (
        "gaussian-mlp"
    )
    """Kind of the policy, one of the list above."""
    group: Annotated[str, Field(max_length=200)] = "policy"
    """Observation group that the policy reads."""
    observation_size: Width
    """Number of observation columns."""
    action_size: Width
    """Number of action columns."""
    hidden: Layers
    """Widths of the hidden layers."""
    activation: Literal["elu", "relu", "tanh", "silu"]
    """Activation of the hidden layers."""
    action_bound: Positive | None
    """Actions are within +-this value; null: unbounded."""
    normalize: bool = False
    """Whether observations are normalised by a running mean and variance."""
    normalize_clip: Positive | None = 10.0
    """Normalised observations are clipped to +-this value; null: no clipping."""
    log_std_range: tuple[_LogStd, _LogStd] | None = None
    """For a squashed-gaussian-mlp: tanh maps the log standard deviation into this range; null: it is clamped to
    [-20, 2]."""
    memory: Layers = []
    """Number of cells of each LSTM layer; empty: no LSTM."""
    vision: CnnSpec | None = None
    """CNN and the images that it reads; null: no CNN."""

    @model_validator(mode="after")
    def _bounded(self) -> PolicySpec:
        if not self.kind.startswith("gaussian-") and self.action_bound is None:
            raise ValueError(f"`kind: {self.kind}` needs a number in `action_bound`")
        if (self.kind == "gaussian-lstm") != bool(self.memory):
            raise ValueError("`kind: gaussian-lstm` needs `memory` (sizes of the LSTM), and no other kind may have it")
        if (self.kind == "gaussian-cnn") != (self.vision is not None):
            raise ValueError("`kind: gaussian-cnn` needs `vision`, and no other kind may have it")
        if self.vision is not None and self.vision.stop > self.observation_size:
            raise ValueError(
                f"an image of `vision` ends at column {self.vision.stop}, but `observation_size` is"
                f" {self.observation_size}"
            )
        return self


class Normalizer(nn.Module):
    """Running mean and variance of observations, merged batch by batch (Chan, Golub and LeVeque 1979).

    The normaliser is a part of the policy: it is exported with the policy, and changes only in training.

    Args:
        size: number of columns.
        clip: normalised observations are clipped to +-this value; None: no clipping.
    """

    EPSILON = 1e-8
    """Number added to the variance before the square root."""

    mean: Tensor
    """Mean of the observations. (size,)"""
    var: Tensor
    """Variance of the observations. (size,)"""
    count: Tensor
    """Number of observations so far. (scalar)"""

    def __init__(self, size: int | tuple[()], clip: float | None = 10.0) -> None:
        super().__init__()
        self.clip = clip
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))

    def forward(self, obs: Tensor) -> Tensor:
        """Return (obs - mean) / std, clipped to +-`clip`. (n, d) -> (n, d)"""
        scale = (self.var + self.EPSILON).rsqrt().float()
        normal = (obs - self.mean.float()) * scale
        return normal if self.clip is None else normal.clamp(-self.clip, self.clip)

    def update(self, obs: Tensor) -> None:
        """Update mean, variance and count with a batch of observations. (n, d)"""
        batch = obs.double()
        self.merge(batch.mean(dim=0), batch.var(dim=0, unbiased=False), float(len(batch)))

    def merge(self, mean: Tensor, var: Tensor, count: float) -> None:
        """Update mean, variance and count with the mean and the variance of `count` samples. (d,), (d,)"""
        total = self.count + count
        delta = mean - self.mean
        # Chan, Golub and LeVeque 1979, equation 2.1b: sums of squares add up, plus delta^2 n_a n_b / (n_a + n_b)
        spread = self.var * self.count + var * count + delta.square() * self.count * count / total
        self.mean += delta * count / total
        self.var.copy_(spread / total)
        self.count.copy_(total)


class WideLinear(nn.Linear):
    """Linear layer with float32 weights that computes in float64.

    Inference libraries add products in different orders. In float64 the difference is too small to change a float32
    action, also for observations far from those of the training. Batches of any size and exported files therefore give
    the same actions.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Return the outputs. (n, in) -> (n, out) float64"""
        return nn.functional.linear(x.double(), self.weight.double(), self.bias.double())


class Lstm(nn.Module):
    """Long short-term memory (Hochreiter and Schmidhuber 1997), one step at a time.

    Args:
        inputs: number of input columns.
        cells: number of cells of each layer.
        wide: compute in float64, as `WideLinear` does.
    """

    def __init__(self, inputs: int, cells: Sequence[int], *, wide: bool = False) -> None:
        super().__init__()
        sizes = [inputs, *cells]
        self.layers = nn.ModuleList(nn.LSTMCell(*pair) for pair in zip(sizes[:-1], cells, strict=True))
        self.cells, self.dtype = list(cells), torch.float64 if wide else torch.float32

    def blank(self, rows: int) -> Tensor:
        """Return zero hidden states for `rows` samples. (rows, 2 x number of cells of all layers)

        The columns are the output h and the cell state c of the first layer, then h and c of the next layer.
        """
        return torch.zeros(rows, 2 * sum(self.cells), dtype=self.dtype, device=next(self.parameters()).device)

    def forward(self, x: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the output, (n, cells of the last layer), and the next hidden state, (n, m).

        Args:
            x: inputs. (n, inputs)
            memory: hidden state, with the columns that `blank` describes. (n, m)
        """
        parts, after = memory.split_with_sizes([size for size in self.cells for _ in range(2)], dim=1), []
        x = x.to(self.dtype)
        for layer, output, cell in zip(self.layers, parts[::2], parts[1::2], strict=True):
            weights = [value.to(self.dtype) for value in layer.parameters()]
            x, cell = torch.lstm_cell(x, (output, cell), *weights)
            after += [x, cell]
        return x, torch.cat(after, dim=1)


class Policy(nn.Module):
    """Multilayer perceptron with optional observation normaliser, LSTM or CNN, and action bound.

    Args:
        spec: structure of the policy.
    """

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__()
        self.spec = spec
        self.normalizer = Normalizer(spec.observation_size, spec.normalize_clip) if spec.normalize else None
        self.memory = Lstm(spec.observation_size, spec.memory, wide=True) if spec.memory else None
        inputs = spec.memory[-1] if spec.memory else spec.observation_size
        self.vision: Cnn | None = None
        if spec.vision is not None:
            self.vision = Cnn(spec.vision, ACTIVATIONS[spec.activation], wide=True)
            inputs = spec.vision.features(inputs)
        self.actor = mlp(inputs, spec.hidden, spec.action_size, spec.activation)
        if spec.kind.startswith("gaussian-"):
            self.log_std = nn.Parameter(torch.zeros(spec.action_size))
        elif spec.kind == "squashed-gaussian-mlp":
            self.log_std_head = WideLinear(spec.hidden[-1] if spec.hidden else spec.observation_size, spec.action_size)

    def forward(self, obs: Tensor) -> Tensor:
        """Return the deterministic action; a policy with an LSTM acts as in the first step of an episode.

        (n, observation_size) -> (n, action_size)
        """
        return self.step(obs, None)[0]

    def sample(self, obs: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return a sampled action; a deterministic policy returns its deterministic action.

        (n, observation_size) -> (n, action_size)
        """
        return self.step(obs, None, stochastic=True, generator=generator)[0]

    def step(
        self,
        obs: Tensor,
        memory: Tensor | None,
        *,
        stochastic: bool = False,
        generator: torch.Generator | None = None,
        noise_repeats: int = 1,
    ) -> tuple[Tensor, Tensor | None]:
        """Return the action, (n, action_size), and the next hidden state, (n, m) or None.

        Args:
            obs: raw observations. (n, observation_size)
            memory: hidden state, or None at the start of an episode. (n, m)
            stochastic: sample the action instead of taking the mean.
            generator: random generator of the noise; None: torch's global generator.
            noise_repeats: sample noise for the first n / noise_repeats rows, and repeat this noise for the other rows.
        """
        inputs = obs if self.normalizer is None else self.normalizer(obs)
        if self.memory is not None:
            inputs, memory = self.memory(inputs, self.memory.blank(len(obs)) if memory is None else memory)
        if self.vision is not None:
            inputs = self.vision(inputs)
        features = self.actor[:-1](inputs)
        mean = self.actor[-1](features).float()
        if not stochastic or self.spec.kind == "deterministic-mlp":
            return self._bounded(mean), memory
        rows, columns = mean.shape
        noise = torch.randn(rows // noise_repeats, columns, generator=generator, device=mean.device)
        noise = noise.repeat(noise_repeats, 1)
        return self._bounded(mean + self._log_std(features).exp() * noise), memory

    def _log_std(self, features: Tensor) -> Tensor:
        if self.spec.kind.startswith("gaussian-"):
            return self.log_std
        log_std: Tensor = self.log_std_head(features).float()
        if self.spec.log_std_range is None:
            return log_std.clamp(*_LOG_STD_RANGE)
        low, high = self.spec.log_std_range
        return low + 0.5 * (high - low) * (torch.tanh(log_std) + 1.0)

    def _bounded(self, action: Tensor) -> Tensor:
        bound = self.spec.action_bound
        if not self.spec.kind.startswith("gaussian-"):
            assert bound is not None
            action = torch.tanh(action) * bound  # clamped below: in some runtimes tanh exceeds 1 by a rounding error
        return action if bound is None else action.clamp(-bound, bound)


def mlp(inputs: int, hidden: list[int], outputs: int, activation: str) -> nn.Sequential:
    """Return linear layers that compute in float64, with activations between them.

    `inputs` and `outputs` are numbers of columns, `hidden` the widths of the hidden layers; `activation` is a key of
    `ACTIVATIONS`.
    """
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [WideLinear(inputs, width), ACTIVATIONS[activation]()]
        inputs = width
    return nn.Sequential(*layers, WideLinear(inputs, outputs))


def load_policy(spec: Mapping[str, object], weights: Mapping[str, Tensor]) -> Policy:
    """Return a policy in evaluation mode from the content of `policy.json` and `policy.safetensors`.

    Raises:
        CheckpointError: if the specification is not valid, the weights do not fit it, or a weight is not finite.
    """
    return filled(blank_policy(spec), weights)


def blank_policy(spec: Mapping[str, object]) -> Policy:
    """Return a policy without weights, on torch's meta device, from the content of `policy.json`.

    No memory is allocated, so a small untrusted file cannot cause a large allocation.

    Raises:
        CheckpointError: if the specification is not valid, or the policy would be larger than 2 GiB.
    """
    try:
        checked = PolicySpec.model_validate(spec)
    except ValidationError as error:
        first = next(messages.problems(error, PolicySpec, spec, messages.dotted))
        place = f"{first.path[:80]}: " if first.path else ""
        raise CheckpointError(f"policy.json is not valid: {place}{first.message}; {_OTHER}") from None
    with torch.device("meta"):
        policy = Policy(checked)
    if size_of(policy) > _MAX_BYTES:
        raise CheckpointError(
            f"policy.json describes a policy of {size_of(policy):,} bytes; train one of at most {_MAX_BYTES:,} bytes"
        )
    return policy


def size_of(policy: Policy) -> int:
    """Return the size of a policy's weights in bytes."""
    return sum(value.numel() * value.element_size() for value in policy.state_dict().values())


def filled(policy: Policy, weights: Mapping[str, Tensor]) -> Policy:
    """Load weights into a policy that `blank_policy` has returned; return this policy in evaluation mode.

    Raises:
        CheckpointError: if the weights do not fit, or a weight is not finite.
    """
    expected, found = _types_and_shapes(policy.state_dict()), _types_and_shapes(weights)
    if expected != found:
        differs = sorted(name for name in {*expected, *found} if expected.get(name) != found.get(name))
        rows = [f"{n[:80]} is {found.get(n, 'missing')}, expected {expected.get(n, 'nothing')}" for n in differs[:4]]
        raise CheckpointError(
            f"policy.safetensors does not fit policy.json: {', '.join(rows)}; export the policy again"
        )
    for name, value in weights.items():
        if not bool(value.isfinite().all()):
            raise CheckpointError(f"policy.safetensors is corrupt: '{name}' is not finite; {_OTHER}")
        if name in ("normalizer.var", "normalizer.count") and bool((value < 0).any()):
            raise CheckpointError(f"policy.safetensors is corrupt: '{name}' is negative; {_OTHER}")
    policy.load_state_dict(dict(weights), assign=True)
    return policy.eval().requires_grad_(False)


def _types_and_shapes(tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """Return the type and the shape of each tensor as text, such as `float32 (64, 4)`."""
    return {name: f"{str(t.dtype).removeprefix('torch.')} {tuple(t.shape)}" for name, t in tensors.items()}
