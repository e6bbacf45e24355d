"""Torch module that is exported to all file formats: the policy, and the conversion of its action to commands.

A command is what the actuators receive: the action, scaled, shifted and clipped.
"""

import copy
import math
from collections.abc import Iterable
from typing import Any, Self

import torch
from torch import Tensor, nn

from rlcli.rl.policy import Policy
from rlcli.runs.layout_and_deployment import ActionColumns


class DeployedPolicy(nn.Module):
    """Policy with the input `obs` and the outputs `action` (argument of `env.step`) and `command` (for actuators).

    A recurrent policy also has the inputs `h_in` and `c_in` and the outputs `h_out` and `c_out`: hidden and cell state
    of its layers, (layers, n, cells) float32 each. These states are zeros when an episode begins.
    """

    scale: Tensor
    offset: Tensor
    clip: Tensor | None
    limits: Tensor | None

    def __init__(self, policy: Policy, actions: list[ActionColumns]) -> None:
        super().__init__()
        self.policy = policy
        self.scaled = any(term.scale is not None for term in actions)
        self.register_buffer("scale", _row(term.scale or [1.0] * term.size for term in actions))
        self.register_buffer("offset", _row(term.offset or [0.0] * term.size for term in actions))
        unbounded = [(None, None)]
        for name in ("clip", "limits"):
            pairs = [getattr(term, name) or unbounded * term.size for term in actions]
            bounds = _row([[_infinite_for_none(pair) for pair in term] for term in pairs])
            self.register_buffer(name, bounds.T.contiguous() if bool(bounds.isfinite().any()) else None)

    @property
    def inputs(self) -> list[str]:
        """Names of the inputs, in order."""
        return ["obs"] if self.policy.memory is None else ["obs", "h_in", "c_in"]

    @property
    def outputs(self) -> list[str]:
        """Names of the outputs, in order."""
        return ["action", "command"] if self.policy.memory is None else ["action", "command", "h_out", "c_out"]

    def initial_state(self, rows: int) -> dict[str, Tensor]:
        """Return the inputs `h_in` and `c_in` at the start of an episode; empty for a policy without memory.

        `rows` is the number of rows of the observations.
        """
        cells = self.policy.spec.memory
        return {name: torch.zeros(len(cells), rows, cells[0]) for name in self.inputs[1:]}

    def forward(self, obs: Tensor, h_in: Tensor | None = None, c_in: Tensor | None = None) -> dict[str, Tensor]:
        """Compute action and command, (n, action_size) each, from observations (n, observation_size)."""
        if h_in is None or c_in is None:
            return self.with_command(self.policy(obs))
        # the policy stores its state as columns: h and c of the first layer, then h and c of the next one
        parts = torch.stack([h_in, c_in], dim=1).flatten(0, 1)
        action, hidden = self.policy.step(obs, torch.cat(list(parts.double()), dim=1))
        assert hidden is not None
        after = torch.split(hidden.float(), h_in.shape[2], dim=1)
        return {**self.with_command(action), "h_out": torch.stack(after[::2]), "c_out": torch.stack(after[1::2])}

    def with_command(self, action: Tensor) -> dict[str, Tensor]:
        """Return `action` and `command`: the command is the action, scaled, shifted and clipped by the action terms."""
        command = action * self.scale + self.offset if self.scaled else action.clone()
        for bounds in (self.clip, self.limits):
            if bounds is not None:
                command = torch.minimum(torch.maximum(command, bounds[0]), bounds[1])
        return {"action": action, "command": command}

    def for_onnx(self) -> Self:
        """Return a copy with a formula instead of each ELU module, because ONNX runtimes have ELU for float32 only."""
        graph = copy.deepcopy(self)
        for module in list(graph.modules()):
            for name, child in module.named_children():
                if isinstance(child, nn.ELU):
                    setattr(module, name, _Elu())
        return graph


class _Elu(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return torch.where(x > 0, x, x.clamp(max=0.0).exp() - 1.0)


def _row(terms: Iterable[list[Any]]) -> Tensor:
    return torch.tensor([value for values in terms for value in values], dtype=torch.float32)


def _infinite_for_none(pair: tuple[float | None, float | None] | None) -> tuple[float, float]:
    low, high = pair or (None, None)
    return -math.inf if low is None else low, math.inf if high is None else high
