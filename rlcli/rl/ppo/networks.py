"""Actor and critic networks of the PPO trainer, in float32, and functions that create and initialise them.

All parameters are in one vector and all gradients in another, so that one operation updates all parameters.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn

from rlcli.envs.environment_protocol import Environment
from rlcli.envs.mirror import ColumnMap
from rlcli.rl.cnn import Cnn, CnnSpec
from rlcli.rl.mlp import Mlp
from rlcli.rl.optimizers import Adam
from rlcli.rl.policy import ACTIVATIONS, Lstm, Normalizer
from rlcli.rl.ppo.config import NetworkConfig, PpoConfig
from rlcli.rl.ppo.setup import cnn_spec

_POLICY = ("memory.", "vision.", "actor.")
"""Prefixes of the weights that belong to the policy."""
_MIN_STD = 1e-6
_VALUE_CLIP = 5.0
_VALUE_EPS = 1e-5
"""Normalised values are clipped to +-5 and 1e-5 is added to their variance, as in rl_games."""


class ActorCritic(nn.Module):
    """Gaussian policy with a state-independent standard deviation, and a value function.

    Args:
        env: the environment, which defines the columns of observations and actions.
        config: configuration of networks, initial weights and standard deviation.
        groups: observation groups of the critic.
        mirror: map from an action to its mirror image; None if the agent does not use the symmetry of the robot.
    """

    mirror_index: Tensor | None
    mirror_sign: Tensor | None

    def __init__(
        self, env: Environment, config: PpoConfig, groups: tuple[str, ...], mirror: ColumnMap | None = None
    ) -> None:
        super().__init__()
        self.register_buffer("mirror_index", None if mirror is None else mirror.index, persistent=False)
        self.register_buffer("mirror_sign", None if mirror is None else mirror.sign, persistent=False)
        layout, self.critic_groups = env.layout, groups
        obs_size, action_size = layout.size("policy"), layout.action_size
        critic_obs_size = sum(layout.size(group) for group in groups)
        vision, critic_vision = cnn_spec(env, config, ("policy",)), cnn_spec(env, config, groups)
        cells = [config.rnn.hidden] * config.rnn.layers if config.rnn else []
        self.memory = Lstm(obs_size, cells) if cells else None
        self.vision, obs_size = _make_cnn(vision, obs_size, config.actor, config.init)
        self.actor = _mlp(cells[-1] if cells else obs_size, config.actor, action_size, config.init, gain=0.01)
        # auxiliary layer of the loss `tell_coef`; no part of the policy
        self.teller = nn.Linear(config.actor.hidden[-1], critic_obs_size) if config.tell_coef else None
        if config.std == "log":
            self.log_std = nn.Parameter(torch.full((action_size,), math.log(config.init_std)))
        else:
            self.raw_std = nn.Parameter(torch.full((action_size,), config.init_std))
        self.critic_memory = Lstm(critic_obs_size, cells) if cells else None
        self.critic_vision, critic_obs_size = _make_cnn(critic_vision, critic_obs_size, config.critic, config.init)
        self.critic = _mlp(cells[-1] if cells else critic_obs_size, config.critic, 1, config.init, gain=1.0)

    @property
    def std(self) -> Tensor:
        """Standard deviation of each action. (a,)"""
        return self.log_std.exp() if hasattr(self, "log_std") else self.raw_std.clamp(min=_MIN_STD)

    def std_gradient(self, log_std_gradient: Tensor) -> Tensor:
        """Return the gradient of the std parameter, given the gradient of the log standard deviation. (a,) -> (a,)"""
        if hasattr(self, "log_std"):
            return log_std_gradient
        return log_std_gradient / self.std * (self.raw_std >= _MIN_STD)  # dlog std/dstd = 1 / std; 0 where clamped

    def mean(self, obs: Tensor) -> Tensor:
        """Return the mean action. (n, d) -> (n, a)"""
        mean: Tensor = self.actor[-1](self.hidden(obs))
        return mean

    def hidden(self, obs: Tensor) -> Tensor:
        """Return the activations of the actor's last hidden layer. (n, d) -> (n, h)"""
        hidden: Tensor = self.actor[:-1](obs if self.vision is None else self.vision(obs))
        return hidden

    def mirror_error(self, mean: Tensor) -> Tensor:
        """Return the mean squared difference between mean actions for mirrored observations and mirrored mean actions.

        The result is a scalar; 0 if the agent does not use the symmetry of the robot.

        Args:
            mean: mean actions for n / 2 observations, then for their mirror images. (n, a)
        """
        if self.mirror_index is None or self.mirror_sign is None:
            return mean.new_zeros(())
        own, image = mean.chunk(2)
        return (image - (own.index_select(1, self.mirror_index) * self.mirror_sign).detach()).square().mean()

    def value(self, critic_obs: Tensor) -> Tensor:
        """Return the critic's value, normalised if the agent normalises values. (..., c) -> (...)"""
        value: Tensor
        if self.critic_vision is not None:
            *rows, _ = critic_obs.shape
            value = self.critic(self.critic_vision(critic_obs.flatten(0, -2))).view(rows)
        else:
            value = self.critic(critic_obs).squeeze(-1)
        return value

    def recurrent_modules(self) -> dict[str, Lstm]:
        """Return the LSTMs, by `actor` and `critic`; an empty dict if the agent has no RNN."""
        modules = {"actor": self.memory, "critic": self.critic_memory}
        return {name: module for name, module in modules.items() if module is not None}

    def policy_tensors(self) -> dict[str, Tensor]:
        """Return the policy's weights, not copied, by their names in a saved policy."""
        tensors = {name: value for name, value in self.state_dict().items() if name.startswith(_POLICY)}
        return {**tensors, "log_std": self.log_std if hasattr(self, "log_std") else self.std.log()}

    def load_policy_tensors(self, policy: Mapping[str, Tensor]) -> None:
        """Load the weights returned by `policy_tensors()`."""
        weights = self.state_dict()
        weights |= {name: policy[name] for name in weights if name.startswith(_POLICY)}
        self.load_state_dict(weights)
        with torch.no_grad():
            if hasattr(self, "log_std"):
                self.log_std.copy_(policy["log_std"])
            else:
                self.raw_std.copy_(policy["log_std"].exp())


def unroll(lstm: Lstm, obs: Tensor, episode_start: Tensor, state: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Run an LSTM over several steps; its hidden state is reset to zero where an episode starts.

    Args:
        lstm: the LSTM.
        obs: inputs. (steps, n, d)
        episode_start: 1 at the first step of an episode. (steps, n)
        state: hidden state before the first step. (n, m)

    Returns:
        The outputs, (steps, n, cells), and the hidden state after each step, (n, m) each.
    """
    outputs, states = [], []
    for step_obs, start in zip(obs, episode_start, strict=True):
        output, state = lstm(step_obs, state * (1.0 - start)[:, None])
        outputs.append(output)
        states.append(state)
    return torch.stack(outputs), states


class ValueNormalizer(Normalizer):
    """Normaliser of discounted returns by their running mean and variance.

    The statistics start from a count of 1 with mean 0 and variance 1, as in rl_games.
    """

    def __init__(self) -> None:
        super().__init__(())
        self.count.fill_(1.0)

    def forward(self, value: Tensor) -> Tensor:
        """Return discounted returns normalised by their running mean and standard deviation, and clipped."""
        return ((value - self.mean.float()) / self._std).clamp(-_VALUE_CLIP, _VALUE_CLIP)

    def inverse(self, value: Tensor) -> Tensor:
        """Return the discounted returns that belong to normalised values: clip the values, then invert `forward`."""
        return value.clamp(-_VALUE_CLIP, _VALUE_CLIP) * self._std + self.mean.float()

    @property
    def _std(self) -> Tensor:
        return (self.var.float() + _VALUE_EPS).sqrt()


def flatten(module: nn.Module) -> tuple[nn.Parameter, Tensor, dict[str, slice]]:
    """Replace a module's parameters by views of one vector.

    Returns:
        The vector, (p,); its gradient followed by one element for the minibatch's KL divergence, (p + 1,), so that one
        call averages both over the ranks; and the slice of each parameter in the vector, by name.
    """
    parameters = dict(module.named_parameters())
    vector = nn.Parameter(torch.cat([value.detach().flatten() for value in parameters.values()]))
    gradient = torch.zeros(len(vector) + 1, device=vector.device)
    vector.grad = gradient[:-1]
    slices, start = {}, 0
    for name, parameter in parameters.items():
        part = slice(start, start + parameter.numel())
        parameter.data = vector.data[part].view_as(parameter)
        slices[name], start = part, part.stop
    return vector, gradient, slices


def adam(vector: nn.Parameter, learning_rate: Tensor, eps: float) -> Adam:
    """Return an Adam optimiser whose state is already allocated: inside a CUDA graph nothing may be allocated."""
    optimizer = Adam([vector], lr=learning_rate, eps=eps, fused=True, capturable=vector.is_cuda)
    optimizer.step()  # the gradient is zero: no parameter changes
    optimizer.state[vector]["step"].zero_()
    return optimizer


def _mlp(inputs: int, config: NetworkConfig, outputs: int, init: str, gain: float) -> Mlp:
    layers: list[nn.Module] = []
    for width in config.hidden:
        layers += [_initialize(nn.Linear(inputs, width), init, math.sqrt(2.0)), _activation(config.activation)]
        inputs = width
    return Mlp(*layers, _initialize(nn.Linear(inputs, outputs), init, gain))


def _make_cnn(spec: CnnSpec | None, columns: int, config: NetworkConfig, init: str) -> tuple[Cnn | None, int]:
    """Return the CNN and the number of columns that the MLP behind the CNN reads; without images None and `columns`."""
    if spec is None:
        return None, columns
    vision = Cnn(spec, ACTIVATIONS[config.activation])
    for layer in vision.modules():
        if isinstance(layer, nn.Conv2d):
            _initialize(layer, init, math.sqrt(2.0))
    return vision, spec.features(columns)


def _activation(name: str) -> nn.Module:
    """Return the activation of a name; it works in place if its gradient can be computed from its output."""
    return ACTIVATIONS[name](inplace=True) if name in ("elu", "relu") else ACTIVATIONS[name]()


def _initialize(layer: nn.Linear | nn.Conv2d, init: str, gain: float) -> nn.Module:
    """Set the initial weights of a layer by the setting `init` (`PpoConfig.init`); return the layer.

    `gain` is the gain of orthogonal weights.
    """
    if init == "orthogonal":
        nn.init.orthogonal_(layer.weight, gain)
    if init != "default":
        assert layer.bias is not None
        nn.init.zeros_(layer.bias)
    return layer
