"""A scene of a walker, an arm, an object and a cabinet, and functions that set its state."""

from types import SimpleNamespace

import numpy as np
import torch
import yaml

from rlcli.config.term_signatures import snake_case
from support.mdp_numbers import FEET, GRAVITY, TIP, states
from support.worlds import CRITTER, build, dump, write

STEP_DT = 0.02
EPISODE_S = 0.6

WALKER = CRITTER.replace("</body></body>", "</body></body>")
for _foot in FEET:
    _geom = '<geom type="capsule" size="0.025" fromto="0 0 0 {}0.02 0 -0.25" mass="0.3"/>'.format(
        "" if _foot[4] == "f" else "-"
    )
    _site = f'<site name="{_foot}_tip" pos="{TIP[0]} {TIP[1]} {TIP[2]}"/>'
    _start = WALKER.index(f'name="{_foot}"')
    _end = WALKER.index(_geom, _start)
    WALKER = WALKER[:_end] + _site + WALKER[_end:]
WALKER = WALKER.replace(
    '<gyro name="gyro" site="imu"/>',
    '<gyro name="gyro" site="imu"/><framequat name="attitude" objtype="site" objname="imu"/>'
    '<subtreeangmom name="spin" body="torso"/>',
)
ARM = """
<mujoco model="arm">
  <worldbody><body name="base"><geom size="0.05"/>
    <body name="upper"><joint name="shoulder" axis="0 1 0"/><geom size="0.05" pos="0 0 0.2" mass="1"/>
      <body name="fore" pos="0 0 0.4"><joint name="elbow" axis="0 1 0"/><geom size="0.04" pos="0 0 0.1" mass="1"/>
        <site name="grip" pos="0 0 0.3"/>
        <body name="jaw" pos="0 0 0.28"><joint name="finger" type="slide" axis="1 0 0"/>
          <geom size="0.01" mass="0.1"/></body></body></body></body></worldbody>
  <actuator><motor name="shoulder" joint="shoulder" gear="2" forcelimited="true" forcerange="-6 6"/></actuator>
</mujoco>
"""
THING = '<mujoco><worldbody><body name="box"><freejoint/><geom size="0.05"/></body></worldbody></mujoco>'
CABINET = """
<mujoco model="cabinet"><worldbody><body name="case"><geom size="0.1"/>
  <body name="drawer"><joint name="slide" type="slide" axis="-1 0 0"/><geom size="0.05" mass="1"/>
    <site name="handle" euler="0 0 17.188733853924695"/></body></body></worldbody></mujoco>
"""
TASK = f"""
decimation: 4
episode_length_s: {EPISODE_S}
sim: {{dt: 0.005}}
scene:
  num_envs: 3
  ground: null
  entities:
    robot:
      model: walker.xml
      joints:
        ".*": {{kp: 20.0, kv: 0.5, effort_limit: 8.0, velocity_limit: 3.5}}
        hip_fr: {{velocity_limit: 1.0}}
        hip_br: {{range: [-1.0, 0.5]}}
      init: {{joint_pos: {{"hip_.l": 0.1, "hip_.r": -0.1}}}}
    arm: {{model: arm.xml, pos: [1, 0, 0.5], quat: [0.70710678118654752, 0, 0, 0.70710678118654752]}}
    object: {{model: thing.xml, pos: [0, 0, 1]}}
    cabinet: {{model: cabinet.xml, pos: [2.0, 0.5, 0.6]}}
actions:
  legs: {{func: joint_position, joints: [hip_fl, hip_fr, hip_bl, hip_br]}}
observations: {{policy: {{pos: {{func: joint_pos}}}}}}
rewards:
  forces: {{func: body_lin_acc_l2, weight: 1.0}}  # has the model compute forces of bodies
terminations:
  time_out: {{func: time_out, time_out: true}}
  fell: {{func: bad_orientation, limit_angle: 1.0}}
  low: {{func: root_height_below_minimum, minimum_height: -9.0}}
"""


FILES = {"walker_xml": WALKER, "arm_xml": ARM, "thing_xml": THING, "cabinet_xml": CABINET}


def hand_made(folder, *overrides, num_envs=3):
    """Build environments in the three states of `mdp_numbers`, in turn."""
    env = build(write(folder / "hand", TASK, **FILES), num_envs, *overrides)
    env.reset()
    put(env)
    return env


def put(env):
    """Write the state into the engine and the managers."""
    three, field = states(), env.engine.field
    some = [three[i % 3] for i in range(env.num_envs)]
    model = env.engine.model

    def joint(name):
        j = model.joint(name)
        return int(j.qposadr[0]), int(j.dofadr[0])

    env.engine.expand("opt.gravity").copy_(torch.tensor(GRAVITY)[torch.arange(env.num_envs) % 3])
    root, thing = joint("robot/root")[0], int(model.jnt_qposadr[model.body("object/box").jntadr[0]])
    for i, s in enumerate(some):
        qpos, qvel, ctrl = (torch.zeros(n, dtype=torch.float64) for n in (model.nq, model.nv, model.nu))
        qpos[root : root + 7] = torch.tensor([*s.pos, *s.quat])
        qvel[:6] = torch.tensor([*s.lin, *s.ang])
        qpos[thing : thing + 7] = torch.tensor([*s.thing, *s.thing_quat])
        names = [f"robot/{n}" for n in ("hip_fl", "hip_fr", "hip_bl", "hip_br")]
        names += ["arm/shoulder", "arm/elbow", "arm/finger", "cabinet/slide"]
        for name, q, v in zip(names, [*s.q, *s.arm, s.drawer], [*s.v, *s.arm_vel, 0.0], strict=True):
            qpos[joint(name)[0]], qvel[joint(name)[1]] = q, v
        for a in range(model.nu):
            name = model.joint(int(model.actuator_trnid[a, 0])).name
            ctrl[a] = s.arm_ctrl if name == "arm/shoulder" else s.ctrl[names.index(name)]
        for name, values in (("qpos", qpos), ("qvel", qvel), ("ctrl", ctrl)):
            field(name)[i] = values.to(field(name).dtype)
        env.action_manager.action[i] = torch.tensor(s.action)
        env.action_manager.prev_action[i] = torch.tensor(s.previous)
        env.origins[i] = torch.tensor(s.origin)
    for name in ("qacc", "qfrc_actuator", "sensordata"):
        field(name)
    env.engine.forward(env._select_all())
    for i, s in enumerate(some):
        for j in range(4):
            field("qacc")[i, 6 + j] = s.acc[j]
            field("qfrc_actuator")[i, 6 + j] = s.effort[j]
        for name, values in s.readings.items():
            sensor = model.sensor(f"robot/{name}")
            start = int(sensor.adr[0])
            field("sensordata")[i, start : start + len(values)] = torch.tensor(values).to(field("sensordata").dtype)
    env.sim.refresh()
    env.episode_length_buf.copy_(torch.tensor([s.steps for s in some]))
    manager = env.termination_manager
    manager.terminated = torch.tensor([s.terminated for s in some])
    manager.time_outs = torch.tensor([s.timed_out for s in some])
    manager.fired = {"time_out": manager.time_outs, "fell": manager.terminated, "low": manager.terminated}


def stacked(values):
    found = torch.tensor(np.stack(values))
    return found if found.dtype == torch.bool else found.float()


def sensors(num_envs=3):
    """Return the values of contact and ray sensors, and commands, as the tensors that terms read."""
    three = states()
    some = [three[i % 3] for i in range(num_envs)]
    feet = {name: stacked([getattr(s.feet, name) for s in some]) for name in vars(some[0].feet)}
    rays = {name: stacked([getattr(s.rays, name) for s in some]) for name in vars(some[0].rays)}
    commands = {name: SimpleNamespace(command=stacked([getattr(s, name) for s in some]))
                for name in ("velocity", "pose", "place")}  # fmt: skip
    world_pose = SimpleNamespace(command=stacked([np.concatenate([s.goal, s.goal_quat]) for s in some]))
    return {
        "feet": SimpleNamespace(**feet, force=feet["force_history"][:, 0], names=[f"robot/{n}" for n in FEET]),
        "rays": SimpleNamespace(**rays),
        **commands,
        "world_pose": world_pose,
    }


def bound(env, kwargs, made):
    """Resolve parameters of the YAML to those that the term gets."""
    params = dict(kwargs)
    for name in ("entity", "object", "cabinet", "goal"):
        if name in params:
            params[name] = env.entities[params[name]]
    for name in ("joints", "bodies", "sites", "sensors"):
        if name in params:
            params[name] = params["entity"].select(name.capitalize(), params[name])[0]
    for name in ("command", "sensor"):
        if name in params:
            params[name] = made[params[name]]
    return params


def whole_task(rows, **sim):
    """Return a task that uses rows of the table by name, with real commands and sensors."""
    task = yaml.safe_load(TASK)
    task["sim"] |= sim
    task["scene"]["ground"] = {"size": 50.0}
    task["scene"]["sensors"] = {
        "feet": {"kind": "contact", "bodies": FEET, "history": 2},
        "rays": {"kind": "rays", "pattern": {"size": [0.2, 0.2], "resolution": 0.1}, "alignment": "yaw"},
    }
    box = {"x": [-0.3, 0.3], "y": [-0.3, 0.3]}
    task["commands"] = {
        "velocity": {"func": "uniform_velocity", "lin_vel_x": [-1, 1], "lin_vel_y": [-1, 1], "ang_vel_z": [-1, 1]},
        "pose": {"func": "uniform_pose", "entity": "arm", "bodies": "fore", "z": [0.3, 0.6], "yaw": [-1, 1], **box},
        "place": {"func": "uniform_pose2d", **box},
        "world_pose": {"func": "uniform_pose", "entity": "arm", "bodies": "fore", "z": [0.3, 0.6], **box},
    }
    for command in task["commands"].values():
        command["resampling_time_s"] = [0.1, 0.3]
    task["events"] = {"start": {"func": "reset_joints_by_offset", "mode": "reset", "position": [-0.2, 0.2]}}
    for section, terms in rows.items():
        entries = {}
        for number, (term, parameters, _) in enumerate(terms):
            entries[f"{snake_case(term.__name__)}_{number}"] = {"func": snake_case(term.__name__), **parameters}
        if section == "observations":
            task[section] = {"policy": entries}
        elif section == "rewards":
            task[section] = {name: {"weight": 1.0, **entry} for name, entry in entries.items()}
        else:
            task[section] |= {name: {**entry, "time_out": False} for name, entry in entries.items()}
    return dump(_lists(task))


def _lists(value):
    if isinstance(value, dict):
        return {key: _lists(item) for key, item in value.items()}
    return [_lists(item) for item in value] if isinstance(value, list | tuple) else value
