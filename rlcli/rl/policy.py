"""The policy as it is saved, played and exported: raw observation in, exactly what `env.step` takes out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor, nn

from rlcli.errors import CheckpointError

_ACTIVATIONS: dict[str, type[nn.Module]] = {"elu": nn.ELU, "relu": nn.ReLU, "tanh": nn.Tanh, "silu": nn.SiLU}


class PolicySpec(BaseModel):
    """What, besides the weights, a policy is made of."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    kind: Literal["gaussian-mlp"] = "gaussian-mlp"
    group: str = "policy"
    observation_size: int = Field(ge=1)
    action_size: int = Field(ge=1)
    hidden: list[Annotated[int, Field(ge=1)]]
    activation: Literal["elu", "relu", "tanh", "silu"]
    action_bound: float | None


class Policy(nn.Module):
    """A multilayer perceptron whose output is the mean of a Gaussian with a state-independent deviation.

    Args:
        spec: its shape.
    """

    def __init__(self, spec: PolicySpec) -> None:
        super().__init__()
        self.spec = spec
        self.actor = mlp(spec.observation_size, spec.hidden, spec.action_size, spec.activation)
        self.log_std = nn.Parameter(torch.zeros(spec.action_size))

    def forward(self, obs: Tensor) -> Tensor:
        """The deterministic action. (n, observation_size) -> (n, action_size)"""
        return self._bounded(self.actor(obs))

    def sample(self, obs: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """A stochastic action, as in training. (n, observation_size) -> (n, action_size)"""
        mean = self.actor(obs)
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        return self._bounded(mean + self.log_std.exp() * noise)

    def _bounded(self, action: Tensor) -> Tensor:
        bound = self.spec.action_bound
        return action if bound is None else action.clamp(-bound, bound)


def mlp(inputs: int, hidden: list[int], outputs: int, activation: str) -> nn.Sequential:
    """Linear layers with activations between them."""
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), _ACTIVATIONS[activation]()]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


def load_policy(spec: Mapping[str, object], weights: Mapping[str, Tensor]) -> Policy:
    """A policy from a checkpoint's `policy.json` and `policy.safetensors`, ready to act.

    Raises:
        CheckpointError: if they do not fit each other, or a weight is not finite.
    """
    try:
        with torch.device("meta"):  # shapes first: a file must not make this allocate what it does not hold
            policy = Policy(PolicySpec.model_validate(spec))
    except ValidationError as error:
        raise CheckpointError(f"policy.json does not describe a policy: {' '.join(str(error).split())}") from None
    expected = {name: tuple(value.shape) for name, value in policy.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in weights.items()}
    if expected != found:
        differs = sorted(name for name in {*expected, *found} if expected.get(name) != found.get(name))
        raise CheckpointError(
            "policy.safetensors does not fit policy.json: "
            + ", ".join(f"{n} is {found.get(n, 'missing')}, expected {expected.get(n, 'nothing')}" for n in differs[:4])
        )
    for name, value in weights.items():
        if value.dtype != torch.float32:
            raise CheckpointError(f"policy.safetensors: '{name}' is {value.dtype}, expected torch.float32")
        if not bool(value.isfinite().all()):
            raise CheckpointError(f"policy.safetensors: '{name}' holds values that are not finite")
    policy.load_state_dict(dict(weights), assign=True)
    return policy.eval().requires_grad_(False)
