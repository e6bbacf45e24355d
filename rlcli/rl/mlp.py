"""Plain multilayer perceptrons on a CPU, of what the libraries inside torch and numpy do fastest.

The library that torch asks for products, MKL, knows AVX-512 on Intel's processors alone; on AMD's oneDNN is twice as
fast, on Intel's slower. numpy's expm1 and tanh are three and ten times as fast as torch's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from rlcli.rl.environment import processor

_aten = torch.ops.aten
_AVX512 = torch.backends.cpu.get_cpu_capability() == "AVX512"
"""Without it, numpy's expm1 goes number by number."""
_WORTH, _LARGE = 2**20, 64 * 64
"""Multiplications from which on a product of oneDNN's is faster; numbers of its result, where it sums over samples."""


def _onednn() -> Callable[..., Tensor] | None:
    """`x @ weight.T + bias`, where it pays. The operator is one of torch's own: there may come a torch without it."""
    if not _AVX512 or "AMD" not in processor()["model"] or not torch.backends.mkldnn.is_available():
        return None
    operator: Any = getattr(torch.ops.mkldnn, "_linear_pointwise", None)
    return operator and (lambda x, weight, bias=None: operator(x, weight, bias, "none", [], ""))


_linear = _onednn()


def affine(x: Tensor, weight: Tensor, bias: Tensor, out: Tensor | None = None) -> Tensor:
    """What a linear layer gives, in new memory or in `out`. (n, i), (o, i), (o,) -> (n, o)"""
    if _linear is not None and len(x) * weight.numel() >= _WORTH:
        return _linear(x, weight, bias)
    return torch.addmm(bias, x, weight.t(), out=out)


def to_inputs(slope: Tensor, weight: Tensor, out: Tensor) -> Tensor:
    """The slope to a layer's inputs, in new memory or in `out`. (n, o), (o, i) -> (n, i)"""
    if _linear is not None and len(slope) * weight.numel() >= _WORTH:
        return _linear(slope, weight.t())
    return torch.mm(slope, weight, out=out)


def to_weights(inputs: Tensor, slope: Tensor, out: Tensor) -> None:
    """The slope to a layer's weights, transposed. (n, i), (n, o) -> (i, o)"""
    if _linear is not None and out.numel() >= _LARGE and len(inputs) * out.numel() >= _WORTH:
        out.copy_(_linear(inputs.t(), slope.t()))
    else:
        torch.mm(inputs.t(), slope, out=out)


class Activation(NamedTuple):
    """An activation and its slope, in memory that is given."""

    forward: Callable[[Tensor, Tensor], object]
    """From what a layer gave to the other tensor."""
    backward: Callable[[Tensor, Tensor, Tensor], object]
    """A slope, in place, from the result to what the layer gave; that, and the result."""


def _elu(given: Tensor, result: Tensor) -> None:
    if not _AVX512:
        _aten.elu.out(given, out=result)
        return
    torch.clamp(given, max=0.0, out=result)
    np.expm1(result.numpy(), out=result.numpy())
    torch.maximum(given, result, out=result)  # expm1(x) is above x below 0, and 0 at it


FAST_ACTIVATIONS: dict[type[nn.Module], Activation] = {
    nn.ELU: Activation(_elu, lambda s, _, y: _aten.elu_backward.grad_input(s, 1.0, 1.0, 1.0, True, y, grad_input=s)),
    nn.ReLU: Activation(
        lambda x, y: torch.clamp(x, min=0.0, out=y),
        lambda s, _, y: _aten.threshold_backward.grad_input(s, y, 0.0, grad_input=s),
    ),
    nn.Tanh: Activation(
        lambda x, y: np.tanh(x.numpy(), out=y.numpy()),
        lambda s, _, y: _aten.tanh_backward.grad_input(s, y, grad_input=s),
    ),
    nn.SiLU: Activation(
        lambda x, y: _aten.silu.out(x, out=y),
        lambda s, x, _: _aten.silu_backward.grad_input(s, x, grad_input=s),
    ),
}


def is_plain(layers: Iterable[nn.Module]) -> bool:
    """Whether these are linear layers with the same known activation between each two, on a CPU."""
    linears, activations = list(layers)[::2], list(layers)[1::2]
    return (
        all(isinstance(layer, nn.Linear) and layer.bias is not None for layer in linears)
        and all(not layer.weight.is_cuda for layer in linears)
        and len({type(layer) for layer in activations}) == 1
        and all(type(layer) in FAST_ACTIVATIONS and getattr(layer, "alpha", 1.0) == 1.0 for layer in activations)
    )


class Mlp(nn.Sequential):
    """Layers that go the fast way where nobody asks for a gradient, and the usual one where somebody does.

    The fast way calls no hooks of its layers.
    """

    def __init__(self, *layers: Any) -> None:
        super().__init__(*layers)
        self._plain = is_plain(self)

    def forward(self, inputs: Tensor) -> Tensor:
        """(..., d) -> (..., outputs)"""
        usual = inputs.is_cuda or inputs.dtype != torch.float32 or not inputs.numel() or not self._plain
        if usual or torch.is_grad_enabled():
            return super().forward(inputs)
        values = inputs.reshape(-1, inputs.shape[-1])
        for layer in self:
            if isinstance(layer, nn.Linear):
                values = affine(values, layer.weight, layer.bias)
            else:
                given, values = values, torch.empty_like(values)
                FAST_ACTIVATIONS[type(layer)].forward(given, values)
        return values.view(*inputs.shape[:-1], values.shape[-1])
