"""Tests of rotations and angles: correct values, and the same bits for any number of rows."""

import math

import pytest
import torch

from rlcli.sim.rotations import atan2, axes, axis_x, axis_y, axis_z

torch.set_num_threads(1)


def test_atan2_equals_math_atan2():
    angles = torch.linspace(-math.pi, math.pi, 1441, dtype=torch.float64)
    for radius in (1e-6, 1.0, 1e3):
        x, y = (radius * angles.cos()).float(), (radius * angles.sin()).float()
        expected = [math.atan2(b, a) for a, b in zip(x.tolist(), y.tolist(), strict=True)]
        assert atan2(y, x).tolist() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("y", "x", "angle"),
    [(0.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, math.pi / 2), (1.0, -0.0, math.pi / 2), (-1.0, 0.0, -math.pi / 2),
     (-1.0, -0.0, -math.pi / 2), (0.0, -1.0, math.pi), (-0.0, -1.0, -math.pi)],
)  # fmt: skip
def test_atan2_is_defined_on_axes_and_at_origin(y, x, angle):
    assert float(atan2(torch.tensor(y), torch.tensor(x))) == pytest.approx(angle, abs=1e-6)


def test_atan2_has_same_bits_for_any_number_of_rows():
    points = torch.randn(203, 2, generator=torch.Generator().manual_seed(0))
    together = atan2(points[:, 0], points[:, 1])
    for rows in range(1, 40):
        alone = points[:rows].clone()
        assert torch.equal(atan2(alone[:, 0], alone[:, 1]), together[:rows])


@pytest.mark.parametrize("rows", [1, 3, 17, 64])
def test_axes_have_the_bits_of_each_axis(rows):
    generator = torch.Generator().manual_seed(0)
    quat = torch.randn(rows, 9, generator=generator)
    quat *= torch.rand(quat.shape, generator=generator) < 0.6  # some zeros, of both signs
    for values in (quat[:, 3:7], quat[:, 3:7].contiguous()):
        expected = torch.cat([axis_x(values), axis_y(values), axis_z(values)], dim=1)
        assert torch.equal(axes(values).view(torch.int32), expected.view(torch.int32))
