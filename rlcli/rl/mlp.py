"""Multilayer perceptrons on a CPU, with the fastest operations of MKL, oneDNN and numpy.

torch uses MKL for matrix products. MKL uses AVX-512 only on Intel processors: on AMD processors oneDNN is twice as fast
as MKL, on Intel processors it is slower. numpy's expm1 is three times as fast as torch's, and numpy's tanh ten times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from rlcli.machine.processor import has_onednn, processor

_aten = torch.ops.aten
_AVX512 = torch.backends.cpu.get_cpu_capability() == "AVX512"
"""Whether the processor has AVX-512; without it numpy's expm1 is not vectorised, and oneDNN is not used."""
_WORTH, _LARGE = 2**20, 64 * 64
"""`_WORTH`: number of multiplications from which oneDNN's matrix product is faster than MKL's. `_LARGE`: number of
elements that the gradient of a layer's weights must have as well."""


_ROWS, _WIDE = 8192, 64
"""Samples are computed in parts of at most `_ROWS` rows if the widest layer has `_WIDE` outputs, and fewer rows for
wider layers: with more rows, intermediate results do not fit into the cache."""
_pools: list[ThreadPoolExecutor] = []
"""List with the thread pool that `use_threads` has created; empty if one thread is used."""


def use_threads(count: int) -> None:
    """Set the number of threads in which `Mlp` computes its outputs; torch's own number of threads must be 1."""
    for pool in _pools:
        pool.shutdown()
    new = ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(1,)) if count > 1 else None
    _pools[:] = [new] if new else []


def part_rows(layers: Iterable[nn.Module]) -> int:
    """Return the number of samples (rows) whose intermediate results in these layers just fit into the CPU's cache."""
    widths = [layer.out_features for layer in layers if isinstance(layer, nn.Linear)]
    return max(1, _ROWS * _WIDE // max(_WIDE, *widths))


def _onednn() -> Callable[..., Tensor] | None:
    """Return oneDNN's operator for `x @ weight.T + bias`; None if it is slower here, or if torch lacks it.

    The operator is private, so a later torch may not have it.
    """
    if not _AVX512 or "AMD" not in processor()["model"] or not has_onednn():
        return None
    operator: Any = getattr(torch.ops.mkldnn, "_linear_pointwise", None)
    return operator and (lambda x, weight, bias=None: operator(x, weight, bias, "none", [], ""))


_linear = _onednn()


def affine(x: Tensor, weight: Tensor, bias: Tensor, out: Tensor | None = None) -> Tensor:
    """Return `x @ weight.T + bias`, in `out` or in new memory. (n, i), (o, i), (o,) -> (n, o)"""
    if _linear is not None and len(x) * weight.numel() >= _WORTH:
        return _linear(x, weight, bias)
    return torch.addmm(bias, x, weight.t(), out=out)


def input_gradient(gradient: Tensor, weight: Tensor, out: Tensor) -> Tensor:
    """Return the gradient of the loss with respect to a linear layer's inputs, in `out` or in new memory.

    (n, o), (o, i) -> (n, i). `gradient` is the gradient with respect to the layer's outputs.
    """
    if _linear is not None and len(gradient) * weight.numel() >= _WORTH:
        return _linear(gradient, weight.t())
    return torch.mm(gradient, weight, out=out)


def weight_gradient(inputs: Tensor, gradient: Tensor, out: Tensor) -> None:
    """Write the gradient of the loss with respect to a linear layer's weights, transposed, to `out`.

    (n, i), (n, o) -> (i, o). `gradient` is the gradient with respect to the layer's outputs.
    """
    if _linear is not None and out.numel() >= _LARGE and len(inputs) * out.numel() >= _WORTH:
        out.copy_(_linear(inputs.t(), gradient.t()))
    else:
        torch.mm(inputs.t(), gradient, out=out)


class Activation(NamedTuple):
    """Activation and its gradient on preallocated tensors."""

    forward: Callable[[Tensor, Tensor], object]
    """forward(inputs, out) writes the activations of the inputs to `out`."""
    backward: Callable[[Tensor, Tensor, Tensor], object]
    """backward(gradient, inputs, outputs) replaces the gradient of the outputs by the gradient of the inputs."""


def _elu(inputs: Tensor, out: Tensor) -> None:
    if not _AVX512:
        _aten.elu.out(inputs, out=out)
        return
    torch.clamp(inputs, max=0.0, out=out)
    np.expm1(out.numpy(), out=out.numpy())
    torch.maximum(inputs, out, out=out)  # expm1(x) > x for x < 0; for x >= 0 `out` is 0 before


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
    """Return whether the layers are linear layers with biases on a CPU, with one of `FAST_ACTIVATIONS` between them."""
    linears, activations = list(layers)[::2], list(layers)[1::2]
    return (
        all(isinstance(layer, nn.Linear) and layer.bias is not None for layer in linears)
        and all(not layer.weight.is_cuda for layer in linears)
        and len({type(layer) for layer in activations}) == 1
        and all(type(layer) in FAST_ACTIVATIONS and getattr(layer, "alpha", 1.0) == 1.0 for layer in activations)
    )


class Mlp(nn.Sequential):
    """Multilayer perceptron that uses the fast operations of this module while autograd is off.

    While autograd is on, torch's operations are used. The fast operations call no hooks of the layers. The samples are
    split into parts, whose hidden layers the threads of `use_threads` compute. The parts do not depend on the number of
    threads. The last layer is computed for all samples at once: the rounding of a product with one column depends on
    the number of its rows.
    """

    def __init__(self, *layers: Any) -> None:
        super().__init__(*layers)
        self._plain = is_plain(self)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the outputs. (..., d) -> (..., outputs)"""
        slow_path = inputs.is_cuda or inputs.dtype != torch.float32 or not inputs.numel() or not self._plain
        if slow_path or torch.is_grad_enabled():
            outputs: Tensor = super().forward(inputs)  # type: ignore[no-untyped-call]  # torch has no type here
            return outputs
        values = inputs.reshape(-1, inputs.shape[-1])
        linears = [layer for layer in self if isinstance(layer, nn.Linear)]
        activations = [FAST_ACTIVATIONS[type(layer)] for layer in self if not isinstance(layer, nn.Linear)]
        if activations:
            values = _hidden(values, linears[: len(activations)], activations)
        if len(linears) > len(activations):
            values = affine(values, linears[-1].weight, linears[-1].bias)
        return values.view(*inputs.shape[:-1], values.shape[-1])


def _hidden(inputs: Tensor, linears: list[nn.Linear], activations: list[Activation]) -> Tensor:
    """Return the outputs of the hidden layers, each followed by its activation. (n, d) -> (n, h)"""
    outputs = torch.empty(len(inputs), linears[-1].out_features)
    # if the number of rows is a multiple of 512, a row's bits do not depend on the part it is in
    rows = max(512, part_rows(linears) // 512 * 512)
    starts = [rows * number for number in range(max(1, len(inputs) // rows))]
    ends = [*starts[1:], len(inputs)]
    inference = torch.is_inference_mode_enabled()  # a setting of each thread

    def compute(start: int, end: int) -> None:
        with torch.inference_mode(inference), torch.no_grad():
            values = inputs[start:end]
            for linear, activation in zip(linears, activations, strict=True):
                values = affine(values, linear.weight, linear.bias)
                out = outputs[start:end] if linear is linears[-1] else torch.empty_like(values)
                activation.forward(values, out)
                values = out

    if _pools and len(starts) > 1:
        list(_pools[0].map(compute, starts, ends))
    else:
        for start, end in zip(starts, ends, strict=True):
            compute(start, end)
    return outputs
