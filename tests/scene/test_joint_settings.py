"""Settings of joints in a scene: which pattern applies, and the time that robots with many joints take."""

import time

from rlcli.config.schema import EntityConfig
from rlcli.scene.joint_and_actuator_setup import joint_settings


def test_the_last_matching_pattern_sets_a_value():
    joints = {".*": {"kp": 1.0, "kv": 1.0}, "left_.*": {"kp": 2.0}, "left_hip": {"kp": 3.0}, "[": {"kp": 4.0}}
    entity = EntityConfig.model_validate({"model": "robot.xml", "joints": joints})
    gains = {name: joint_settings(entity, name).kp for name in ("left_hip", "left_knee", "right_hip")}
    assert gains == {"left_hip": 3.0, "left_knee": 2.0, "right_hip": 1.0}
    assert joint_settings(entity, "left_hip").kv == 1.0


def test_settings_of_a_hundred_joints_are_found_in_less_than_two_seconds():
    names = [f"segment_{number}_{axis}" for number in range(34) for axis in ("abduction", "extension", "twist")]
    joints = {name: {"kp": 1.0, "kv": 0.1} for name in names}
    entity = EntityConfig.model_validate({"model": "robot.xml", "joints": joints})
    start = time.process_time()
    assert all(joint_settings(entity, name).kp == 1.0 for name in names)
    assert time.process_time() - start < 2.0
