"""USD calls of tasks on prims: drives, limits, masses, clones, references, joints and terrains act on the model."""

import math
import types

import mujoco
import numpy as np
import pytest
from stand_ins import body, geom, model

from rlcli.config.schema import SceneConfig, SimConfig
from rlcli.errors import ConfigError, TaskError
from rlcli.scene.scene import Scene
from rlcli_oige.scene_objects import Cloner, DynamicCuboid, Robot, XFormPrim
from rlcli_oige.stage import Stage, add_reference_to_stage, current_stage, get_prim_at_path
from rlcli_oige.usd_names import Gf, PhysxSchema, UsdGeom, UsdPhysics

ENV = "/World/envs/env_0"
DT = 0.01
SCENE = {"num_envs": 1, "ground": None, "entities": {}}


def arm():
    """An arm with a hinge, a slide and a gripper."""
    tool = body("tool", geom(mass=0.2), "0.1 0 0", "slide:reach", "1 0 0", "0 0.3")
    upper = body("upper", geom("0.1 0.02 0.02", 1.0, "0.1 0 0", "box") + tool, "0 0 0.4", "lift", "0 0 1", "-2 2")
    return model("arm", body("base", geom("0.1", 3.0) + upper))


@pytest.fixture
def stage(tmp_path):
    (tmp_path / "arm.xml").write_text(arm().replace(' armature="0.01" damping="0.05"', ""))
    (tmp_path / "box.xml").write_text(model("box", body("object", "<freejoint/>" + geom("0.05", 0.2))))
    grid = np.array([[3.0, 4.0, 0.0], [5.0, 4.0, 0.0]])
    rows = [types.SimpleNamespace(cpu=lambda row=row: types.SimpleNamespace(numpy=lambda: row)) for row in grid]
    with current_stage(Stage({"Arm": "arm.xml", "box_usd": "box.xml"}, tmp_path, rows)) as stage:
        yield stage


def compiled(stage, **sim):
    scene = Scene(
        SceneConfig.model_validate(SCENE, context={"open_scene": True}),
        SimConfig(dt=DT, gravity=(0.0, 0.0, 0.0), **sim),
        stage.root,
    )
    stage.attach(scene, joint_forces=False)
    found = scene.compile()
    return found, mujoco.MjData(found)


def drive(path, kind="angular", **values):
    api = UsdPhysics.DriveAPI.Apply(get_prim_at_path(path), kind)
    for name, value in values.items():
        getattr(api, f"Get{name}Attr")().Set(value)
    return api


@pytest.mark.parametrize(("stiffness", "damping"), [(0.5, 0.05), (400.0, 40.0), (0.0, 3.0), (7.0, 0.0)])
def test_drive_steps_like_an_implicit_one(stage, stiffness, damping):
    Robot(f"{ENV}/Arm", "arm")
    drive(f"{ENV}/Arm/base/lift", Stiffness=stiffness, Damping=damping)
    drive(f"{ENV}/Arm/upper/reach", "linear", Stiffness=1e7, Damping=1e6)  # it stays at 0
    found, data = compiled(stage)
    inertia = float(found.dof_M0[0]) - float(found.dof_armature[0])
    kp, kd = math.degrees(stiffness), math.degrees(damping)  # USD's stiffness is per degree
    target, q, v = (0.3 if kp else 0.7), 0.0, 0.2
    data.qvel[0], data.ctrl[0] = v, target
    for _ in range(20):
        mujoco.mj_step(found, data)
        force = kp * (target - q) - kd * v if kp else kd * (target - v)
        v += DT * (force - DT * kp * v) / (inertia + DT * kd + DT * DT * kp)
        q += DT * v
        assert data.qvel[0] == pytest.approx(v, rel=1e-5, abs=1e-8)
    assert data.qpos[0] == pytest.approx(q, rel=1e-5)


def test_drives_without_gains_and_with_limits(stage):
    Robot(f"{ENV}/Arm", "arm")
    drive(f"{ENV}/Arm/joints/reach", "linear", Stiffness=30.0, Damping=0.5, MaxForce=4.0)
    drive(f"{ENV}/Arm/lift", Stiffness=0.0, Damping=0.0)
    UsdPhysics.RevoluteJoint(get_prim_at_path(f"{ENV}/Arm/base/lift")).CreateLowerLimitAttr(-45.0)
    PhysxSchema.PhysxJointAPI.Get(stage, f"{ENV}/Arm/base/lift").CreateArmatureAttr().Set(0.3)
    found, _ = compiled(stage)
    assert found.nu == 1
    assert found.actuator_gainprm[0, 0] == 30.0  # not per degree
    assert found.actuator_forcerange[0].tolist() == [-4.0, 4.0]
    assert found.joint("Arm/lift").range[0] == pytest.approx(-math.pi / 4)
    assert found.dof_armature[0] == pytest.approx(0.3)
    assert not any("MaxForce" in name for name in stage.lost)


def test_stiff_drive_has_no_limit_and_says_so(stage):
    Robot(f"{ENV}/Arm", "arm")
    drive(f"{ENV}/Arm/base/lift", Stiffness=400.0, Damping=40.0, MaxForce=10.0)
    found, _ = compiled(stage)
    assert not found.actuator_forcelimited.any()
    assert any("MaxForce" in name for name in stage.lost)


def test_schemas_of_bodies(stage):
    Robot(f"{ENV}/Arm", "arm")
    links = stage.GetPrimAtPath(f"{ENV}/Arm").GetChildren()
    assert [link.GetName() for link in links] == ["base", "upper", "tool"]
    assert all(link.HasAPI(PhysxSchema.PhysxRigidBodyAPI) for link in links)
    assert not any(link.HasAPI(UsdPhysics.DriveAPI) for link in links)
    (joint,) = links[0].GetChildren()
    assert not joint.HasAPI(UsdPhysics.DriveAPI)
    UsdPhysics.DriveAPI.Apply(joint, "angular").CreateStiffnessAttr(1.0)
    assert joint.HasAPI(UsdPhysics.DriveAPI)
    PhysxSchema.PhysxRigidBodyAPI.Get(stage, links[1].GetPrimPath()).GetDisableGravityAttr().Set(True)
    UsdPhysics.MassAPI.Apply(links[2]).CreateMassAttr(0.7)
    found, _ = compiled(stage)
    assert found.body_gravcomp.tolist() == [0.0, 0.0, 1.0, 0.0]
    assert found.body("Arm/tool").mass[0] == pytest.approx(0.7)


def test_prims_that_do_not_exist_are_invalid(stage):
    Robot(f"{ENV}/Arm", "arm")
    assert not stage.GetPrimAtPath("/allegro/Looks").IsValid()
    assert not stage.GetPrimAtPath(f"{ENV}/Arm/elbow")
    assert stage.GetPrimAtPath(f"{ENV}/Arm/upper")
    with pytest.raises(TaskError, match="no joint 'elbow'"):
        drive(f"{ENV}/Arm/base/elbow", Stiffness=1.0)
    with pytest.raises(TaskError, match="no prim at"):
        get_prim_at_path(f"{ENV}/Leg")


def test_referenced_object_gets_its_model_and_pose(stage):
    add_reference_to_stage("/Isaac/Props/box_usd.usd", f"{ENV}/object")
    prim = XFormPrim(f"{ENV}/object/object", "object", translation=(1.0, 2.0, 3.0))
    prim.prim.settings["make_kinematic"] = True
    found, data = compiled(stage)
    mujoco.mj_forward(found, data)
    assert data.body("object/object").xpos.tolist() == [1.0, 2.0, 3.0]
    assert found.body("object/object").mocapid[0] == 0
    add_reference_to_stage("/Isaac/Props/other.usd", f"{ENV}/other")
    with pytest.raises(ConfigError, match=r"other.usd'; give an MJCF file: --model other=FILE.xml"):
        XFormPrim(f"{ENV}/other", "other")


def test_cloner_copies_shapes_inside_an_environment(stage):
    DynamicCuboid(f"{ENV}/prop/prop_0", "prop", size=0.1, density=100.0)
    places = np.array([[0.0, 0.0, 1.0], [0.0, 0.5, 1.0], [0.0, 1.0, 1.0]])
    Cloner().clone(f"{ENV}/prop/prop_0", [f"{ENV}/prop/prop_{n}" for n in range(3)], positions=places)
    found, data = compiled(stage)
    mujoco.mj_forward(found, data)
    assert data.xpos[1:].tolist() == places.tolist()
    assert found.body_mass[1:].tolist() == pytest.approx([0.1] * 3)
    with pytest.raises(TaskError, match="copies prims only inside"):
        Cloner().clone(ENV, ["/World/envs/env_1"])


def test_world_pose_of_a_link_has_the_position_of_its_environment(stage):
    Robot(f"{ENV}/Arm", "arm", translation=(1.0, 0.0, 0.0), orientation=(0.0, 0.0, 0.0, 1.0))
    pose = UsdGeom.Xformable(stage.GetPrimAtPath(f"{ENV}/Arm/tool")).ComputeLocalToWorldTransform(0)
    assert pose.ExtractTranslation() == pytest.approx([3.0 + 1.0 - 0.1, 4.0, 0.4])
    quat = pose.ExtractRotationQuat()
    assert [quat.real, *quat.imaginary] == pytest.approx([0.0, 0.0, 0.0, 1.0])


def tie(stage, env, offset, axes=("transX", "transY", "transZ")):
    joint = UsdPhysics.Joint.Define(stage, f"/World/envs/env_{env}/Arm/upper_ground")
    joint.CreateBody0Rel().SetTargets(["/World/defaultGroundPlane"])
    joint.CreateBody1Rel().SetTargets([f"/World/envs/env_{env}/Arm/upper"])
    place = stage.GetPrimAtPath(f"/World/envs/env_{env}").GetAttribute("xformOp:translate").Get()
    joint.CreateLocalPos0Attr().Set(place + Gf.Vec3d(*offset))
    joint.CreateLocalPos1Attr().Set(Gf.Vec3f(0.2, 0, 0))
    for axis in axes:
        limit = UsdPhysics.LimitAPI.Apply(stage.GetPrimAtPath(f"/World/envs/env_{env}/Arm/upper_ground"), axis)
        limit.CreateLowAttr(1.0)
        limit.CreateHighAttr(-1.0)


def test_joint_to_the_ground_is_a_constraint(stage):
    Robot(f"{ENV}/Arm", "arm")
    for env in (0, 1):
        tie(stage, env, (0.0, 0.2, 0.4))
    found, data = compiled(stage)
    assert found.neq == 1
    for _ in range(300):
        mujoco.mj_step(found, data)
    assert data.qpos[0] == pytest.approx(math.pi / 2, abs=0.05)


@pytest.mark.parametrize("axes", [("transX", "transY"), ()])
def test_other_joints_are_refused(stage, axes):
    Robot(f"{ENV}/Arm", "arm")
    tie(stage, 0, (0.0, 0.2, 0.4), axes)
    with pytest.raises(TaskError, match="no counterpart: only a joint that locks"):
        compiled(stage)


def mesh(stage, heights, cell, shift=0.0):
    rows, columns = heights.shape
    x, y = np.meshgrid(np.arange(rows) * cell, np.arange(columns) * cell, indexing="ij")
    x[2, 2] += shift
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1)
    faces = [(i, i + columns + 1, i + 1, i, i + columns, i + columns + 1) for i in first]
    prim = stage.DefinePrim("/World/terrain", "Mesh")
    prim.GetAttribute("points").Set(np.stack([x, y, heights], axis=-1).reshape(-1, 3))
    prim.GetAttribute("faceVertexIndices").Set(np.array(faces).reshape(-1))
    XFormPrim("/World/terrain", "terrain", position=(-1.0, -2.0, 0.0))
    UsdPhysics.CollisionAPI.Apply(prim)


def test_terrain_mesh_is_a_height_field(stage):
    heights = np.random.default_rng(0).uniform(-0.2, 0.3, (9, 14))
    mesh(stage, heights, 0.5)
    found, data = compiled(stage)
    mujoco.mj_forward(found, data)
    for row, column in [(1, 1), (4, 9), (7, 2)]:
        start = np.array([0.5 * row - 1.0, 0.5 * column - 2.0, 5.0])
        hit = mujoco.mj_ray(found, data, start, np.array([0.0, 0.0, -1.0]), None, 1, -1, np.zeros(1, np.int32), None)
        assert start[2] - hit == pytest.approx(heights[row, column], abs=1e-4)
    assert not stage.lost


def test_walls_are_reported_and_other_meshes_refused(stage):
    mesh(stage, np.zeros((9, 14)), 0.5, shift=0.4)
    compiled(stage)
    assert any("vertical walls" in name for name in stage.lost)
    mesh(stage, np.zeros((9, 14)), 0.5, shift=0.9)
    with pytest.raises(TaskError, match="not a grid of heights"):
        compiled(stage)
