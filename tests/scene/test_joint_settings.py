"""Settings of joints in a scene: which pattern applies to a joint."""

import sys

from rlcli.config.schema import EntityConfig
from rlcli.scene.joint_and_actuator_setup import joint_settings


def test_the_last_matching_pattern_sets_a_value():
    joints = {".*": {"kp": 1.0, "kv": 1.0}, "left_.*": {"kp": 2.0}, "left_hip": {"kp": 3.0}, "[": {"kp": 4.0}}
    entity = EntityConfig.model_validate({"model": "robot.xml", "joints": joints})
    gains = {name: joint_settings(entity, name).kp for name in ("left_hip", "left_knee", "right_hip")}
    assert gains == {"left_hip": 3.0, "left_knee": 2.0, "right_hip": 1.0}
    assert joint_settings(entity, "left_hip").kv == 1.0


def test_no_suggestions_are_computed_for_patterns_of_other_joints():
    """They took most of the time of `rlcli check` for robots with a hundred joints."""
    names = [f"segment_{number}" for number in range(20)]
    entity = EntityConfig.model_validate({"model": "robot.xml", "joints": {name: {"kp": 1.0} for name in names}})
    called = set()
    sys.setprofile(lambda frame, event, value: called.add(frame.f_code.co_name))
    try:
        gains = [joint_settings(entity, name).kp for name in names]
    finally:
        sys.setprofile(None)
    assert gains == [1.0] * 20
    assert "joint_settings" in called
    assert "get_close_matches" not in called
