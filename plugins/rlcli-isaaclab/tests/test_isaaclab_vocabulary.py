"""Isaac Lab's terms with Isaac Lab's parameters: each maps to its built-in term, and all run in one environment."""

import re
from pathlib import Path

import pytest
import torch
from support.mdp_worlds import FILES

import rlcli
from rlcli.config.dump import to_data
from rlcli.config.load import resolve
from rlcli.config.python_task import source_of
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError
from rlcli_isaaclab import (
    ArticulationCfg,
    ContactSensorCfg,
    CurrTerm,
    DCMotorCfg,
    DoneTerm,
    EventTerm,
    ImplicitActuatorCfg,
    InteractiveSceneCfg,
    ManagerBasedRLEnvCfg,
    ObsGroup,
    ObsTerm,
    RayCasterCfg,
    RewTerm,
    RigidObjectCfg,
    TerrainImporterCfg,
    configclass,
    mdp,
    patterns,
    sim_utils,
)
from rlcli_isaaclab import SceneEntityCfg as Pick
from rlcli_isaaclab.lab_terms import LAB_TERMS
from rlcli_isaaclab.randomization import EVENTS

torch.set_num_threads(1)

PAGE = Path(rlcli.__path__[0]).parent / "docs" / "reference" / "isaac-lab-terms.md"
LEGS = {"asset_cfg": Pick("robot", joint_names=["hip_.*"])}
TORSO = {"asset_cfg": Pick("robot", body_names="torso")}
FEET = {"asset_cfg": Pick("robot", body_names="leg_.*"), "sensor_cfg": Pick("contact_forces", body_names="leg_.*")}
GRIP = {"asset_cfg": Pick("arm", site_names="grip")}
HAND = {"asset_cfg": Pick("arm", body_names="fore"), "command_name": "hand"}
THING = {"robot_cfg": Pick("robot"), "object_cfg": Pick("object")}
GOAL = {"command_name": "hand", "object_cfg": Pick("object")}
VELOCITY = {"command_name": "base_velocity"}
LEVER = {"asset_cfg": Pick("cabinet", joint_names=["slide"])}
OURS = {"handle": "handle"}
"""Constants in the code of Isaac Lab's terms, which are written for one scene."""

OBSERVATIONS = {
    "base_pos_z": {}, "base_lin_vel": {}, "base_ang_vel": {}, "projected_gravity": {}, "root_pos_w": {},
    "root_quat_w": {"make_quat_unique": True}, "root_lin_vel_w": {}, "root_ang_vel_w": {},
    "body_pose_w": TORSO, "body_projected_gravity_b": TORSO, "joint_pos": LEGS, "joint_vel": LEGS,
    "joint_pos_rel": LEGS, "joint_vel_rel": {}, "joint_pos_limit_normalized": LEGS, "joint_effort": LEGS,
    "height_scan": {"sensor_cfg": Pick("height_scanner"), "offset": 0.4}, "body_incoming_wrench": TORSO,
    "imu_orientation": {"asset_cfg": Pick("robot", sensor_names="attitude")},
    "imu_projected_gravity": {"asset_cfg": Pick("robot", sensor_names="attitude")},
    "imu_ang_vel": {"asset_cfg": Pick("robot", sensor_names="gyro")},
    "imu_lin_acc": {"asset_cfg": Pick("robot", sensor_names="acc")},
    "last_action": {}, "generated_commands": VELOCITY, "current_time_s": {}, "remaining_time_s": {},
    "base_yaw_roll": {}, "base_up_proj": {}, "base_heading_proj": {"target_pos": (9.0, 0.0, 0.0)},
    "base_angle_to_target": {"target_pos": (9.0, 0.0, 0.0)}, "base_roll_pitch": {},
    "rel_ee_object_distance": GRIP, "rel_ee_drawer_distance": {**GRIP, **OURS}, "fingertips_pos": GRIP,
    "ee_pos": GRIP, "ee_quat": {**GRIP, "make_quat_unique": True},
    "goal_quat_diff": {"asset_cfg": Pick("object"), "command_name": "hand", "make_quat_unique": False},
    "object_position_in_robot_root_frame": THING, "object_pos_b": THING, "object_quat_b": THING,
    "body_state_b": {"body_asset_cfg": Pick("robot", body_names="leg_f."), "base_asset_cfg": Pick("robot")},
    "fingers_contact_force_b": {"contact_sensor_names": ["contact_forces"]},
    "ee_frame_pos": GRIP, "ee_frame_quat": GRIP,
    "gripper_pos": {"asset_cfg": Pick("arm", joint_names=["finger"])},
    "cube_positions_in_world_frame": {"asset_cfg": Pick("object")},
    "cube_orientations_in_world_frame": {"asset_cfg": Pick("object")}, "object_obs": GRIP,
}  # fmt: skip
REWARDS = {
    "is_alive": {}, "is_terminated": {}, "is_terminated_term": {"term_keys": "bad_orientation"}, "lin_vel_z_l2": {},
    "ang_vel_xy_l2": {}, "flat_orientation_l2": {},
    "base_height_l2": {"target_height": 0.3, "sensor_cfg": Pick("height_scanner")}, "body_lin_acc_l2": TORSO,
    "joint_torques_l2": LEGS, "joint_vel_l1": LEGS, "joint_vel_l2": LEGS, "joint_acc_l2": LEGS,
    "joint_deviation_l1": LEGS, "joint_pos_limits": LEGS, "joint_vel_limits": {"soft_ratio": 0.9, **LEGS},
    "applied_torque_limits": LEGS, "action_rate_l2": {}, "action_l2": {},
    "undesired_contacts": {"threshold": 1.0, "sensor_cfg": Pick("contact_forces", body_names="torso")},
    "desired_contacts": {"sensor_cfg": Pick("contact_forces", body_names=["leg_f.*"])},
    "contact_forces": {"threshold": 50.0, "sensor_cfg": Pick("contact_forces", body_names="leg_.*")},
    "track_lin_vel_xy_exp": {**VELOCITY, "std": 0.5}, "track_ang_vel_z_exp": {**VELOCITY, "std": 0.5},
    "joint_pos_target_l2": {"target": 0.1, **LEGS}, "upright_posture_bonus": {"threshold": 0.9},
    "move_to_target_bonus": {"threshold": 0.8, "target_pos": (9.0, 0.0, 0.0)},
    "progress_reward": {"target_pos": (9.0, 0.0, 0.0)},
    "joint_pos_limits_penalty_ratio": {"threshold": 0.98, "gear_ratio": {"hip_f.": 60.0, "hip_b.": 30.0}},
    "power_consumption": {"gear_ratio": {".*": 15.0}},
    "feet_air_time": {**VELOCITY, "sensor_cfg": Pick("contact_forces", body_names="leg_.*"), "threshold": 0.5},
    "feet_air_time_positive_biped": {**VELOCITY, "sensor_cfg": FEET["sensor_cfg"], "threshold": 0.4},
    "feet_slide": FEET, "track_lin_vel_xy_yaw_frame_exp": {**VELOCITY, "std": 0.5},
    "track_ang_vel_z_world_exp": {**VELOCITY, "std": 0.5}, "stand_still_joint_deviation_l1": VELOCITY,
    "air_time_reward": {"asset_cfg": Pick("robot"), "sensor_cfg": FEET["sensor_cfg"], "mode_time": 0.3,
                        "velocity_threshold": 0.5},
    "base_angular_velocity_reward": {"asset_cfg": Pick("robot"), "std": 2.0},
    "base_linear_velocity_reward": {"asset_cfg": Pick("robot"), "std": 1.0, "ramp_at_vel": 1.0, "ramp_rate": 0.5},
    "GaitReward": {"std": 0.1, "max_err": 0.2, "velocity_threshold": 0.5, "asset_cfg": Pick("robot"),
                   "synced_feet_pairs": (("leg_fl", "leg_br"), ("leg_fr", "leg_bl")),
                   "sensor_cfg": Pick("contact_forces")},
    "foot_clearance_reward": {"asset_cfg": FEET["asset_cfg"], "target_height": 0.1, "std": 0.05, "tanh_mult": 2.0},
    "action_smoothness_penalty": {}, "air_time_variance_penalty": {"sensor_cfg": FEET["sensor_cfg"]},
    "base_motion_penalty": {"asset_cfg": Pick("robot")}, "base_orientation_penalty": {"asset_cfg": Pick("robot")},
    "foot_slip_penalty": {**FEET, "threshold": 1.0}, "joint_acceleration_penalty": LEGS,
    "joint_position_penalty": {"asset_cfg": Pick("robot", joint_names=".*"), "stand_still_scale": 5.0,
                               "velocity_threshold": 0.5},
    "joint_torques_penalty": LEGS, "joint_velocity_penalty": LEGS, "position_command_error": HAND,
    "position_command_error_tanh": {**HAND, "std": 0.1}, "orientation_command_error": HAND,
    "object_is_lifted": {"minimal_height": 0.04}, "object_ee_distance": {"std": 0.1, "ee_frame_cfg": GRIP["asset_cfg"]},
    "object_goal_distance": {"std": 0.3, "minimal_height": 0.04, "command_name": "hand", **THING},
    "approach_ee_handle": {**GRIP, **OURS, "threshold": 0.2}, "align_ee_handle": {**GRIP, **OURS},
    "grasp_handle": {"threshold": 0.03, "open_joint_pos": 0.04, **OURS,
                     "asset_cfg": Pick("arm", joint_names=["finger"], site_names="grip")},
    "open_drawer_bonus": LEVER, "multi_stage_open_drawer": LEVER, "success_bonus": GOAL, "track_pos_l2": GOAL,
    "track_orientation_inv_l2": {**GOAL, "rot_eps": 0.1}, "action_l2_clamped": {}, "action_rate_l2_clamped": {},
    "orientation_command_error_tanh": {**HAND, "std": 0.5},
    "distance_to_goal_exp": {"asset_cfg": Pick("robot"), "std": 1.0, "command_name": "hand"},
    "ang_vel_xyz_exp": {"asset_cfg": Pick("robot"), "std": 1.0}, "lin_vel_xyz_exp": {"std": 1.0},
    "yaw_aligned": {"std": 0.5}, "heading_command_error_abs": {"command_name": "place"},
}  # fmt: skip
TERMINATIONS = {
    "time_out": {}, "bad_orientation": {"limit_angle": 1.5}, "root_height_below_minimum": {"minimum_height": -5.0},
    "joint_pos_out_of_limit": LEGS, "joint_pos_out_of_manual_limit": {"bounds": (-2.0, 2.0), **LEGS},
    "joint_vel_out_of_limit": LEGS, "joint_vel_out_of_manual_limit": {"max_velocity": 90.0, **LEGS},
    "joint_effort_out_of_limit": LEGS,
    "illegal_contact": {"threshold": 1e4, "sensor_cfg": Pick("contact_forces", body_names="torso")},
    "terrain_out_of_bounds": {"asset_cfg": Pick("robot"), "distance_buffer": 3.0},
    "object_reached_goal": {"command_name": "hand", "threshold": 0.001, **THING},
    "object_away_from_goal": {"command_name": "hand", "threshold": 99.0, **THING},
    "object_away_from_robot": {"threshold": 99.0, "asset_cfg": Pick("robot"), "object_cfg": Pick("object")},
    "out_of_bound": {"asset_cfg": Pick("robot"), "in_bound_range": dict.fromkeys("xyz", (-90.0, 90.0))},
    "abnormal_robot_state": {},
}  # fmt: skip
SPREAD = {"operation": "scale", "distribution": "uniform"}
EVENT_TERMS = {
    "randomize_rigid_body_scale": {"asset_cfg": Pick("object"), "scale_range": (0.9, 1.1)},
    "randomize_rigid_body_material": {
        "asset_cfg": Pick("robot", body_names="leg_f.*"), "static_friction_range": (0.8, 0.8), "num_buckets": 64,
        "dynamic_friction_range": (0.6, 0.6), "restitution_range": (0.0, 0.0)},
    "randomize_rigid_body_mass": {
        "asset_cfg": Pick("robot", body_names="torso"), "mass_distribution_params": (-1.0, 3.0), "operation": "add"},
    "randomize_rigid_body_com": {
        "asset_cfg": Pick("robot", body_names="torso"), "com_range": {"x": (-0.05, 0.05), "z": (-0.01, 0.01)}},
    "randomize_rigid_body_collider_offsets": {
        "asset_cfg": Pick("robot"), "contact_offset_distribution_params": (0.001, 0.002)},
    "randomize_physics_scene_gravity": {
        "gravity_distribution_params": ([0.0, 0.0, 0.0], [0.0, 0.0, 0.4]), "operation": "add"},
    "randomize_actuator_gains": {
        "asset_cfg": Pick("robot", joint_names=".*"), "stiffness_distribution_params": (0.8, 1.2),
        "damping_distribution_params": (0.9, 1.1), "operation": "scale", "distribution": "log_uniform"},
    "randomize_joint_parameters": {
        "asset_cfg": Pick("robot", joint_names=["hip_f."]), "friction_distribution_params": (0.0, 0.1),
        "armature_distribution_params": (0.01, 0.02), "lower_limit_distribution_params": (-1.0, -0.9)},
    "apply_external_force_torque": {**TORSO, "force_range": (-1.0, 1.0), "torque_range": (0.0, 0.0)},
    "push_by_setting_velocity": {"velocity_range": {"x": (-0.5, 0.5), "yaw": (-0.1, 0.1)}},
    "reset_root_state_uniform": {
        "pose_range": {"x": (-0.5, 0.5), "yaw": (-3.14, 3.14)}, "velocity_range": {"z": (-0.1, 0.1)}},
    "reset_root_state_with_random_orientation": {
        "pose_range": {"x": (-0.5, 0.5)}, "velocity_range": {}, "asset_cfg": Pick("object")},
    "reset_joints_by_scale": {"position_range": (0.5, 1.5), "velocity_range": (0.0, 0.0)},
    "reset_joints_by_offset": {"position_range": (-0.1, 0.1), "velocity_range": (0.0, 0.0), **LEGS},
    "reset_scene_to_default": {"reset_joint_targets": True},
    "reset_joints_around_default": {"position_range": (-0.1, 0.1), "velocity_range": (0.0, 0.0)},
    "randomize_joint_by_gaussian_offset": {"asset_cfg": Pick("arm", joint_names=["elbow"]), "mean": 0.0, "std": 0.02},
}  # fmt: skip
ELSEWHERE = {
    "contacts", "success_reward",  # needs the sensors and assets of one hand
    "reset_joints_within_limits_range", "randomize_object_pose",  # ranges per joint, lists of assets
    "image",  # needs a camera, and so OpenGL: tests/mdp/test_pictures.py
    "randomize_fixed_tendon_parameters",  # no robot here has tendons
}  # fmt: skip
"""Terms of the page that are not tried here."""


def articulation(name, **more):
    return ArticulationCfg(
        prim_path="{ENV_REGEX_NS}/" + name.title(), spawn=sim_utils.UsdFileCfg(usd_path=f"{name}.xml"), **more
    )


@configclass
class SceneCfg(InteractiveSceneCfg):
    ground = TerrainImporterCfg(prim_path="/World/ground", terrain_type="plane")
    robot = articulation("walker", init_state=ArticulationCfg.InitialStateCfg(pos=(0.0, 0.0, 0.35)), actuators={
        "front": ImplicitActuatorCfg(joint_names_expr=["hip_f."], stiffness=20.0, damping=0.5, effort_limit_sim=8.0),
        "back": DCMotorCfg(joint_names_expr=["hip_b."], stiffness=20.0, damping=0.5, effort_limit=8.0,
                           saturation_effort=9.0, velocity_limit=30.0)})  # fmt: skip
    arm = articulation("arm", actuators={}, init_state=ArticulationCfg.InitialStateCfg(pos=(1.0, 0.0, 0.5)))
    cabinet = articulation("cabinet", actuators={}, init_state=ArticulationCfg.InitialStateCfg(pos=(3.0, 0.5, 0.6)))
    object = RigidObjectCfg(
        prim_path="{ENV_REGEX_NS}/Object",
        spawn=sim_utils.SphereCfg(radius=0.05, rigid_props=sim_utils.RigidBodyPropertiesCfg()),
        init_state=RigidObjectCfg.InitialStateCfg(pos=(0.0, 2.0, 1.0), lin_vel=(0.5, 0.0, 0.0)),
    )
    contact_forces = ContactSensorCfg(prim_path="{ENV_REGEX_NS}/Walker/.*", history_length=3, track_air_time=True)
    height_scanner = RayCasterCfg(
        prim_path="{ENV_REGEX_NS}/Walker/torso", ray_alignment="yaw", mesh_prim_paths=["/World/ground"],
        pattern_cfg=patterns.GridPatternCfg(resolution=0.2, size=[0.4, 0.2]),
    )  # fmt: skip


def group(terms, kind, **more):
    return {name: kind(func=getattr(mdp, name), params=dict(params), **more) for name, params in terms.items()}


@configclass
class PolicyCfg(ObsGroup):
    def __post_init__(self):
        vars(self).update(group(OBSERVATIONS, ObsTerm))


def velocity(**ranges):
    ranges = {"lin_vel_x": (-1.0, 1.0), "lin_vel_y": (0.0, 0.0), "ang_vel_z": (-1.0, 1.0), **ranges}
    return mdp.UniformVelocityCommandCfg(
        asset_name="robot", resampling_time_range=(1.0, 2.0), ranges=mdp.UniformVelocityCommandCfg.Ranges(**ranges)
    )


@configclass
class Cfg(ManagerBasedRLEnvCfg):
    scene: SceneCfg = SceneCfg(num_envs=3, env_spacing=4.0)

    def __post_init__(self):
        self.decimation, self.episode_length_s, self.sim.dt = 2, 0.2, 0.005
        legs = mdp.JointPositionActionCfg(asset_name="robot", joint_names=["hip_.*"], scale=0.5)
        self.actions = {"legs": legs}
        self.observations = {"policy": PolicyCfg()}
        self.rewards = group(REWARDS, RewTerm, weight=0.1)
        self.terminations = group(TERMINATIONS, DoneTerm)
        self.terminations["time_out"].time_out = True
        self.events = group(EVENT_TERMS, EventTerm, mode="reset")
        self.events["randomize_rigid_body_scale"].mode = "prestartup"
        pose = mdp.UniformPoseCommandCfg.Ranges(
            pos_x=(0.1, 0.4), pos_y=(0.0, 0.0), pos_z=(0.3, 0.5), roll=(0.0, 0.0), pitch=(0.0, 0.0), yaw=(-1.0, 1.0)
        )
        again = {"resampling_time_range": (4.0, 4.0)}
        self.commands = {
            "base_velocity": velocity(),
            "hand": mdp.UniformPoseCommandCfg(asset_name="arm", body_name="fore", ranges=pose, **again),
            "place": mdp.UniformPose2dCommandCfg(asset_name="robot", simple_heading=False, **again, ranges=(
                mdp.UniformPose2dCommandCfg.Ranges(pos_x=(-1.0, 1.0), pos_y=(-1.0, 1.0), heading=(-1.0, 1.0)))),
        }  # fmt: skip
        ramp = {"term_name": "action_l2", "weight": -0.5, "num_steps": 3}
        self.curriculum = {"ramp": CurrTerm(func=mdp.modify_reward_weight, params=ramp)}


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("words")
    for name, text in FILES.items():
        (folder / name.replace("_xml", ".xml")).write_text(text)
    return lambda cfg=Cfg: source_of(cfg(), folder)


def rows(section):
    """Return Isaac Lab's name -> name of the built-in term, from the page."""
    text = PAGE.read_text().split(f"`{section}:`\n")[1].split("\n## ")[0]
    found = re.findall(r"^\| `([^`]+)` \| (same|similar|`[a-z0-9_]+`) \|", text, re.MULTILINE)
    return {name: name if here in ("same", "similar") else here.strip("`") for name, here in found}


@pytest.mark.parametrize(
    ("section", "tried"),
    [
        ("observations", OBSERVATIONS),
        ("rewards", REWARDS),
        ("terminations", TERMINATIONS),
        ("events", EVENT_TERMS),
    ],
)
def test_every_listed_term_maps_to_listed_counterpart(source, section, tried):
    listed = rows(section)
    assert set(listed) - ELSEWHERE == set(tried)
    made = to_data(resolve(source()))[section]
    made = made["policy"] if section == "observations" else made
    for name in tried:
        found = {term["func"] for key, term in made.items() if key == name or key.startswith(f"{name}_")}
        assert listed[name] in found or (name in LAB_TERMS and found == {name}), name
    assert set(EVENTS) - ELSEWHERE <= set(EVENT_TERMS)


def test_all_terms_run_in_one_env(source):
    env = make_env(resolve(source()), seed=1)
    assert env.reset()["policy"].isfinite().all()
    generator = torch.Generator().manual_seed(0)
    for _ in range(45):
        step = env.step(torch.randn(3, 4, generator=generator))
        assert step.obs["policy"].isfinite().all()
        assert step.reward.isfinite().all()
    assert env.divergences == 0
    assert env.extras()["Curriculum/ramp"] == -0.5


def test_object_starts_with_configured_velocity(source):
    env = make_env(resolve(source(), overrides=["events.reset_root_state_with_random_orientation=null"]), seed=1)
    env.reset()
    assert env.entities["object"].data.root_lin_vel_w.tolist() == [[0.5, 0.0, 0.0]] * 3


def test_term_with_sensor_bodies_reads_only_these(source):
    env = make_env(resolve(source()), seed=1)
    env.reset()
    for _ in range(15):
        env.step(torch.zeros(3, 4))
    sensors = env.sensors
    assert sensors["contact_forces_leg"].names == ["leg_fl", "leg_fr", "leg_bl", "leg_br"]
    assert sensors["contact_forces_torso"].names == ["torso"]
    whole = sensors["contact_forces"].force_history
    assert whole.norm(dim=-1).max() > 1.0  # the robot stands on its feet
    for name in ("contact_forces_leg", "contact_forces_torso", "contact_forces_leg_f"):
        places = [sensors["contact_forces"].names.index(body) for body in sensors[name].names]
        assert torch.equal(sensors[name].force_history, whole[:, :, places])


MASS = {"asset_cfg": Pick("robot"), "mass_distribution_params": (0.0, 1.0), "operation": "add"}


@pytest.mark.parametrize(
    ("section", "name", "params", "message"),
    [
        ("rewards", "undesired_contacts", {"threshold": 1.0, "sensor_cfg": Pick("contacts")},
         "no sensor 'contacts' of kind contact.*did you mean 'contact_forces'"),
        ("rewards", "undesired_contacts", {"threshold": 1.0, "sensor_cfg": Pick("contact_forces", body_names="toe")},
         "no body matches 'toe'; bodies: torso, leg_fl"),
        ("rewards", "joint_vel_l2", {"asset_cfg": Pick("robot", joint_names=["hip_f.", "hip_fl"])}, "matched twice"),
        ("rewards", "track_lin_vel_xy_exp", {"command_name": "speed", "std": 0.5},
         "no command 'speed'; commands: base_velocity, hand, place"),
        ("rewards", "power_consumption", {"gear_ratio": {"knee": 1.0}}, "no joint matches 'knee'"),
        ("events", "randomize_rigid_body_mass", {**MASS, "asset_cfg": Pick("robot", body_names="base")},
         "no body matches 'base'"),
        ("events", "randomize_rigid_body_mass", {**MASS, "mass_range": 3},
         "'randomize_rigid_body_mass' has no parameter 'mass_range'"),
        ("events", "randomize_rigid_body_mass", {"asset_cfg": Pick("robot")}, "missing 'mass_distribution_params'"),
        ("events", "randomize_rigid_body_com", {"asset_cfg": Pick("robot"), "com_range": {"roll": (0.0, 1.0)}},
         "expected ranges for x, y and z"),
        ("events", "randomize_physics_scene_gravity", {"gravity_distribution_params": (0.0, 1.0)},
         r"expected two numbers|expected \(lowest, highest\), each \[x, y, z\]"),
        ("events", "randomize_rigid_body_material", {"asset_cfg": Pick("robot")}, "missing 'dynamic_friction_range'"),
        ("events", "randomize_actuator_gains",
         {"asset_cfg": Pick("cabinet"), "stiffness_distribution_params": (1.0, 2.0)}, "no actuator of 'cabinet'"),
        ("curriculum", "modify_reward_weight", {"term_name": "acton_l2", "weight": 1.0, "num_steps": 3},
         "cannot change 'rewards.acton_l2.weight'.*did you mean 'action_l2'"),
        ("curriculum", "modify_term_cfg", {"address": "rewards.action_l2.wieght", "modify_fn": max},
         "'rewards.action_l2.wieght' names no setting that rlcli can change during training"),
    ],
)  # fmt: skip
def test_invalid_params_error_lists_valid_names(source, section, name, params, message):
    class Wrong(Cfg):
        def __post_init__(self):
            super().__post_init__()
            kind = {"rewards": RewTerm, "events": EventTerm, "curriculum": CurrTerm}[section]
            more = {"rewards": {"weight": 1.0}, "events": {"mode": "startup"}}.get(section, {})
            getattr(self, section)["wrong"] = kind(func=getattr(mdp, name), params=params, **more)

    with pytest.raises(ConfigError, match=message):
        make_env(resolve(source(Wrong)))


SCRIPTED = """
    scale_transform unscale_transform saturate normalize wrap_to_pi copysign quat_unique matrix_from_quat quat_conjugate
    quat_inv quat_from_euler_xyz quat_from_matrix euler_xyz_from_quat axis_angle_from_quat quat_from_angle_axis quat_mul
    yaw_quat quat_box_minus quat_box_plus quat_apply quat_apply_inverse quat_apply_yaw quat_error_magnitude
    skew_symmetric_matrix combine_frame_transforms apply_delta_pose default_orientation random_orientation
    random_yaw_orientation transform_points quat_rotate quat_rotate_inverse
"""
"""Functions that Isaac Lab compiles to TorchScript, so that compiled functions of task files may call them."""


@pytest.mark.filterwarnings("ignore:.*torch.jit.script.*:DeprecationWarning")
def test_rotations_agree_and_compile_to_torchscript():
    import torch

    from rlcli.sim.rotations import rotate, rotate_inverse
    from rlcli_isaaclab.utils import math

    generator = torch.Generator().manual_seed(3)
    quat = math.normalize(torch.randn(64, 4, generator=generator))
    vector = torch.randn(64, 3, generator=generator)
    torch.testing.assert_close(math.quat_apply(quat, vector), rotate(quat, vector))
    torch.testing.assert_close(math.quat_apply_inverse(quat, vector), rotate_inverse(quat, vector))
    matrix = math.matrix_from_quat(quat)
    torch.testing.assert_close((matrix @ vector[:, :, None])[:, :, 0], rotate(quat, vector))
    torch.testing.assert_close(math.quat_unique(math.quat_from_matrix(matrix)), math.quat_unique(quat))
    turn = math.axis_angle_from_quat(quat)
    again = math.quat_from_angle_axis(turn.norm(dim=-1), turn)
    torch.testing.assert_close(again, math.quat_unique(quat), atol=1e-5, rtol=1e-5)
    skew = math.skew_symmetric_matrix(vector)
    torch.testing.assert_close((skew @ turn[:, :, None])[:, :, 0], torch.linalg.cross(vector, turn))
    for name in SCRIPTED.split():
        torch.jit.script(getattr(math, name))
