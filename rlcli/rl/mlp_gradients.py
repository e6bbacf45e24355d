"""Gradients of plain multilayer perceptrons on a CPU, written out instead of recorded by autograd.

Autograd takes each operation through a whole minibatch, with threads that wait for each other at its end. Here a
minibatch is cut into parts whose intermediate results stay in the cache, and a thread takes a part through all
operations of one network. Each part has a gradient of its own, so that their sum does not depend on which thread took
which.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor, nn

from rlcli.rl.mlp import FAST_ACTIVATIONS, affine, to_inputs, to_weights

_ROWS, _WIDE = 8192, 64
"""Samples of a part at most, if no layer is wider than the other number: beyond, results leave the cache."""
_PARTS = 2
"""Parts of a minibatch that is large enough for them: with two networks, work for as many threads as there are by
default. Fewer and longer operations are better than that: between any two of them a thread waits for Python's lock."""
Slopes = Callable[[slice, Tensor], tuple[Tensor, Tensor]]
"""Rows of a minibatch, a network's outputs for them, (n, a) -> how what is minimised changes with these, in the same
shape, and numbers that are summed over the parts. (m,)"""


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
        threads = min(threads, 2 * parts)
        self._scratch = [
            (_Passes(actor, min(rows, self._most)), _Passes(critic, min(rows, self._most))) for _ in range(threads)
        ]
        self._pool = (
            ThreadPoolExecutor(threads - 1, initializer=torch.set_num_threads, initargs=(1,)) if threads > 1 else None
        )

    def __call__(self, obs: Tensor, critic_obs: Tensor, of_actor: Slopes, of_critic: Slopes) -> tuple[Tensor, Tensor]:
        """Write the gradients of a minibatch. (n, d), (n, c) -> the sums of the numbers that each `Slopes` gave."""
        cuts = self._cut(len(obs))
        numbers = [[torch.empty(0)] * len(cuts) for _ in range(2)]
        left = deque(itertools.product(range(2), enumerate(cuts)))

        def work(mlps: Sequence[_Passes]) -> None:
            while True:
                try:
                    network, (part, rows) = left.popleft()
                except IndexError:
                    return
                mlp, seen, slopes = mlps[network], (obs, critic_obs)[network], (of_actor, of_critic)[network]
                slope, numbers[network][part] = slopes(rows, mlp.forward(seen[rows]))
                first = mlps[0].parameters if network else 0
                mlp.backward(slope, self._places[part][first : first + mlp.parameters])

        with torch.no_grad():
            others = [self._pool.submit(work, mlps) for mlps in self._scratch[1:]] if self._pool else []
            work(self._scratch[0])
            for other in others:
                other.result()
            torch.sum(self._own[: len(cuts)], dim=0, out=self._sum)
            for gradient, transposed in zip(self._gradients, self._sums, strict=True):
                gradient.copy_(transposed.t())
            one, two = (torch.stack(values).sum(dim=0) for values in numbers)
            return one, two

    def _cut(self, rows: int) -> list[slice]:
        """The parts of a minibatch, as even as they can be."""
        parts = max(1, -(-rows // self._most), min(_PARTS, 2 * rows // self._most))
        ends = [rows * number // parts for number in range(parts + 1)]
        return [slice(start, end) for start, end in itertools.pairwise(ends)]


class _Passes:
    """A network that goes forwards and backwards over some samples, in memory of its own."""

    def __init__(self, layers: Iterable[nn.Module], rows: int) -> None:
        linears = [layer for layer in layers if isinstance(layer, nn.Linear)]
        self._weights = [(layer.weight.detach(), layer.bias.detach()) for layer in linears]
        (self._activation,) = {FAST_ACTIVATIONS[type(layer)] for layer in layers if not isinstance(layer, nn.Linear)}
        self._given, self._results, self._slopes = (
            [torch.empty(rows, len(bias)) for _, bias in self._weights] for _ in range(3)
        )
        self._inputs: list[Tensor] = []
        self._outputs: list[Tensor] = []
        self.parameters = 2 * len(self._weights)
        """How many there are."""

    def forward(self, inputs: Tensor) -> Tensor:
        """(n, d) -> (n, outputs), valid until the next call."""
        self._inputs, rows = [inputs], len(inputs)
        *hidden, last = self._weights
        self._outputs = []
        for (weight, bias), given, result in zip(hidden, self._given, self._results, strict=False):
            self._outputs.append(affine(inputs, weight, bias, out=given[:rows]))
            inputs = result[:rows]
            self._activation.forward(self._outputs[-1], inputs)
            self._inputs.append(inputs)
        return affine(inputs, *last, out=self._given[-1][:rows])

    def backward(self, slope: Tensor, gradients: Sequence[Tensor]) -> None:
        """From the slope with respect to what `forward` gave, (n, outputs), to the gradients of weights and biases."""
        for number in reversed(range(len(self._weights))):
            inputs = self._inputs[number]
            to_weights(inputs, slope, gradients[2 * number])
            torch.sum(slope, dim=0, out=gradients[2 * number + 1])
            if number:
                slope = to_inputs(slope, self._weights[number][0], self._slopes[number - 1][: len(inputs)])
                self._activation.backward(slope, self._outputs[number - 1], inputs)


def _views(vector: Tensor, shapes: Sequence[torch.Size]) -> list[Tensor]:
    parts = vector.split([shape.numel() for shape in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]
