"""A step on the GPU engine forces no host sync: the host reads no value, and no size depends on one."""

import pytest
import torch
import yaml
from support.worlds import CRITTER, CRITTER_TASK, build, dump, write

from rlcli.testing.host_sync import HostSyncError, HostSyncGuard

pytestmark = pytest.mark.warp


def every_term():
    """Return the critter's task with the remaining terms of the library."""
    task = yaml.safe_load(CRITTER_TASK)
    task["sim"]["engine"] = "warp"
    task["success"] = {"near": {"func": "joint_error", "at_most": 0.5, "hold_s": 0.1}}
    task["divergence_reward"] = -1.0
    task["actions"]["push"] = {"func": "joint_effort", "joints": ["hip_fl"], "scale": 0.1, "clip": [-1.0, 1.0]}
    task["observations"]["policy"]["vel"].pop("joints")
    task["events"]["scene"] = {"func": "reset_scene_to_default", "mode": "reset"}
    task["events"]["offset"] = {"func": "reset_joints_by_offset", "mode": "reset", "joints": ["hip_fl", "hip_br"],
                                "position": [-0.1, 0.1], "velocity": [-0.1, 0.1]}  # fmt: skip
    mixed = {"distribution": "loguniform", "range": [0.5, 2.0]}
    task["events"] |= {
        "mass": {"func": "randomize_body_mass", "mode": "reset", **mixed},
        "com": {"func": "randomize_body_com", "mode": "reset", "range": [-0.01, 0.01], "min_steps_between": 3},
        "friction": {"func": "randomize_geom_friction", "mode": "interval", "interval_range_s": [0.02, 0.1],
                     "global_time": True, "range": [0.5, 1.5]},
        "gravity": {"func": "randomize_gravity", "mode": "reset", "range": [0.0, 0.1], "distribution": "gaussian"},
        "limits": {"func": "randomize_joint_range", "mode": "reset", "upper": [-0.1, 0.1]},
        "pose": {"func": "randomize_default_joint_pos", "mode": "reset", "range": [-0.1, 0.1]},
        "gains": {"func": "randomize_actuator_gains", "mode": "reset", "actuators": ["hip_bl"], "kp": [0.9, 1.1]},
        "effort": {"func": "randomize_effort_limit", "mode": "reset", "actuators": ["hip_bl"], "range": [0.9, 1.1]},
        "pd": {"func": "randomize_pd_gains", "mode": "reset", "joints": ["hip_f.", "hip_br"], "stiffness": [0.9, 1.1]},
        "turn": {"func": "randomize_body_quat", "mode": "reset", "bodies": ["leg_bl"], "yaw": [-0.1, 0.1]},
        "hit": {"func": "apply_body_impulse", "mode": "interval", "interval_range_s": [0.02, 0.1], "bodies": ["torso"],
                "force": [-1.0, 1.0]},
        "anyhow": {"func": "reset_root_state_with_random_orientation", "mode": "reset", "z": [0.2, 0.3]},
        "within": {"func": "reset_joints_within_limits", "mode": "reset"},
        "gauss": {"func": "reset_joints_by_gaussian", "mode": "reset", "position": [0.0, 0.1]},
    }  # fmt: skip
    task["commands"] = {
        "walk": {"func": "uniform_velocity", "resampling_time_s": [0.04, 0.08], "lin_vel_x": [-1.0, 1.0],
                 "ang_vel_z": [-1.0, 1.0], "heading": [-3.0, 3.0], "rel_standing": 0.2},
        "run": {"func": "normal_velocity", "resampling_time_s": [0.04, 0.08], "mean": [1.0, 0.0, 0.0],
                "std": [0.1, 0.1, 0.1], "zero_prob": [0.0, 0.5, 0.5]},
        "pose": {"func": "uniform_pose", "resampling_time_s": [0.04, 0.08], "bodies": ["torso"], "x": [0.0, 1.0],
                 "y": [0.0, 0.0], "z": [0.0, 0.0]},
        "goal": {"func": "reachable_position", "resampling_time_s": [0.04, 0.08], "bodies": ["leg_fl"]},
        "place": {"func": "uniform_pose2d", "resampling_time_s": [0.04, 0.08], "x": [0.0, 1.0], "y": [0.0, 1.0]},
    }  # fmt: skip
    task["observations"]["policy"]["pos"] |= {
        "modifiers": [{"kind": "digital_filter", "a": [0.5], "b": [0.5]}, {"kind": "integrator"},
                      {"kind": "clip", "bounds": [-9.0, 9.0]}, {"kind": "scale", "factor": 2.0}],
        "noise": {"kind": "gaussian", "std": 0.1}, "bias": {"kind": "uniform"},
        "delay": {"steps": [0, 2], "redraw": 0.5}, "history": 3,
    }  # fmt: skip
    task["curriculum"] = {
        "mass": {"func": "interpolate", "address": "events.mass.range", "end": 10, "to": [0.8, 1.2]},
        "weight": {"func": "stages", "address": "rewards.alive.weight", "steps": [3], "values": [2.0]},
        "push": {"func": "interpolate", "address": "events.push.linear_velocity", "end": 10,
                 "to": [[-2.0, 2.0], [-2.0, 2.0], [0.0, 0.0]]},
    }  # fmt: skip
    task["scene"]["entities"]["robot"]["actuators"] = {
        "front": {"joints": ["hip_f."], "stiffness": 20.0, "damping": 0.5, "delay": [0, 2]},
        "rear": {"joints": ["hip_br"], "kind": "dc_motor", "stiffness": 20.0, "saturation_effort": 9.0,
                 "velocity_limit": 20.0},
    }  # fmt: skip
    task["rewards"]["target"] = {"func": "joint_pos_target_l2", "weight": -0.1, "target": 0.0}
    task["rewards"].pop("power")  # it needs one joint a column; two actions drive the same joint
    task["terminations"] |= {
        "manual": {"func": "joint_pos_out_of_manual_limit", "bounds": [-2.0, 2.0]},
        "soft": {"func": "joint_pos_out_of_limit"},
        "fast": {"func": "joint_vel_out_of_manual_limit", "max_velocity": 500.0},
    }
    return dump(task)


def watched_steps(env, steps):
    """Run steps with resets, and return the number of ended episodes."""
    action = 0.3 * torch.ones(env.num_envs, env.layout.action_size)
    env.reset()
    env.step(action)
    ended = torch.zeros((), dtype=torch.int64)
    with HostSyncGuard():
        for _ in range(steps):
            ended += env.step(action).episodes.mask.sum()
    env.check()
    return int(ended)


@pytest.mark.parametrize("task", ["cartpole", "ant-direct"])
def test_built_in_task_step_has_no_host_sync(task):
    env = build(task, 4, "sim.engine=warp", "episode_length_s=0.1")
    assert watched_steps(env, 8) >= 4


def test_step_with_every_kind_of_term_has_no_host_sync(tmp_path):
    folder = write(tmp_path / "critter", every_term(), critter_xml=CRITTER)
    env = build(folder, 4, "episode_length_s=0.1", "sim.forces_after_reset=true")
    assert watched_steps(env, 8) >= 4
    env.engine.field("qvel")[1, 0] = torch.nan
    with HostSyncGuard():
        result = env.step(torch.zeros(4, env.layout.action_size))
    assert result.terminated[1]
    assert env.divergences == 1


@pytest.mark.slow  # kernels for height fields compile for a minute
def test_step_with_terrain_and_sensors_has_no_host_sync(tmp_path):
    task = yaml.safe_load(every_term())
    sub_terrains = {"hills": {"kind": "noise"}, "stairs": {"kind": "stairs", "boxes": True}}
    task["scene"]["terrain"] = {"kind": "generator", "rows": 2, "columns": 2, "sub_terrains": sub_terrains}
    task["scene"]["sensors"] = {
        "feet": {"kind": "contact", "bodies": "leg_.*", "history": 2, "against": "ground", "force_threshold": 1.0},
        "scan": {"kind": "rays", "pattern": {"size": [0.4, 0.4], "resolution": 0.2}, "alignment": "yaw"},
    }
    task["scene"]["entities"]["gate"] = {"shape": "box", "size": [0.1, 1.0, 1.0], "pos": [9.0, 0, 0.5], "mocap": True}
    task["observations"]["policy"] |= {"feet": {"func": "sensed"}}
    task["curriculum"] = {"levels": {"func": "terrain_levels", "least": 0.1}}
    terms = """
import torch
from rlcli.task import ContactSensor, RaySensor

def sensed(env, *, feet: ContactSensor = "feet", scan: RaySensor = "scan"):
    \"\"\"Readings of both sensors. (num_envs, k)\"\"\"
    return torch.cat([feet.force_history.flatten(1), feet.air_time, feet.first_contact.float(), scan.distance], dim=1)
"""
    folder = write(tmp_path / "critter", dump(task), critter_xml=CRITTER, terms_py=terms)
    env = build(folder, 4, "episode_length_s=0.1")
    assert watched_steps(env, 14) >= 4


def test_detector_finds_mask_and_number_reads():
    values = torch.arange(4.0)
    for reading in (lambda: values[values > 1], lambda: float(values.sum()), lambda: (values > 1).nonzero()):
        with pytest.raises(HostSyncError), HostSyncGuard():
            reading()
