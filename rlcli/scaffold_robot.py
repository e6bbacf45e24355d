"""Task design for `rlcli new --robot`: read an MJCF, choose a kind of task, and return the model and the YAML data.

velocity: follow velocity commands, for a robot with a floating base, feet, at least four driven joints, and fewer
passive joints than driven ones, whose MJCF has gravity and contacts with the ground. reach: bring the last body to
goals, for a robot with a fixed base and at least two joints, all driven. balance: keep the default pose, for any other
robot.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rlcli.config.strict_yaml import load
from rlcli.errors import TaskError, UsageError, listing, require_known
from rlcli.scaffold_mjcf import Robot, round3
from rlcli.scaffold_mjcf_copy import SCALAR
from rlcli.scene.mjcf_safety_check import BadModel
from rlcli.scene.untrusted_mjcf import read_mjcf

_TEMPLATES = Path(__file__).parent / "templates" / "robot_tasks"

_AGENT_VALUES: dict[str, dict[str, Any]] = {  # kind of task -> values of the template `agent.yaml`
    "velocity": {"max_iterations": 1500, "gamma": 0.99, "entropy_coef": 0.005},
    # a horizon of 0.7 s, in which an arm reaches most goals; little noise at the end, so that the arm settles
    "reach": {"max_iterations": 1000, "gamma": 0.97, "entropy_coef": 0.001},
    "balance": {"max_iterations": 300, "gamma": 0.99, "entropy_coef": 0.005},
}


@dataclass(slots=True)
class RobotTask:
    """Task for a robot: the content of the task's files, and the names of the elements in the robot's MJCF."""

    kind: str
    """Kind of the task: velocity, reach or balance."""
    reason: str
    """Why the robot gets a task of this kind."""
    model: str
    """The MJCF of the task."""
    assets: dict[str, Path]
    """Path of an asset file in the task's package -> file to copy."""
    task: dict[str, Any]
    """The task as data of its YAML."""
    found: dict[str, list[str]]
    """Names of the elements of the MJCF, under the keys `joints`, `actuators`, `sensors` and `keyframes`."""
    has_pose: bool
    """Whether the MJCF has a default pose: a keyframe, or the element `numeric` with the name `init_qpos`."""
    doubts: list[tuple[str, str]]
    """(message, hint) for each property of the MJCF that is probably an error, such as a wrong unit."""


def read_robot(file: Path, name: str, kind: str | None = None) -> RobotTask:
    """Read an MJCF and design a task for its robot.

    Args:
        file: the MJCF.
        name: name of the task.
        kind: velocity, reach or balance; None: the kind that fits the robot.

    Raises:
        UsageError: if there is no such file, no joint of the robot can be driven, or the kind is unknown or impossible
            for the robot.
        TaskError: if MuJoCo cannot compile the model, or it has an element that rlcli refuses.
    """
    if file.is_dir():
        models = sorted(entry.name for entry in file.glob("*.xml"))
        inside = f"give a file in the folder: {listing(models)}" if models else "give the MJCF file of a robot"
        raise UsageError(f"--robot: {file} is a folder", hint=inside)
    if not file.is_file():
        raise UsageError(f"--robot: there is no file {file}", hint="give the MJCF of a robot, as in --robot robot.xml")
    try:
        spec = read_mjcf(file, _asset_roots(file.resolve()))
        with warnings.catch_warnings(action="ignore"):  # MuJoCo warns of deprecated attributes, which still work
            robot = Robot(spec, file)
    except (BadModel, ValueError) as error:
        raise TaskError(
            f"{file} cannot be used: {error}", hint="correct the file; python -m mujoco.viewer --mjcf FILE shows it"
        ) from None
    if not robot.driven:
        raise UsageError(
            f"{file}: no joint can be driven", hint="add hinges or slides, with motors or position actuators"
        )
    fitting, reason = robot.fitting_kind()
    if kind is None:
        kind, reason = fitting, f"{reason}; --kind chooses another kind"
    else:
        require_known(kind, list(_SUMMARIES), "kind of task", "kinds")
        reason = f"--kind says so; without --kind {fitting}, because {reason}"
        if obstacle := robot.obstacle_to(kind):
            raise UsageError(f"--kind {kind} is impossible for {file}: {obstacle}", hint=f"try --kind {fitting}")
    if kind == "reach":
        robot.prepare_for_reaching()
    parts = {"velocity": _velocity, "reach": _reach, "balance": _balance}[kind](robot)
    sensors = parts.pop("_sensors", {})
    task = {
        "summary": f"{_SUMMARIES[kind]} ({name}).",
        "decimation": robot.decimation,
        "episode_length_s": round3(robot.tempo * (20.0 if kind == "velocity" else 8.0)),
        "sim": robot.sim_settings(),
        "scene": robot.scene_settings(kind) | {"sensors": sensors},
        "viewer": robot.viewer_settings(kind),
        **parts,
        "play": {"scene": {"num_envs": 16}},
        "agents": {
            "default": "ppo",
            "ppo": _fill("agent", _AGENT_VALUES[kind]),
        },
    }
    task = json.loads(json.dumps(task))  # copies: YAML would write lists that are used twice as anchors
    return RobotTask(kind, reason, robot.xml, robot.assets, task, robot.found, robot.has_pose, robot.doubts)


def _asset_roots(file: Path) -> list[Path]:
    """Return the folders from which an MJCF may load files.

    They are the folder of the MJCF, its parent, its Python package and its repository, unless the repository contains
    the home folder, such as a repository of dotfiles.
    """
    home = Path.home()
    own = [folder for folder in file.parents if folder != home and folder not in home.parents]
    packages = [folder for folder in own if (folder / "__init__.py").is_file()]
    projects = [folder for folder in own if any((folder / mark).exists() for mark in _PROJECT_MARKS)]
    return [file.parent, file.parent.parent, *packages[-1:], *projects[:1]]


_PROJECT_MARKS = (".git", "pyproject.toml", "package.xml")
"""Files or folders by which the top folder of a repository is found."""
_SUMMARIES = {
    "velocity": "Follow velocity commands",
    "reach": "Bring the last body to goals",
    "balance": "Keep the default pose",
}


def _fill(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the data of the YAML template `name`, with each value `$key` replaced by `values[key]`."""

    def filled(node: Any) -> Any:
        """Return a node of the data with its values replaced."""
        if isinstance(node, dict):
            return {key: filled(item) for key, item in node.items()}
        if isinstance(node, list):
            return [filled(item) for item in node]
        return values[node[1:]] if isinstance(node, str) and node.startswith("$") else node

    data: dict[str, Any] = filled(load((_TEMPLATES / f"{name}.yaml").read_bytes()).data)
    return data


def _velocity(robot: Robot) -> dict[str, Any]:
    """Return the sections of a task with velocity commands for a robot, as data of its YAML."""
    speed = round3(math.sqrt(robot.gravity * robot.com_height / 15.0))  # a slow walk for every size: Froude number 1/15
    yaw_rate = round3(0.6 / robot.tempo)
    values = {
        "joints": [robot.name(j) for j in robot.driven],
        "feet": robot.feet(),
        "trunk": robot.trunk(),
        "period": round3(10.0 * robot.tempo),
        "speed": speed,
        "minus_speed": -speed,
        "half_speed": round3(0.5 * speed),
        "minus_half_speed": round3(-0.5 * speed),
        "yaw_rate": yaw_rate,
        "minus_yaw_rate": -yaw_rate,
        "half_yaw_rate": round3(0.5 * yaw_rate),
        "air_time": round3(0.2 * robot.tempo),
        "velocity_error": round3(0.42 * speed),
    }
    return _fill("velocity", values)


def _reach(robot: Robot) -> dict[str, Any]:
    """Return the sections of a reaching task for a robot, as data of its YAML."""
    extents = np.ptp(robot.workspace(), axis=0)
    size = float(extents.max())
    values = {
        "joints": [robot.name(j) for j in robot.driven],
        "hand": robot.body_name(robot.last_body()),
        "period": round3(8.0 * robot.tempo),
        "offsets": robot.offsets(),
        "scales": robot.action_scales(),
        "moving_axes": [i for i in range(3) if extents[i] > 0.01 * size],
        "distance_weight": round3(-4.0 / size),
        "near_std": round3(0.05 * size),
        "at_most": round3(0.025 * size),
        "hold_s": round3(0.5 * robot.tempo),
    }
    return _fill("reach", values)


def _balance(robot: Robot) -> dict[str, Any]:
    """Return the sections of a balance task for a robot, as data of its YAML."""
    moving = sorted([*robot.driven, *robot.passive])
    posed = [j for j in moving if not robot.is_wheel(j)]
    if not posed and not robot.free:
        posed = moving  # a wheel on a fixed axis: there is no other joint to hold
    passive = [j for j in robot.passive if j in posed]
    hinges = [j for j in passive if robot.model.jnt_type[j] == SCALAR[0]] or passive or posed
    held: dict[float, list[str]] = {}
    for joint in hinges:
        held.setdefault(round(float(robot.data.qpos[robot.model.jnt_qposadr[joint]]), 4), []).append(robot.name(joint))
    values = {
        "driven": [robot.name(j) for j in robot.driven],
        "scale": {robot.name(j): round3(abs(robot.max_effort(j))) for j in robot.driven},
        "moving": [robot.name(j) for j in moving],
        "joints": [robot.name(j) for j in posed],
        "hinges": [robot.name(j) for j in hinges],
        "wheels": [robot.name(j) for j in moving if j not in posed],
    }
    task = _fill("balance", values)
    observations, rewards = task["observations"]["policy"], task["rewards"]
    if not robot.free:
        del task["events"]["root"], rewards["upright"]
        del observations["base_lin_vel"], observations["base_ang_vel"], observations["projected_gravity"]
    for terms in (observations, rewards):
        for name in [name for name, term in terms.items() if term.get("joints") == []]:
            del terms[name]
    task["success"], ends = _balance_conditions(robot, held)
    task["terminations"] |= ends
    return task


def _balance_conditions(robot: Robot, held: dict[float, list[str]]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the sections `success` and `terminations` of a balance task.

    For a floating base, the sections limit the tilt; for a fixed base, the deviation of joints from the default pose.

    Args:
        robot: the robot.
        held: position in the default pose [m or rad] -> names of the joints that the task holds at this position.
    """
    hold = {"at_most": 0.2, "hold_s": robot.tempo}
    if robot.free:
        success: dict[str, Any] = {"upright": {"func": "root_tilt", **hold}}
        return success, {"fallen": {"func": "bad_orientation", "limit_angle": 1.0}}
    success, ends = {}, {}
    for number, (target, joints) in enumerate(held.items()):
        name = "pose" if len(held) == 1 else f"pose_{number}"
        success[name] = {"func": "joint_error", "joints": joints, "target": target, **hold}
        bounds = [target - 1.0, target + 1.0]
        ends[f"{name}_lost"] = {"func": "joint_pos_out_of_manual_limit", "joints": joints, "bounds": bounds}
    return success, ends
