"""Parsing of `--sweep`, and its values."""

import pytest

from rlcli.errors import UsageError
from rlcli.evaluation.stress_parameters import grid, read_sweeps


def read(text, points=5):
    (sweep,) = read_sweeps([text], points)
    return sweep


@pytest.mark.parametrize(
    ("text", "points", "values"),
    [
        ("body_mass.pole=0.5:2", 5, (0.5, 0.5 * 2**0.5, 1.0, 2**0.5, 2.0)),  # factors lie at equal ratios
        ("body_mass.pole=0.8:1.25", 3, (0.8, 1.0, 1.25)),
        ("gravity=0:2", 3, (0.0, 1.0, 2.0)),  # not from 0
        ("joint_damping.hinge=abs:1:4", 4, (1.0, 2.0, 3.0, 4.0)),
        ("action_noise=0:0.4", 5, (0.0, 0.1, 0.2, 0.3, 0.4)),
        ("action_delay=0:3", 5, (0, 1, 2, 3)),  # whole steps
        ("action_delay=0:10", 3, (0, 5, 10)),
        ("push=0:1:3", 5, (0.0, 0.5, 1.0)),
        ("body_mass=0.5,1,2", 9, (0.5, 1.0, 2.0)),
        ("action_delay=2", 9, (2,)),
        ("geom_size.ball=1:4", 3, (1.0, 2.0, 4.0)),  # a field of the model
    ],
)
def test_read_sweeps_values(text, points, values):
    assert read(text, points).values == pytest.approx(values, rel=1e-11)


def test_geometric_middle_is_exactly_1():
    assert 1.0 in read("body_mass=0.8:1.25", 3).values
    assert 1.0 in read("body_mass=0.1:10", 5).values


def test_sweep_name_element_and_neutral_value():
    sweep = read("body_mass.left_(foot|toe)=0.5:2")
    assert (sweep.parameter, sweep.element, sweep.name) == ("body_mass", "left_(foot|toe)", "body_mass.left_(foot|toe)")
    assert sweep.neutral == 1.0
    assert read("joint_damping=abs:0:1").neutral is None
    assert read("action_delay=0:1").neutral == 0.0


def test_grid_is_every_combination():
    sweeps = read_sweeps(["gravity=1,2", "action_delay=0:2"], 5)
    assert grid(sweeps) == [(1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2)]


@pytest.mark.parametrize("text", ["body_mass=0.5:2", "gravity=0:3", "action_delay=0:7", "joint_damping=abs:2:9"])
def test_share_inverts_between(text):
    sweep = read(text)
    assert [sweep.between(sweep.share(value)) for value in sweep.values] == pytest.approx(sweep.values)


@pytest.mark.parametrize(
    ("text", "output"),
    [
        ("body_mass", "is not NAME=LOW:HIGH"),
        ("=1:2", "is not NAME=LOW:HIGH"),
        ("body_mass=", "is not NAME=LOW:HIGH"),
        ("body_mass=2:1", "2 is not below 1"),
        ("body_mass=1:1", "1 is not below 1"),
        ("body_mass=1:x", "'x' is not a number"),
        ("body_mass=1:inf", "'inf' is not a number"),
        ("body_mass=nan", "'nan' is not a number"),
        ("body_mass=1:2:3:4", "write the range as"),
        ("body_mass=1:2:x", "is not a number of points; write a whole number"),
        ("body_mass=1:2:1", "1 points"),
        ("body_mass=1:2:99999", "99999 points"),
        ("body_mass=0:2", "mass must be above 0"),
        ("gravity=-1:1", "cannot be -1"),
        ("body_mass=1,1", "appears twice"),
        ("action_delay=0.5:2", "whole numbers of steps"),
        ("action_delay=0:5000", "whole numbers of steps"),
        ("action_noise=abs:0:1", "are always absolute"),
        ("actuator_gain=abs:0:1", "is always a factor"),
    ],
)
def test_invalid_sweep_raises_usage_error(text, output):
    with pytest.raises(UsageError) as caught:
        read(text)
    assert output in caught.value.message


def test_repeated_parameter_raises_usage_error():
    with pytest.raises(UsageError, match="given twice"):
        read_sweeps(["gravity=1:2", "gravity=1:3"], 5)
