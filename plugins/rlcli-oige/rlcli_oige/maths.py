"""Tensor mathematics under the names of Isaac Sim's torch utilities. TorchScript can compile every function."""

import math
import random

import numpy as np
import torch
from torch import Tensor


def set_seed(seed: int, torch_deterministic: bool = False) -> int:
    """Seed torch, numpy and random, and return the seed. The seed -1 chooses a random one."""
    if seed == -1:
        seed = 42 if torch_deterministic else int(np.random.randint(0, 10000))
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    return seed


def normalize(x: Tensor, eps: float = 1e-9) -> Tensor:
    """Return vectors scaled to length 1; a vector of length 0 stays 0. (..., k)"""
    return x / x.norm(p=2, dim=-1).clamp(min=eps, max=None).unsqueeze(-1)


def tensor_clamp(t: Tensor, min_t: Tensor, max_t: Tensor) -> Tensor:
    """Return t with each element clamped between those of `min_t` and `max_t`."""
    return torch.max(torch.min(t, max_t), min_t)


def scale(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return x mapped linearly from [-1, 1] to [lower, upper]."""
    return 0.5 * (x + 1.0) * (upper - lower) + lower


def unscale(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return x mapped linearly from [lower, upper] to [-1, 1]."""
    return (2.0 * x - upper - lower) / (upper - lower)


def scale_transform(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return x mapped linearly from [lower, upper] to [-1, 1], as `unscale` does."""
    return unscale(x, lower, upper)


def unscale_transform(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return x mapped linearly from [-1, 1] to [lower, upper], as `scale` does."""
    return scale(x, lower, upper)


def unscale_np(x, lower, upper):
    """Return a numpy array x mapped linearly from [lower, upper] to [-1, 1]."""
    return (2.0 * x - upper - lower) / (upper - lower)


def scale_np(x, lower, upper):
    """Return a numpy array x mapped linearly from [-1, 1] to [lower, upper]."""
    return 0.5 * (x + 1.0) * (upper - lower) + lower


def saturate(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return x with each element clamped between those of `lower` and `upper`."""
    return torch.max(torch.min(x, upper), lower)


def copysign(a: float, b: Tensor) -> Tensor:
    """Return |a| with the signs of b. (n,)"""
    return torch.abs(torch.full_like(b, a)) * torch.sign(b)


def torch_rand_float(lower: float, upper: float, shape: tuple[int, int], device: str) -> Tensor:
    """Return a tensor of this shape with uniform samples from [lower, upper)."""
    return (upper - lower) * torch.rand(*shape, device=device) + lower


def torch_random_dir_2(shape: tuple[int, int], device: str) -> Tensor:
    """Sample unit vectors in the plane uniformly. shape (n, 1) -> (n, 2)"""
    angle = torch_rand_float(-math.pi, math.pi, shape, device).squeeze(-1)
    return torch.stack([torch.cos(angle), torch.sin(angle)], dim=-1)


def normalize_angle(x: Tensor) -> Tensor:
    """Return the same angles in [-pi, pi] [rad]."""
    return torch.atan2(torch.sin(x), torch.cos(x))


def deg2rad(x: Tensor) -> Tensor:
    """Return angles in radians for angles in degrees."""
    return x * (math.pi / 180.0)


def rad2deg(x: Tensor) -> Tensor:
    """Return angles in degrees for angles in radians."""
    return x * (180.0 / math.pi)


def matmul(matrix_a: Tensor, matrix_b: Tensor) -> Tensor:
    """Return the product of two matrices, or of batches of matrices."""
    return torch.matmul(matrix_a, matrix_b)


def sin(data: Tensor) -> Tensor:
    """Return the sine of each element [rad]."""
    return torch.sin(data)


def cos(data: Tensor) -> Tensor:
    """Return the cosine of each element [rad]."""
    return torch.cos(data)


def transpose_2d(data: Tensor) -> Tensor:
    """Return the transpose of a matrix."""
    return torch.transpose(data, 0, 1)


def inverse(data: Tensor) -> Tensor:
    """Return the inverse of a matrix, or of a batch of matrices."""
    return torch.linalg.inv(data)


def create_zeros_tensor(shape, dtype="float32", device=None) -> Tensor:
    """Return a tensor of zeros of this shape."""
    return torch.zeros(tuple(shape), dtype=_dtype(dtype), device=device)


def create_tensor_from_list(data, dtype="float32", device=None) -> Tensor:
    """Return a list of numbers as a new tensor."""
    return torch.tensor(data, dtype=_dtype(dtype), device=device)


def as_type(data: Tensor, dtype) -> Tensor:
    """Return a tensor with another data type, such as "int32"."""
    return data.to(_dtype(dtype))


def convert(data, device=None, dtype="float32") -> Tensor:
    """Return a tensor, array, list or number as a tensor of a data type on a device."""
    return torch.as_tensor(data, dtype=_dtype(dtype), device=device)


def move_data(data: Tensor, device: str) -> Tensor:
    """Return a tensor on another device."""
    return data.to(device)


def clone_tensor(data: Tensor, device=None) -> Tensor:
    """Return a copy of a tensor, on another device if one is named."""
    return data.to(device).clone() if device else data.clone()


def expand_dims(data: Tensor, axis: int) -> Tensor:
    """Return a tensor with a new dimension of size 1 at the position `axis`."""
    return torch.unsqueeze(data, axis)


def tensor_cat(data, device=None, dim: int = -1) -> Tensor:
    """Return tensors or lists concatenated along a dimension."""
    return torch.cat([torch.as_tensor(item, device=device) for item in data], dim=dim)


def tensor_stack(data, dim: int = 0) -> Tensor:
    """Return tensors stacked along a new dimension."""
    return torch.stack(list(data), dim=dim)


def to_list(data) -> list:
    """Return a tensor or an array as nested lists."""
    return data if isinstance(data, list) else data.tolist()


def to_numpy(data):
    """Return a tensor or a list as a numpy array."""
    return data.detach().cpu().numpy() if isinstance(data, Tensor) else np.asarray(data)


def resolve_indices(indices, count: int, device=None) -> Tensor:
    """Return indices as an int64 tensor; for None the indices 0 to `count` - 1."""
    if indices is None:
        return torch.arange(count, device=device)
    return torch.as_tensor(indices, device=device).long()


def _dtype(name) -> torch.dtype:
    return name if isinstance(name, torch.dtype) else getattr(torch, {"long": "int64"}.get(name, name))


TENSOR_NAMES = [
    "set_seed", "normalize", "tensor_clamp", "scale", "unscale", "scale_transform", "unscale_transform", "unscale_np",
    "scale_np", "saturate", "copysign", "torch_rand_float", "torch_random_dir_2", "normalize_angle", "deg2rad",
    "rad2deg", "matmul", "sin", "cos", "transpose_2d", "inverse", "create_zeros_tensor", "create_tensor_from_list",
    "as_type", "convert", "move_data", "clone_tensor", "expand_dims", "tensor_cat", "tensor_stack", "to_list",
    "to_numpy", "resolve_indices",
]  # fmt: skip
"""Names of this module that `from rlcli_oige import *` exports."""
