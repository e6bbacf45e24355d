"""Mirror maps of a task: derived from a symmetric robot, refused with the name of what is not symmetric."""

import pytest
from support import mirrored_robot, small_task

from rlcli.config.load import resolve
from rlcli.envs.mirror import mirror_maps
from rlcli.errors import ConfigError
from rlcli.registry import find_task

GROUPS = ("policy", "critic")
FALL = "fall: {func: joint_pos_out_of_manual_limit, joints: [left_hip], bounds: [-0.1, 0.1]}"
LEGS = ([2, 3, 0, 1], [-1, 1, -1, 1])


def maps(folder, **files):
    return mirror_maps(resolve(find_task(mirrored_robot.write(folder, **files))), GROUPS, tolerance=1e-3)


def test_maps_of_a_symmetric_robot(tmp_path):
    """Joints and contacts change sides; rays go from right to left; the terms of vectors change signs."""
    found = maps(tmp_path)
    assert (found.action.index.tolist(), found.action.sign.tolist()) == LEGS
    index, sign = (
        values.tolist() for values in (found.observations["policy"].index, found.observations["policy"].sign)
    )
    assert index[:4] == LEGS[0]
    assert sign[:4] == LEGS[1]
    assert index[4:10] == [4, 5, 6, 7, 8, 9]
    assert sign[4:10] == [-1, 1, -1, 1, -1, -1]
    assert index[10:19] == [16, 17, 18, 13, 14, 15, 10, 11, 12]
    assert index[19:] == [21, 22, 19, 20]
    critic = found.observations["critic"]
    assert critic.index.tolist() == [0, 1, 2, 3, 4, 5, 7, 6]
    assert critic.sign.tolist() == [1, -1, 1, 1, -1, 1, 1, 1]


@pytest.mark.parametrize(
    ("place", "old", "new", "named"),
    [
        ("model", 'pos="0 0 -.2" mass=".3"', 'pos="0 0 -.2" mass=".4"', "joints 'robot/left_"),
        ("model", 'pos="0 .15 0"', 'pos="0 .2 0"', "joint 'robot/left_hip' has no mirror image"),
        ("model", '"left_knee" axis="0 1 0"', '"left_knee" axis="0 1 1"', "joint 'robot/left_knee' has another type"),
        ("task", "action_rate_l2,", "joint_vel_l2, joints: [left_knee],", "reward 'calm' differs"),
        ("task", "{func: base_ang_vel}", "{func: joint_vel, joints: [left_hip]}", "observation 'policy.turn' equals"),
        ("task", "{time_out: {", f"{{{FALL}, time_out: {{", "terminations differ"),
        ("task", "joint_position, ", "joint_position, joints: [left_hip, left_knee, right_hip], ", "not its mirror"),
        ("task", "{func: base_ang_vel}", "{func: body_pose_w, bodies: [left_shin]}", "policy.turn' equals no column"),
    ],
)  # fmt: skip
def test_asymmetry_is_refused_by_name(tmp_path, place, old, new, named):
    text = getattr(mirrored_robot, place.upper())
    assert old in text
    with pytest.raises(ConfigError) as error:
        maps(tmp_path, **{place: text.replace(old, new, 1)})
    assert named in str(error.value)
    assert "agents.ppo.symmetry" in str(error.value)


def test_planar_robot_is_refused(tmp_path):
    (tmp_path / "model.xml").write_text(small_task.MODEL)
    (tmp_path / "task.yaml").write_text(small_task.TASK)
    with pytest.raises(ConfigError, match="the mirror changes nothing") as error:
        mirror_maps(resolve(find_task(str(tmp_path))), ["policy"], tolerance=1e-3)
    assert error.value.problems[0].hint == "set symmetry: null"


def test_small_asymmetry_is_allowed_by_the_tolerance(tmp_path):
    model = mirrored_robot.MODEL.replace('mass=".3"', 'mass=".301"', 1)
    file = mirrored_robot.write(tmp_path, model=model)
    with pytest.raises(ConfigError, match=r"symmetry\.tolerance allows"):
        mirror_maps(resolve(find_task(file)), GROUPS, tolerance=1e-4)
    assert mirror_maps(resolve(find_task(file)), GROUPS, tolerance=0.1).action.index.tolist() == LEGS[0]
