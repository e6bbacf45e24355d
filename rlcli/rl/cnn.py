"""CNN over the images in an observation; its features replace the columns of the images."""

from __future__ import annotations

import math
from typing import Annotated

import torch
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, model_validator
from torch import Tensor, nn

_Size = Annotated[int, Field(ge=1, le=4096)]


class PictureSpec(BaseModel):
    """Columns of an image in an observation: row by row, channel after channel."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    start: Annotated[int, Field(ge=0, le=2**24)]
    """Its first column."""
    shape: tuple[_Size, _Size, _Size]
    """Channels (with a history, the oldest step first), rows, columns."""
    steps: Annotated[int, Field(ge=1, le=4096)] = 1
    """Number of images whose channels these are: the length of the history."""

    @property
    def stop(self) -> int:
        """The column after the image."""
        return self.start + math.prod(self.shape)


class VisionSpec(BaseModel):
    """Convolutions without padding: the same layers for every image, with separate weights."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    pictures: Annotated[list[PictureSpec], Field(min_length=1, max_length=16)]
    """Images in the order of their columns, which do not overlap."""
    channels: Annotated[list[_Size], Field(min_length=1, max_length=16)]
    """Output channels of each layer."""
    kernels: list[_Size]
    """Edge of each layer's square kernel [pixels]."""
    strides: list[_Size]
    """Stride of each layer [pixels]."""
    motion: PositiveFloat | None = None
    """Older images of a history are replaced by the newest minus them, times this; null: they are kept."""

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
        """The column after the last image."""
        return self.pictures[-1].stop

    def sizes(self, picture: PictureSpec) -> list[tuple[int, int, int]]:
        """Return (channels, rows, columns) of an image before the first layer and after each.

        Raises:
            ValueError: if a kernel is larger than its input.
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
        """Return the number of features of an observation with this number of columns."""
        kept = columns - sum(math.prod(picture.shape) for picture in self.pictures)
        return kept + sum(math.prod(self.sizes(picture)[-1]) for picture in self.pictures)


class Vision(nn.Module):
    """CNN of an observation. Its outputs are the features of all images, then the columns outside of images.

    Args:
        spec: the images and the layers.
        activation: activation after each layer.
        wide: compute in float64 by matrix products, as `WideLinear` does; ONNX runtimes have no float64 convolution.
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
        """Return the features. (n, columns) -> (n, features)"""
        features, rest, end = [], [], 0
        for picture, layers in zip(self.spec.pictures, self.pictures, strict=True):
            pixels = torch.unflatten(obs[:, picture.start : picture.stop], 1, picture.shape)
            if self.spec.motion is not None and picture.steps > 1:
                pixels = motion_channels(pixels, picture.steps, self.spec.motion)
            features.append(layers(pixels).flatten(1))
            rest.append(obs[:, end : picture.start])
            end = picture.stop
        rest.append(obs[:, end:])
        return torch.cat([*features, *(part.to(features[0].dtype) for part in rest if part.shape[1])], dim=1)


def motion_channels(pixels: Tensor, steps: int, factor: float) -> Tensor:
    """Replace all images but the newest by the newest minus them, times `factor`. (n, steps x c, h, w), oldest first"""
    frames = torch.unflatten(pixels, 1, (steps, -1))
    newest = frames[:, -1:]
    return torch.cat([factor * (newest - frames[:, :-1]), newest], dim=1).flatten(1, 2)


class WideConv(nn.Conv2d):
    """Convolution with float32 weights that computes in float64, as a matrix product."""

    def forward(self, x: Tensor) -> Tensor:
        """Return the convolution. (n, c, h, w) -> (n, k, rows, columns) float64"""
        _, channels, height, width = x.shape
        edge, step = self.kernel_size[0], self.stride[0]
        rows, columns = (height - edge) // step + 1, (width - edge) // step + 1
        along = torch.arange(edge, device=x.device)
        channel = torch.arange(channels, device=x.device)
        window = (channel[:, None, None] * height + along[:, None]) * width + along  # of the first position
        down, right = (step * torch.arange(count, device=x.device) for count in (rows, columns))
        first = (down[:, None] * width + right).flatten()
        patches = x.double().flatten(1)[:, first[:, None] + window.flatten()]  # (n, rows * columns, c * edge * edge)
        assert self.bias is not None
        outputs = nn.functional.linear(patches, self.weight.double().flatten(1), self.bias.double())
        return torch.unflatten(outputs.transpose(1, 2), 2, (rows, columns))
