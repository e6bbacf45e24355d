"""What every exported file computes: the policy and, behind it, what the action terms make of its action."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

from rlcli.rl.policy import Policy
from rlcli.runs.checkpoint_manifest import ActionColumns


class Deployed(nn.Module):
    """Of a policy without a memory: `obs` in, `action` and `command` out.

    With one, `h_in` and `c_in` besides and `h_out` and `c_out` besides: output and cell state of its layers, zeros
    when an episode begins, (layers, n, cells) float32 each.
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
        free = [(None, None)]
        clip = [[_finite(pair) for pair in term.clip or free * term.size] for term in actions]
        limits = [[_finite(pair) for pair in term.limits or free * term.size] for term in actions]
        for name, pairs in (("clip", clip), ("limits", limits)):
            bounds = _row(pairs)
            self.register_buffer(name, bounds.T.contiguous() if bool(bounds.isfinite().any()) else None)

    @property
    def inputs(self) -> list[str]:
        """Names of what goes in, in order."""
        return ["obs"] if self.policy.memory is None else ["obs", "h_in", "c_in"]

    @property
    def outputs(self) -> list[str]:
        """Names of what comes out, in order."""
        return ["action", "command"] if self.policy.memory is None else ["action", "command", "h_out", "c_out"]

    def start(self, rows: int) -> dict[str, Tensor]:
        """The memory of episodes that begin, as inputs; empty without one."""
        cells = self.policy.spec.memory
        blank = torch.zeros(len(cells), rows, cells[0]) if cells else None
        return {} if blank is None else {"h_in": blank, "c_in": blank.clone()}

    def forward(self, obs: Tensor, h_in: Tensor | None = None, c_in: Tensor | None = None) -> dict[str, Tensor]:
        """(n, observation_size) -> action and command, (n, action_size) each"""
        if h_in is None or c_in is None:
            return self.commanded(self.policy(obs))
        parts = torch.stack([h_in, c_in], dim=1).flatten(0, 1)  # of each layer output, then cell state
        action, memory = self.policy.step(obs, torch.cat(list(parts.double()), dim=1))
        assert memory is not None
        after = torch.split(memory.float(), h_in.shape[2], dim=1)
        return {**self.commanded(action), "h_out": torch.stack(after[::2]), "c_out": torch.stack(after[1::2])}

    def commanded(self, action: Tensor) -> dict[str, Tensor]:
        """An action, and what becomes of it. (n, action_size)"""
        command = action * self.scale + self.offset if self.scaled else action.clone()
        for bounds in (self.clip, self.limits):
            if bounds is not None:
                command = torch.minimum(torch.maximum(command, bounds[0]), bounds[1])
        return {"action": action, "command": command}

    def plain(self) -> Deployed:
        """The same without what runtimes of ONNX have in float32 only."""
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


def _finite(pair: tuple[float | None, float | None] | None) -> tuple[float, float]:
    low, high = pair or (None, None)
    return -math.inf if low is None else low, math.inf if high is None else high
