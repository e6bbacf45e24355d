"""Task of `rlcli new --robot`: reads an MJCF, chooses what its robot can do, and writes the model and the YAML.

A floating base with at least four driven joints follows velocity commands, a fixed base whose joints are all driven
brings its last body to goals, and any other robot balances its passive joints at the default pose.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2

from rlcli.config import strict_yaml
from rlcli.errors import TaskError, UsageError
from rlcli.robot_model import SCALAR, Robot, short
from rlcli.scene.untrusted_mjcf import BadModel, read_mjcf

_TEMPLATES = Path(__file__).parent / "templates" / "robot_task"


@dataclass(slots=True)
class RobotTask:
    """The files of a task for one robot, and what was found in its MJCF."""

    kind: str
    """velocity, reach or balance."""
    model: str
    """The MJCF of the task."""
    assets: dict[str, Path]
    """File in the task's package -> file to copy."""
    task: dict[str, Any]
    """The task as data of its YAML."""
    found: dict[str, list[str]]
    """joints, actuators, sensors and keyframes -> their names."""


def read_robot(file: Path, name: str) -> RobotTask:
    """Read an MJCF and design a task for its robot.

    Raises:
        UsageError: if there is no such file, or the robot has nothing that can be controlled.
        TaskError: if the model is refused.
    """
    if not file.is_file():
        raise UsageError(f"there is no file {file}", hint="give the MJCF of a robot, as in --robot robot.xml")
    try:
        spec = read_mjcf(file, [file.parent.resolve(), file.resolve().parent.parent])
        robot = Robot(spec, file)
    except (BadModel, ValueError) as error:
        raise TaskError(f"{file} cannot be used: {error}", hint="MuJoCo must be able to compile it") from None
    if not robot.driven:
        raise UsageError(
            f"{file}: no joint can be driven", hint="add hinges or slides, with motors or position actuators"
        )
    kind = robot.kind()
    values = {"velocity": _velocity, "reach": _reach, "balance": _balance}[kind](robot)
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        autoescape=False,  # the filter `json` quotes the names of the MJCF
    )
    environment.filters["json"] = json.dumps
    driven = [robot.name(j) for j in robot.driven]
    text = environment.get_template(f"{kind}.yaml.jinja").render(name=name, robot=robot, driven=driven, **values)
    return RobotTask(kind, robot.xml, robot.assets, strict_yaml.load(text).data, robot.found)


def _velocity(robot: Robot) -> dict[str, Any]:
    sensors = {"feet": robot.feet(), "trunk": [robot.body(robot.root)]}
    return {"sensors": {n: {"kind": "contact", "bodies": b, "against": "ground"} for n, b in sensors.items()}}


def _reach(robot: Robot) -> dict[str, Any]:
    last = robot.last_body()
    box = robot.workspace(last)
    return {"hand": robot.body(last), "box": box, "columns": [i for i in range(3) if box[i][0] < box[i][1]]}


def _balance(robot: Robot) -> dict[str, Any]:
    hinges = [j for j in robot.passive if robot.model.jnt_type[j] == SCALAR[0]] or robot.passive or robot.driven
    positions = {round(float(robot.data.qpos[robot.model.jnt_qposadr[j]]), 4) for j in hinges}
    target = positions.pop() if len(positions) == 1 else None
    return {
        "held": [robot.name(j) for j in hinges],
        "every": [robot.name(j) for j in robot.joints],
        "efforts": {robot.name(j): short(abs(robot.effort(j))) for j in robot.driven},
        "target": target or 0.0,
        "bounds": None if target is None else [target - 1.0, target + 1.0],
    }
