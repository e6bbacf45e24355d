"""Contract of the task, and values of its own terms."""

import math
from types import SimpleNamespace

import pytest
import torch
from rlcli_example_acrobot.terms import tip_below, tip_height


def arm(*angles):
    """Return an entity with these joint angles (shoulder, elbow), one pair per environment."""
    return SimpleNamespace(data=SimpleNamespace(joint_pos=torch.tensor(angles)))


def test_contract(rlcli_check):
    assert rlcli_check("acrobot") == []


@pytest.mark.parametrize(
    ("shoulder", "elbow", "expected"),
    [(0.0, 0.0, 1.0), (math.pi, 0.0, -1.0), (0.0, math.pi, 0.0), (math.pi / 2, -math.pi / 2, 0.5)],
)
def test_tip_height_is_fraction_of_arm_length(shoulder, elbow, expected):
    height = tip_height(None, entity=arm((shoulder, elbow)), joints=slice(0, 2), lengths=(0.5, 0.5))
    assert height.tolist() == pytest.approx([expected], abs=1e-6)


def test_tip_below_splits_environments():
    entity = arm((0.0, 0.0), (math.pi / 2, 0.0))
    parameters = {"entity": entity, "joints": slice(0, 2), "lengths": (0.5, 0.5), "height": 0.5}
    assert tip_below(None, **parameters).tolist() == [False, True]
