"""Tasks that can diverge in every way, and how to cause each kind of divergence."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from rlcli.runs.trusted_tasks import named_task
from support.worlds import actions, build, clone, dump, results_of_env, same, write

N = 5
WHO = (0, 2, N - 1)
MACHINE = """
<mujoco model="machine">
  <compiler angle="radian" autolimits="true"/>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body name="base"><geom size="0.05" mass="1"/>
      <body name="arm"><joint name="swing" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.1 0 -0.5" mass="1"/>
        <body name="hand" pos="0 0 -0.5"><joint name="reach" type="slide" axis="0 0 1" damping="1" range="-0.1 0.1"/>
          <geom size="0.03" mass="0.2"/></body></body>
    </body>
  </worldbody>
  <actuator>
    <motor name="turn" joint="swing"/>
    <general name="push" joint="reach" dyntype="filter" dynprm="0.05" gainprm="5"/>
  </actuator>
</mujoco>
"""
TARGET = """
<mujoco model="target"><worldbody><body name="target" mocap="true"><geom size="0.05"/></body></worldbody></mujoco>
"""
TERMS = '''
import torch
from rlcli.task import Entity

BAD = {}


def _rows(selection, what, values):
    """Return the selected environments that the fault applies to."""
    return [i for i in BAD.get(what, ()) if i in selection.ids.tolist()]


def start(env, selection, *, entity: Entity = "robot"):
    """Sample small joint positions; a fault may replace the initial state."""
    selection.write(entity.engine.field("qpos"), selection.uniform(-0.3, 0.3, (1,)).double(), slice(0, 1))
    for i in _rows(selection, "reset", None):
        entity.engine.field("qpos")[i, 0] = BAD["value"]


def shove(env, selection, *, entity: Entity = "robot"):
    """Push a little; a fault may replace the push."""
    qvel = entity.engine.field("qvel")
    for i in selection.ids.tolist():
        qvel[i, 0] += 0.01
    for i in _rows(selection, "event", None):
        qvel[i, 0] = BAD["value"]


class Turned:
    """Action term that sets the controls; a fault may replace them."""

    def __init__(self, env, *, entity: Entity = "robot") -> None:
        self.size, self.elements, self.unit = 2, ("turn", "push"), ""
        self._ctrl = entity.engine.field("ctrl")

    def process(self, action: torch.Tensor) -> None:
        self._ctrl[:] = action.double()
        for i in BAD.get("ctrl", ()):
            self._ctrl[i, 0] = BAD["value"]


def angle(env, *, entity: Entity = "robot"):
    """(num_envs,)"""
    value = entity.data.joint_pos[:, 0].clone()
    for i in BAD.get("reward", ()):
        value[i] = BAD["value"]
    return value


def seen(env, *, entity: Entity = "robot"):
    """(num_envs, 2)"""
    value = entity.data.joint_vel.clone()
    for i in BAD.get("observation", ()):
        value[i, 1] = BAD["value"]
    return value
'''
TASK = {
    "decimation": 3,
    "episode_length_s": 3.0,
    "sim": {"dt": 0.01},
    "scene": {
        "num_envs": N,
        "ground": None,
        "entities": {"robot": {"model": "machine.xml"}, "target": {"model": "target.xml"}},
    },
    "actions": {"drive": {"func": "turned"}},
    "observations": {"policy": {"pos": {"func": "joint_pos"}, "vel": {"func": "seen"}}},
    "events": {
        "start": {"func": "start", "mode": "reset"},
        "shove": {"func": "shove", "mode": "interval", "interval_range_s": [0.15, 0.15]},
    },
    "rewards": {"alive": {"func": "is_alive", "weight": 1.0}, "angle": {"func": "angle", "weight": 1.0}},
    "terminations": {"time_out": {"func": "time_out", "time_out": True}},
}
_MOVES = "".join(
    f'<joint name="{kind}{axis}{{0}}" type="{kind}" axis="{" ".join(str(int(axis == a)) for a in "xyz")}"/>'
    for kind in ("slide", "hinge")
    for axis in "xyz"
)
_BOX = '<body name="box{0}" pos="{1} 0 0.00{0}">' + _MOVES + '<geom type="box" size="0.1 0.1 0.1" mass="1"/></body>'
BOXES = f"""
<mujoco model="boxes"><size memory="70K"/><worldbody>
  {"".join(_BOX.format(i, 5 * i) for i in range(4))}
</worldbody></mujoco>
"""
"""Boxes that are apart; stacked, their contacts need more memory than available."""
BOXES_TASK = {
    **TASK,
    "sim": {"dt": 0.01, "gravity": [0.0, 0.0, 0.0]},
    "scene": {"num_envs": N, "ground": None, "entities": {"robot": {"model": "boxes.xml"}}},
    "actions": {"drive": {"func": "joint_effort", "joints": ["slidex0", "slidex1"]}},
    "observations": {"policy": {"pos": {"func": "joint_pos"}}},
    "events": {},
    "rewards": {"alive": {"func": "is_alive", "weight": 1.0}},
}
EXPLICIT_TASK = {
    **TASK,
    "scene": {
        "num_envs": N,
        "ground": None,
        "entities": {
            "robot": {"model": "arm.xml", "actuators": {"servo": {"joints": ["swing", "reach"], "stiffness": 5.0,
                                                                 "damping": 0.1}}}
        },
    },
    "actions": {"drive": {"func": "joint_position", "joints": ["swing", "reach"], "scale": 0.1}},
}  # fmt: skip


PLAIN_TASK = {
    **TASK,
    "scene": {"num_envs": N, "ground": None, "entities": {"robot": {"model": "arm.xml"}}},
    "actions": {"drive": {"func": "joint_effort", "joints": ["swing", "reach"]}},
    "events": {},
}

LEARNERS = {
    "ppo": {
        "trainer": "ppo",
        "algorithm": "ppo",
        "num_steps": 8,
        "num_minibatches": 2,
        "num_epochs": 2,
        "normalize_observations": True,
    },
    "sb3-ppo": {"trainer": "sb3", "algorithm": "ppo", "n_steps": 8, "num_minibatches": 2, "n_epochs": 2},
    "sb3-a2c": {"trainer": "sb3", "algorithm": "a2c", "n_steps": 8},
    "sb3-sac": {"trainer": "sb3", "algorithm": "sac", "train_freq": 4, "gradient_steps": 2, "learning_starts": 8},
    "sb3-td3": {"trainer": "sb3", "algorithm": "td3", "train_freq": 4, "gradient_steps": 2, "learning_starts": 8},
}
"""Minimal agents of every algorithm."""
LEARNING_TASK = {
    **PLAIN_TASK,
    "agents": {
        name: {"max_iterations": 3, "normalize_observations": True, "save_interval": 1, **agent}
        | ({"batch_size": 8, "buffer_size": 1000} if "train_freq" in agent else {})
        for name, agent in LEARNERS.items()
    },
}


def machine(folder: Path, task: dict | None = None):
    """Write a task with activations, controls, a mocap body, events and terms that can fail."""
    arm = MACHINE[: MACHINE.index("  <actuator>")] + "</mujoco>"
    return write(
        folder / "machine", dump(task or TASK), machine_xml=MACHINE, target_xml=TARGET, arm_xml=arm, boxes_xml=BOXES,
        terms_py=TERMS,
    )  # fmt: skip


def faults(env) -> dict:
    """Return the faults that the terms of the task read."""
    return env.reward_manager.terms[-1].instance.func.__globals__["BAD"]


@dataclass(frozen=True)
class Fault:
    """A way to make the simulation diverge in some environments."""

    strike: Callable
    """(env, environments)"""
    cause: str
    """Cause that the guard reports."""
    detail: str = ""
    """Part of the guard's message."""
    cure: Callable = lambda env, who: None
    """Removes the fault."""
    expands: tuple[str, ...] = ()
    """Model fields that must be expanded per environment."""
    task: dict | None = None
    written: bool = False
    """Whether an event or a reset causes it: then the episode ends with the next step."""


def _writes(field: str, value: float, *columns: int) -> Callable:
    def strike(env, who):
        for i in who:
            env.engine.field(field)[(i, *columns)] = value

    return strike


def _spoils(field: str, value: float, *columns: int) -> dict:
    def strike(env, who):
        for i in who:
            env.engine.expand(field)[(i, *columns)] = value

    def cure(env, who):
        owner, name = (env.engine.model.opt, field[4:]) if field.startswith("opt.") else (env.engine.model, field)
        env.engine.expand(field)[:] = torch.as_tensor(getattr(owner, name), dtype=torch.float64)

    return {"strike": strike, "cure": cure, "expands": (field,)}


def _tells(what: str, value: float) -> dict:
    def strike(env, who):
        faults(env).update({what: list(who), "value": value})

    return {"strike": strike, "cure": lambda env, who: faults(env).clear()}


def _stiffens(env, who):
    for i in who:
        env.actuators["robot.servo"].stiffness[i] = math.nan


def _softens(env, who):
    env.actuators["robot.servo"].stiffness.fill_(5.0)


def _piles_up(env, who):
    for i in who:
        env.engine.field("qpos")[i, ::6] = -5.0 * torch.arange(4, dtype=torch.float64)


def _starts_badly(env, who):
    """End the episodes of some environments; their new initial states are bad."""
    faults(env).update({"reset": list(who), "value": math.nan})
    for i in who:
        env.episode_length_buf[i] = env.max_episode_length


QUICK_TASK = {**TASK, "sim": {"dt": 0.01, "max_velocity": 200.0}}

FAULTS = {
    "nan qpos": Fault(_writes("qpos", math.nan, 0), "BADQPOS", "joint 'robot/swing'"),
    "inf qpos": Fault(_writes("qpos", math.inf, 1), "BADQPOS", "joint 'robot/reach'"),
    "1e30 qpos": Fault(_writes("qpos", 1e30, 0), "BADQPOS", "joint 'robot/swing'"),
    "nan qvel": Fault(_writes("qvel", math.nan, 1), "BADQVEL", "joint 'robot/reach'"),
    "inf qvel": Fault(_writes("qvel", -math.inf, 0), "BADQVEL", "joint 'robot/swing'"),
    "1e30 qvel": Fault(_writes("qvel", -1e30, 0), "BADQVEL", "joint 'robot/swing'"),
    "nan act": Fault(_writes("act", math.nan, 0), "BADQACC", "act was not finite"),
    "nan ctrl": Fault(cause="BADCTRL", detail="actuator 'robot/turn'", **_tells("ctrl", math.nan)),
    "inf ctrl": Fault(cause="BADCTRL", detail="ctrl was not finite", **_tells("ctrl", math.inf)),
    "1e30 ctrl": Fault(cause="BADCTRL", detail="actuator 'robot/turn'", **_tells("ctrl", 1e30)),
    "nan xfrc": Fault(_writes("xfrc_applied", math.nan, 2, 0), "BADQACC", "xfrc_applied was not finite"),
    "1e30 xfrc": Fault(_writes("xfrc_applied", 1e30, 2), "BADQACC"),
    "nan qfrc": Fault(_writes("qfrc_applied", math.nan, 0), "BADQACC", "qfrc_applied was not finite"),
    "nan mocap": Fault(_writes("mocap_pos", math.nan, 0, 1), "BADQACC", "mocap_pos was not finite"),
    "nan mass": Fault(cause="BADQACC", detail="model field body_mass", **_spoils("body_mass", math.nan, 2)),
    "nan timestep": Fault(cause="BADQACC", detail="model field opt.timestep", **_spoils("opt.timestep", math.nan)),
    "nan gravity": Fault(cause="BADQACC", detail="model field opt.gravity", **_spoils("opt.gravity", math.nan, 2)),
    "nan damping": Fault(cause="BADQACC", detail="model field dof_damping", **_spoils("dof_damping", math.nan, 0)),
    "actuator model": Fault(
        _stiffens, "BADCTRL", "ctrl was not finite before the step", cure=_softens, task=EXPLICIT_TASK
    ),
    "engine error": Fault(_piles_up, "engine error", "memory", task=BOXES_TASK),
    "event writes nan": Fault(cause="qvel not finite", detail="an event", written=True, **_tells("event", math.nan)),
    "event writes 1e30": Fault(cause="qvel out of bounds", detail="an event", written=True, **_tells("event", 1e30)),
    "reset writes nan": Fault(
        _starts_badly, "qpos not finite", "a reset", cure=lambda env, who: faults(env).clear(), written=True
    ),
    "too fast": Fault(_writes("qvel", 900.0, 0), "qvel out of bounds", "joint 'robot/swing' = ", task=QUICK_TASK),
}


def pair(folder: Path, fault: Fault, *overrides: str):
    """Build two equal environments: one gets the fault, the other is the reference."""
    task = machine(folder, fault.task)
    named_task(str(task))  # trust the task: a dump of it is loaded later
    envs = [build(task, N, *overrides) for _ in range(2)]
    for env in envs:
        for field in fault.expands:
            env.engine.expand(field)
        for field in ("xfrc_applied", "qfrc_applied", "mocap_pos", "act"):
            env.engine.field(field)
        env.reset()
    return envs


def step_both(envs, steps: int, seed: int):
    """Step both environments with the same actions."""
    size = envs[0].layout.action_size
    return [[clone(env.step(a)) for env in envs] for a in actions(steps, N, size, seed)]


def untouched(results, who) -> bool:
    """Return whether all other environments have equal trajectories in both."""
    left, right = zip(*results, strict=True)
    return all(same(results_of_env(list(left), i), results_of_env(list(right), i)) for i in range(N) if i not in who)
