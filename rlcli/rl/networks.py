"""Actor and critic as they are trained: float32, all their parameters one vector and all gradients another."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from rlcli.rl.mlp import Mlp
from rlcli.rl.optimizers import Adam
from rlcli.rl.policy import ACTIVATIONS, Lstm, Normalizer
from rlcli.rl.ppo_config import NetworkConfig, PpoConfig
from rlcli.rl.vision import Vision, VisionSpec

_POLICY = ("memory.", "vision.", "actor.")
_MIN_STD = 1e-6
_VALUE_CLIP = 5.0
_VALUE_EPS = 1e-5


class ActorCritic(nn.Module):
    """A Gaussian policy with a deviation that no state changes, and a value.

    Args:
        obs_size: what the actor sees.
        critic_obs_size: what the critic sees.
        action_size: columns of the action.
        config: networks, initial weights, parametrisation of the deviation.
        vision: convolutions over the actor's pictures.
        critic_vision: over the critic's, if it sees any.
    """

    def __init__(
        self,
        obs_size: int,
        critic_obs_size: int,
        action_size: int,
        config: PpoConfig,
        vision: VisionSpec | None = None,
        critic_vision: VisionSpec | None = None,
    ) -> None:
        super().__init__()
        cells = [config.rnn.hidden] * config.rnn.layers if config.rnn else []
        self.memory = Lstm(obs_size, cells) if cells else None
        self.vision, obs_size = _eyes(vision, obs_size, config.actor, config.init)
        self.actor = _mlp(cells[-1] if cells else obs_size, config.actor, action_size, config.init, gain=0.01)
        self.teller = nn.Linear(config.actor.hidden[-1], critic_obs_size) if config.tell_coef else None
        if config.std == "log":
            self.log_std = nn.Parameter(torch.full((action_size,), math.log(config.init_std)))
        else:
            self.raw_std = nn.Parameter(torch.full((action_size,), config.init_std))
        self.critic_memory = Lstm(critic_obs_size, cells) if cells else None
        self.critic_vision, critic_obs_size = _eyes(critic_vision, critic_obs_size, config.critic, config.init)
        self.critic = _mlp(cells[-1] if cells else critic_obs_size, config.critic, 1, config.init, gain=1.0)

    @property
    def std(self) -> Tensor:
        """Deviation of each action. (a,)"""
        return self.log_std.exp() if hasattr(self, "log_std") else self.raw_std.clamp(min=_MIN_STD)

    def std_gradient(self, of_log: Tensor) -> Tensor:
        """What changes so with the deviation's logarithm changes so with its parameter. (a,) -> (a,)"""
        return of_log if hasattr(self, "log_std") else of_log / self.std * (self.raw_std >= _MIN_STD)

    def mean(self, obs: Tensor) -> Tensor:
        """The mean action. (n, d) -> (n, a)"""
        return self.actor[-1](self.hidden(obs))

    def hidden(self, obs: Tensor) -> Tensor:
        """The actor's last hidden layer. (n, d) -> (n, h)"""
        return self.actor[:-1](obs if self.vision is None else self.vision(obs))

    def value(self, critic_obs: Tensor) -> Tensor:
        """(..., c) -> (...)"""
        if self.critic_vision is not None:
            *rows, _ = critic_obs.shape
            return self.critic(self.critic_vision(critic_obs.flatten(0, -2))).view(rows)
        return self.critic(critic_obs).squeeze(-1)

    def policy_tensors(self) -> dict[str, Tensor]:
        """Copies of what the policy is made of, by the names that a saved policy has."""
        tensors = {
            name: value.detach().clone() for name, value in self.state_dict().items() if name.startswith(_POLICY)
        }
        log_std = self.log_std if hasattr(self, "log_std") else self.std.log()
        return {**tensors, "log_std": log_std.detach().clone()}

    def load_policy_tensors(self, policy: Mapping[str, Tensor]) -> None:
        """Take what `policy_tensors` gave."""
        weights = self.state_dict()
        weights |= {name: policy[name] for name in weights if name.startswith(_POLICY)}
        self.load_state_dict(weights)
        with torch.no_grad():
            if hasattr(self, "log_std"):
                self.log_std.copy_(policy["log_std"])
            else:
                self.raw_std.copy_(policy["log_std"].exp())


def remembered(memory: Lstm, seen: Tensor, begins: Tensor, before: Tensor) -> tuple[Tensor, list[Tensor]]:
    """What a memory makes of several steps, and its state after each; it is blank where an episode begins.

    (steps, n, d), (steps, n), (n, m) -> (steps, n, cells), (n, m) each
    """
    features, states = [], []
    for obs, begin in zip(seen, begins, strict=True):
        feature, before = memory(obs, before * (1.0 - begin)[:, None])
        features.append(feature)
        states.append(before)
    return torch.stack(features), states


class ValueNormalizer(Normalizer):
    """Running mean and variance of returns; they begin as if one return had been seen, 0 with a variance of 1."""

    def __init__(self) -> None:
        super().__init__(())
        self.count.fill_(1.0)

    def forward(self, value: Tensor) -> Tensor:
        """To what the critic learns."""
        return ((value - self.mean.float()) / self._std).clamp(-_VALUE_CLIP, _VALUE_CLIP)

    def inverse(self, value: Tensor) -> Tensor:
        """From what the critic gives."""
        return value.clamp(-_VALUE_CLIP, _VALUE_CLIP) * self._std + self.mean.float()

    @property
    def _std(self) -> Tensor:
        return (self.var.float() + _VALUE_EPS).sqrt()


def flatten(module: nn.Module) -> tuple[nn.Parameter, Tensor, dict[str, slice]]:
    """Make a module's parameters views of one vector, that has a gradient of its own.

    Returns:
        The vector, its gradient with room for one more number behind it, and where each parameter lies.
    """
    parameters = dict(module.named_parameters())
    vector = nn.Parameter(torch.cat([value.detach().flatten() for value in parameters.values()]))
    gradient = torch.zeros(len(vector) + 1, device=vector.device)
    vector.grad = gradient[:-1]
    places, start = {}, 0
    for name, parameter in parameters.items():
        place = slice(start, start + parameter.numel())
        parameter.data = vector.data[place].view_as(parameter)
        places[name], start = place, place.stop
    return vector, gradient, places


def adam(vector: nn.Parameter, learning_rate: Tensor, eps: float) -> Adam:
    """Adam with its state in place, so that a captured step finds it and nothing is made while capturing."""
    on_gpu = vector.is_cuda
    optimizer = Adam([vector], lr=learning_rate, eps=eps, fused=True, capturable=on_gpu)
    optimizer.step()  # of a gradient of zero: it moves nothing
    optimizer.state[vector]["step"].zero_()
    return optimizer


def _mlp(inputs: int, config: NetworkConfig, outputs: int, init: str, gain: float) -> Mlp:
    layers: list[nn.Module] = []
    for width in config.hidden:
        layers += [_linear(inputs, width, init, math.sqrt(2.0)), _activation(config.activation)]
        inputs = width
    return Mlp(*layers, _linear(inputs, outputs, init, gain))


def _eyes(spec: VisionSpec | None, columns: int, config: NetworkConfig, init: str) -> tuple[Vision | None, int]:
    """Convolutions, if there is something to see, and how many columns the network behind them gets."""
    if spec is None:
        return None, columns
    vision = Vision(spec, ACTIVATIONS[config.activation])
    for layer in vision.modules():
        if isinstance(layer, nn.Conv2d):
            _begin(layer, init, math.sqrt(2.0))
    return vision, spec.features(columns)


def _activation(name: str) -> nn.Module:
    """In place where the gradient can be had from the result: nothing reads a linear layer's output otherwise."""
    return ACTIVATIONS[name](inplace=True) if name in ("elu", "relu") else ACTIVATIONS[name]()


def _linear(inputs: int, outputs: int, init: str, gain: float) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    _begin(layer, init, gain)
    return layer


def _begin(layer: nn.Linear | nn.Conv2d, init: str, gain: float) -> None:
    """Initial weights, where they are not torch's."""
    if init == "orthogonal":
        nn.init.orthogonal_(layer.weight, gain)
    if init != "default":
        assert layer.bias is not None
        nn.init.zeros_(layer.bias)
