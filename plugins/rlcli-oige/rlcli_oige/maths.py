"""Tensor mathematics under the names of Isaac Sim's torch utilities; what a task scripts, TorchScript can read."""

import math
import random

import numpy as np
import torch
from torch import Tensor


def set_seed(seed: int, torch_deterministic: bool = False) -> int:
    """Seed torch, numpy and random; -1 draws a seed. Returns the seed."""
    if seed == -1:
        seed = 42 if torch_deterministic else int(np.random.randint(0, 10000))
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
    return seed


def normalize(x: Tensor, eps: float = 1e-9) -> Tensor:
    """Vectors of length 1. (..., k)"""
    return x / x.norm(p=2, dim=-1).clamp(min=eps, max=None).unsqueeze(-1)


def tensor_clamp(t: Tensor, min_t: Tensor, max_t: Tensor) -> Tensor:
    """Elementwise between two tensors."""
    return torch.max(torch.min(t, max_t), min_t)


def scale(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """[-1, 1] -> [lower, upper]."""
    return 0.5 * (x + 1.0) * (upper - lower) + lower


def unscale(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """[lower, upper] -> [-1, 1]."""
    return (2.0 * x - upper - lower) / (upper - lower)


def scale_transform(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """[lower, upper] -> [-1, 1], as `unscale`."""
    return unscale(x, lower, upper)


def unscale_transform(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """[-1, 1] -> [lower, upper], as `scale`."""
    return scale(x, lower, upper)


def unscale_np(x, lower, upper):
    """`unscale` of numpy arrays."""
    return (2.0 * x - upper - lower) / (upper - lower)


def scale_np(x, lower, upper):
    """`scale` of numpy arrays."""
    return 0.5 * (x + 1.0) * (upper - lower) + lower


def saturate(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Elementwise between two tensors."""
    return torch.max(torch.min(x, upper), lower)


def copysign(a: float, b: Tensor) -> Tensor:
    """|a| with the signs of b. (n,)"""
    return torch.abs(torch.full_like(b, a)) * torch.sign(b)


def torch_rand_float(lower: float, upper: float, shape: tuple[int, int], device: str) -> Tensor:
    """Uniform in [lower, upper)."""
    return (upper - lower) * torch.rand(*shape, device=device) + lower


def torch_random_dir_2(shape: tuple[int, int], device: str) -> Tensor:
    """Directions in the plane. (*shape, 2) without shape's last 1"""
    angle = torch_rand_float(-math.pi, math.pi, shape, device).squeeze(-1)
    return torch.stack([torch.cos(angle), torch.sin(angle)], dim=-1)


def normalize_angle(x: Tensor) -> Tensor:
    """The same angle in [-pi, pi] [rad]."""
    return torch.atan2(torch.sin(x), torch.cos(x))


def deg2rad(x: Tensor) -> Tensor:
    """Degrees as radians."""
    return x * (math.pi / 180.0)


def rad2deg(x: Tensor) -> Tensor:
    """Radians as degrees."""
    return x * (180.0 / math.pi)


def matmul(matrix_a: Tensor, matrix_b: Tensor) -> Tensor:
    """Matrix product."""
    return torch.matmul(matrix_a, matrix_b)


def sin(data: Tensor) -> Tensor:
    """Sine."""
    return torch.sin(data)


def cos(data: Tensor) -> Tensor:
    """Cosine."""
    return torch.cos(data)


def transpose_2d(data: Tensor) -> Tensor:
    """Transpose of a matrix."""
    return torch.transpose(data, 0, 1)


def inverse(data: Tensor) -> Tensor:
    """Inverse of a matrix."""
    return torch.linalg.inv(data)


def create_zeros_tensor(shape, dtype="float32", device=None) -> Tensor:
    """Zeros."""
    return torch.zeros(tuple(shape), dtype=_dtype(dtype), device=device)


def create_tensor_from_list(data, dtype="float32", device=None) -> Tensor:
    """A list as a tensor."""
    return torch.tensor(data, dtype=_dtype(dtype), device=device)


def as_type(data: Tensor, dtype) -> Tensor:
    """In another data type."""
    return data.to(_dtype(dtype))


def convert(data, device=None, dtype="float32") -> Tensor:
    """Anything tensor-like as a tensor on a device."""
    return torch.as_tensor(data, dtype=_dtype(dtype), device=device)


def move_data(data: Tensor, device: str) -> Tensor:
    """On another device."""
    return data.to(device)


def clone_tensor(data: Tensor, device=None) -> Tensor:
    """A copy."""
    return data.to(device).clone() if device else data.clone()


def expand_dims(data: Tensor, axis: int) -> Tensor:
    """With one more dimension."""
    return torch.unsqueeze(data, axis)


def tensor_cat(data, device=None, dim: int = -1) -> Tensor:
    """Joined along a dimension."""
    return torch.cat([torch.as_tensor(item, device=device) for item in data], dim=dim)


def tensor_stack(data, dim: int = 0) -> Tensor:
    """Stacked along a new dimension."""
    return torch.stack(list(data), dim=dim)


def to_list(data) -> list:
    """As a list."""
    return data if isinstance(data, list) else data.tolist()


def to_numpy(data):
    """As a numpy array."""
    return data.detach().cpu().numpy() if isinstance(data, Tensor) else np.asarray(data)


def resolve_indices(indices, count: int, device=None) -> Tensor:
    """Indices as int64; all of them for None."""
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
"""What `from rlcli_oige import *` gives of this module."""
