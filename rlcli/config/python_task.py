"""Conversion of a task's configuration in Python to the plain data that a YAML file would contain.

The configuration is a `TaskConfig`, a mapping with its keys, or a function that returns one of them. A configuration of
another framework has a method `__rlcli_task__(root, models) -> PythonTask`; its optional method
`__rlcli_fill__(values)` sets required settings that have no value in the file, and returns their paths. An agent of
another framework has a method `__rlcli_agent__(notes)`; its optional method `__rlcli_fit__(agent, observations, notes)`
adapts the settings to the observation groups of the task.

Terms are names, functions or classes. A function or class that is not a term of `rlcli.mdp` becomes one of the task's
own terms: under its name, a class in snake_case.
"""

import copy
import functools
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path as FilePath
from typing import Any

from pydantic import BaseModel, ValidationError

from rlcli.config.code_place import at_place, place_of, short_path
from rlcli.config.schema import AgentConfig, TaskConfig
from rlcli.config.strict_yaml import Path
from rlcli.config.term_signatures import SECTIONS, Signature, SignatureError, builtin_terms, signature_of, snake_case
from rlcli.errors import ConfigError, Problem, RlcliError, TaskError, did_you_mean, listing, short_error
from rlcli.formats import Note
from rlcli.registry import TaskSource, import_file, is_framework, load_object
from rlcli.registry.failed_imports import error_location, report_failures, take_failures
from rlcli.registry.formats import Format, first_result, format_of_module, require_module
from rlcli.registry.module_names import with_own_names
from rlcli.registry.task_imports import (
    CONFIGURATION,
    ENVIRONMENT,
    files_that_register,
    import_packages_above,
    missing_module_hint,
    registered_object,
    registrations,
)

_log = logging.getLogger(__name__)
_OWN = "rlcli.mdp."
_AGENTS = "agents/*.py"


@dataclass(slots=True)
class PythonTask:
    """A task that was written in Python, as plain data."""

    data: dict[str, Any]
    """The task as a YAML file would contain it; functions of terms are replaced by their names."""
    terms: dict[str, Signature] = field(default_factory=dict)
    """Name in `data` -> signature of a function that is not a term of `rlcli.mdp`."""
    notes: list[Note] = field(default_factory=list)
    """How each setting was translated, for a configuration of another framework."""
    params: type[BaseModel] | None = None
    """Model of `params` in `data`: settings that the code of another framework's task reads; None: no such settings."""
    format: Format | None = None
    """The other framework's format to whose classes the configuration belongs; None: rlcli's own."""
    places: dict[Path, str] = field(default_factory=dict)
    """Path in `data` -> file and line of the class or file that sets its value; `()`: of the configuration's class."""
    filled: list[Path] = field(default_factory=list)
    """Paths of required settings without a value in the file, whose value comes from the command line."""


def source_of(value: object, root: FilePath | None = None, name: str = "task") -> TaskSource:
    """Return the `TaskSource` of a configuration that exists in memory only.

    Args:
        value: the configuration: a `TaskConfig`, a mapping, or a function that returns one.
        root: the folder to which the paths of its models are relative; None: the current folder.
        name: the name of the task.
    """
    root = (root or FilePath.cwd()).resolve()
    return TaskSource(name, root, root / "task.py", value=value)


def load(
    source: TaskSource, models: Mapping[str, Any] | None = None, values: Mapping[Path, Any] | None = None
) -> PythonTask:
    """Import the configuration of a task in Python and convert it to plain data.

    Args:
        source: the task.
        models: name of a robot or object -> its MJCF file, from `--model`.
        values: path -> value, for required settings that have no value in a configuration of another framework.

    Raises:
        TaskError: if the code of the task raises an error, or the configuration's object does not exist.
        ConfigError: if the object is not a configuration.
    """
    if source.value is not None:
        return to_task(source.value, source.label, source.root, models, values)
    assert source.python is not None
    place = ""
    try:
        value, agents = _import_configuration(source)
        report_failures()
        place = place_of(value)
        task = to_task(value, source.label, source.root, models, values)
        task.places = {(): place} if place else {}
        _add_agents(task, agents)
    except ValidationError as error:
        items = error.errors(include_url=False)
        problems = [Problem(source.label, ".".join(map(str, item["loc"])), item["msg"]) for item in items]
        raise ConfigError(problems) from None
    except ConfigError as error:
        raise at_place(error, place or source.label) from None
    except RlcliError:
        raise
    except Exception as error:
        require_module(error)
        importing = str(source.root) if isinstance(error, ModuleNotFoundError) else ""
        message = f"{source.python}: {with_own_names(short_error(error))}{error_location(error, importing)}"
        hint = first_result("hint", error) or missing_module_hint(error, source.root, source.python.rpartition(":")[2])
        raise TaskError(message, hint=hint) from error
    return task


def to_task(
    value: Any,
    label: str,
    root: FilePath,
    models: Mapping[str, Any] | None = None,
    values: Mapping[Path, Any] | None = None,
) -> PythonTask:
    """Convert a configuration object to plain data.

    Args:
        value: the object, or a function that returns it.
        label: name of the configuration in messages.
        root: the folder of the task.
        models: name of a robot or object -> its MJCF file, from `--model`.
        values: path -> value, for required settings that have no value in a configuration of another framework.

    Raises:
        ConfigError: if the object is not a configuration.
    """
    if hasattr(value, "__rlcli_task__"):
        value = value() if isinstance(value, type) else value
        filled = []
        if values and hasattr(value, "__rlcli_fill__"):
            value = copy.deepcopy(value)
            filled = value.__rlcli_fill__(values)
        made = value.__rlcli_task__(root, models or {})
        task = made if isinstance(made, PythonTask) else PythonTask(made)
        task.filled = filled
        task.format = format_of_module(value.__rlcli_task__.__module__)
    else:
        if callable(value) and not isinstance(value, BaseModel):
            return to_task(value(), label, root, models, values)
        task = PythonTask(value)
    if not isinstance(task.data, TaskConfig | Mapping):
        found = f"expected a TaskConfig, found a value of type {type(task.data).__name__}"
        hint = "write a TaskConfig, a mapping with its keys, or a function that returns one of them"
        raise ConfigError([Problem(label, "", found, hint)])
    task.data = _PlainData(task.terms, label).read(task.data)
    return task


def agent_data(value: object, notes: list[Note]) -> dict[str, Any]:
    """Return the settings of an agent as plain data.

    Args:
        value: a mapping, the settings of a trainer (an `AgentConfig`), or an object with `__rlcli_agent__(notes)`.
        notes: the list to which notes about the translation are added.

    Raises:
        TypeError: if the settings are not a mapping.
    """
    value = value() if isinstance(value, type) else value
    if hasattr(value, "__rlcli_agent__"):
        value = value.__rlcli_agent__(notes)
    plain = _PlainData({}, "agent").plain(value, ())
    if not isinstance(plain, dict):
        raise TypeError(f"the agent is of type {type(value).__name__}; write a mapping")
    return plain


class _PlainData:
    """Converter of a configuration object to plain data. Defaults are left out: only values that were set are written.

    `label` names the configuration in messages. Functions that are not terms of `rlcli.mdp` are added to `terms`.
    """

    def __init__(self, terms: dict[str, Signature], label: str) -> None:
        self.terms = terms
        self.label = label
        self.problems: list[Problem] = []

    def read(self, value: object) -> dict[str, Any]:
        data: dict[str, Any] = self.plain(value, ())
        if self.problems:
            raise ConfigError(self.problems)
        return data

    def plain(self, value: object, path: tuple[str | int, ...]) -> Any:
        if isinstance(value, BaseModel):
            data = {name: getattr(value, name) for name in type(value).model_fields if name in value.model_fields_set}
            if isinstance(value, AgentConfig):
                # the algorithm is needed even if it is the default, because it selects the agent's model
                data["algorithm"] = value.algorithm
            return self.plain({**data, **(value.model_extra or {})}, path)
        if isinstance(value, Mapping):
            return {str(key): self.plain(item, (*path, str(key))) for key, item in value.items()}
        if path and path[-1] == "func" and callable(value):
            return self._term(value, path)
        if isinstance(value, Enum):
            return self.plain(value.value, path)
        if isinstance(value, str | bool | int | float | None):
            return value
        if hasattr(value, "tolist"):  # a tensor or array
            return self.plain(value.tolist(), path)
        if isinstance(value, Sequence | set | frozenset):
            return [self.plain(item, (*path, index)) for index, item in enumerate(value)]
        self._problem(path, f"type {type(value).__name__} has no YAML form; use numbers, text, lists or mappings")
        return None

    def _term(self, term: object, path: tuple[str | int, ...]) -> str:
        """Return the name in YAML of a function or class that is a term; add it to `terms` if it is not built in."""
        section = str(path[0])
        wanted = getattr(term, "__name__", type(term).__name__)
        wanted = snake_case(wanted) if isinstance(term, type) else wanted
        is_builtin = getattr(term, "__module__", "").startswith(_OWN) and section in SECTIONS
        if is_builtin and wanted in builtin_terms(section):
            return wanted
        name, number = wanted, 1
        while name in self.terms and self.terms[name].target is not _target(term):  # two functions of the same name
            number += 1
            name = f"{wanted}_{number}"
        if name not in self.terms:
            try:
                made = term.__rlcli_term__(name) if hasattr(term, "__rlcli_term__") else signature_of(term, name)
                self.terms[name] = made
            except SignatureError as error:
                self._problem(path, f"{wanted}: {error}")
        return name

    def _problem(self, path: tuple[str | int, ...], message: str) -> None:
        self.problems.append(Problem(self.label, ".".join(map(str, path)), message))


def _target(term: Any) -> Any:
    return term.target if hasattr(term, "__rlcli_term__") else term


def _import_configuration(source: TaskSource) -> tuple[Any, dict[str, Any]]:
    """Import the configuration of a task in Python; return it and the agents that are not in it, by name."""
    assert source.python is not None
    agents = {name: load_object(reference) for name, reference in source.agents}
    if source.distribution is not None:
        return load_object(source.python), agents
    file, _, attribute = source.python.rpartition(":")
    if not file.endswith(".py"):
        return _registered(source)
    module = import_file(FilePath(file))
    if not hasattr(module, attribute.partition(".")[0]) and attribute in registrations:
        uses = [registrations[attribute]]
        return _of_registration(uses[0], FilePath(file).parent)
    value: Any = module
    for part in attribute.split("."):
        if not hasattr(value, part):
            names = [n for n in vars(value) if not n.startswith("_")]
            raise TaskError(f"{file} has no '{part}'", hint=f"names in this place: {listing(names)}")
        value = getattr(value, part)
    if agents or not hasattr(value, "__rlcli_task__"):
        return value, agents
    uses = [kwargs for kwargs in registrations.values() if _is_entry(kwargs[CONFIGURATION], module.__name__, attribute)]
    if uses:
        return _with_environment(value, uses[0]), _registered_agents(uses[0])
    folder, form = FilePath(file).parent, format_of_module(value.__rlcli_task__.__module__)
    files = sorted(folder.glob(_AGENTS))
    if form is not None:
        files += form.call("agents_beside", folder) or ()
    return value, _agents_in_modules([module]) or _agents_in_modules(map(import_file, files))


def _agents_in_modules(modules: Iterable[Any]) -> dict[str, Any]:
    """Return the agent settings in another framework's format that are variables or classes of these modules.

    The key is the name of the variable or class; if there is only one, the name of its library.
    """
    found = {
        name: item
        for module in modules
        for name, item in vars(module).items()
        if hasattr(item, "__rlcli_agent__") and not is_framework(str(getattr(item, "__module__", "")))
    }
    inner = {base for item in found.values() if isinstance(item, type) for base in item.__mro__[1:]}
    found = {name: item for name, item in found.items() if item not in inner} or found
    if len(found) == 1:
        item = next(iter(found.values()))
        return {item.__rlcli_library__: item}
    return found


def _registered(source: TaskSource) -> tuple[Any, dict[str, Any]]:
    """Return the configuration that a package registers with Gymnasium, and its agents by name.

    These objects are the arguments `env_cfg_entry_point` and `AGENT_cfg_entry_point` of the registration.
    """
    module = import_file(source.root / "__init__.py")
    wanted = str(source.python).removeprefix(str(source.root)).removeprefix(":")
    # a package need not import the packages inside of it that register tasks
    if wanted and wanted not in registrations:
        for file in files_that_register(source.root, wanted, "__init__.py"):
            import_file(file)
    found = {
        name: kwargs
        for name, kwargs in registrations.items()  # the configuration of the wanted task may be another package's
        if name == wanted or _module_of(kwargs[CONFIGURATION]).startswith(module.__name__)
    }
    if wanted and wanted not in found:
        known = did_you_mean(wanted, found) or f"registered tasks: {listing(found)}"
        scripts = files_that_register(source.root, wanted)
        known = "; ".join(take_failures()) or listing(f"name the file: {file}:{wanted}" for file in scripts) or known
        raise TaskError(f"{source.root} does not register a task '{wanted}'", hint=known)
    if not wanted and len(found) != 1:
        hint = f"name one: {listing(f'{source.root}:{name}' for name in found)}" if found else None
        raise TaskError(f"{source.root} registers {len(found)} tasks with {CONFIGURATION}, expected 1", hint=hint)
    kwargs = found[wanted or next(iter(found))]
    return _of_registration(kwargs, source.root)


def _of_registration(kwargs: Mapping[str, Any], folder: FilePath) -> tuple[Any, dict[str, Any]]:
    """Return the configuration and the agents of a registration with Gymnasium by a file in a folder."""
    import_packages_above(kwargs.values(), folder)
    return _with_environment(registered_object(kwargs[CONFIGURATION]), kwargs), _registered_agents(kwargs)


def _with_environment(value: Any, kwargs: Mapping[str, Any]) -> Any:
    """Return a configuration object; pass it the registered environment class if it has `__rlcli_environment__`.

    Args:
        value: the configuration, or its class.
        kwargs: the arguments of its registration with Gymnasium.
    """
    value = value() if isinstance(value, type) else value
    if hasattr(value, "__rlcli_environment__"):
        value.__rlcli_environment__(kwargs[ENVIRONMENT])
    return value


def _registered_agents(kwargs: Mapping[str, Any]) -> dict[str, Any]:
    ending = "_cfg_entry_point"
    return {
        key.removesuffix(ending).replace("_", "-"): _agent_object(value)
        for key, value in kwargs.items()
        if key.endswith(ending) and not key.endswith(CONFIGURATION)  # `play_env_cfg_entry_point` is not an agent either
    }


def _agent_object(entry: object) -> Any:
    """Import the settings of an agent.

    If a library that the settings import is not installed, return the error: another agent may be used.
    """
    try:
        return registered_object(entry)
    except ModuleNotFoundError as error:
        return error


def _is_entry(entry: object, module: str, attribute: str) -> bool:
    """Return whether an argument of a registration with Gymnasium is the object `attribute` of a module.

    Args:
        entry: the argument: a reference `module:name`, or the object itself.
        module: dotted name of the module.
        attribute: name of the object in the module.
    """
    if isinstance(entry, str):
        return entry == f"{module}:{attribute}"
    kind = entry if hasattr(entry, "__qualname__") else type(entry)  # the configuration's class
    return getattr(kind, "__module__", "") == module and kind.__qualname__ == attribute


def _module_of(entry: object) -> str:
    return entry.partition(":")[0] if isinstance(entry, str) else str(getattr(entry, "__module__", ""))


def _add_agents(task: PythonTask, agents: Mapping[str, Any]) -> None:
    """Add agents, by name, to the data of a task, and choose the default agent.

    The default is the first name in the format's `agent_order` that exists; without an order, the only agent. If there
    are several agents, those that rlcli cannot read are left out, each with a note.
    """
    order = task.format.spec.agent_order if task.format is not None else ()
    found: dict[str, Any] = {}
    for name, agent in agents.items():
        first = len(task.notes)
        try:
            data = _read_agent(task, name, agent)
            task.notes[first:] = [replace(note, agent=name) for note in task.notes[first:]]
        except ConfigError as error:
            error = at_place(error, place_of(agent) or "configuration")
            if len(agents) == 1:
                raise error from None
            task.notes.append(Note("", f"agents.{name}", "ignored", "; ".join(map(str, error.problems))))
            continue
        if isinstance(agent, ModuleNotFoundError):
            task.notes.append(Note("", f"agents.{name}", "ignored", str(agent)))
        elif data is None:
            what = str(agent) if isinstance(agent, str | FilePath) else type(agent).__name__
            task.notes.append(Note("", f"agents.{name}", "ignored", f"rlcli cannot read {what}; write a mapping"))
        else:
            found[name] = data
            place = str(short_path(agent)) if isinstance(agent, FilePath) else place_of(agent)
            task.places |= {("agents", name): place} if place else {}
    ranked = [name for name in order if name in found]
    default = next(iter(ranked or (found if len(found) == 1 or not order else ())), None)
    if found:
        task.data.setdefault("agents", {}).update({"default": default} if default else {}, **found)
    if default is not None and len(found) > 1 and order:
        others = listing(name for name in found if name != default)
        _report_choice(f"agent '{default}'; --agent chooses another one: {others}")


def _read_agent(task: PythonTask, name: str, agent: object) -> dict[str, Any] | None:
    """Return the settings of an agent as plain data; None if rlcli cannot read the form of the settings.

    Args:
        task: the task, which gets the notes about the translation.
        name: name of the agent.
        agent: a file, a mapping, or an object with settings.
    """
    if isinstance(agent, FilePath):
        return None if task.format is None else task.format.call("agent_file", agent, name, task.notes)
    if isinstance(agent, Mapping | BaseModel) or hasattr(agent, "__rlcli_agent__"):
        agent = agent() if isinstance(agent, type) else agent
        data = agent_data(agent, task.notes)
        if hasattr(agent, "__rlcli_fit__"):
            agent.__rlcli_fit__(data, task.data.get("observations", {}), task.notes)
        return data
    return None


@functools.cache
def _report_choice(message: str) -> None:
    _log.info(message)
