"""Shapes that Isaac Lab spawns without a model: their axis, cones, meshes, and shapes that touch nothing."""

import math

import mujoco
import pytest
import torch
from test_isaaclab_user_code import rover

from rlcli.envs.make import make_env
from rlcli.errors import ConfigError

torch.set_num_threads(1)
ROBOT = "    robot = ArticulationCfg("


def with_prop(folder, spawn, kind="RigidObjectCfg"):
    """Return the rover task with an object `prop` at 1 m; `spawn` is the text of its settings."""
    prop = (
        f"    prop = {kind}(prim_path='E/Prop', spawn=sim_utils.{spawn})\n    prop.init_state.pos = (3.0, 0.0, 1.0)\n"
    )
    return rover(folder, f"from isaaclab.assets import AssetBaseCfg, {kind}\n", [(ROBOT, prop + ROBOT)])


def model_of(resolved):
    env = make_env(resolved.with_num_envs(1), seed=0)
    env.reset()
    return env.world(0)[0]


RIGID = "rigid_props=sim_utils.RigidBodyPropertiesCfg()"
HARD = "collision_props=sim_utils.CollisionPropertiesCfg()"
SIZES = "radius=0.1, height=0.6"


@pytest.mark.parametrize(("axis", "expected"), [("X", (1.0, 0.0, 0.0)), ("Y", (0.0, 1.0, 0.0)), ("Z", (0.0, 0.0, 1.0))])
@pytest.mark.parametrize("kind", ["CylinderCfg", "CapsuleCfg", "ConeCfg", "MeshCylinderCfg", "MeshConeCfg"])
def test_axis_of_a_shape(tmp_path, kind, axis, expected):
    spawn = f"{kind}({SIZES}, axis='{axis}', {RIGID}, {HARD})"
    compiled = model_of(with_prop(tmp_path / "rover", spawn))
    geom = compiled.geom("prop/geom")
    turned, matrix = torch.zeros(3, dtype=torch.float64).numpy(), torch.zeros(9, dtype=torch.float64).numpy()
    if "Cone" in kind:  # MuJoCo turns a mesh into the frame of its inertia: compare the corner at the tip
        mesh = compiled.geom_dataid[geom.id]
        first, count = compiled.mesh_vertadr[mesh], compiled.mesh_vertnum[mesh]
        mujoco.mju_quat2Mat(matrix, geom.quat)
        corners = compiled.mesh_vert[first : first + count] @ matrix.reshape(3, 3).T + geom.pos
        tip = max(corners.tolist(), key=lambda corner: sum(a * b for a, b in zip(corner, expected, strict=True)))
        assert tip == pytest.approx([0.3 * value for value in expected], abs=1e-6)
        return
    mujoco.mju_rotVecQuat(turned, [0.0, 0.0, 1.0], geom.quat)
    assert turned.tolist() == pytest.approx(expected, abs=1e-9)
    assert geom.size.tolist()[:2] == [0.1, 0.3]


def test_mass_and_centre_of_a_cone(tmp_path):
    compiled = model_of(with_prop(tmp_path / "rover", f"ConeCfg({SIZES}, {RIGID}, {HARD})"))
    body = compiled.body("prop/body")
    assert body.mass[0] == pytest.approx(1000.0 * math.pi * 0.1**2 * 0.6 / 3.0, rel=1e-3)
    assert body.ipos.tolist() == pytest.approx([0.0, 0.0, -0.15], abs=1e-4)  # a quarter of the height above the base


@pytest.mark.parametrize(
    ("properties", "collides"),
    [("", False), (HARD, True), ("collision_props=sim_utils.CollisionPropertiesCfg(collision_enabled=False)", False)],
)
@pytest.mark.parametrize("kind", ["RigidObjectCfg", "AssetBaseCfg"])
def test_shape_collides_only_with_collision_properties(tmp_path, kind, properties, collides):
    rigid = f"{RIGID}, " if kind == "RigidObjectCfg" else ""
    resolved = with_prop(tmp_path / "rover", f"SphereCfg(radius=0.1, {rigid}{properties})", kind)
    geom = model_of(resolved).geom("prop/geom")
    assert (geom.contype[0], geom.conaffinity[0]) == (int(collides), int(collides))
    noted = [note for note in resolved.notes if note.key == "scene.prop.spawn.mass_props"]
    assert [note.status for note in noted] == ["approximated"] * (kind == "RigidObjectCfg" and not collides)


def test_soft_shape_is_refused_at_its_line(tmp_path):
    spawn = "MeshSphereCfg(radius=0.1, deformable_props=sim_utils.DeformableBodyPropertiesCfg())"
    with pytest.raises(ConfigError, match="rlcli simulates rigid bodies only") as caught:
        with_prop(tmp_path / "rover", spawn)
    assert "rover_env.py:" in str(caught.value)


def test_missing_model_names_the_option_that_gives_it(tmp_path):
    with pytest.raises(ConfigError, match=r"scene\.prop: no model") as caught:
        with_prop(tmp_path / "rover", "MultiUsdFileCfg(usd_path=None)")
    assert "--model prop=FILE.xml" in str(caught.value)
