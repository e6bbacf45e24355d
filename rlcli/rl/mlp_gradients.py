"""Gradients of multilayer perceptrons on a CPU in closed form, without autograd.

Autograd computes each operation on a whole minibatch, with threads that synchronise at its end. Here a minibatch is cut
into parts whose intermediate results stay in the cache. One thread computes all operations of one network on a part.
Each part has its own gradient, so the sum does not depend on which thread computed which part.

For a layer y = x W^T + b with the gradient G of its outputs, (n, o):

    dL/dW = G^T x        dL/db = sum of the rows of G        dL/dx = G W
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor, nn

from rlcli.rl.mlp import FAST_ACTIVATIONS, affine, input_gradient, weight_gradient

_ROWS, _WIDE = 8192, 64
"""Most samples of a part whose widest layer has `_WIDE` columns: with more, results leave the cache."""
_PARTS = 2
"""Parts of a large minibatch. With two networks they occupy the default number of threads, four. More parts mean
shorter operations, and a thread waits for Python's lock between two operations."""
OutputGradient = Callable[[slice, Tensor], tuple[Tensor, Tensor]]
"""Function of the rows of a part and of a network's outputs for them, (n, a). It returns the gradient of the loss with
respect to the outputs, (n, a), and numbers that are summed over the parts, (m,)."""


class MlpGradients:
    """Gradients of an actor and a critic on the same samples.

    Args:
        actor: layers of the actor.
        critic: layers of the critic.
        gradients: tensors to write to: gradients of the actor's parameters, layer by layer, then of the critic's.
        rows: number of samples of the largest minibatch.
        threads: number of threads that share the work; torch itself must use one thread meanwhile.
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
        self._max_rows = max(1, _ROWS * _WIDE // max(_WIDE, *(layer.out_features for layer in linears)))
        self._gradients = gradients
        parts = len(self._split(rows))
        # transposed, (inputs, outputs): products with few inputs are several times faster so
        shapes = [parameter.t().shape for layer in linears for parameter in (layer.weight, layer.bias)]
        self._part_gradients = torch.zeros(parts, sum(shape.numel() for shape in shapes))
        self._part_views = [_views(row, shapes) for row in self._part_gradients]
        self._sum = torch.zeros(self._part_gradients.shape[1])
        self._sum_views = _views(self._sum, shapes)
        threads = min(threads, 2 * parts)
        rows = min(rows, self._max_rows)
        self._scratch = [(_Passes(actor, rows), _Passes(critic, rows)) for _ in range(threads)]
        self._pool = (
            ThreadPoolExecutor(threads - 1, initializer=torch.set_num_threads, initargs=(1,)) if threads > 1 else None
        )

    def __call__(
        self, obs: Tensor, critic_obs: Tensor, actor_loss: OutputGradient, critic_loss: OutputGradient
    ) -> tuple[Tensor, Tensor]:
        """Write the gradients of a minibatch; return the summed metrics of both losses. Inputs (n, d), (n, c)"""
        cuts = self._split(len(obs))
        numbers = [[torch.empty(0)] * len(cuts) for _ in range(2)]
        tasks = deque(itertools.product(range(2), enumerate(cuts)))

        def work(mlps: Sequence[_Passes]) -> None:
            while True:
                try:
                    network, (part, rows) = tasks.popleft()
                except IndexError:
                    return
                mlp, inputs = mlps[network], (obs, critic_obs)[network]
                output_gradient = (actor_loss, critic_loss)[network]
                gradient, numbers[network][part] = output_gradient(rows, mlp.forward(inputs[rows]))
                first = mlps[0].parameters if network else 0
                mlp.backward(gradient, self._part_views[part][first : first + mlp.parameters])

        with torch.no_grad():
            others = [self._pool.submit(work, mlps) for mlps in self._scratch[1:]] if self._pool else []
            work(self._scratch[0])
            for other in others:
                other.result()
            torch.sum(self._part_gradients[: len(cuts)], dim=0, out=self._sum)
            for gradient, transposed in zip(self._gradients, self._sum_views, strict=True):
                gradient.copy_(transposed.t())
            actor_numbers, critic_numbers = (torch.stack(values).sum(dim=0) for values in numbers)
            return actor_numbers, critic_numbers

    def _split(self, rows: int) -> list[slice]:
        """Return the rows of each part of a minibatch; the parts are as even as possible."""
        parts = max(1, -(-rows // self._max_rows), min(_PARTS, 2 * rows // self._max_rows))
        ends = [rows * number // parts for number in range(parts + 1)]
        return [slice(start, end) for start, end in itertools.pairwise(ends)]


class _Passes:
    """Forward and backward pass of one network, with preallocated memory."""

    def __init__(self, layers: Iterable[nn.Module], rows: int) -> None:
        linears = [layer for layer in layers if isinstance(layer, nn.Linear)]
        self._weights = [(layer.weight.detach(), layer.bias.detach()) for layer in linears]
        (self._activation,) = {FAST_ACTIVATIONS[type(layer)] for layer in layers if not isinstance(layer, nn.Linear)}
        self._linear_buffers, self._activation_buffers, self._gradient_buffers = (
            [torch.empty(rows, len(bias)) for _, bias in self._weights] for _ in range(3)
        )
        self._inputs: list[Tensor] = []
        self._outputs: list[Tensor] = []
        self.parameters = 2 * len(self._weights)
        """Number of parameters."""

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the outputs in memory that the next call overwrites. (n, d) -> (n, outputs)"""
        self._inputs, rows = [inputs], len(inputs)
        *hidden, last = self._weights
        self._outputs = []
        buffers = zip(hidden, self._linear_buffers[:-1], self._activation_buffers[:-1], strict=True)
        for (weight, bias), linear, activation in buffers:
            self._outputs.append(affine(inputs, weight, bias, out=linear[:rows]))
            inputs = activation[:rows]
            self._activation.forward(self._outputs[-1], inputs)
            self._inputs.append(inputs)
        return affine(inputs, *last, out=self._linear_buffers[-1][:rows])

    def backward(self, gradient: Tensor, gradients: Sequence[Tensor]) -> None:
        """Write the gradients of weights and biases, given the gradient of the outputs. (n, outputs)"""
        for number in reversed(range(len(self._weights))):
            inputs = self._inputs[number]
            weight_gradient(inputs, gradient, gradients[2 * number])
            torch.sum(gradient, dim=0, out=gradients[2 * number + 1])
            if number:
                out = self._gradient_buffers[number - 1][: len(inputs)]
                gradient = input_gradient(gradient, self._weights[number][0], out)
                self._activation.backward(gradient, self._outputs[number - 1], inputs)


def _views(vector: Tensor, shapes: Sequence[torch.Size]) -> list[Tensor]:
    parts = vector.split_with_sizes([shape.numel() for shape in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]
