"""Command `rlcli new`: generator of an installable package with a new task.

The files are written by `rlcli.scaffold`; for the robot of an MJCF, `rlcli.scaffold_robot` designs the task.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import choice
from rlcli.errors import UsageError, listing, pip_install

if TYPE_CHECKING:
    from rlcli.scaffold_robot import RobotTask


def command(
    name: Annotated[str, typer.Argument()],
    flavour: Annotated[str, choice("FLAVOUR", "yaml", "direct")] = "yaml",
    robot: Annotated[Path | None, typer.Option(metavar="FILE")] = None,
    kind: Annotated[str | None, choice("KIND", "velocity", "reach", "balance")] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="FOLDER")] = None,
) -> None:
    """Write the package of a new task with model, configuration, code and tests.

    Options:
        name: Name of the task in lowercase letters, digits and hyphens, such as my-arm.
        robot: MJCF of a robot, for which the task is written: velocity tracking for a floating base with feet and at
            least four driven joints, reaching goals for a fixed base with all joints driven, else balancing.
        kind: Kind of the task for the robot. [default: the kind that fits, as described at --robot]
        flavour: yaml (a task.yaml with lists of terms: observations, rewards and others), or direct (one Python class
            that computes observations, rewards and terminations).
        output: Folder to write. [default: a new folder named after the task]

    Examples:
        rlcli new my-arm
            Write a package with a YAML task into the folder my-arm.
        rlcli new my-dog --robot robots/dog.xml
            Write a package with a task for a robot.
    """
    from rlcli.scaffold import create

    design = None
    if robot is None and kind is not None:
        raise UsageError("--kind needs --robot", hint="add --robot FILE.xml")
    if robot is not None:
        from rlcli.scaffold_robot import read_robot

        if flavour != "yaml":
            raise UsageError(f"--robot and --flavour {flavour} contradict each other", hint="leave out --flavour")
        design = read_robot(robot, name, kind)
        _print_design(design)
    folder, files = create(name, flavour, output, design)
    for file in files:
        console.data(str(folder / file))
    lint = "" if design is None else f"rlcli lint {name} && "  # a robot may fall at once in its file's pose
    console.info(f"next: cd {folder} && {pip_install('-e .')} && {lint}rlcli train {name}")
    console.document(
        "new", task=name, flavour=flavour if design is None else design.kind, folder=str(folder), files=files
    )


def _print_design(design: "RobotTask") -> None:
    """Print the elements of the robot's MJCF, doubts about the file, and the kind of the task with the reason."""
    for what, names in design.found.items():
        noun = what.removesuffix("s") if len(names) == 1 else what
        console.info(f"{len(names)} {noun}: {listing([each or '(unnamed)' for each in names])}")
    for message, hint in design.doubts:
        console.warn(f"{message}; {hint}")
    if not design.has_pose:
        console.warn(
            "no keyframe: the default pose is zero joint angles, except where a limit is near or beyond zero; to change"
            " the pose, set scene.entities.robot.init.joint_pos in task.yaml; for the height, scene.entities.robot.pos"
        )
    console.info(f"task: {design.kind}, because {design.reason}")
