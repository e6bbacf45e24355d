"""A task with legs, commands, noise, pushes and a curriculum as written for Isaac Lab."""

import pytest
import torch
from support.worlds import CRITTER

from rlcli.config.dump import to_data
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli.registry import find_task

torch.set_num_threads(1)

TASK = """
import math

from rlcli_isaaclab import sim_utils
from rlcli_isaaclab import (
    AdditiveUniformNoiseCfg as Unoise, ArticulationCfg, CurrTerm, DCMotorCfg, DoneTerm, EventTerm, ImplicitActuatorCfg,
    InteractiveSceneCfg, ManagerBasedRLEnvCfg, ObsGroup, ObsTerm, RewTerm, SceneEntityCfg, TerrainImporterCfg,
    configclass, mdp,
)

CRITTER_CFG = ArticulationCfg(
    spawn=sim_utils.UsdFileCfg(usd_path="critter.xml"),
    init_state=ArticulationCfg.InitialStateCfg(
        pos=(0.0, 0.0, 0.4), joint_pos={"hip_f[lr]": 0.2, "hip_b.*": -0.2}, joint_vel={".*": 0.0}
    ),
    soft_joint_pos_limit_factor=0.9,
    actuators={
        "legs": ImplicitActuatorCfg(
            joint_names_expr=["hip_.*"], effort_limit_sim=8.0, stiffness=20.0, damping=0.5, armature=0.02
        )
    },
)


def command_of(env, command_name: str):
    return env.command_manager.get_command(command_name)


def level(env, env_ids, gain: float):
    return gain * len(env_ids)


@configclass
class SceneCfg(InteractiveSceneCfg):
    terrain = TerrainImporterCfg(
        prim_path="/World/ground", terrain_type="plane",
        physics_material=sim_utils.RigidBodyMaterialCfg(static_friction=0.8, dynamic_friction=0.8),
    )
    robot: ArticulationCfg = CRITTER_CFG.replace(prim_path="{ENV_REGEX_NS}/Robot")
    sun = None


@configclass
class CommandsCfg:
    base_velocity = mdp.UniformVelocityCommandCfg(
        asset_name="robot", resampling_time_range=(5.0, 8.0), rel_standing_envs=0.02, rel_heading_envs=1.0,
        heading_command=True, heading_control_stiffness=0.5, debug_vis=True,
        ranges=mdp.UniformVelocityCommandCfg.Ranges(
            lin_vel_x=(-1.0, 1.0), lin_vel_y=(-0.5, 0.5), ang_vel_z=(-1.0, 1.0), heading=(-math.pi, math.pi)
        ),
    )


@configclass
class ActionsCfg:
    joint_pos = mdp.JointPositionActionCfg(
        asset_name="robot", joint_names=["hip_b.*", "hip_f.*"], scale={"hip_f.*": 0.5, "hip_b.*": 0.25},
        use_default_offset=True,
    )


@configclass
class ObservationsCfg:
    @configclass
    class PolicyCfg(ObsGroup):
        ang_vel = ObsTerm(func=mdp.base_ang_vel, noise=Unoise(n_min=-0.2, n_max=0.2), clip=(-10, 10))
        gravity = ObsTerm(func=mdp.projected_gravity)
        command = ObsTerm(func=command_of, params={"command_name": "base_velocity"})
        joint_pos = ObsTerm(func=mdp.joint_pos_rel, noise=Unoise(n_min=-0.01, n_max=0.01), scale=2.0)
        actions = ObsTerm(func=mdp.last_action, history_length=2)

        def __post_init__(self):
            self.enable_corruption = CORRUPT
            self.concatenate_terms = True

    @configclass
    class CriticCfg(PolicyCfg):
        lin_vel = ObsTerm(func=mdp.base_lin_vel)

    policy: PolicyCfg = PolicyCfg()
    critic: CriticCfg = CriticCfg()


@configclass
class EventCfg:
    base = EventTerm(
        func=mdp.reset_root_state_uniform, mode="reset",
        params={"pose_range": {"x": (-0.5, 0.5), "yaw": (-3.14, 3.14)}, "velocity_range": {"x": (-0.1, 0.1)}},
    )
    joints = EventTerm(
        func=mdp.reset_joints_by_scale, mode="reset",
        params={"position_range": (0.5, 1.5), "velocity_range": (0.0, 0.0)},
    )
    push = EventTerm(
        func=mdp.push_by_setting_velocity, mode="interval", interval_range_s=(1.0, 2.0),
        params={"velocity_range": {"x": (-0.5, 0.5), "y": (-0.5, 0.5)}},
    )


@configclass
class RewardsCfg:
    flat = RewTerm(func=mdp.flat_orientation_l2, weight=-2.0)
    rate = RewTerm(func=mdp.action_rate_l2, weight=-0.01)
    acc = RewTerm(
        func=mdp.joint_acc_l2, weight=-2.5e-7,
        params={"asset_cfg": SceneEntityCfg("robot", joint_names=["hip_.*"])},
    )
    removed = None


@configclass
class TerminationsCfg:
    time_out = DoneTerm(func=mdp.time_out, time_out=True)
    low = DoneTerm(func=mdp.root_height_below_minimum, params={"minimum_height": 0.1})


@configclass
class CurriculumCfg:
    flat = CurrTerm(func=mdp.modify_reward_weight, params={"term_name": "rate", "weight": -0.05, "num_steps": 5})
    level = CurrTerm(func=level, params={"gain": 2.0})


@configclass
class Cfg(ManagerBasedRLEnvCfg):
    scene: SceneCfg = SceneCfg(num_envs=4, env_spacing=2.5)
    observations: ObservationsCfg = ObservationsCfg()
    actions: ActionsCfg = ActionsCfg()
    commands: CommandsCfg = CommandsCfg()
    rewards: RewardsCfg = RewardsCfg()
    terminations: TerminationsCfg = TerminationsCfg()
    events: EventCfg = EventCfg()
    curriculum: CurriculumCfg = CurriculumCfg()

    def __post_init__(self):
        self.decimation = 4
        self.episode_length_s = 20.0
        self.sim.dt = 0.005
        self.sim.render_interval = self.decimation
"""


@pytest.fixture
def velocity(tmp_path):
    """Return velocity(*changes) -> source of the task; each change is a pair (old text, new text)."""
    number = iter(range(10))

    def make(*changes, corrupt=True):
        text = TASK.replace("CORRUPT", str(corrupt))
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "critter.xml").write_text(CRITTER)
        file = tmp_path / f"velocity_{next(number)}.py"
        file.write_text(text)
        return find_task(f"{file}:Cfg")

    return make


def test_every_section_is_translated(velocity):
    data = to_data(resolve(velocity()))
    robot = data["scene"]["entities"]["robot"]
    legs = {key: value for key, value in robot["joints"]["hip_.*"].items() if value is not None}
    assert legs == {"actuator": "position", "kp": 20.0, "kv": 0.5, "armature": 0.02, "effort_limit": 8.0}
    assert robot["init"]["joint_pos"] == {"hip_f[lr]": 0.2, "hip_b.*": -0.2}
    assert robot["soft_joint_pos_limit_factor"] == 0.9
    assert data["scene"]["ground"]["friction"] == 0.8
    command = data["commands"]["base_velocity"]
    assert (command["func"], command["resampling_time_s"]) == ("uniform_velocity", [5.0, 8.0])
    assert (command["rel_standing"], command["heading_stiffness"]) == (0.02, 0.5)
    assert command["heading"] == pytest.approx([-3.14159265, 3.14159265])
    action = data["actions"]["joint_pos"]
    assert action["joints"] == ["hip_fl", "hip_fr", "hip_bl", "hip_br"]  # the model's order
    assert action["scale"] == {"hip_f.*": 0.5, "hip_b.*": 0.25}
    policy = data["observations"]["policy"]
    assert policy["ang_vel"]["noise"] == {"operation": "add", "kind": "uniform", "low": -0.2, "high": 0.2}
    assert policy["actions"]["history"] == 2
    assert list(data["observations"]["critic"])[-1] == "lin_vel"
    assert data["events"]["push"]["linear_velocity"] == [[-0.5, 0.5], [-0.5, 0.5], [0.0, 0.0]]
    assert list(data["rewards"]) == ["flat", "rate", "acc"]
    assert data["curriculum"]["flat"]["address"] == "rewards.rate.weight"


def test_task_runs_and_curriculum_acts(velocity):
    env = make_env(resolve(velocity(("self.episode_length_s = 20.0", "self.episode_length_s = 1.0"))))
    obs = env.reset(seed=0)
    assert obs["policy"].shape == (4, 3 + 3 + 3 + 4 + 2 * 4)
    assert obs["critic"].shape == (4, 3 + 3 + 3 + 4 + 2 * 4 + 3)
    generator = torch.Generator().manual_seed(0)
    for _ in range(120):
        step = env.step(torch.randn(4, 4, generator=generator))
        assert step.obs["critic"].isfinite().all()
    assert env.extras()["Curriculum/flat"] == pytest.approx(-0.05)
    assert env.extras()["Curriculum/level"] in (2.0, 4.0, 6.0, 8.0)  # 2 for each environment that ended last


def test_preserve_order_keeps_written_order(velocity):
    change = ("use_default_offset=True,", "use_default_offset=True, preserve_order=True,")
    env = make_env(resolve(velocity(change)))
    assert list(env.action_manager.terms[0].instance.elements) == ["hip_bl", "hip_br", "hip_fl", "hip_fr"]


def test_observations_without_corruption_are_exact(velocity):
    env = make_env(resolve(velocity(corrupt=False)))
    obs = env.reset(seed=0)["policy"]
    data = env.entities["robot"].data
    assert torch.equal(obs[:, :3], data.root_ang_vel_b)
    assert torch.equal(obs[:, 9:13], 2.0 * (data.joint_pos - data.default_joint_pos))


def test_dc_motor_becomes_actuator_model(velocity):
    motor = ("ImplicitActuatorCfg(\n", "DCMotorCfg(saturation_effort=12.0, velocity_limit=20.0,\n")
    limit = ("effort_limit_sim=8.0", "effort_limit=8.0")
    env = make_env(resolve(velocity(motor, limit)))
    made = env.config.scene.entities["robot"].actuators["legs"]
    assert (made.kind, made.saturation_effort, made.velocity_limit, made.effort_limit) == ("dc_motor", 12.0, 20.0, 8.0)
    env.reset(seed=0)
    assert env.step(torch.zeros(4, 4)).reward.isfinite().all()


def test_unknown_command_or_reward_is_named(velocity):
    with pytest.raises(ConfigError, match="base_veloc"):
        make_env(resolve(velocity(('{"command_name": "base_velocity"}', '{"command_name": "base_veloc"}'))))
    with pytest.raises(ConfigError, match=r"rewards\.rat"):
        make_env(resolve(velocity(('"term_name": "rate"', '"term_name": "rat"'))))


SENSORS = """
    contact = ContactSensorCfg(prim_path="{ENV_REGEX_NS}/Robot/leg_.*", history_length=3, track_air_time=True)
    scan = RayCasterCfg(
        prim_path="{ENV_REGEX_NS}/Robot/torso", offset=RayCasterCfg.OffsetCfg(pos=(0.0, 0.0, 20.0)),
        ray_alignment="yaw", pattern_cfg=patterns.GridPatternCfg(resolution=0.1, size=[0.4, 0.2]),
        mesh_prim_paths=["/World/ground"],
    )
    ball = RigidObjectCfg(
        prim_path="{ENV_REGEX_NS}/Ball",
        spawn=sim_utils.SphereCfg(
            radius=0.1, rigid_props=sim_utils.RigidBodyPropertiesCfg(), mass_props=sim_utils.MassPropertiesCfg(mass=0.5)
        ),
        init_state=RigidObjectCfg.InitialStateCfg(pos=(3.0, 0.0, 2.0)),
    )
    sun = None
"""
OWN = """

def touched(env, sensor_cfg: SceneEntityCfg, threshold: float):
    sensor = env.scene.sensors[sensor_cfg.name]
    forces = sensor.data.net_forces_w_history[:, :, sensor_cfg.body_ids].norm(dim=-1)
    air = sensor.data.current_air_time[:, sensor_cfg.body_ids]
    assert forces.shape[1:] == (3, 2)
    assert air.shape[1] == 2
    return (forces.max(dim=1)[0] > threshold).sum(dim=1).float()


def scanned(env, sensor_cfg: SceneEntityCfg):
    sensor = env.scene[sensor_cfg.name]
    return sensor.data.pos_w[:, 2:3] - sensor.data.ray_hits_w[..., 2]


def ball_height(env, asset_cfg: SceneEntityCfg = SceneEntityCfg("ball")):
    return env.scene[asset_cfg.name].data.root_pos_w[:, 2:3]


def level("""
FINE = (
    ("ImplicitActuatorCfg,\n", "ImplicitActuatorCfg, ContactSensorCfg, RayCasterCfg, RigidObjectCfg, patterns,\n"),
    ("    sun = None\n", SENSORS),
    ("\n\ndef level(", OWN),
    (
        "    removed = None",
        '    touched = RewTerm(func=touched, weight=1.0, params={"threshold": 0.01, "sensor_cfg":'
        ' SceneEntityCfg("contact", body_names="leg_f.*")})',
    ),
    (
        "        gravity = ObsTerm(",
        '        ball = ObsTerm(func=ball_height)\n        scan = ObsTerm(func=scanned, params={"sensor_cfg":'
        ' SceneEntityCfg("scan")})\n        gravity = ObsTerm(',
    ),
)


def test_terms_read_sensors_and_objects(velocity):
    env = make_env(resolve(velocity(*FINE)))
    obs = env.reset(seed=0)["policy"]
    assert torch.equal(obs[:, 3:4], torch.full((4, 1), 2.0))  # the ball, before it falls
    assert torch.allclose(obs[:, 4:19].mean(dim=1), env.entities["robot"].data.root_pos_w[:, 2] + 20.0, atol=1e-4)
    rewards = []
    for _ in range(40):
        step = env.step(torch.zeros(4, 4))
        rewards.append(env.reward_manager._values[-1].clone())
    fallen = step.obs["policy"][:, 3]
    assert float(fallen.max()) < 2.0 - 0.1
    assert float(torch.stack(rewards).max()) == pytest.approx(2.0 * env.step_dt)  # both front feet on the ground


def test_terrain_generator_keeps_sub_terrains(velocity):
    generator = (
        'terrain_type="generator", max_init_terrain_level=1, terrain_generator=TerrainGeneratorCfg(size=(4.0, 4.0),'
        ' border_width=2.0, num_rows=3, num_cols=2, curriculum=True, sub_terrains={"slope":'
        " terrains.HfPyramidSlopedTerrainCfg(proportion=0.4, slope_range=(0.0, 0.3), platform_width=1.5),"
        ' "rough": terrains.HfRandomUniformTerrainCfg(proportion=0.6, noise_range=(0.01, 0.05), noise_step=0.01,'
        " border_width=0.25)})"
    )
    imports = ("TerrainImporterCfg,\n", "TerrainGeneratorCfg, TerrainImporterCfg, terrains,\n")
    task = resolve(velocity(imports, ('terrain_type="plane"', generator)))
    terrain = task.task.scene.terrain
    assert task.task.scene.ground is None
    assert (terrain.rows, terrain.columns, terrain.patch, terrain.max_start_level) == (3, 2, (4.0, 4.0), 1)
    assert terrain.friction == 0.8
    slope, rough = terrain.sub_terrains["slope"], terrain.sub_terrains["rough"]
    assert (slope.kind, slope.proportion, slope.slope, slope.platform) == ("slope", 0.4, (0.0, 0.3), 1.5)
    assert (rough.kind, rough.spacing, rough.border, slope.border) == ("noise", 0.1, 0.25, 0.0)
    assert rough.height == pytest.approx((0.02, 0.02))  # 4 cm between the extremes, at every difficulty
    notes = {note.key: (note.status, note.text) for note in task.notes}
    generator = "scene.terrain.terrain_generator"
    assert notes[f"{generator}.slope_threshold"][0] == "approximated"
    assert notes[f"{generator}.sub_terrains.rough.noise_range"][0] == "approximated"
    env = make_env(task)
    env.reset(seed=0)
    assert env.step(torch.zeros(4, 4)).reward.isfinite().all()
