"""Classes of a task that derive from Isaac Lab's: what runs, what is reported, and what is refused with its place."""

import numpy as np
import pytest
import torch
from test_isaaclab_packages import stepped
from test_isaaclab_user_code import rover

from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli_isaaclab.config_class import configclass
from rlcli_isaaclab.controllers import DifferentialIKController, DifferentialIKControllerCfg

torch.set_num_threads(1)
ACTIONS = "@configclass\nclass Actions:"
TERRAINS = "from isaaclab.terrains import TerrainImporter, TerrainImporterCfg\n"
GROUND = "prim_path='/World/ground', terrain_type='plane'"


def scene(folder, code, member):
    return rover(folder / "task", code, [(ACTIONS, f"    {member}\n\n{ACTIONS}")])


def note_of(resolved, key):
    (note,) = [note for note in resolved.notes if note.key == key]
    return note.status, note.text


def test_own_terrain_importer_is_read_as_a_terrain_importer(tmp_path):
    code = f"""{TERRAINS}
class Moon(TerrainImporter):
    def __init__(self, cfg):
        super().__init__(cfg)
        self.dust = 1

@configclass
class MoonCfg(TerrainImporterCfg):
    class_type: type = Moon
"""
    resolved = scene(tmp_path, code, f"ground = MoonCfg({GROUND})")
    stepped(resolved)
    status, why = note_of(resolved, "scene.ground.class_type")
    assert status == "approximated"
    assert why.startswith("read as TerrainImporter; ")
    assert why.endswith("rover_env.py:15: scene.ground: rlcli does not run the method __init__ of the class Moon")


def test_own_articulation_is_read_as_an_articulation(tmp_path):
    code = """
from isaaclab.assets import Articulation

class Kite(Articulation):
    def lift(self):
        return self.data.root_lin_vel_b[:, 2]
"""
    path = '        prim_path="{ENV_REGEX_NS}/Robot",'
    resolved = rover(tmp_path / "task", code, [(path, f"{path} class_type=Kite,")])
    stepped(resolved)
    assert note_of(resolved, "scene.robot.class_type")[0] == "approximated"


@pytest.mark.parametrize(
    ("base", "settings"),
    [
        ("ContactSensor", "prim_path='{ENV_REGEX_NS}/Robot/.*'"),
        (
            "RayCaster",
            "prim_path='{ENV_REGEX_NS}/Robot/base', mesh_prim_paths=['/World/ground'],"
            " pattern_cfg=patterns.GridPatternCfg(resolution=0.1, size=(0.4, 0.4))",
        ),
    ],
)
def test_own_sensor_is_read_as_its_base_class(tmp_path, base, settings):
    code = f"""{TERRAINS}
from isaaclab.sensors import {base}, {base}Cfg, patterns

class Gauge({base}):
    def _update_buffers_impl(self, env_ids):
        super()._update_buffers_impl(env_ids)

@configclass
class GaugeCfg({base}Cfg):
    class_type: type = Gauge
"""
    ground = f"ground = TerrainImporterCfg({GROUND})"
    resolved = scene(tmp_path, code, f"{ground}\n    gauge = GaugeCfg({settings})")
    env, _ = stepped(resolved)
    assert "gauge" in env.sensors
    status, why = note_of(resolved, "scene.gauge.class_type")
    assert status == "approximated"
    assert why.startswith(f"read as {base}; ")
    assert why.endswith("scene.gauge: rlcli does not run the method _update_buffers_impl of the class Gauge")


def test_class_that_derives_from_a_term_is_refused_where_it_is_used(tmp_path):
    code = """
class Mass(mdp.randomize_rigid_body_mass):
    pass
"""
    mass = "EventTermCfg(func=Mass, mode='startup', params={'asset_cfg': SceneEntityCfg('robot')})"
    stepped(rover(tmp_path / "unused", code))
    with pytest.raises(ConfigError) as caught:
        rover(tmp_path / "used", code, events={"mass": mass})
    (problem,) = caught.value.problems
    assert "a subclass of mdp.randomize_rigid_body_mass cannot be used" in problem.message
    assert problem.hint == "use the term itself, or derive from ManagerTermBase"
    assert "rover_env.py:" in str(problem)


def shifted(data):
    return data + 1.0


@configclass
class BaseCfg:
    func: object = None
    other: int = 1


@configclass
class DerivedCfg(BaseCfg):
    func = shifted

    def method(self):
        return 3


def test_function_without_annotation_replaces_the_default_of_a_base_class():
    cfg = DerivedCfg()
    assert cfg.func is shifted
    assert cfg.method() == 3
    assert "method" not in cfg.to_dict()


GENERATOR = np.random.default_rng(28)
JACOBIAN = GENERATOR.normal(size=(5, 6, 7))
JOINTS, START = GENERATOR.normal(size=(5, 7)), GENERATOR.normal(size=(5, 3))


def changes(method, rows):
    """Return the change of the joints for an error of 0.1 m along x, by formulas of numpy. (5, 7)"""
    found = []
    for matrix in JACOBIAN[:, :rows]:
        error = np.zeros(rows)
        error[0] = 0.1
        if method == "dls":
            found.append(matrix.T @ np.linalg.inv(matrix @ matrix.T + 0.01**2 * np.eye(rows)) @ error)
        else:
            found.append((matrix.T if method == "trans" else np.linalg.pinv(matrix)) @ error)
    return np.array(found)


@pytest.mark.parametrize("command_type", ["position", "pose"])
@pytest.mark.parametrize("relative", [True, False])
@pytest.mark.parametrize("method", ["dls", "pinv", "svd", "trans"])
def test_controller_of_inverse_kinematics_has_the_formulas_of_its_method(command_type, relative, method):
    cfg = DifferentialIKControllerCfg(command_type=command_type, use_relative_mode=relative, ik_method=method)
    controller = DifferentialIKController(cfg, 5, "cpu")
    start = torch.tensor(START, dtype=torch.float32)
    quat = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(5, 1)
    moved = torch.tensor([0.1, 0.0, 0.0])
    parts = [moved.expand(5, 3) if relative else start + moved]
    if command_type == "pose":
        parts.append(torch.zeros(5, 3) if relative else quat)
    command = torch.cat(parts, dim=1)
    assert controller.action_dim == command.shape[1]
    controller.set_command(command, start, quat)
    jacobian, joints = (torch.tensor(values, dtype=torch.float32) for values in (JACOBIAN, JOINTS))
    found = controller.compute(start, quat, jacobian, joints) - joints
    expected = torch.tensor(changes(method, 3 if command_type == "position" else 6), dtype=torch.float32)
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-4)


def test_controller_names_unknown_methods():
    with pytest.raises(Exception, match="unknown command_type 'pose' or ik_method 'newton'"):
        DifferentialIKController(DifferentialIKControllerCfg(command_type="pose", ik_method="newton"), 2, "cpu")


def test_image_with_a_further_dimension_is_an_image(tmp_path):
    code = """
def image(env):
    return torch.ones(env.num_envs, 4, 5, 1, 1)
"""
    velocity = "velocity = ObservationTermCfg(func=mdp.base_lin_vel)"
    env, _ = stepped(rover(tmp_path / "task", code, [(velocity, "image = ObservationTermCfg(func=image)")]))
    assert env.layout.observations["policy"][0].shape == (4, 5, 1)


@pytest.mark.slow
def test_camera_of_rays_is_rendered(tmp_path):
    code = f"""{TERRAINS}
from isaaclab.sensors import RayCasterCameraCfg, patterns

def seen(env):
    return env.scene["eye"].data.output["distance_to_image_plane"].flatten(1)
"""
    eye = (
        "eye = RayCasterCameraCfg(prim_path='{ENV_REGEX_NS}/Robot/base', mesh_prim_paths=['/World/ground'],"
        " offset=RayCasterCameraCfg.OffsetCfg("
        "pos=(0.0, 0.0, -0.2), rot=(0.7071068, 0.0, 0.7071068, 0.0), convention='world'),"
        " pattern_cfg=patterns.PinholeCameraPatternCfg(width=8, height=6))"
    )
    path = '        prim_path="{ENV_REGEX_NS}/Robot",'
    high = f"{path}\n        init_state=ArticulationCfg.InitialStateCfg(pos=(0.0, 0.0, 1.2)),"
    members = f"    {eye}\n    ground = TerrainImporterCfg({GROUND})\n\n{ACTIONS}"
    resolved = rover(
        tmp_path / "task", code, [(ACTIONS, members), ("func=mdp.base_lin_vel", "func=seen"), (path, high)]
    )
    assert note_of(resolved, "scene.eye.mesh_prim_paths")[0] == "approximated"
    env = make_env(resolved, seed=0)
    torch.testing.assert_close(env.reset()["policy"], torch.ones(4, 48), rtol=0.0, atol=0.01)


def test_ray_sensor_has_the_orientation_of_its_body(tmp_path):
    code = f"""{TERRAINS}
from isaaclab.sensors import RayCasterCfg, patterns

def difference(env):
    return env.scene["rays"].data.quat_w - env.scene["robot"].data.root_quat_w
"""
    rays = (
        "rays = RayCasterCfg(prim_path='{ENV_REGEX_NS}/Robot/base', mesh_prim_paths=['/World/ground'],"
        " pattern_cfg=patterns.GridPatternCfg(resolution=0.1, size=(0.4, 0.4)))"
    )
    members = f"    {rays}\n    ground = TerrainImporterCfg({GROUND})\n\n{ACTIONS}"
    resolved = rover(tmp_path / "task", code, [(ACTIONS, members), ("func=mdp.base_lin_vel", "func=difference")])
    _, result = stepped(resolved)
    assert not result.obs["policy"].any()


def test_gains_of_joints_after_an_event(tmp_path):
    code = """
def scale(env):
    data = env.scene["robot"].data
    pairs = ((data.joint_stiffness, data.default_joint_stiffness), (data.joint_damping, data.default_joint_damping))
    return torch.cat([value[:, :1] / default[:, :1] for value, default in pairs], dim=1)
"""
    params = (
        "{'asset_cfg': SceneEntityCfg('robot', joint_names=['arm']), 'operation': 'scale',"
        " 'stiffness_distribution_params': (1.5, 1.5), 'damping_distribution_params': (0.5, 0.5)}"
    )
    gains = f"EventTermCfg(func=mdp.randomize_actuator_gains, mode='startup', params={params})"
    replaced = [("func=mdp.base_lin_vel", "func=scale")]
    _, result = stepped(rover(tmp_path / "task", code, replaced, events={"gains": gains}))
    torch.testing.assert_close(
        result.obs["policy"], torch.tensor([[1.5, 0.6 / 1.1]]).expand(4, 2)
    )  # the MJCF has damping 0.1


def test_unknown_data_of_an_asset_has_a_place(tmp_path):
    code = """
def wrong(env):
    return env.scene["robot"].data.joint_warmth
"""
    with pytest.raises(Exception, match=r"rover_env\.py:15: asset\.data has no 'joint_warmth'"):
        stepped(rover(tmp_path / "task", code, [("func=mdp.base_lin_vel", "func=wrong")]))
