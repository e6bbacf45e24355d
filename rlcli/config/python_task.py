"""A configuration that is built in Python, as the same plain data that a YAML file holds.

The object is a `TaskConfig` (or the mapping that one is made of), something that makes one, or a configuration of
another framework that knows how it is written as one: it has a method `__rlcli_task__(root) -> PythonTask`. Terms are
names or functions; a function that is no term of `rlcli.mdp` joins the task's own terms under its name.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path as FilePath
from typing import Any

from pydantic import BaseModel, ValidationError

from rlcli.config.schema import AgentConfig, TaskConfig
from rlcli.config.term_signatures import SECTIONS, Signature, SignatureError, builtin_terms, signature_of, snake_case
from rlcli.errors import ConfigError, Problem, RlcliError, TaskError, listing
from rlcli.formats import Note
from rlcli.registry import TaskSource, import_file, is_framework, load_object
from rlcli.registry.formats import Format, format_of_module, installed_formats, require_module

_OWN = "rlcli.mdp."
_AGENTS = "agents/*.py"


@dataclass(slots=True)
class PythonTask:
    """A task as plain data, the functions that its terms name, and what there is to say about how it came to be."""

    data: dict[str, Any]
    terms: dict[str, Signature] = field(default_factory=dict)
    notes: list[Note] = field(default_factory=list)
    format: Format | None = None
    """The format whose class the configuration is an object of."""


def source_of(value: object, root: FilePath | None = None, name: str = "task") -> TaskSource:
    """A task that exists in memory only. `root` is the folder its models lie in, by default the current one."""
    root = (root or FilePath.cwd()).resolve()
    return TaskSource(name, root, root / "task.py", None, None, (), (), None, None, value=value)


def load(source: TaskSource) -> PythonTask:
    """The configuration of a task in Python.

    Raises:
        TaskError: if its code does not run, or there is no such object.
        ConfigError: if the object is not a configuration.
    """
    if source.value is not None:
        return to_task(source.value, source.label, source.root)
    assert source.python is not None
    try:
        value, agents = _import_configuration(source)
        task = to_task(value, source.label, source.root)
        for name, agent in agents.items():
            _add_agent(task, name, agent)
    except ValidationError as error:
        raise ConfigError(_problems(error, source.label)) from None
    except ConfigError as error:
        raise ConfigError(
            [replace(p, where=source.label) if p.where == "configuration" else p for p in error.problems]
        ) from None
    except RlcliError:
        raise
    except Exception as error:
        require_module(error)
        said = f"{source.python}: {type(error).__name__}: {error}{_place(error)}"
        raise TaskError(said, hint=_hint(error)) from error
    return task


def to_task(value: Any, label: str, root: FilePath) -> PythonTask:
    """A configuration object as plain data.

    Raises:
        ConfigError: if it is not a configuration.
    """
    if hasattr(value, "__rlcli_task__"):
        value = value() if isinstance(value, type) else value
        made = value.__rlcli_task__(root)
        task = made if isinstance(made, PythonTask) else PythonTask(made)
        task.format = format_of_module(value.__rlcli_task__.__module__)
    else:
        if callable(value) and not isinstance(value, BaseModel):
            return to_task(value(), label, root)
        task = PythonTask(value)
    if not isinstance(task.data, TaskConfig | Mapping):
        found = f"expected a TaskConfig, found a {type(task.data).__name__}"
        raise ConfigError([Problem(label, "", found, "a TaskConfig, or a function that returns one")])
    task.data = _PlainData(task.terms, label).read(task.data)
    return task


def agent_data(value: object, notes: list[Note]) -> dict[str, Any]:
    """An agent's settings as plain data: a mapping, a trainer's model, or an object with `__rlcli_agent__(notes)`."""
    value = value() if isinstance(value, type) else value
    if hasattr(value, "__rlcli_agent__"):
        value = value.__rlcli_agent__(notes)
    plain = _PlainData({}, "agent").plain(value, ())
    if not isinstance(plain, dict):
        raise TypeError(f"expected an agent's settings, found a {type(value).__name__}")
    return plain


class _PlainData:
    """Walks a configuration; only what was set is written down, so that defaults stay defaults."""

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
            given = {name: getattr(value, name) for name in type(value).model_fields if name in value.model_fields_set}
            if isinstance(value, AgentConfig):
                given["algorithm"] = value.algorithm  # which model the settings are read with
            return self.plain({**given, **(value.model_extra or {})}, path)
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
        self._problem(path, f"a {type(value).__name__} cannot be written to a file")
        return None

    def _term(self, term: object, path: tuple[str | int, ...]) -> str:
        """The name under which the task knows a function."""
        section = str(path[0])
        wanted = getattr(term, "__name__", type(term).__name__)
        wanted = snake_case(wanted) if isinstance(term, type) else wanted
        if getattr(term, "__module__", "").startswith(_OWN) and wanted in _builtin(section):
            return wanted
        name, number = wanted, 1
        while name in self.terms and self.terms[name].target is not _target(term):
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


def _builtin(section: str) -> Mapping[str, Signature]:
    return builtin_terms(section) if section in SECTIONS else {}


def _import_configuration(source: TaskSource) -> tuple[Any, dict[str, Any]]:
    """The configuration that a source names, and its further agents."""
    assert source.python is not None
    agents = {name: load_object(reference) for name, reference in source.agents}
    if source.distribution is not None:
        return load_object(source.python), agents
    place, _, attribute = source.python.rpartition(":")
    if not place.endswith(".py"):
        return _registered(source)
    module = import_file(FilePath(place))
    value: Any = module
    for part in attribute.split("."):
        if not hasattr(value, part):
            names = [n for n in vars(value) if not n.startswith("_")]
            raise TaskError(f"{place} has no '{part}'", hint=f"it has {listing(names)}")
        value = getattr(value, part)
    if agents or not hasattr(value, "__rlcli_task__"):
        return value, agents
    folder, form = FilePath(place).parent, format_of_module(value.__rlcli_task__.__module__)
    files = sorted(folder.glob(_AGENTS))
    if form is not None and form.spec.agents_beside:
        files += form.load(form.spec.agents_beside)(folder)
    return value, _agents_in_modules([module]) or _agents_in_modules(map(import_file, files))


def _agents_in_modules(modules: Iterable[Any]) -> dict[str, Any]:
    """The agents that stand beside a configuration: in its module, in the `agents` folder, or in a file next to it."""
    found = {
        name: item
        for module in modules
        for name, item in vars(module).items()
        if hasattr(item, "__rlcli_agent__") and not is_framework(str(getattr(item, "__module__", "")))
    }
    if len(found) == 1:
        item = next(iter(found.values()))
        return {item.__rlcli_library__: item}
    return found


def _registered(source: TaskSource) -> tuple[Any, dict[str, Any]]:
    """What a package has registered with gymnasium: kwargs with `env_cfg_entry_point` and the agents beside it."""
    module = import_file(source.root / "__init__.py")
    gymnasium = sys.modules.get("gymnasium")
    registry = gymnasium.envs.registry if gymnasium is not None else {}
    found = {
        name: spec.kwargs
        for name, spec in registry.items()
        if _module_of(spec.kwargs.get("env_cfg_entry_point")).startswith(module.__name__)
    }
    wanted = str(source.python).removeprefix(str(source.root)).removeprefix(":")
    if wanted and wanted not in found:
        raise TaskError(f"{source.root} does not register '{wanted}'", hint=f"it registers {listing(found)}")
    if not wanted and len(found) != 1:
        hint = f"name one: {' or '.join(f'{source.root}:{name}' for name in found)}" if found else None
        raise TaskError(f"{source.root} registers {len(found)} tasks with an env_cfg_entry_point", hint=hint)
    kwargs = found[wanted or next(iter(found))]
    ending = "_cfg_entry_point"
    agents = {
        key.removesuffix(ending).replace("_", "-"): _object(value)
        for key, value in kwargs.items()
        if key.endswith(ending) and key != "env_cfg_entry_point"
    }
    return _object(kwargs["env_cfg_entry_point"]), agents


def _module_of(entry: object) -> str:
    return entry.partition(":")[0] if isinstance(entry, str) else str(getattr(entry, "__module__", ""))


def _object(entry: object) -> Any:
    if not isinstance(entry, str):
        return entry
    return entry if entry.endswith((".yaml", ".yml")) else load_object(entry)


def _add_agent(task: PythonTask, name: str, agent: object) -> None:
    if isinstance(agent, str) or not (isinstance(agent, Mapping | BaseModel) or hasattr(agent, "__rlcli_agent__")):
        what = agent if isinstance(agent, str) else type(agent).__name__
        task.notes.append(Note("", f"agents.{name}", "ignored", f"{what} is no agent that this reads"))
        return
    agents = task.data.setdefault("agents", {})
    agents.setdefault("default", name)
    agents[name] = agent_data(agent, task.notes)


def _problems(error: ValidationError, label: str) -> list[Problem]:
    return [Problem(label, ".".join(map(str, item["loc"])), item["msg"]) for item in error.errors(include_url=False)]


def _place(error: BaseException) -> str:
    """Return the line that the error came from: of the task's own files, if it went through one."""
    frames = [
        (frame.f_code.co_filename, line, is_framework(str(frame.f_globals.get("__name__", ""))))
        for frame, line in traceback.walk_tb(error.__traceback__)
        if not frame.f_code.co_filename.startswith("<")
    ]
    own = [frame for frame in frames if not frame[2]] or frames
    return f" ({own[-1][0]}:{own[-1][1]})" if own else ""


def _hint(error: BaseException) -> str | None:
    """Return what an installed format says about an error of a task's code."""
    for form in installed_formats():
        hint: str | None = form.load(form.spec.hint)(error) if form.spec.hint else None
        if hint is not None:
            return hint
    return None
