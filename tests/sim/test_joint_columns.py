"""Tests of the cached columns of the joint state, and of joint angles."""

import math

import pytest
import torch
from support.worlds import build


@pytest.fixture
def data():
    env = build("humanoid", 2)
    env.reset()
    qpos = env.engine.field("qpos")
    qpos[:, 7:] = torch.linspace(-4.0, 4.0, qpos.shape[1] - 7, dtype=torch.float64)
    env.sim.refresh()
    return env.entities["robot"].data


INDICES = [slice(0, 6), slice(0, 6, 2), slice(1, None, 2), slice(None), torch.tensor([0, 3]), torch.tensor([5, 1])]


@pytest.mark.parametrize("name", ["joint_pos", "joint_vel", "default_joint_pos", "default_joint_vel"])
def test_columns_equal_indexed_tensor(data, name):
    for index in INDICES:  # on one entity: the cache must not mix them up
        torch.testing.assert_close(getattr(data, f"{name}_of")(index), getattr(data, name)[:, index], rtol=0, atol=0)


def test_columns_follow_state_and_replaced_tensor(data):
    names = data._entity.joint_names[:3]
    indices = [data._entity.select("Joints", names)[0] for _ in range(2)]  # as two terms do
    first = data.joint_pos_of(indices[0])
    assert data.joint_pos_of(indices[1]) is first
    data.default_joint_pos_of(slice(0, 3))
    data.default_joint_pos = data.default_joint_pos + 1.0
    assert torch.equal(data.default_joint_pos_of(slice(0, 3)), data.default_joint_pos[:, :3])


def test_joint_limits_follow_randomization(data):
    engine = data._entity.engine
    for _ in range(2):  # as configured, and randomised
        for soft in (False, True):
            for index in INDICES:
                for part, whole in zip(data.joint_limits_of(index, soft), data.joint_limits(soft), strict=True):
                    assert torch.equal(part, whole[:, index])
        engine.expand("jnt_range")[1] *= 0.5
        data._sim.stamp += 1
    low = data.joint_limits_of(slice(0, 3))[0]
    assert low.shape == (2, 3)
    assert bool((low[1] > low[0]).any())


def test_joint_angle_is_wrapped_and_computed_once_per_step(data):
    turn = 2.0 * math.pi
    for index in INDICES:
        angle, position = data.joint_angle_of(index), data.joint_pos[:, index]
        assert angle.abs().max() <= math.pi
        torch.testing.assert_close(torch.remainder(angle - position + 1.0, turn), torch.ones_like(angle))
    before = data.joint_angle_of(slice(8, 10)).clone()
    data._entity.engine.field("qpos")[:, 15:17] += 0.5
    data._sim.refresh()
    torch.testing.assert_close(data.joint_angle_of(slice(8, 10)), before + 0.5)


def test_joint_angle_cache_distinguishes_temporary_indices(data):
    found = [data.joint_angle_of(torch.tensor([column])) for column in range(8)]
    assert torch.equal(torch.cat(found, dim=1), data.joint_angle_of(slice(0, 8)))


def test_write_with_stepped_slice_sets_own_columns(data):
    entity = data._entity
    selection = entity.engine.select(torch.ones(2, dtype=torch.bool), 0, torch.zeros(2, dtype=torch.int64))
    entity.write_joint_positions(selection, torch.zeros(2, 6), slice(0, 6))
    entity.write_joint_positions(selection, torch.ones(2, 3), slice(0, 6, 2))
    data._sim.refresh()
    assert data.joint_pos[0, :6].tolist() == [1.0, 0.0, 1.0, 0.0, 1.0, 0.0]
