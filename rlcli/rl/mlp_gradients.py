"""Gradients of plain multilayer perceptrons on a CPU, written out instead of recorded by autograd.

Autograd takes each operation through a whole minibatch, with threads that wait for each other at its end. Here a
minibatch is cut into parts whose intermediate results stay in the cache, and a thread takes a part through all
operations. Each part has a gradient of its own, so that their sum does not depend on which thread took which.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

_aten = torch.ops.aten
_ROWS, _WIDE = 4096, 64
"""Samples of a part at most, if no layer is wider than the other number: beyond, results leave the cache."""
_PARTS = 4
"""Parts of a minibatch that is large enough for them: work for as many threads as there are by default."""
_VECTOR_EXPM1 = torch.backends.cpu.get_cpu_capability() == "AVX512"
"""Whether numpy's expm1 is three times as fast as torch's ELU; elsewhere it goes number by number."""

Slopes = Callable[[slice, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]
"""Rows of a minibatch, the actor's and the critic's outputs for them, (n, a) and (n, 1) -> how what is minimised
changes with each of these, in the same shapes, and numbers that are summed over the parts. (m,)"""


def is_plain(layers: Iterable[nn.Module]) -> bool:
    """Whether these are linear layers with the same known activation between each two, on a CPU."""
    linears, activations = list(layers)[::2], list(layers)[1::2]
    return (
        all(isinstance(layer, nn.Linear) and layer.bias is not None for layer in linears)
        and all(not layer.weight.is_cuda for layer in linears)
        and len({type(layer) for layer in activations}) == 1
        and all(type(layer) in _ACTIVATIONS and getattr(layer, "alpha", 1.0) == 1.0 for layer in activations)
    )


class MlpGradients:
    """Gradients of an actor and a critic on the same samples.

    Args:
        actor: its layers.
        critic: its layers.
        gradients: where those of the actor's parameters go, layer by layer, then those of the critic's.
        rows: samples of the largest minibatch.
        threads: how many share the work. Each computes on its own, so torch is to be on one thread meanwhile.
    """

    def __init__(
        self,
        actor: Iterable[nn.Module],
        critic: Iterable[nn.Module],
        gradients: Sequence[Tensor],
        rows: int,
        threads: int,
    ) -> None:
        linears = [layer for layer in (*actor, *critic) if isinstance(layer, nn.Linear)]
        self._most = max(1, _ROWS * _WIDE // max(_WIDE, *(layer.out_features for layer in linears)))
        self._gradients = gradients
        parts = len(self._cut(rows))
        # transposed, (inputs, outputs): products with few inputs are several times faster so
        shapes = [parameter.t().shape for layer in linears for parameter in (layer.weight, layer.bias)]
        self._own = torch.zeros(parts, sum(shape.numel() for shape in shapes))
        self._places = [_views(row, shapes) for row in self._own]
        self._sum = torch.zeros(self._own.shape[1])
        self._sums = _views(self._sum, shapes)
        threads = min(threads, parts)
        self._scratch = [
            (_Mlp(actor, min(rows, self._most)), _Mlp(critic, min(rows, self._most))) for _ in range(threads)
        ]
        self._pool = (
            ThreadPoolExecutor(threads - 1, initializer=torch.set_num_threads, initargs=(1,)) if threads > 1 else None
        )

    def __call__(self, obs: Tensor, critic_obs: Tensor, slopes: Slopes) -> Tensor:
        """Write the gradients of a minibatch. (n, d), (n, c) -> the sum of the numbers that `slopes` gave (m,)"""
        cuts = self._cut(len(obs))
        left, numbers = deque(enumerate(cuts)), [torch.empty(0)] * len(cuts)

        def work(actor: _Mlp, critic: _Mlp) -> None:
            while True:
                try:
                    part, rows = left.popleft()
                except IndexError:
                    return
                outputs = actor.forward(obs[rows]), critic.forward(critic_obs[rows])
                of_actor, of_critic, numbers[part] = slopes(rows, *outputs)
                actor.backward(of_actor, self._places[part][: actor.parameters])
                critic.backward(of_critic, self._places[part][actor.parameters :])

        with torch.no_grad():
            others = [self._pool.submit(work, *scratch) for scratch in self._scratch[1:]] if self._pool else []
            work(*self._scratch[0])
            for other in others:
                other.result()
            torch.sum(self._own[: len(cuts)], dim=0, out=self._sum)
            for gradient, transposed in zip(self._gradients, self._sums, strict=True):
                gradient.copy_(transposed.t())
            return torch.stack(numbers).sum(dim=0)

    def _cut(self, rows: int) -> list[slice]:
        """The parts of a minibatch, as even as they can be."""
        parts = max(1, -(-rows // self._most), min(_PARTS, 2 * rows // self._most))
        ends = [rows * number // parts for number in range(parts + 1)]
        return [slice(start, end) for start, end in itertools.pairwise(ends)]


class _Activation(NamedTuple):
    forward: Callable[[Tensor, Tensor], object]
    """From what a layer gave to the other tensor."""
    backward: Callable[[Tensor, Tensor, Tensor], object]
    """A slope, in place, from the result to what the layer gave; that, and the result."""


class _Mlp:
    """A network that goes forwards and backwards over some samples, in memory of its own."""

    def __init__(self, layers: Iterable[nn.Module], rows: int) -> None:
        linears = [layer for layer in layers if isinstance(layer, nn.Linear)]
        self._weights = [(layer.weight.detach(), layer.bias.detach()) for layer in linears]
        (self._activation,) = {_ACTIVATIONS[type(layer)] for layer in layers if not isinstance(layer, nn.Linear)}
        self._given, self._results, self._slopes = (
            [torch.empty(rows, len(bias)) for _, bias in self._weights] for _ in range(3)
        )
        self._inputs: list[Tensor] = []
        self.parameters = 2 * len(self._weights)
        """How many there are."""

    def forward(self, inputs: Tensor) -> Tensor:
        """(n, d) -> (n, outputs), valid until the next call."""
        self._inputs, rows = [inputs], len(inputs)
        *hidden, last = self._weights
        for (weight, bias), given, result in zip(hidden, self._given, self._results, strict=False):
            torch.addmm(bias, inputs, weight.t(), out=given[:rows])
            inputs = result[:rows]
            self._activation.forward(given[:rows], inputs)
            self._inputs.append(inputs)
        return torch.addmm(last[1], inputs, last[0].t(), out=self._given[-1][:rows])

    def backward(self, slope: Tensor, gradients: Sequence[Tensor]) -> None:
        """From the slope with respect to what `forward` gave, (n, outputs), to the gradients of weights and biases."""
        for number in reversed(range(len(self._weights))):
            inputs = self._inputs[number]
            torch.mm(inputs.t(), slope, out=gradients[2 * number])
            torch.sum(slope, dim=0, out=gradients[2 * number + 1])
            if number:
                slope = torch.mm(slope, self._weights[number][0], out=self._slopes[number - 1][: len(inputs)])
                self._activation.backward(slope, self._given[number - 1][: len(inputs)], inputs)


def _elu(given: Tensor, result: Tensor) -> None:
    if not _VECTOR_EXPM1:
        _aten.elu.out(given, out=result)
        return
    torch.clamp(given, max=0.0, out=result)
    np.expm1(result.numpy(), out=result.numpy())
    torch.maximum(given, result, out=result)  # expm1(x) is above x below 0, and 0 at it


_ACTIVATIONS: dict[type[nn.Module], _Activation] = {
    nn.ELU: _Activation(_elu, lambda s, _, y: _aten.elu_backward.grad_input(s, 1.0, 1.0, 1.0, True, y, grad_input=s)),
    nn.ReLU: _Activation(
        lambda x, y: torch.clamp(x, min=0.0, out=y),
        lambda s, _, y: _aten.threshold_backward.grad_input(s, y, 0.0, grad_input=s),
    ),
    nn.Tanh: _Activation(  # numpy's is five times as fast
        lambda x, y: np.tanh(x.numpy(), out=y.numpy()),
        lambda s, _, y: _aten.tanh_backward.grad_input(s, y, grad_input=s),
    ),
    nn.SiLU: _Activation(
        lambda x, y: _aten.silu.out(x, out=y),
        lambda s, x, _: _aten.silu_backward.grad_input(s, x, grad_input=s),
    ),
}


def _views(vector: Tensor, shapes: Sequence[torch.Size]) -> list[Tensor]:
    parts = vector.split([shape.numel() for shape in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]
