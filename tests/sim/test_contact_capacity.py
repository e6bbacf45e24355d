"""Tests of the GPU engine's capacity for contacts and constraints, and of its errors if the capacity is exceeded."""

import mujoco
import numpy as np
import pytest
import torch
from support.worlds import build

from rlcli.config.schema import SimConfig
from rlcli.errors import DivergedError
from rlcli.sim.contact_capacity import required_capacity
from rlcli.sim.engine import open_engine

torch.set_num_threads(1)

BOXES = (
    '<mujoco><worldbody><geom type="plane" size="5 5 1"/>'
    + "".join(
        f'<body pos="0 0 {0.11 + 0.21 * i}"><freejoint/><geom type="box" size="0.1 0.1 0.1" mass="1"/></body>'
        for i in range(4)
    )
    + "</worldbody></mujoco>"
)
BALL = '<mujoco>{}<worldbody>{}<body pos="0 0 0.1"><freejoint/>{}</body></worldbody></mujoco>'


def ant():
    """Return the model of the built-in task with ground and motors."""
    return build("ant-direct", 1).engine.model


def simulated_maximum(model, steps, shake=2.0):
    """Return the largest numbers of contacts and rows in a long simulation."""
    data, random = mujoco.MjData(model), np.random.default_rng(7)
    contacts = rows = 0
    for trial in range(4):
        mujoco.mj_resetData(model, data)
        data.qvel[:] = random.normal(0.0, shake if trial else 0.0, model.nv)
        for _ in range(steps):
            data.ctrl[:] = random.uniform(-1.0, 1.0, model.nu)
            mujoco.mj_step(model, data)
            contacts, rows = max(contacts, data.ncon), max(rows, data.nefc)
    return contacts, rows


def test_capacity_covers_long_simulation_of_ant():
    model = ant()
    capacity, (contacts, rows) = required_capacity(model), simulated_maximum(model, 800)
    assert contacts >= 4
    assert capacity.contacts >= contacts
    assert capacity.constraints >= rows


def test_capacity_covers_stack_of_boxes():
    model = mujoco.MjModel.from_xml_string(BOXES)
    capacity, (contacts, rows) = required_capacity(model), simulated_maximum(model, 400, shake=0.5)
    assert contacts >= 12
    assert capacity.contacts >= contacts
    assert capacity.constraints >= rows


HILLS = '<asset><hfield name="hills" nrow="20" ncol="20" size="1 1 0.1 0.1" elevation="{}"/></asset>'.format(
    " ".join(str(float((i * 7 + j * 3) % 5)) for i in range(20) for j in range(20))
)
CUBE = " ".join(f"{x} {y} {z}" for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1))
LYING = {
    "capsule": ("", '<geom type="plane" size="5 5 1"/>', '<geom type="capsule" size="0.1 0.3" euler="90 0 0"/>'),
    "box": ("", '<geom type="plane" size="5 5 1"/>', '<geom type="box" size="0.1 0.1 0.1"/>'),
    "cylinder": ("", '<geom type="plane" size="5 5 1"/>', '<geom type="cylinder" size="0.1 0.1"/>'),
    "mesh": (
        f'<asset><mesh name="cube" vertex="{CUBE}"/></asset>',
        '<geom type="plane" size="5 5 1"/>',
        '<geom type="mesh" mesh="cube"/>',
    ),
    "box on box": ("", '<geom type="box" size="1 1 0.1" pos="0 0 -0.1"/>', '<geom type="box" size="0.1 0.1 0.1"/>'),
    "capsule on box": (
        "",
        '<geom type="box" size="1 1 0.1" pos="0 0 -0.1"/>',
        '<geom type="capsule" size="0.1 0.3" euler="90 0 0"/>',
    ),
    "capsule on hills": (
        HILLS,
        '<geom type="hfield" hfield="hills"/>',
        '<geom type="capsule" size="0.1 0.5" euler="90 0 0"/>',
    ),
    "box on hills": (HILLS, '<geom type="hfield" hfield="hills"/>', '<geom type="box" size="0.5 0.5 0.1"/>'),
}


@pytest.mark.parametrize("xml", [BALL.format(*parts) for parts in LYING.values()], ids=LYING)
def test_capacity_covers_two_geoms_at_rest(xml):
    model = mujoco.MjModel.from_xml_string(xml)
    capacity, (contacts, rows) = required_capacity(model), simulated_maximum(model, 200, shake=0.2)
    assert contacts > 0
    assert capacity.contacts >= contacts
    assert capacity.constraints >= rows


def test_capacity_covers_contacts_of_parent_and_child():
    xml = """<mujoco><option><flag filterparent="disable"/></option><worldbody><body><joint/><geom size="0.1"/>
      <body pos="0 0 0.15"><joint axis="0 1 0"/><geom size="0.1"/></body></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    capacity, (contacts, rows) = required_capacity(model), simulated_maximum(model, 20)
    assert contacts == 1
    assert capacity.contacts >= contacts
    assert capacity.constraints >= rows


def test_capacity_covers_contacts_at_joint_limits():
    joint = '<joint type="slide" axis="0 0 1" range="-1 0"/>'
    box = f'<body pos="{{}} 0 1">{joint}<geom type="box" size="0.1 0.1 0.6"/></body>'
    parts = "".join(box.format(i) for i in range(16))
    xml = f"""<mujoco><option gravity="0 0 0"/><default><joint limited="true" damping="1e4"/></default><worldbody>
      <geom type="plane" size="20 20 1"/>{parts}</worldbody></mujoco>"""
    capacity = required_capacity(mujoco.MjModel.from_xml_string(xml))
    assert capacity.contacts >= 4 * 16


def test_settings_replace_estimated_capacity():
    model = mujoco.MjModel.from_xml_string(BOXES)
    estimate, found = required_capacity(model), required_capacity(model, contacts=5)
    assert (found.contacts, found.constraints) == (5, estimate.constraints)
    assert required_capacity(model, constraints=9).constraints == 9


def test_capacity_without_contacts_is_small():
    capacity = build("cartpole", 2, "sim.engine=warp").engine.capacity
    assert capacity.contacts <= 2
    assert capacity.constraints <= 4


@pytest.mark.parametrize("setting", ["contacts_per_env", "constraints_per_env"])
def test_check_raises_with_setting_if_capacity_is_exceeded(setting):
    env = build("ant-direct", 3, "sim.engine=warp", f"sim.{setting}=1")
    env.reset()
    for _ in range(60):
        env.step(torch.zeros(3, 8))
    with pytest.raises(DivergedError) as error:
        env.check()
    assert setting in error.value.hint
    assert f"sim.{setting}=2" in error.value.hint
    assert "1" in str(error.value)


def test_sufficient_capacity_reports_nothing():
    model = mujoco.MjModel.from_xml_string(BOXES)
    engine = open_engine(model, 2, SimConfig(dt=0.002, engine="warp"))
    for _ in range(40):
        engine.step(1)
        engine.diverged()
    assert engine.report_nonfinite() == []


def test_capacity_covers_whole_height_field():
    """Start 20 feet above a pit, in which they touch nothing; the ground around the pit is higher."""
    heights = np.ones((41, 41))
    heights[16:25, 16:25] = 0.0
    spec = mujoco.MjSpec()
    spec.add_hfield(name="land", nrow=41, ncol=41, size=[20.0, 20.0, 10.0, 1.0], userdata=heights.ravel())
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="land", pos=[0.0, 0.0, -10.0])
    body = spec.worldbody.add_body(name="table", pos=[0.0, 0.0, 0.1])
    body.add_freejoint()
    for foot in range(20):
        place = [0.2 * (foot % 5), 0.2 * (foot // 5), 0.0]
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0.0, 0.0], pos=place)
    model = spec.compile()
    assert simulated_maximum(model, 100, shake=0.0)[0] == 0
    assert required_capacity(model).contacts >= 60
