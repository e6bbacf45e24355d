"""Interface for plugins with tasks: the class `TaskSpec`, and the type aliases for the parameters of terms."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias, get_type_hints

API_VERSION = 1
"""Version of the plugin interface. A plugin that needs a newer version is refused; the message has both versions."""


@dataclass(frozen=True, slots=True)
class TaskSpec:
    """A task of a plugin. An entry point of the group `rlcli.tasks` names an object of this class.

    The module that defines the object must be cheap to import. The name of the task is the name of the entry point. The
    task belongs to the distribution (the installed package) that declares the entry point.

    Attributes:
        package: the Python package that has the YAML and the models, usually `__name__`.
        summary: one line that describes the task, for `rlcli list-tasks`.
        config: the YAML file, relative to the package; or `module:attribute`, a `TaskConfig` built in Python.
        task: the direct task class as `module:Class`; None for a manager-based task.
        terms: modules whose functions the YAML may name; these modules are searched before `rlcli.mdp`.
        agents: further agents of a configuration in Python: name -> `module:attribute`.
        policies: a folder, relative to the package. Its subfolder `NAME` is the trained policy of the task `NAME`, as
            `rlcli export --format bundle` writes it. Trained policies are optional.
        api: the version of this interface, `rlcli.task.API_VERSION`, that the task was written for.
    """

    package: str
    summary: str
    config: str = "task.yaml"
    task: str | None = None
    terms: tuple[str, ...] = ()
    agents: Mapping[str, str] = field(default_factory=dict)
    policies: str = "policies"
    api: int = API_VERSION

    def __post_init__(self) -> None:
        require_field_types(self)


def require_field_types(spec: Any) -> None:
    """Check the types of the fields of a plugin's `TaskSpec`, `TrainerSpec` or `FormatSpec`.

    Raises:
        TypeError: if a field has a wrong type; with the name of the first such field.
    """
    for name, kind in get_type_hints(type(spec)).items():
        value = getattr(spec, name)
        if not _has_type(value, kind) or (name == "api" and value < 1):
            raise TypeError(f"{name} of a {type(spec).__name__} must be {_KINDS[kind]}, found {repr(value)[:100]}")


_KINDS: dict[Any, str] = {
    str: "a string",
    str | None: "a string or None",
    bool: "True or False",
    int: "a whole number of 1 or more",
    tuple[str, ...]: "a tuple of strings, such as ('a',)",
    Mapping[str, str]: "a mapping from strings to strings",
}
"""Type of a field -> description for messages."""


def _has_type(value: Any, kind: Any) -> bool:
    """Return whether a value has one of the types in `_KINDS`; a list is accepted for a tuple."""
    if kind == str | None:
        return value is None or isinstance(value, str)
    if kind == tuple[str, ...]:
        return isinstance(value, tuple | list) and all(isinstance(item, str) for item in value)
    if kind == Mapping[str, str]:
        return isinstance(value, Mapping) and all(isinstance(text, str) for pair in value.items() for text in pair)
    return isinstance(value, kind) and (kind is not int or not isinstance(value, bool))


# Aliases for the parameters of terms. A YAML file gives a name or regular expressions; the term receives the object or
# index that they resolve to in the compiled model. A type checker sees Any, because the default in the signature is the
# name ("robot"), while the body of the function uses the object.
Entity: TypeAlias = Any
"""An entity of the scene. In YAML: its name. At run time: an `rlcli.scene.entity.Entity`."""
Joints: TypeAlias = Any
"""Hinge and slide joints of the parameter `entity`. In YAML: names or regular expressions. At run time: an index of the
joints' columns in tensors such as `entity.data.joint_pos`, in the order of the YAML."""
Bodies: TypeAlias = Any
"""Bodies of the parameter `entity`. In YAML: names or regular expressions. At run time: an index of the bodies' columns
in tensors of `entity.data`."""
Sites: TypeAlias = Any
"""Sites of the parameter `entity`. In YAML: names or regular expressions. At run time: an index of the sites' columns
in tensors of `entity.data`."""
Sensors: TypeAlias = Any
"""MJCF sensors of the parameter `entity`. In YAML: names or regular expressions. At run time: an index of the sensors'
columns in `sensordata`."""
Actuators: TypeAlias = Any
"""Actuators of the parameter `entity`. In YAML: names or regular expressions. At run time: an index of the actuators'
columns in tensors of `entity.data`."""
Geoms: TypeAlias = Any
"""Geoms of the parameter `entity`. In YAML: names or regular expressions. At run time: an index into the list of the
names of the entity's geoms."""
Tendons: TypeAlias = Any
"""Tendons of the parameter `entity`. In YAML: names or regular expressions. At run time: an index into the list of the
names of the entity's tendons."""
Pairs: TypeAlias = Any
"""Contact pairs of the parameter `entity`. In YAML: names or regular expressions. At run time: an index into the list
of the names of the entity's contact pairs."""
ContactSensor: TypeAlias = Any
"""A contact sensor. In YAML: its name in `scene.sensors`. At run time: an `rlcli.scene.sensors.ContactSensor`."""
RaySensor: TypeAlias = Any
"""A ray sensor. In YAML: its name in `scene.sensors`. At run time: an `rlcli.scene.sensors.RaySensor`."""
CameraSensor: TypeAlias = Any
"""A camera. In YAML: its name in `scene.sensors`. At run time: an `rlcli.scene.camera.CameraSensor`."""
Command: TypeAlias = Any
"""A term of the section `commands`. In YAML: its name. At run time: the term; its `.command` is (num_envs, k)."""
Address: TypeAlias = Any
"""A number or a list of numbers in the task's configuration that may change during training. In YAML: its dotted key.
At run time: a tensor on the environment's device. A value that is written into this tensor takes effect wherever the
number is used."""
Range: TypeAlias = tuple[float, float]
"""Range `[low, high]` with low <= high."""


def reads_body_forces(term: Any) -> Any:
    """Mark (as a decorator) a term that reads `body_lin_acc_w`, `body_ang_acc_w` or `body_incoming_wrench_b`.

    MuJoCo computes accelerations and forces of bodies only if a sensor of the model needs them. If a task uses a marked
    term, rlcli adds such a sensor to the model.
    """
    term.reads_body_forces = True
    return term
