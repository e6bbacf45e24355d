"""Values: every term that the page calls the same has the value that Isaac Lab computes, on 64 random states.

The formulas below follow from the meaning of each term, in numpy, from states of plain MuJoCo. The base has its centre
of mass 6 cm off, half of each joint's range is inside the soft limits, and some feet touch the ground.
"""

import math
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from support.mdp_worlds import FILES
from test_isaaclab_terms_page import tables
from test_isaaclab_vocabulary import (
    OBSERVATIONS,
    REWARDS,
    TERMINATIONS,
    Cfg,
    SceneCfg,
    group,
)

from rlcli.config.load import resolve
from rlcli.config.python_task import source_of
from rlcli.envs.make import make_env
from rlcli_isaaclab import ArticulationCfg, DoneTerm, EventTerm, ObsGroup, ObsTerm, RewTerm, configclass, mdp
from rlcli_isaaclab import SceneEntityCfg as Pick

torch.set_num_threads(1)
ENVS, STEPS, DT = 64, 6, 0.005
LEGS = ["hip_fl", "hip_fr", "hip_bl", "hip_br"]
FEET = ["leg_fl", "leg_fr", "leg_bl", "leg_br"]
SPEED = np.array([6.0, 6.0, 9.0, 9.0])
"""Speed limits of the legs [rad/s]."""
OFF = '<inertial pos="0.05 0.02 -0.0265" mass="3" diaginertia="0.02 0.05 0.06"/>'
"""Inertia of the torso, whose centre of mass is 6 cm from its origin."""
HALF_PI = 0.5 * math.pi
PARAMS = {
    "base_height_l2": {"target_height": 0.3},
    "bad_orientation": {"limit_angle": 0.8},
    "root_height_below_minimum": {"minimum_height": 0.3},
    "joint_pos_out_of_manual_limit": {"bounds": (-0.6, 0.5)},
    "joint_vel_out_of_manual_limit": {"max_velocity": 5.0},
    "illegal_contact": {"threshold": 5.0, "sensor_cfg": Pick("contact_forces", body_names="leg_.*")},
    "object_reached_goal": {"command_name": "hand", "threshold": 1.5, "robot_cfg": Pick("arm")},
    "object_away_from_goal": {"command_name": "hand", "threshold": 1.5},
    "object_away_from_robot": {"threshold": 1.5},
    "out_of_bound": {"in_bound_range": {"x": (-1.0, 1.0), "y": (-2.0, 2.0), "z": (0.2, 1.0)}},
    "contact_forces": {"threshold": 5.0, "sensor_cfg": Pick("contact_forces", body_names="leg_.*")},
    "is_terminated_term": {"term_keys": [".*_orientation", "joint_vel.*"]},
    "object_goal_distance": {"std": 0.3, "minimal_height": 0.5, "command_name": "hand", "robot_cfg": Pick("arm")},
    "object_ee_distance": {"std": 1.0, "ee_frame_cfg": Pick("arm", site_names="grip")},
    "approach_ee_handle": {"asset_cfg": Pick("arm", site_names="grip"), "handle": "handle", "threshold": 1.7},
    "grasp_handle": {"threshold": 1.7, "open_joint_pos": 0.04, "handle": "handle",
                     "asset_cfg": Pick("arm", joint_names=["finger"], site_names="grip")},
    "object_is_lifted": {"minimal_height": 0.7},
    "success_bonus": {"command_name": "hand", "threshold": 1.5},
    "lin_vel_xyz_exp": {"std": 2.0}, "ang_vel_xyz_exp": {"std": 3.0}, "yaw_aligned": {"std": 1.5},
    "joint_vel_limits": {"soft_ratio": 0.5, "asset_cfg": Pick("robot", joint_names=LEGS)},
    "body_pose_w": {"asset_cfg": Pick("robot", body_names=["torso", "leg_br"])},
    "joint_pos_limits_penalty_ratio": {"threshold": 0.5, "gear_ratio": {"hip_f.": 60.0, "hip_b.": 30.0}},
    "foot_clearance_reward": {"asset_cfg": Pick("robot", body_names="leg_.*"), "target_height": 0.1, "std": 0.5,
                              "tanh_mult": 0.5},
    "distance_to_goal_exp": {"std": 2.0, "command_name": "hand"},
}  # fmt: skip
"""Parameters that both values of a condition occur with; other terms have those of test_isaaclab_vocabulary.py."""


def with_params(terms):
    return {name: {**({} if name in PARAMS else params), **PARAMS.get(name, {})} for name, params in terms.items()}


def single(name, params):
    @configclass
    class Group(ObsGroup):
        def __post_init__(self):
            vars(self).update({name: ObsTerm(func=getattr(mdp, name), params=dict(params))})

    return Group()


def called(section, *words):
    return {name for name, counterpart, _ in tables()[section] if counterpart in words}


ELSEWHERE = {"image"}  # needs OpenGL: tests/mdp/test_pictures.py


@configclass
class ValuesCfg(Cfg):
    scene: SceneCfg = SceneCfg(num_envs=ENVS, env_spacing=4.0)

    def __post_init__(self):
        Cfg.__post_init__(self)
        self.decimation, self.episode_length_s, self.sim.dt = 1, 1000.0, DT
        self.scene.robot.soft_joint_pos_limit_factor = 0.5
        self.scene.robot.actuators["front"].velocity_limit_sim = 6.0
        self.scene.robot.actuators["back"].velocity_limit = 9.0
        self.events, self.curriculum = {}, {}
        self.observations = {"policy": single("joint_pos", {})}
        self.observations |= {name: single(name, with_params(OBSERVATIONS)[name]) for name in OBSERVED}
        rewards, ends = with_params(REWARDS), with_params(TERMINATIONS)
        self.rewards = group({name: rewards[name] for name in REWARDED}, RewTerm, weight=1.0)
        self.terminations = group({name: ends[name] for name in ENDED}, DoneTerm)
        self.terminations["time_out"].time_out = True


# --- rotations ---


def rows(function):
    return lambda quat, vector: np.stack([function(q, v) for q, v in zip(quat, vector, strict=True)])


def matrix(quat):
    found = np.zeros(9)
    mujoco.mju_quat2Mat(found, quat)
    return found.reshape(3, 3)


turned = rows(lambda q, v: v @ matrix(q).T)
"""Vectors of the body's frame in the world. (n, 4), (n, 3) or (n, k, 3)"""
inside = rows(lambda q, v: v @ matrix(q))
"""Vectors of the world in the body's frame."""


def product(left, right):
    found = np.zeros((len(left), 4))
    for row, a, b in zip(found, left, right, strict=True):
        mujoco.mju_mulQuat(row, a, b)
    return found


def conjugate(quat):
    return quat * [1.0, -1.0, -1.0, -1.0]


def angle_between(left, right):
    return 2.0 * np.arccos(np.abs((left * right).sum(axis=1)).clip(max=1.0))


def yaw(quat):
    x_axis = turned(quat, np.tile([1.0, 0.0, 0.0], (len(quat), 1)))
    return np.arctan2(x_axis[:, 1], x_axis[:, 0])


def roll_pitch(quat):
    r = np.stack([matrix(q) for q in quat])
    return np.arctan2(r[:, 2, 1], r[:, 2, 2]), -np.arcsin(r[:, 2, 0].clip(-1, 1))


def wrap(angle):
    return np.arctan2(np.sin(angle), np.cos(angle))


def norm(vectors):
    return np.linalg.norm(vectors, axis=-1)


# --- the states ---


def random_state(model, generator):
    """Return random qpos and qvel, with some feet on the ground and some joints beyond their limits."""
    data = mujoco.MjData(model)
    qpos, qvel = model.qpos0.copy(), generator.normal(size=model.nv)
    root, thing = model.joint("robot/root").qposadr[0], model.body("object/body").jntadr[0]
    for start, height in ((root, 0.0), (model.jnt_qposadr[thing], generator.uniform(0.3, 1.1))):
        qpos[start : start + 3] = [*generator.uniform(-1.5, 1.5, 2), height]
        quat = generator.normal(size=4)
        if start == root:
            quat = np.array([1.0, 0.0, 0.0, 0.0]) + generator.choice([0.2, 1.0]) * quat
        qpos[start + 3 : start + 7] = quat / np.linalg.norm(quat)
    for name in LEGS:
        qpos[model.joint(f"robot/{name}").qposadr[0]] = generator.uniform(-1.3, 1.3)
    for name in ("arm/shoulder", "arm/elbow", "arm/finger", "cabinet/slide"):
        qpos[model.joint(name).qposadr[0]] = generator.uniform(-0.3, 0.5)
    qvel[6:10] = generator.uniform(-10.0, 10.0, 4)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    feet = [g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE]
    axes = [data.geom_xmat[g].reshape(3, 3)[2, 2] for g in feet]
    lowest = min(
        data.geom_xpos[g][2] - abs(axis) * model.geom_size[g][1] - model.geom_size[g][0]
        for g, axis in zip(feet, axes, strict=True)
    )
    qpos[root + 2] = generator.choice([-0.003, -0.003, 0.3]) - lowest
    return qpos, qvel


def forces_on_bodies(model, data, bodies):
    """Return the net contact force on each body, world frame."""
    total = np.zeros((len(bodies), 3))
    for number, contact in enumerate(data.contact):
        wrench = np.zeros(6)
        mujoco.mj_contactForce(model, data, number, wrench)
        force = contact.frame.reshape(3, 3).T @ wrench[:3]  # on the second geom
        for geom, sign in ((contact.geom[0], -1.0), (contact.geom[1], 1.0)):
            name = model.body(model.geom_bodyid[geom]).name
            if name in bodies:
                total[bodies.index(name)] += sign * force
    return total


def velocity_at(model, data, body, kind):
    found = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, kind, body, found, 0)
    return found[3:], found[:3]


class Recorder:
    """Independent record of what the sensors and actuators of the last steps measure."""

    def __init__(self, env):
        self.env, self.model = env, env.engine.model
        self.bodies = ["robot/torso", *(f"robot/{foot}" for foot in FEET)]
        shape = (ENVS, len(self.bodies))
        self.air, self.contact, self.last_air, self.last_contact = (np.zeros(shape) for _ in range(4))
        self.first = np.zeros(shape, dtype=bool)
        self.history = np.zeros((ENVS, 3, len(self.bodies), 3))
        self.actions = np.zeros((2, ENVS, 4))

    def before(self, action):
        field = {n: self.env.engine.field(n).numpy().astype(float).copy() for n in ("qpos", "qvel")}
        self.start = field
        self.actions = np.stack([action, self.actions[0]])

    def after(self):
        """Take the same physics step in plain MuJoCo, from the same state and with the same controls."""
        model, engine = self.model, self.env.engine
        forces = []
        for i in range(ENVS):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = self.start["qpos"][i], self.start["qvel"][i]
            data.ctrl[:] = engine.field("ctrl")[i].numpy()
            mujoco.mj_step(model, data)
            forces.append(forces_on_bodies(model, data, self.bodies))
            np.testing.assert_allclose(data.qpos, engine.field("qpos")[i].numpy(), atol=1e-4)
        self.applied = self.motor_efforts()
        force = np.stack(forces)
        self.history = np.concatenate([force[:, None], self.history[:, :2]], axis=1)
        touching = norm(force) > 1.0
        self.first = touching & (self.air > 0)
        off = ~touching & (self.contact > 0)
        self.last_air = np.where(self.first, self.air + DT, self.last_air)
        self.last_contact = np.where(off, self.contact + DT, self.last_contact)
        self.air, self.contact = (
            np.where(c, t + DT, 0.0) for c, t in ((~touching, self.air), (touching, self.contact))
        )

    def motor_efforts(self):
        """Return the efforts of the legs after their limits: PD in front, DC motors behind."""
        joints = [self.model.joint(f"robot/{name}") for name in LEGS]
        q = self.start["qpos"][:, [j.qposadr[0] for j in joints]]
        v = self.start["qvel"][:, [j.dofadr[0] for j in joints]]
        computed = 20.0 * (0.5 * self.actions[0] - q) - 0.5 * v
        high, low = np.full_like(q, 8.0), np.full_like(q, -8.0)
        curve = 9.0 * v[:, 2:] / 9.0
        high[:, 2:], low[:, 2:] = np.clip(9.0 - curve, -np.inf, 8.0), np.clip(-9.0 - curve, -8.0, np.inf)
        return computed.clip(low, high)


def state_of(env, recorder):
    """Return the state after the last step: of plain MuJoCo, of the recorder, and of the commands."""
    model = env.engine.model
    s = SimpleNamespace(r=recorder, air=recorder.air, contact=recorder.contact, history=recorder.history)
    names = {n: model.body(n).id for n in ("robot/torso", "arm/base", "arm/fore", "object/body", "cabinet/case")}
    names |= {f"robot/{foot}": model.body(f"robot/{foot}").id for foot in FEET}
    found = {}
    for i in range(ENVS):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = (env.engine.field(n)[i].numpy() for n in ("qpos", "qvel"))
        mujoco.mj_forward(model, data)
        row = {"q": [], "v": []}
        for key in LEGS:
            row["q"].append(data.joint(f"robot/{key}").qpos[0])
            row["v"].append(data.joint(f"robot/{key}").qvel[0])
        for key, body in names.items():
            row[f"{key} pos"], row[f"{key} quat"] = data.xpos[body].copy(), data.xquat[body].copy()
            linear, row[f"{key} ang"] = velocity_at(model, data, body, mujoco.mjtObj.mjOBJ_BODY)
            row[f"{key} lin"] = linear  # of the centre of mass
            row[f"{key} origin"] = velocity_at(model, data, body, mujoco.mjtObj.mjOBJ_XBODY)[0]
        for site in ("arm/grip", "cabinet/handle"):
            row[f"{site} pos"] = data.site(site).xpos.copy()
            row[f"{site} mat"] = data.site(site).xmat.reshape(3, 3).copy()
        row["finger"], row["slide"] = data.joint("arm/finger").qpos[0], data.joint("cabinet/slide").qpos[0]
        row["attitude"] = data.sensor("robot/attitude").data.copy()
        row["gyro"] = data.sensor("robot/gyro").data.copy()
        for key, value in row.items():
            found.setdefault(key, []).append(value)
    s.f = {key: np.array(values) for key, values in found.items()}
    s.q, s.v = s.f["q"], s.f["v"]
    s.pos, s.quat = s.f["robot/torso pos"], s.f["robot/torso quat"]
    s.lin, s.ang = s.f["robot/torso lin"], s.f["robot/torso ang"]
    s.lin_b, s.ang_b = inside(s.quat, s.lin), inside(s.quat, s.ang)
    s.down = np.tile([0.0, 0.0, -1.0], (ENVS, 1))
    s.g = inside(s.quat, s.down)
    commands = {t.name: t.instance.command.numpy().astype(float) for t in env.command_manager.terms}
    s.velocity, s.hand, s.place = commands["base_velocity"], commands["hand"], commands["place"]
    s.action, s.previous = recorder.actions
    s.low, s.high = -math.pi / 6, math.pi / 6  # the soft limits: half of +-60 degrees
    s.scaled = (2.0 * s.q - s.low - s.high) / (s.high - s.low)
    s.thing, s.thing_quat = s.f["object/body pos"], s.f["object/body quat"]
    s.goal = s.f["arm/base pos"] + turned(s.f["arm/base quat"], s.hand[:, :3])
    s.goal_quat = product(s.f["arm/base quat"], s.hand[:, 3:])
    s.grip, s.handle = s.f["arm/grip pos"], s.f["cabinet/handle pos"]
    s.feet = np.stack([s.f[f"robot/{foot} lin"] for foot in FEET], axis=1)
    s.feet_pos = np.stack([s.f[f"robot/{foot} pos"] for foot in FEET], axis=1)
    s.strongest = norm(recorder.history).max(axis=1)
    s.time = env.episode_length_buf.numpy().astype(float)[:, None] * env.step_dt
    s.speed = norm(s.velocity[:, :2])
    s.moving = (norm(s.velocity) > 0) | (norm(s.lin_b[:, :2]) > 0.5)
    s.fired = {n: v.numpy() for n, v in env.termination_manager.fired.items()}
    s.ended, s.timed_out = env.termination_manager.terminated.numpy(), env.termination_manager.time_outs.numpy()
    return s


def grid_heights(s):
    return np.repeat(s.pos[:, 2:] - 0.4, 6, axis=1)  # flat ground: 3 x 2 rays hit z = 0


def unique(quat):
    return np.where(quat[:, :1] < 0, -quat, quat)


def to_target(s):
    return np.array([9.0, 0.0]) - s.pos[:, :2]


def facing(s):
    way = to_target(s) / norm(to_target(s))[:, None]
    return (turned(s.quat, np.tile([1.0, 0.0, 0.0], (ENVS, 1)))[:, :2] * way).sum(axis=1)


def relative(s, pos):
    return inside(s.quat, pos - s.pos)


def body_state(s):
    parts = []
    for name in ("robot/leg_fl", "robot/leg_fr"):
        parts += [relative(s, s.f[f"{name} pos"]), product(conjugate(s.quat), s.f[f"{name} quat"]),
                  inside(s.quat, s.f[f"{name} lin"]), inside(s.quat, s.f[f"{name} ang"])]  # fmt: skip
    return np.concatenate(parts, axis=1)


def poses(s):
    parts = [s.f[f"robot/{n} {part}"] for n in ("torso", "leg_br") for part in ("pos", "quat")]
    return np.concatenate(parts, axis=1)


def euler(s):
    return (*roll_pitch(s.quat), yaw(s.quat))


OBSERVED = {
    "base_pos_z": lambda s: s.pos[:, 2:],
    "base_lin_vel": lambda s: s.lin_b,
    "base_ang_vel": lambda s: s.ang_b,
    "projected_gravity": lambda s: s.g,
    "root_pos_w": lambda s: s.pos,
    "root_quat_w": lambda s: unique(s.quat),
    "root_lin_vel_w": lambda s: s.lin,
    "root_ang_vel_w": lambda s: s.ang,
    "body_pose_w": poses,
    "body_projected_gravity_b": lambda s: s.g,
    "joint_pos": lambda s: s.q,
    "joint_vel": lambda s: s.v,
    "joint_pos_rel": lambda s: s.q,
    "joint_vel_rel": lambda s: s.v,
    "joint_pos_limit_normalized": lambda s: s.scaled,
    "joint_effort": lambda s: s.r.applied,
    "imu_orientation": lambda s: s.f["attitude"],
    "imu_projected_gravity": lambda s: inside(s.f["attitude"], s.down),
    "imu_ang_vel": lambda s: s.ang_b,
    "last_action": lambda s: s.action,
    "generated_commands": lambda s: s.velocity,
    "current_time_s": lambda s: s.time,
    "remaining_time_s": lambda s: 1000.0 - s.time,
    "base_yaw_roll": lambda s: np.stack([euler(s)[2], euler(s)[0]], axis=1),
    "base_roll_pitch": lambda s: np.stack(euler(s)[:2], axis=1),
    "base_up_proj": lambda s: -s.g[:, 2:],
    "base_heading_proj": lambda s: facing(s)[:, None],
    "base_angle_to_target": lambda s: wrap(np.arctan2(*to_target(s).T[::-1]) - yaw(s.quat))[:, None],
    "rel_ee_object_distance": lambda s: s.thing - s.grip,
    "rel_ee_drawer_distance": lambda s: s.handle - s.grip,
    "ee_pos": lambda s: s.grip,
    "ee_quat": lambda s: unique(np.stack([quat_of(m) for m in s.f["arm/grip mat"]])),
    "goal_quat_diff": lambda s: product(s.thing_quat, conjugate(s.hand[:, 3:])),
    "object_position_in_robot_root_frame": lambda s: relative(s, s.thing),
    "object_quat_b": lambda s: product(conjugate(s.quat), s.thing_quat),
    "body_state_b": body_state,
    "height_scan": grid_heights,
    "fingers_contact_force_b": lambda s: inside(s.quat, s.history[:, 0]).reshape(ENVS, -1),
}


def quat_of(mat):
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, mat.flatten())
    return quat


def bell(squared, std):
    return np.exp(-squared / std**2)


def ratio_penalty(s):
    gear = np.array([1.0, 1.0, 0.5, 0.5])
    return (np.where(np.abs(s.scaled) > 0.5, (np.abs(s.scaled) - 0.5) / 0.5, 0.0) * gear).sum(axis=1)


def biped(s):
    air, contact = s.air[:, 1:], s.contact[:, 1:]
    down = contact > 0
    alone = down.sum(axis=1) == 1
    lasted = np.where(down, contact, air).min(axis=1).clip(max=0.4)
    return lasted * alone * (s.speed > 0.1)


def stepping(s):
    air, contact = s.air[:, 1:], s.contact[:, 1:]
    longest = np.maximum(air, contact)
    moving = np.where(longest < 0.3, longest, 0.0)
    standing = (contact - air).clip(-0.3, 0.3)
    return np.where(s.moving[:, None], moving, standing).sum(axis=1)


def gait(s):
    air, contact = ({foot: t[:, 1 + k] for k, foot in enumerate(FEET)} for t in (s.air, s.contact))
    error = np.zeros(ENVS)
    for a, b in (("leg_fl", "leg_br"), ("leg_fr", "leg_bl")):
        error += ((air[a] - air[b]) ** 2).clip(max=0.04) + ((contact[a] - contact[b]) ** 2).clip(max=0.04)
    for a in ("leg_fl", "leg_br"):
        for b in ("leg_fr", "leg_bl"):
            error += ((air[a] - contact[b]) ** 2).clip(max=0.04) + ((contact[a] - air[b]) ** 2).clip(max=0.04)
    return np.exp(-error / 0.1) * s.moving


def yaw_frame_velocity(s):
    cos, sin = np.cos(yaw(s.quat)), np.sin(yaw(s.quat))
    return np.stack([cos * s.lin[:, 0] + sin * s.lin[:, 1], cos * s.lin[:, 1] - sin * s.lin[:, 0]], axis=1)


def velocity_reward(s):
    factor = np.maximum(1.0, 1.0 + 0.5 * (s.speed - 1.0))
    return np.exp(-norm(s.velocity[:, :2] - s.lin_b[:, :2])) * factor


def near(distance, std):
    return 1.0 - np.tanh(distance / std)


def approach(s):
    value = (1.0 / (1.0 + norm(s.handle - s.grip) ** 2)) ** 2
    return np.where(norm(s.handle - s.grip) <= 1.7, 2.0 * value, value)


def aligned(s):
    site, handle = s.f["arm/grip mat"], s.f["cabinet/handle mat"]
    z = -(site[:, :, 2] * handle[:, :, 0]).sum(axis=1)
    x = -(site[:, :, 0] * handle[:, :, 1]).sum(axis=1)
    return 0.5 * (np.sign(z) * z**2 + np.sign(x) * x**2)


def fore(s):
    return norm(s.f["arm/fore pos"] - s.goal)


def variance(values):
    return values[:, 1:].clip(max=0.5).var(axis=1, ddof=1)


REWARDED = {
    "is_alive": lambda s: ~s.ended,
    "is_terminated": lambda s: s.ended,
    "is_terminated_term": lambda s: (
        sum(
            s.fired[n].astype(float)
            for n in ("bad_orientation", "joint_vel_out_of_limit", "joint_vel_out_of_manual_limit")
        )
        * ~s.timed_out
    ),
    "lin_vel_z_l2": lambda s: s.lin_b[:, 2] ** 2,
    "ang_vel_xy_l2": lambda s: (s.ang_b[:, :2] ** 2).sum(axis=1),
    "flat_orientation_l2": lambda s: (s.g[:, :2] ** 2).sum(axis=1),
    "base_height_l2": lambda s: (s.pos[:, 2] - 0.3) ** 2,
    "joint_torques_l2": lambda s: (s.r.applied**2).sum(axis=1),
    "joint_vel_l1": lambda s: np.abs(s.v).sum(axis=1),
    "joint_vel_l2": lambda s: (s.v**2).sum(axis=1),
    "joint_deviation_l1": lambda s: np.abs(s.q).sum(axis=1),
    "joint_pos_limits": lambda s: ((s.low - s.q).clip(min=0) + (s.q - s.high).clip(min=0)).sum(axis=1),
    "joint_vel_limits": lambda s: (np.abs(s.v) - 0.5 * SPEED).clip(0, 1).sum(axis=1),
    "action_rate_l2": lambda s: ((s.action - s.previous) ** 2).sum(axis=1),
    "action_l2": lambda s: (s.action**2).sum(axis=1),
    "undesired_contacts": lambda s: s.strongest[:, 0] > 1.0,
    "desired_contacts": lambda s: (s.strongest[:, 1:3] <= 1.0).all(axis=1),
    "contact_forces": lambda s: (s.strongest[:, 1:] - 5.0).clip(min=0).sum(axis=1),
    "track_lin_vel_xy_exp": lambda s: bell(((s.velocity - s.lin_b)[:, :2] ** 2).sum(axis=1), 0.5),
    "track_ang_vel_z_exp": lambda s: bell((s.velocity - s.ang_b)[:, 2] ** 2, 0.5),
    "joint_pos_target_l2": lambda s: ((wrap(s.q) - 0.1) ** 2).sum(axis=1),
    "upright_posture_bonus": lambda s: -s.g[:, 2] > 0.9,
    "move_to_target_bonus": lambda s: np.where(facing(s) > 0.8, 1.0, facing(s) / 0.8),
    "joint_pos_limits_penalty_ratio": ratio_penalty,
    "power_consumption": lambda s: np.abs(s.action * s.v).sum(axis=1),
    "feet_air_time": lambda s: ((s.r.last_air - 0.5) * s.r.first)[:, 1:].sum(axis=1) * (s.speed > 0.1),
    "feet_air_time_positive_biped": biped,
    "feet_slide": lambda s: (norm(s.feet[..., :2]) * (s.strongest[:, 1:] > 1.0)).sum(axis=1),
    "track_lin_vel_xy_yaw_frame_exp": lambda s: bell(
        ((s.velocity[:, :2] - yaw_frame_velocity(s)) ** 2).sum(axis=1), 0.5
    ),
    "track_ang_vel_z_world_exp": lambda s: bell((s.velocity - s.ang)[:, 2] ** 2, 0.5),
    "stand_still_joint_deviation_l1": lambda s: np.abs(s.q).sum(axis=1) * (s.speed < 0.06),
    "air_time_reward": stepping,
    "base_angular_velocity_reward": lambda s: np.exp(-np.abs((s.velocity - s.ang_b)[:, 2]) / 2.0),
    "base_linear_velocity_reward": velocity_reward,
    "GaitReward": gait,
    "foot_clearance_reward": lambda s: np.exp(
        -((s.feet_pos[..., 2] - 0.1) ** 2 * np.tanh(0.5 * norm(s.feet[..., :2]))).sum(axis=1) / 0.5
    ),
    "action_smoothness_penalty": lambda s: norm(s.action - s.previous),
    "air_time_variance_penalty": lambda s: variance(s.r.last_air) + variance(s.r.last_contact),
    "base_motion_penalty": lambda s: 0.8 * s.lin_b[:, 2] ** 2 + 0.2 * np.abs(s.ang_b[:, :2]).sum(axis=1),
    "base_orientation_penalty": lambda s: norm(s.g[:, :2]),
    "foot_slip_penalty": lambda s: (norm(s.feet[..., :2]) * (s.strongest[:, 1:] > 1.0)).sum(axis=1),
    "joint_position_penalty": lambda s: norm(s.q) * np.where(s.moving, 1.0, 5.0),
    "joint_torques_penalty": lambda s: norm(s.r.applied),
    "joint_velocity_penalty": lambda s: norm(s.v),
    "position_command_error": fore,
    "position_command_error_tanh": lambda s: near(fore(s), 0.1),
    "orientation_command_error": lambda s: angle_between(s.f["arm/fore quat"], s.goal_quat),
    "object_is_lifted": lambda s: s.thing[:, 2] > 0.7,
    "object_ee_distance": lambda s: near(norm(s.thing - s.grip), 1.0),
    "object_goal_distance": lambda s: near(norm(s.goal - s.thing), 0.3) * (s.thing[:, 2] > 0.5),
    "approach_ee_handle": approach,
    "align_ee_handle": aligned,
    "grasp_handle": lambda s: (0.04 - s.f["finger"]) * (norm(s.handle - s.grip) <= 1.7),
    "success_bonus": lambda s: angle_between(s.thing_quat, s.hand[:, 3:]) <= 1.5,
    "track_pos_l2": lambda s: norm(s.hand[:, :3] - s.thing),
    "track_orientation_inv_l2": lambda s: 1.0 / (angle_between(s.thing_quat, s.hand[:, 3:]) + 0.1),
    "distance_to_goal_exp": lambda s: bell(norm(s.hand[:, :3] - s.pos) ** 2, 2.0),
    "ang_vel_xyz_exp": lambda s: bell(norm(s.ang) ** 2, 3.0),
    "lin_vel_xyz_exp": lambda s: bell(norm(s.lin) ** 2, 2.0),
    "yaw_aligned": lambda s: bell(yaw(s.quat) ** 2, 1.5),
    "heading_command_error_abs": lambda s: np.abs(s.place[:, 3]),
}


def outside(s):
    low, high = np.array([[-1.0, -2.0, 0.2], [1.0, 2.0, 1.0]])
    return ((s.thing < low) | (s.thing > high)).any(axis=1)


ENDED = {
    "time_out": lambda s: s.time[:, 0] >= 1000.0,
    "bad_orientation": lambda s: np.arccos(-s.g[:, 2]) > 0.8,
    "root_height_below_minimum": lambda s: s.pos[:, 2] < 0.3,
    "joint_pos_out_of_limit": lambda s: ((s.q < s.low) | (s.q > s.high)).any(axis=1),
    "joint_pos_out_of_manual_limit": lambda s: ((s.q < -0.6) | (s.q > 0.5)).any(axis=1),
    "joint_vel_out_of_limit": lambda s: (np.abs(s.v) > SPEED).any(axis=1),
    "joint_vel_out_of_manual_limit": lambda s: (np.abs(s.v) > 5.0).any(axis=1),
    "illegal_contact": lambda s: (s.strongest[:, 1:] > 5.0).any(axis=1),
    "object_reached_goal": lambda s: norm(s.goal - s.thing) < 1.5,
    "object_away_from_goal": lambda s: norm(s.hand[:, :3] - s.thing) > 1.5,
    "object_away_from_robot": lambda s: norm(s.pos - s.thing) > 1.5,
    "out_of_bound": outside,
    "abnormal_robot_state": lambda s: (np.abs(s.v) > 2.0 * SPEED).any(axis=1),
}
FORMULAS = {"observations": OBSERVED, "rewards": REWARDED, "terminations": ENDED}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("values")
    for name, text in FILES.items():
        text = text.replace('<freejoint name="root"/>', f'<freejoint name="root"/>{OFF}')
        (folder / name.replace("_xml", ".xml")).write_text(text)
    return folder


@pytest.fixture(scope="module")
def compared(folder):
    """Return section -> term -> (values of the term, values of the formula) after six steps from random states."""
    env = make_env(resolve(source_of(ValuesCfg(), folder)), seed=5)
    env.reset()
    generator = np.random.default_rng(5)
    states = [random_state(env.engine.model, generator) for _ in range(ENVS)]
    recorder = Recorder(env)
    terms = env.termination_manager.terms
    env._reset_envs = lambda *args: None  # the states go on although terminations fire
    for name, values in zip(("qpos", "qvel"), zip(*states, strict=True), strict=True):
        env.engine.field(name)[:] = torch.tensor(np.array(values)).to(env.engine.field(name).dtype)
    env.engine.forward(env._select_all())
    env.sim.refresh()
    for _ in range(STEPS):
        action = generator.normal(size=(ENVS, 4))
        recorder.before(action)
        step = env.step(torch.tensor(action, dtype=torch.float32))
        recorder.after()
    manager = env.termination_manager
    manager.terminated[::2], manager.time_outs[::3] = False, True  # otherwise every state ends an episode
    s = state_of(env, recorder)
    read = {
        "observations": {name: step.obs[name].numpy() for name in OBSERVED},
        "rewards": {term.name: term.instance().numpy() for term in env.reward_manager.terms},
        "terminations": {term.name: term.instance().numpy() for term in terms},
    }
    return {
        section: {name: (values[name], formula(s)) for name, formula in FORMULAS[section].items()}
        for section, values in read.items()
    }


@pytest.mark.parametrize("section", FORMULAS)
def test_every_term_called_the_same_has_a_formula(section):
    assert called(section, "same") - ELSEWHERE <= set(FORMULAS[section])


def test_terms_of_other_sections_are_not_called_the_same():
    assert {section for section in tables() if called(section, "same")} <= {*FORMULAS, "events"}


@pytest.mark.parametrize(("section", "name"), [(section, name) for section in FORMULAS for name in FORMULAS[section]])
def test_term_has_the_value_of_its_formula(compared, section, name):
    found, expected = (np.asarray(values, dtype=float) for values in compared[section][name])
    expected = expected.reshape(found.shape)
    if name in {"root_quat_w", "object_quat_b", "goal_quat_diff", "imu_orientation", "ee_quat"}:
        expected = expected * np.sign((expected * found).sum(axis=1, keepdims=True))
    assert name in CONSTANT or np.ptp(expected) > 0, "the states do not tell"
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3)


CONSTANT = {"time_out", "current_time_s", "remaining_time_s"}


# --- events: ranges of one value make them deterministic ---

START = {"pos": (0.3, -0.2, 0.5), "rot": (0.6, 0.0, 0.0, 0.8), "lin_vel": (0.1, 0.2, 0.3), "ang_vel": (0.5, -1.0, 2.0)}
JOINTS = {"hip_fl": 0.2, "hip_fr": -0.3, "hip_bl": 0.1, "hip_br": 0.4}
SPEEDS = {"hip_fl": 1.0, "hip_fr": -2.0, "hip_bl": 3.0, "hip_br": -4.0}
MOVED = {axis: (value, value) for axis, value in {"x": 0.1, "y": 0.2, "z": -0.1, "yaw": 0.5, "pitch": 0.3}.items()}
SPUN = {axis: (value, value) for axis, value in {"x": 1.0, "z": -2.0, "roll": 3.0, "yaw": -1.0}.items()}
CHANGE = (np.array([1.0, 0.0, -2.0]), np.array([3.0, 0.0, -1.0]))


def after(folder, *events):
    """Return the state of the robot after a reset with some events, from plain MuJoCo."""

    @configclass
    class EventCfg(ValuesCfg):
        def __post_init__(self):
            ValuesCfg.__post_init__(self)
            self.scene.num_envs = 2
            self.scene.robot.init_state = ArticulationCfg.InitialStateCfg(**START, joint_pos=JOINTS, joint_vel=SPEEDS)
            self.observations = {"policy": single("joint_pos", {})}
            self.rewards = group({"is_alive": {}}, RewTerm, weight=1.0)
            self.terminations = {"time_out": self.terminations["time_out"]}
            self.events = {
                f"event_{number}": EventTerm(func=getattr(mdp, name), mode="reset", params=params)
                for number, (name, params) in enumerate(events)
            }

    env = make_env(resolve(source_of(EventCfg(), folder)), seed=1)
    env.reset()
    model = env.engine.model
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (env.engine.field(n)[1].numpy() for n in ("qpos", "qvel"))
    mujoco.mj_forward(model, data)
    torso = model.body("robot/torso").id
    linear, angular = velocity_at(model, data, torso, mujoco.mjtObj.mjOBJ_BODY)
    joints = [data.joint(f"robot/{name}") for name in LEGS]
    return SimpleNamespace(
        pos=data.xpos[torso], quat=data.xquat[torso], lin=linear, ang=angular,
        q=np.array([j.qpos[0] for j in joints]), v=np.array([j.qvel[0] for j in joints]),
    )  # fmt: skip


def expect(state, pos=START["pos"], quat=START["rot"], lin=START["lin_vel"], ang=START["ang_vel"]):
    for found, expected in ((state.pos, pos), (state.quat, quat), (state.lin, lin), (state.ang, ang)):
        np.testing.assert_allclose(found, expected, atol=1e-5)


def tilt():
    quats = [np.array([math.cos(0.25), 0.0, 0.0, math.sin(0.25)]), np.array([math.cos(0.15), 0.0, math.sin(0.15), 0.0])]
    turn = product(quats[0][None], quats[1][None])  # yaw, then pitch
    return product(np.array([START["rot"]]), turn)[0]


def check_root_uniform(folder):
    state = after(folder, ("reset_root_state_uniform", {"pose_range": MOVED, "velocity_range": SPUN}))
    lin, ang = np.array(START["lin_vel"]) + CHANGE[0], np.array(START["ang_vel"]) + CHANGE[1]
    expect(state, np.add(START["pos"], (0.1, 0.2, -0.1)), tilt(), lin, ang)


def check_random_orientation(folder):
    params = {"pose_range": {axis: MOVED[axis] for axis in ("x", "y", "z")}, "velocity_range": SPUN}
    state = after(folder, ("reset_root_state_with_random_orientation", params))
    lin, ang = np.array(START["lin_vel"]) + CHANGE[0], np.array(START["ang_vel"]) + CHANGE[1]
    assert abs(state.quat @ START["rot"]) < 0.999
    expect(state, np.add(START["pos"], (0.1, 0.2, -0.1)), state.quat, lin, ang)


def check_push(folder):
    default = ("reset_scene_to_default", {})
    state = after(folder, default, ("push_by_setting_velocity", {"velocity_range": SPUN}))
    expect(state, lin=np.array(START["lin_vel"]) + CHANGE[0], ang=np.array(START["ang_vel"]) + CHANGE[1])


def check_default(folder):
    for state in (after(folder), after(folder, ("reset_scene_to_default", {}))):
        expect(state)
        np.testing.assert_allclose(state.q, list(JOINTS.values()), atol=1e-6)
        np.testing.assert_allclose(state.v, list(SPEEDS.values()), atol=1e-6)


def check_joints(name, positions, velocities):
    def check(folder):
        ranges = {"position_range": (1.5, 1.5), "velocity_range": (3.5, 3.5)}
        state = after(folder, (name, ranges))
        limit = math.pi / 6
        np.testing.assert_allclose(state.q, positions(np.array(list(JOINTS.values()))).clip(-limit, limit), atol=1e-6)
        np.testing.assert_allclose(state.v, velocities(np.array(list(SPEEDS.values()))).clip(-SPEED, SPEED), atol=1e-6)

    return check


EVENTS = {
    "push_by_setting_velocity": check_push,
    "reset_root_state_uniform": check_root_uniform,
    "reset_root_state_with_random_orientation": check_random_orientation,
    "reset_joints_by_scale": check_joints("reset_joints_by_scale", lambda q: 1.5 * q, lambda v: 3.5 * v),
    "reset_joints_by_offset": check_joints("reset_joints_by_offset", lambda q: 1.5 + q, lambda v: 3.5 + v),
    "reset_scene_to_default": check_default,
}


def test_every_event_called_the_same_has_a_check():
    assert called("events", "same") == set(EVENTS)


@pytest.mark.parametrize("name", EVENTS)
def test_event_writes_the_state_of_its_formula(folder, name):
    EVENTS[name](folder)
