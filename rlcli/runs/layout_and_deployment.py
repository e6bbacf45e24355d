"""Schema of the entries `layout` and `deployment` of a checkpoint's manifest.json, and checks against the policy.

The layout lists the columns of observations and actions that a policy was trained with. The deployment record describes
the environment, with formulas for observations and controls, for programs that run the policy without rlcli. A manifest
may be untrusted, so every entry is checked.
"""

import math
import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Self

from pydantic import ConfigDict, Field, JsonValue, model_validator

from rlcli.errors import CheckpointError
from rlcli.rl.policy import Policy
from rlcli.runs.checkpoint_reader import Checkpoint
from rlcli.runs.safe_io import FileModel, check_json

Name = Annotated[str, Field(max_length=1000)]
Columns = Annotated[list[Annotated[int, Field(ge=0, lt=2**31)]], Field(max_length=100_000)]
Numbers = Annotated[list[float], Field(max_length=100_000)]

OPS = {
    "add": 2, "sub": 2, "mul": 2, "div": 2, "clip": 3, "take": 2, "cat": None, "dot": 2, "cross": 2, "sqrt": 1,
    "rotate": 2, "unrotate": 2, "product": 2, "inverse": 1, "unique": 1, "asin": 1, "angle": 1, "wrap": 1, "below": 4,
    "filter": 1,
}  # fmt: skip
"""Operation that a formula may contain, such as `add` -> number of its operands; None: one or more."""
FIELDS = {
    "qpos", "qvel", "xpos", "xipos", "xquat", "site_xpos", "cvel", "subtree_com", "sensordata", "qfrc_actuator",
    "mocap_pos", "mocap_quat",
}  # fmt: skip
"""Fields of MjData that formulas may read."""
_DAMAGED = "the manifest is damaged: use another checkpoint"
_NO_LAYOUT = "the checkpoint does not describe the policy's columns, which this rlcli needs: train again"
_INPUT_NAME = re.compile(r"last_action|steps|action|command|(command|observation|target)/.{1,1000}", re.DOTALL)


def check_formula(value: Any) -> None:
    """Check that a JSON value is a formula for observations or controls.

    A formula is a list of constants, `{field, at}` (elements of a field of MjData), `{given}` (an input, such as the
    action), or `{op, of}` (an operation on formulas).

    Raises:
        ValueError: if the value is anything else.
    """
    if isinstance(value, list):
        if not all(type(item) in (int, float) for item in value):
            raise ValueError(f"the constant of a formula must be a list of numbers; {_DAMAGED}")
        return
    if not isinstance(value, dict):
        raise ValueError(f"{str(value)[:60]} is not a list of numbers or a mapping; {_DAMAGED}")
    keys, at, name = set(value), value.get("at", []), value.get("given")
    if not isinstance(at, list) or not all(type(i) is int and 0 <= i < 2**31 for i in at):
        raise ValueError(f"`at` must be a list of indices from 0 on; {_DAMAGED}")
    if keys == {"field", "at"} and value["field"] in FIELDS:
        return
    if keys in ({"given"}, {"given", "at"}) and isinstance(name, str) and _INPUT_NAME.fullmatch(name):
        return
    own = {"b", "a", "key"} if value.get("op") == "filter" else set()
    if keys != {"op", "of"} | own or not isinstance(value["op"], str) or value["op"] not in OPS:
        raise ValueError(
            f"the manifest has an operation that this rlcli version does not know: {str(value)[:60]}; {_DAMAGED}"
        )
    count, of = OPS[value["op"]], value["of"]
    if not isinstance(of, list) or (count is not None and len(of) != count) or not of:
        raise ValueError(f"operation '{value['op']}' takes {count or 'one or more'} operands; {_DAMAGED}")
    if own and not (isinstance(value["key"], str) and all(_are_numbers(value[key]) for key in "ab") and value["b"]):
        need = "`b` and `a` (lists of numbers, `b` not empty) and `key` (a text)"
        raise ValueError(f"operation 'filter' needs {need}; {_DAMAGED}")
    for part in of:
        check_formula(part)


def _are_numbers(values: object) -> bool:
    return isinstance(values, list) and all(type(value) in (int, float) for value in values)


def _is_external_input(value: object) -> bool:
    return isinstance(value, dict) and set(value) == {"given"} and str(value["given"]).startswith("observation/")


class _Record(FileModel):
    model_config = ConfigDict(extra="forbid", strict=False)


class _Columns(_Record):
    """Names, unit and scale of the columns (numbers of the vector) of one observation or action term."""

    name: str
    size: int = Field(ge=1)
    elements: list[str]
    unit: str
    scale: list[float] | None

    @model_validator(mode="after")
    def _check_widths(self) -> Self:
        own = ("offset", "clip", "limits") if isinstance(self, ActionColumns) else ()
        for key in ("scale", *own):
            values = getattr(self, key)
            if values is not None and len(values) != self.size:
                raise ValueError(f"{key} has {len(values)} values, but the term has {self.size} columns")
        return self


class ObservationColumns(_Columns):
    """Columns of an observation term; with a history, the columns of the oldest step come first."""

    clip: tuple[float, float] | None
    history: int = Field(ge=1)
    shape: list[int] = Field(default_factory=list)
    """(channels, rows, columns) of an image; empty for other terms."""
    modifiers: list[dict[str, Any]]


class ActionColumns(_Columns):
    """Columns of an action term, which computes clip(scale x action + offset).

    Without a scale the term computes clip(action).
    """

    offset: list[float] | None
    clip: list[tuple[float | None, float | None]] | None
    limits: list[tuple[float | None, float | None]] | None


class LayoutRecord(_Record):
    """Entry `layout`: the columns of observations and actions, and the time steps, that a policy was trained with.

    An environment must have the same layout to run the policy.
    """

    observations: dict[str, list[ObservationColumns]]
    actions: list[ActionColumns]
    step_dt: float = Field(gt=0)
    dt: float = Field(gt=0)
    decimation: int = Field(ge=1)


class _Formula(_Record):
    """Formula (`value`, see `check_formula`) for the columns of a term.

    `closed` is true if the formula needs only MjData, the actions and the commands, so that a program can compute the
    columns without the code of the task.
    """

    @model_validator(mode="after")
    def _check_value(self) -> Self:
        value, closed = getattr(self, "value", None), getattr(self, "closed", False)
        if value is not None:
            check_formula(value)
        if closed and value is None:
            raise ValueError(
                "the manifest is damaged: 'closed' is true, but 'value' has no formula; use another checkpoint"
            )
        if not closed and isinstance(self, ObservationFormula) and not _is_external_input(value):
            raise ValueError(f"'closed' is false, but 'value' is not {{'given': 'observation/NAME'}}; {_DAMAGED}")
        return self


class ObservationFormula(_Formula):
    """Formula of an observation term: `value` computes the term's columns of one step.

    If `closed` is false, there is no formula: `value` is `{given: observation/NAME}`, and the program that runs the
    policy must compute the columns itself.
    """

    name: Name
    func: Name
    params: dict[str, JsonValue]
    columns: tuple[int, int]
    history: int = Field(ge=1)
    closed: bool
    value: JsonValue


class ControlFormula(_Formula):
    """Formula of an action term: it computes the elements `ctrl` of `MjData.ctrl` from `action` and `command`.

    At a joint with an actuator model (`ActuatorModelRecord`) it computes the target of the model.
    """

    name: Name
    func: Name
    ctrl: Columns
    actuators: list[Name]
    closed: bool
    value: JsonValue


class ActuatorModelRecord(_Formula):
    """An actuator model: its formula computes the elements `ctrl` of `MjData.ctrl` before every physics step.

    The formula reads the targets of the action terms, `target/NAME`, which hold for a whole control step.
    """

    name: Name
    kind: Name
    """pd, dc_motor, or own for a model of the task's code."""
    joints: list[Name]
    ctrl: Columns
    stiffness: Numbers
    damping: Numbers
    effort_limit: list[float | None]
    saturation_effort: float | None
    velocity_limit: list[float | None] | None
    delay: tuple[int, int]
    closed: bool
    value: JsonValue


class CommandRecord(_Record):
    """A command (goal) that the program must give the policy, such as a velocity: its name, function and size."""

    name: Name
    func: Name
    size: int = Field(ge=0, le=100_000)


class JointRecord(_Record):
    """A hinge or slide joint with its default position and the gains of its actuator.

    The gains (stiffness, damping) are null without an actuator, and 0 for a motor.
    """

    name: Name
    entity: Name
    qpos: int = Field(ge=0)
    dof: int = Field(ge=0)
    default: float
    stiffness: float | None
    damping: float | None


class ActuatorRecord(_Record):
    """An actuator of the model, and the range of its control. Lists of actuators have the order of `MjData.ctrl`."""

    name: Name
    range: tuple[float, float] | None


class DeploymentRecord(_Record):
    """Entry `deployment`: description of the environment for programs that run the policy without rlcli."""

    joints: list[JointRecord]
    actuators: list[ActuatorRecord]
    observations: dict[str, list[ObservationFormula]]
    controls: list[ControlFormula]
    actuator_models: list[ActuatorModelRecord] = Field(default_factory=list)
    commands: list[CommandRecord]
    start: dict[Annotated[str, Field(pattern="^(qpos|qvel)$")], Numbers]
    forces_after_reset: bool
    derived: Annotated[str, Field(pattern="^(current|substep)$")]


def layout_of(checkpoint: Checkpoint, policy: Policy) -> LayoutRecord:
    """Return the layout (columns of observations and actions) of a checkpoint, and check that it fits the policy.

    Raises:
        CheckpointError: if there is no layout, or its numbers of columns differ from those of the policy.
    """
    file, spec = checkpoint.folder / "manifest.json", policy.spec
    layout = check_json(LayoutRecord, checkpoint.manifest.get("layout"), file, "layout", hint=_NO_LAYOUT)
    sizes = (
        ("observations", sum(t.size for t in layout.observations.get(spec.group, [])), spec.observation_size),
        ("actions", sum(t.size for t in layout.actions), spec.action_size),
    )
    for kind, found, expected in sizes:
        if found != expected:
            raise CheckpointError(
                f"{file} does not fit policy.json: {found} columns of {kind}, expected {expected}; the checkpoint is"
                " damaged: use another checkpoint"
            )
    return layout


def deployment_of(checkpoint: Checkpoint, policy: Policy, found: object = None) -> DeploymentRecord | None:
    """Return the checkpoint's description of the environment for programs without rlcli; None if there is none.

    Args:
        checkpoint: the checkpoint.
        policy: the policy of the checkpoint.
        found: a description (JSON data) to use if the checkpoint has none; None: use no other.

    Raises:
        CheckpointError: if the record is malformed, or does not fit the policy.
    """
    recorded = checkpoint.manifest.get("deployment", found)
    if recorded is None:
        return None
    file = checkpoint.folder / "manifest.json"
    record = check_json(DeploymentRecord, recorded, file, "deployment", hint=_NO_LAYOUT)
    terms = record.observations.get(policy.spec.group, [])
    begins = [term.columns[0] for term in terms] + [policy.spec.observation_size]
    ends = [0] + [term.columns[1] for term in terms]
    widths = [term.columns[1] - term.columns[0] for term in terms]
    if begins != ends or any(width <= 0 or width % t.history for width, t in zip(widths, terms, strict=True)):
        raise CheckpointError(
            f"{file}: the record of the observation and action columns (deployment) does not fit the policy; the"
            " checkpoint is damaged: use another checkpoint"
        )
    return record


def deployment_differences(checkpoint: Checkpoint, layout: object, deployment: Any, randomized: bool) -> list[str]:
    """Return the dotted keys in which the layout and deployment records of a checkpoint and an environment differ.

    Formulas are not compared.

    Args:
        checkpoint: the checkpoint.
        layout: the environment's layout, as plain JSON.
        deployment: the environment's description, as `rlcli.deploy.env_description.describe` returns it.
        randomized: whether the task randomises gains and the start state, which then are not compared.
    """
    saved_layout, saved = checkpoint.manifest.get("layout"), checkpoint.manifest.get("deployment")
    if saved is not None and "actuator_models" not in saved and deployment["actuator_models"]:
        # written by an rlcli without formulas for actuator models
        saved, deployment = ({**r, "controls": [], "actuator_models": []} for r in (saved, deployment))
    found = list(_differing_keys(saved_layout, layout, "layout"))
    if saved is not None:
        before, now = (_comparable_parts(description, randomized) for description in (saved, deployment))
        found += _differing_keys(before, now, "deployment")
    return found


def _comparable_parts(deployment: Any, randomized: bool) -> dict[str, Any]:
    """Return the entries of a deployment record that must be equal in the checkpoint and the environment.

    Formulas and settings of the physics engine are left out; if `randomized`, also gains and the start state.
    """
    terms = {group: [_without_values(t) for t in found] for group, found in deployment["observations"].items()}
    rest = {key: deployment[key] for key in ("actuators", "commands", *(() if randomized else ("start",)))}
    gains = ("default", "stiffness", "damping") if randomized else ()
    joints = [_without_values(joint, *gains) for joint in deployment["joints"]]
    controls = [_without_values(term) for term in deployment["controls"]]
    models = [_without_values(model) for model in deployment.get("actuator_models", [])]
    return {"observations": terms, "controls": controls, "actuator_models": models, "joints": joints, **rest}


def _without_values(entry: Mapping[str, Any], *randomized: str) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key != "value" and key not in randomized}


def _differing_keys(one: Any, other: Any, path: str) -> Iterator[str]:
    if isinstance(one, dict) and isinstance(other, dict):
        for key in {**one, **other}:  # a key that one rlcli version does not have yet counts as null
            yield from _differing_keys(one.get(key), other.get(key), f"{path}.{key}")
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple) and len(one) == len(other):
        for number, pair in enumerate(zip(one, other, strict=True)):
            yield from _differing_keys(*pair, f"{path}.{number}")
    elif type(one) in (int, float) and type(other) in (int, float):
        if not math.isclose(one, other, rel_tol=1e-5, abs_tol=1e-6):  # engines round differently
            yield path
    elif one != other:
        yield path
