"""Positions that a robot reaches: equal scenes share one computation."""

import mujoco
import numpy as np

from rlcli.scene.reachable_positions import reachable_positions

ARM = """<mujoco><worldbody><body name="upper"><joint name="a" axis="0 1 0" range="-90 90"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0.4 0 0"/><body name="hand" pos="{length} 0 0"><joint name="b"
axis="0 1 0" range="-90 90"/><geom size="0.03"/></body></body></worldbody></mujoco>"""


def reached(length=0.4, joints=(0, 1), largest=1.0):
    model = mujoco.MjModel.from_xml_string(ARM.format(length=length))
    return reachable_positions(model, np.zeros(model.nq), joints, 2, (-largest, largest))


def test_equal_scenes_share_one_computation():
    assert reached() is reached()


def test_other_scenes_joints_and_offsets_have_their_own_positions():
    first = reached()
    assert np.linalg.norm(first, axis=1).max() < 0.41
    assert np.linalg.norm(reached(length=0.5), axis=1).max() > 0.49
    assert np.ptp(reached(joints=(1,)), axis=0).max() < 1e-9  # the second joint turns the hand about its own centre
    assert abs(reached(largest=0.5)[:, 2]).max() < abs(first[:, 2]).max()
