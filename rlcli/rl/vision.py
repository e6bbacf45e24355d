"""What a network sees of pictures: convolutions over the columns that hold them, in place of the columns."""

from __future__ import annotations

import math
from typing import Annotated

import torch
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, model_validator
from torch import Tensor, nn

_Size = Annotated[int, Field(ge=1, le=4096)]


class PictureSpec(BaseModel):
    """Where a picture lies in an observation: its columns, row by row, channel after channel."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    start: Annotated[int, Field(ge=0, le=2**24)]
    """Its first column."""
    shape: tuple[_Size, _Size, _Size]
    """Channels (with a history those of the oldest step first), rows, columns."""
    steps: Annotated[int, Field(ge=1, le=4096)] = 1
    """Of a history: its channels are those of so many pictures."""

    @property
    def stop(self) -> int:
        """The column behind its last."""
        return self.start + math.prod(self.shape)


class VisionSpec(BaseModel):
    """Convolutions without padding, the same layers for every picture with weights of its own each."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    pictures: Annotated[list[PictureSpec], Field(min_length=1, max_length=16)]
    """In the order of their columns, which do not overlap."""
    channels: Annotated[list[_Size], Field(min_length=1, max_length=16)]
    """What each layer gives."""
    kernels: list[_Size]
    """Edge of each layer's square window [pixels]."""
    strides: list[_Size]
    """How far each layer's window moves [pixels]."""
    motion: PositiveFloat | None = None
    """The steps of a history before the newest become what has changed since them, times this; null: they stay."""

    @model_validator(mode="after")
    def _fits(self) -> VisionSpec:
        if not len(self.channels) == len(self.kernels) == len(self.strides):
            raise ValueError("channels, kernels and strides have a number for each layer")
        end = 0
        for picture in self.pictures:
            if picture.start < end:
                raise ValueError("pictures overlap, or are not in the order of their columns")
            if picture.shape[0] % picture.steps:
                raise ValueError(f"{picture.shape[0]} channels are not those of {picture.steps} steps")
            end = picture.stop
            self.sizes(picture)
        return self

    @property
    def stop(self) -> int:
        """The column behind the last picture's last."""
        return self.pictures[-1].stop

    def sizes(self, picture: PictureSpec) -> list[tuple[int, int, int]]:
        """(channels, rows, columns) of a picture before the first layer and after each.

        Raises:
            ValueError: if a window is larger than what it moves over.
        """
        sizes: list[tuple[int, int, int]] = [picture.shape]
        for number, (channels, kernel, stride) in enumerate(
            zip(self.channels, self.kernels, self.strides, strict=True)
        ):
            _, rows, columns = sizes[-1]
            if min(rows, columns) < kernel:
                raise ValueError(f"layer {number} has windows of {kernel} x {kernel} for {rows} x {columns} pixels")
            sizes.append((channels, (rows - kernel) // stride + 1, (columns - kernel) // stride + 1))
        return sizes

    def features(self, columns: int) -> int:
        """Columns that are left of an observation with so many."""
        kept = columns - sum(math.prod(picture.shape) for picture in self.pictures)
        return kept + sum(math.prod(self.sizes(picture)[-1]) for picture in self.pictures)


class Vision(nn.Module):
    """Each picture through its convolutions; their results come first, then the columns that are no picture's.

    Args:
        spec: the pictures and the layers.
        activation: after each layer.
        wide: compute in float64 by products of matrices, as `WideLinear` does; runtimes of ONNX have no convolution of
            that kind.
    """

    def __init__(self, spec: VisionSpec, activation: type[nn.Module], *, wide: bool = False) -> None:
        super().__init__()
        kind = WideConv if wide else nn.Conv2d
        self.spec = spec
        self.pictures = nn.ModuleList()
        for picture in spec.pictures:
            layers: list[nn.Module] = []
            sizes = spec.sizes(picture)
            for (inputs, *_), outputs, kernel, stride in zip(
                sizes, spec.channels, spec.kernels, spec.strides, strict=False
            ):
                layers += [kind(inputs, outputs, kernel, stride), activation()]
            self.pictures.append(nn.Sequential(*layers))

    def forward(self, obs: Tensor) -> Tensor:
        """(n, columns) -> (n, features)"""
        found, kept, end = [], [], 0
        for picture, layers in zip(self.spec.pictures, self.pictures, strict=True):
            pixels = obs[:, picture.start : picture.stop].unflatten(1, picture.shape)
            if self.spec.motion is not None and picture.steps > 1:
                pixels = moved(pixels, picture.steps, self.spec.motion)
            found.append(layers(pixels).flatten(1))
            kept.append(obs[:, end : picture.start])
            end = picture.stop
        kept.append(obs[:, end:])
        return torch.cat([*found, *(part.to(found[0].dtype) for part in kept if part.shape[1])], dim=1)


def moved(pixels: Tensor, steps: int, factor: float) -> Tensor:
    """Of each step but the newest, what has changed since. (n, steps x c, h, w), the oldest first, likewise back"""
    frames = pixels.unflatten(1, (steps, -1))
    now = frames[:, -1:]
    return torch.cat([factor * (now - frames[:, :-1]), now], dim=1).flatten(1, 2)


class WideConv(nn.Conv2d):
    """A convolution with float32 weights that computes in float64, as a product of matrices."""

    def forward(self, x: Tensor) -> Tensor:
        """(n, c, h, w) -> (n, k, rows, columns) float64"""
        _, channels, height, width = x.shape
        edge, step = self.kernel_size[0], self.stride[0]
        rows, columns = (height - edge) // step + 1, (width - edge) // step + 1
        along = torch.arange(edge, device=x.device)
        channel = torch.arange(channels, device=x.device)
        window = (channel[:, None, None] * height + along[:, None]) * width + along  # of the first position
        down, right = (step * torch.arange(count, device=x.device) for count in (rows, columns))
        first = (down[:, None] * width + right).flatten()
        seen = x.double().flatten(1)[:, first[:, None] + window.flatten()]  # (n, rows * columns, c * edge * edge)
        assert self.bias is not None
        found = nn.functional.linear(seen, self.weight.double().flatten(1), self.bias.double())
        return found.transpose(1, 2).unflatten(2, (rows, columns))
