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
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import torch
from torch import Tensor, nn

from rlcli.rl.mlp import FAST_ACTIVATIONS, affine, input_gradient, part_rows, weight_gradient

_PARTS = 2
"""Smallest number of parts of a large minibatch. Two networks with two parts each occupy the default number of threads,
four. More parts mean shorter operations, and a thread waits for Python's lock between two operations."""
Layers = Iterable[nn.Module]
OutputGradient = Callable[[slice, Tensor], tuple[Tensor, Tensor]]
"""Function `(rows, outputs) -> (gradient, statistics)` for one part of a minibatch.

`rows` is the slice of the part in the minibatch, `outputs` (n, a) are a network's outputs for the part. `gradient`
(n, a) is that of the loss with respect to the outputs. `statistics` is a vector whose sum over all parts is needed
(losses, gradients of the standard deviations, ...): at most 3 + 2 a numbers for the actor, one for the critic.
"""


class PartMemory:
    """Memory for the gradients of all parts of a minibatch, which several threads or processes fill.

    Args:
        actor: layers of the actor.
        critic: layers of the critic.
        rows: number of samples of the largest minibatch.
        tensors: memory to use, such as shared memory, with the names and shapes of the attribute `shapes`; None:
            allocate new memory.
    """

    def __init__(self, actor: Layers, critic: Layers, rows: int, tensors: Mapping[str, Tensor] | None = None) -> None:
        linears = [[layer for layer in layers if isinstance(layer, nn.Linear)] for layers in (actor, critic)]
        self._max_rows = part_rows([*linears[0], *linears[1]])
        # transposed, (inputs, outputs): products with few inputs are several times faster this way
        parameters = [parameter for layer in (*linears[0], *linears[1]) for parameter in (layer.weight, layer.bias)]
        self._shapes = [parameter.t().shape for parameter in parameters]
        self._ends = (0, 2 * len(linears[0]), len(parameters))
        sizes = sum(shape.numel() for shape in self._shapes)
        self._parts, self._columns = len(self.split(rows)), 3 + 2 * linears[0][-1].out_features
        self.rows = min(rows, self._max_rows)
        """Number of samples of the largest part."""
        self.shapes = {"gradients": (self._parts, sizes), "numbers": (2, self._parts, self._columns)}
        tensors = tensors or {name: torch.zeros(shape) for name, shape in self.shapes.items()}
        self._gradients, self.numbers = tensors["gradients"], tensors["numbers"]
        """`numbers`: the statistics of each network and part, see `OutputGradient`. (2, parts, columns)"""
        self._views = [_views(row, self._shapes) for row in self._gradients]
        self._sum = torch.zeros(sizes)
        self._sum_views = _views(self._sum, self._shapes)

    def split(self, rows: int) -> list[slice]:
        """Split a minibatch of `rows` samples into parts of nearly equal size; return the rows of each part."""
        parts = max(1, -(-rows // self._max_rows), min(_PARTS, 2 * rows // self._max_rows))
        ends = [rows * number // parts for number in range(parts + 1)]
        return [slice(start, end) for start, end in itertools.pairwise(ends)]

    def tasks(self, rows: int) -> list[tuple[int, int, slice]]:
        """Return the units of work for a minibatch of `rows` samples, which threads or processes share.

        A unit is (network, part, rows of the part): network 0 is the actor, 1 the critic; `part` is the part's index.
        """
        return [(network, part, part_of) for network in range(2) for part, part_of in enumerate(self.split(rows))]

    def gradients_of(self, network: int, part: int) -> list[Tensor]:
        """Return the tensors for the gradients of one network (0: actor, 1: critic) on one part of the minibatch.

        The tensors alternate between weights, transposed (inputs, outputs), and biases (outputs,), layer by layer.
        """
        return self._views[part][self._ends[network] : self._ends[network + 1]]

    def sum_parts(self, rows: int, out: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Add up the results of all parts of a minibatch of `rows` samples, and write its gradients to `out`.

        Return the sums of the statistics that `OutputGradient` computes: of the actor (columns,), and of the critic ().
        """
        parts = len(self.split(rows))
        torch.sum(self._gradients[:parts], dim=0, out=self._sum)
        for gradient, transposed in zip(out, self._sum_views, strict=True):
            gradient.copy_(transposed.t())
        return self.numbers[0, :parts].sum(dim=0), self.numbers[1, :parts, 0].contiguous().sum()


class PartGradients:
    """Gradients of single parts of a minibatch, computed by one thread.

    Args:
        actor: layers of the actor.
        critic: layers of the critic.
        memory: memory for the results.
    """

    def __init__(self, actor: Layers, critic: Layers, memory: PartMemory) -> None:
        self._memory, self._passes = memory, (_Passes(actor, memory.rows), _Passes(critic, memory.rows))

    def compute(
        self, task: tuple[int, int, slice], inputs: Sequence[Tensor], output_gradients: Sequence[OutputGradient]
    ) -> None:
        """Write the gradients and statistics of one unit of work to the memory.

        Args:
            task: one of `PartMemory.tasks`.
            inputs: observations of the actor, and of the critic, for the whole minibatch. (n, d), (n, c)
            output_gradients: `OutputGradient` of the actor, and of the critic.
        """
        network, part, rows = task
        mlp = self._passes[network]
        gradient, numbers = output_gradients[network](rows, mlp.forward(inputs[network][rows]))
        self._memory.numbers[network, part, : numbers.numel()] = numbers
        mlp.backward(gradient, self._memory.gradients_of(network, part))


class MlpGradients:
    """Gradients of an actor and a critic on the same samples, computed by several threads.

    Args:
        actor: layers of the actor.
        critic: layers of the critic.
        gradients: tensors to write to: gradients of the actor's parameters, layer by layer, then of the critic's.
        rows: number of samples of the largest minibatch.
        threads: number of threads that share the work; torch itself must use one thread meanwhile.
    """

    def __init__(self, actor: Layers, critic: Layers, gradients: Sequence[Tensor], rows: int, threads: int) -> None:
        self._gradients, self._memory = gradients, PartMemory(actor, critic, rows)
        threads = min(threads, len(self._memory.tasks(rows)))
        self._threads = [PartGradients(actor, critic, self._memory) for _ in range(threads)]
        self._pool = (
            ThreadPoolExecutor(threads - 1, initializer=torch.set_num_threads, initargs=(1,)) if threads > 1 else None
        )

    def __call__(
        self, obs: Tensor, critic_obs: Tensor, actor_gradient: OutputGradient, critic_gradient: OutputGradient
    ) -> tuple[Tensor, Tensor]:
        """Write the gradients of a minibatch to `gradients`; return the statistics, summed over all samples.

        Args:
            obs: inputs of the actor. (n, d)
            critic_obs: inputs of the critic. (n, c)
            actor_gradient: function that computes the gradient of the loss with respect to the actor's outputs, and
                statistics.
            critic_gradient: the same for the critic.

        Returns:
            The statistics of the actor, (columns,), and of the critic, ().
        """
        tasks = deque(self._memory.tasks(len(obs)))

        def work(thread: PartGradients) -> None:
            while True:
                try:
                    task = tasks.popleft()
                except IndexError:
                    return
                thread.compute(task, (obs, critic_obs), (actor_gradient, critic_gradient))

        with torch.no_grad():
            others = [self._pool.submit(work, thread) for thread in self._threads[1:]] if self._pool else []
            work(self._threads[0])
            for other in others:
                other.result()
            return self._memory.sum_parts(len(obs), self._gradients)


class _Passes:
    """Forward and backward pass of one network, with preallocated memory."""

    def __init__(self, layers: Layers, rows: int) -> None:
        linears = [layer for layer in layers if isinstance(layer, nn.Linear)]
        self._weights = [(layer.weight.detach(), layer.bias.detach()) for layer in linears]
        (self._activation,) = {FAST_ACTIVATIONS[type(layer)] for layer in layers if not isinstance(layer, nn.Linear)}
        self._linear_buffers, self._activation_buffers, self._gradient_buffers = (
            [torch.empty(rows, len(bias)) for _, bias in self._weights] for _ in range(3)
        )
        self._inputs: list[Tensor] = []
        self._outputs: list[Tensor] = []

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the outputs of the network, in memory that the next call overwrites. (n, d) -> (n, outputs)"""
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
        """Write the gradients of weights and biases for the samples of the last `forward` to `gradients`.

        `gradient` is the gradient of the loss with respect to the outputs. (n, outputs)
        """
        for number in reversed(range(len(self._weights))):
            inputs = self._inputs[number]
            weight_gradient(inputs, gradient, gradients[2 * number])
            torch.sum(gradient, dim=0, out=gradients[2 * number + 1])
            if number:
                out = self._gradient_buffers[number - 1][: len(inputs)]
                gradient = input_gradient(gradient, self._weights[number][0], out)
                self._activation.backward(gradient, self._outputs[number - 1], inputs)


def _views(vector: Tensor, shapes: Sequence[torch.Size]) -> list[Tensor]:
    """Split a vector into consecutive parts, and return them as views of the given shapes."""
    parts = vector.split_with_sizes([shape.numel() for shape in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]
