"""Convolutional neural network over the images of an observation, for actor, critic and saved policies.

The features of the network replace the columns of the images; other columns of the observation stay as they are.
"""

from __future__ import annotations

import math
from typing import Annotated

import torch
from pydantic import BaseModel, ConfigDict, Field, model_validator
from torch import Tensor, nn

from rlcli.config.schema import Positive

_Size = Annotated[int, Field(ge=1, le=4096)]


class ImageSpec(BaseModel):
    """Place of an image in an observation vector: its first column and its shape.

    The pixels of the image are consecutive columns, in the order (channels, rows, columns).
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    start: Annotated[int, Field(ge=0, le=2**24)]
    """First column of the image."""
    shape: tuple[_Size, _Size, _Size]
    """Channels (with a history, the oldest step first), rows, columns."""
    steps: Annotated[int, Field(ge=1, le=4096)] = 1
    """Length of the history: number of images that the channels consist of."""

    @property
    def stop(self) -> int:
        """First column after the image."""
        return self.start + math.prod(self.shape)


class CnnSpec(BaseModel):
    """Structure of a CNN without padding. All images have the same layers, with separate weights."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    pictures: Annotated[list[ImageSpec], Field(min_length=1, max_length=16)]
    """Images of the observation, sorted by their first column; their columns must not overlap."""
    channels: Annotated[list[_Size], Field(min_length=1, max_length=16)]
    """Number of output channels of each layer."""
    kernels: list[_Size]
    """Kernel size of each layer (square) [pixels]."""
    strides: list[_Size]
    """Stride of each layer [pixels]."""
    motion: Positive | None = None
    """Each older image of a history becomes (newest - older) times this factor; null: images are not changed."""

    @model_validator(mode="after")
    def _fits(self) -> CnnSpec:
        if not len(self.channels) == len(self.kernels) == len(self.strides):
            raise ValueError("channels, kernels and strides must be equally long: one number for each layer")
        end = 0
        for image in self.pictures:
            if image.start < end:
                raise ValueError(
                    "`pictures` must be sorted by `start`, and their columns of the observation must not overlap"
                )
            if image.shape[0] % image.steps:
                raise ValueError(
                    f"`steps: {image.steps}` must divide the {image.shape[0]} channels of an image's `shape`"
                )
            end = image.stop
            self.sizes(image)
        return self

    @property
    def stop(self) -> int:
        """First column after the last image."""
        return self.pictures[-1].stop

    def sizes(self, image: ImageSpec) -> list[tuple[int, int, int]]:
        """Return (channels, rows, columns) of an image before the first layer and after each layer.

        Raises:
            ValueError: if a kernel is larger than its input.
        """
        sizes: list[tuple[int, int, int]] = [image.shape]
        layers = zip(self.channels, self.kernels, self.strides, strict=True)
        for number, (channels, kernel, stride) in enumerate(layers):
            _, rows, columns = sizes[-1]
            if min(rows, columns) < kernel:
                raise ValueError(
                    f"the kernel of layer {number} ({kernel} x {kernel} pixels) is larger than its input"
                    f" ({rows} x {columns} pixels)"
                )
            sizes.append((channels, (rows - kernel) // stride + 1, (columns - kernel) // stride + 1))
        return sizes

    def features(self, columns: int) -> int:
        """Return the number of outputs of `Cnn` for an observation with `columns` columns.

        The outputs are the image features and the columns that belong to no image.
        """
        kept = columns - sum(math.prod(image.shape) for image in self.pictures)
        return kept + sum(math.prod(self.sizes(image)[-1]) for image in self.pictures)


class Cnn(nn.Module):
    """CNN over the images of an observation. The outputs are the features of all images, then the other columns.

    Args:
        spec: the images and the layers.
        activation: activation after each layer.
        wide: compute in float64, so that batches of any size give the same float32 actions (`WideConv`).
    """

    def __init__(self, spec: CnnSpec, activation: type[nn.Module], *, wide: bool = False) -> None:
        super().__init__()
        kind = WideConv if wide else nn.Conv2d
        self.spec = spec
        self.pictures = nn.ModuleList()
        for image in spec.pictures:
            layers: list[nn.Module] = []
            inputs = [channels for channels, _, _ in spec.sizes(image)[:-1]]
            settings = zip(inputs, spec.channels, spec.kernels, spec.strides, strict=True)
            for channels, outputs, kernel, stride in settings:
                layers += [kind(channels, outputs, kernel, stride), activation()]
            self.pictures.append(nn.Sequential(*layers))

    def forward(self, obs: Tensor) -> Tensor:
        """Return the features of the images, then the other columns of `obs`. (n, columns) -> (n, features)"""
        features, rest, end = [], [], 0
        for image, layers in zip(self.spec.pictures, self.pictures, strict=True):
            pixels = torch.unflatten(obs[:, image.start : image.stop], 1, image.shape)
            if self.spec.motion is not None and image.steps > 1:
                pixels = motion_channels(pixels, image.steps, self.spec.motion)
            features.append(layers(pixels).flatten(1))
            rest.append(obs[:, end : image.start])
            end = image.stop
        rest.append(obs[:, end:])
        return torch.cat([*features, *(part.to(features[0].dtype) for part in rest if part.shape[1])], dim=1)


def motion_channels(pixels: Tensor, steps: int, factor: float) -> Tensor:
    """Replace each older image of a history by (newest - older) * factor; the oldest image has the first channels.

    (n, steps x c, h, w) -> the same shape. `steps` is the number of images in the history.
    """
    frames = torch.unflatten(pixels, 1, (steps, -1))
    newest = frames[:, -1:]
    return torch.cat([factor * (newest - frames[:, :-1]), newest], dim=1).flatten(1, 2)


class WideConv(nn.Conv2d):
    """Convolution with float32 weights that computes in float64, as a matrix product.

    ONNX runtimes have no float64 convolution.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Return the convolution without padding. (n, c, h, w) -> (n, output channels, rows, columns) float64"""
        _, channels, height, width = x.shape
        edge, step = self.kernel_size[0], self.stride[0]
        rows, columns = (height - edge) // step + 1, (width - edge) // step + 1
        offset = torch.arange(edge, device=x.device)
        channel = torch.arange(channels, device=x.device)
        # flat indices of the pixels below the kernel at its first position: (c, row, column) -> (c h + row) w + column
        window = (channel[:, None, None] * height + offset[:, None]) * width + offset
        down, right = (step * torch.arange(count, device=x.device) for count in (rows, columns))
        corner = (down[:, None] * width + right).flatten()
        patches = x.double().flatten(1)[:, corner[:, None] + window.flatten()]  # (n, rows * columns, c * edge * edge)
        assert self.bias is not None
        outputs = nn.functional.linear(patches, self.weight.double().flatten(1), self.bias.double())
        return torch.unflatten(outputs.transpose(1, 2), 2, (rows, columns))
