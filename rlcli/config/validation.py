"""Checks of a configuration against the schema, the terms and the trainers."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from rlcli.config import messages, python_task
from rlcli.config.foreign_keys import with_foreign
from rlcli.config.layers import Layers, Origin, marked, parse_override, read
from rlcli.config.schema import AgentConfig, TaskConfig, TermConfig
from rlcli.config.strict_yaml import Document, Path
from rlcli.config.term_signatures import SECTIONS, Signature, SignatureError, Vocabulary, params_model, read_params
from rlcli.errors import ConfigError, DependencyError, Problem, TaskError, did_you_mean, listing
from rlcli.formats import Note
from rlcli.registry import TRAINERS, TaskSource, catalog, find_entry, load_entry
from rlcli.registry.formats import (
    Format,
    format_of_key,
    installed_formats,
    known_trainers,
    missing_formats,
    require_format,
)
from rlcli.task import API_VERSION
from rlcli.trainers import TrainerSpec

PATCHES = ("agents", "play")
"""Keys of a task file that are not the task itself: they hold patches of it, and are merged before those apply."""
_DEVICES = ("cpu", "cuda")


def agent_names(layers: Layers) -> list[str]:
    """The agents that a configuration describes."""
    return [name for name in _mapping(layers.get(("agents",))) if name != "default"]


class _AnyAgent(AgentConfig):
    """An agent of a trainer that is not known: what all agents have in common is still checked."""

    model_config = ConfigDict(extra="allow")

    algorithm: str | dict[str, Any]  # type: ignore[assignment]

    @model_validator(mode="after")
    def _budget(self) -> _AnyAgent:
        return self  # a trainer may have its budget elsewhere


Change = tuple[Path, Any, Origin]


@dataclass(slots=True)
class TaskCheck:
    """One pass of phase 1: the layers so far, and every problem found on the way."""

    source: TaskSource
    layers: Layers = field(default_factory=Layers)
    vocabulary: Vocabulary = field(default_factory=Vocabulary)
    problems: list[Problem] = field(default_factory=list)
    missing: DependencyError | None = None
    homes: messages.Homes = field(default_factory=dict)
    functions: dict[str, Signature] = field(default_factory=dict)
    notes: list[Note] = field(default_factory=list)
    format: Format | None = None

    def document(self) -> Document:
        """What the task's file holds; a configuration in Python also brings its functions."""
        if self.source.python is None and self.source.value is None:
            return read(self.source.config, self.source.label)
        task = python_task.load(self.source)
        self.functions, self.notes, self.format = task.terms, task.notes, task.format
        if self.source.config.suffix == ".py":
            return Document(task.data)
        return read(self.source.config, self.source.label)  # a run's record of it

    def problem(self, path: Path, message: str, hint: str | None = None) -> None:
        """Note a problem at a path."""
        self.problems.append(Problem(self.layers.place(path), messages.dotted(path), message, hint))

    # --- layers ---

    def read_task(self, document: Document) -> None:
        """Merge the task's file, in whichever form it is."""
        if not self._read_other_format(document):
            self.layers.merge(document.data, marked(document, self.source.label, "task"))

    def _read_other_format(self, document: Document) -> bool:
        """Merge the data of a document that has another format; False for one in rlcli's own.

        Raises:
            DependencyError: if its format is known and the plugin is not installed.
        """
        unknown = {key: value for key, value in document.data.items() if key not in TaskConfig.model_fields}
        if not unknown:
            return False
        for form in installed_formats():
            found = form.load(form.spec.read)(document, self.source) if form.spec.read else None
            if found is not None:
                self.layers.merge(found.data, found.origin)
                if found.agents_origin is not None:
                    self.layers.merge(found.agents, found.agents_origin)
                self.notes += found.notes
                return True
        for known in missing_formats().values():
            if unknown.get(known.key):
                raise known.missing(self.source.label)
        if "scene" not in document.data:
            require_format(self.source.config)
        return False

    def changes(self, overrides: Iterable[str], flags: Mapping[str, Any]) -> list[Change]:
        """What the command line changes, overrides before flags."""
        found: list[Change] = []
        for text in overrides:
            try:
                found.append((*parse_override(text), Origin("override", f"override '{text}'")))
            except ConfigError as error:
                self.problems += error.problems
        for key, value in flags.items():
            path = tuple(key.split("."))
            found.append((path, value, Origin("flag", f"--{path[-1].replace('_', '-')}")))
        return found

    def choose_agent(self, wanted: str | None, device: str, changes: Iterable[Change]) -> str | None:
        """The agent's name; None if the task has none, or several and no default."""
        agents = self.layers.get(("agents",), {})
        if not isinstance(agents, dict):
            self.problem(("agents",), f"expected a mapping, found {messages.shown(agents)}")
            return None
        names = [name for name in agents if name != "default"]
        if wanted is not None:
            if wanted in names:
                return wanted
            near = did_you_mean(wanted, names) or f"agents of this task: {listing(names)}"
            self.problems.append(Problem("--agent", "", f"no agent '{wanted}'", near))
            return None
        self.apply([change for change in changes if change[0][:2] == ("agents", "default")], None)
        at: Path = ("agents", "default")
        default = self.layers.get(at)
        if isinstance(default, dict):
            for kind in default:
                if kind not in _DEVICES:
                    self.problem((*at, kind), f"no device '{kind}'", f"devices: {listing(_DEVICES)}")
            kind = device.partition(":")[0]
            at = (*at, kind if kind in default else "cpu")
            default = self.layers.get(at)
        if default is None:
            return names[0] if len(names) == 1 else None
        if default not in names:
            near = did_you_mean(str(default), names) or f"agents of this task: {listing(names)}"
            self.problem(at, f"no agent {messages.shown(default)}", near)
            return None
        return str(default)

    def merge_agent(self, patch: object, origin: Callable[[Path], Origin], name: str | None) -> None:
        """Merge the `agent:` part of a --config file into the chosen agent."""
        if name is None:
            self._no_agent(origin(()).where)
        elif not isinstance(patch, dict):
            where = origin(()).where
            self.problems.append(Problem(where, "agent", f"expected a mapping, found {messages.shown(patch)}"))
        else:
            self.layers.merge(patch, origin, ("agents", name))

    def _no_agent(self, where: str) -> None:
        names = agent_names(self.layers)
        if not names:
            self.problems.append(Problem(where, "agent", "this task has no agents"))
        elif not self.problems:  # otherwise the choice itself was wrong, and that has been said
            hint = f"name one: --agent {' or '.join(names)}"
            self.problems.append(Problem(where, "agent", "the task has several agents and no default", hint))

    def patch(self, layer: str, at: Path) -> None:
        """Merge what stands at `at` over the task."""
        patch = self.layers.get(at)
        if patch is None:
            return
        if not isinstance(patch, dict):
            self.problem(at, f"expected a mapping, found {messages.shown(patch)}")
            return
        for key in PATCHES:
            if key in patch:
                self.problem((*at, key), f"'{key}' cannot be patched here")
        task = {key: value for key, value in patch.items() if key not in PATCHES}
        self.layers.merge(task, lambda path: Origin(layer, self.layers.place(at + path)))

    def apply(self, changes: Iterable[Change], name: str | None) -> None:
        """Set what the command line changes."""
        for path, value, origin in changes:
            if path[0] == "agent":
                if name is None:
                    self._no_agent(origin.where)
                    continue
                path = ("agents", name, *path[1:])
            if value is None and path[0] in SECTIONS and not isinstance(self.layers.get(path), dict):
                near = did_you_mean(str(path[-1]), _mapping(self.layers.get(path[:-1])))
                if near:
                    self.problems.append(
                        Problem(origin.where, messages.dotted(path), "there is nothing to remove", near)
                    )
                    continue
            try:
                self.layers.set(path, value, origin)
            except LookupError as error:
                self.problems.append(Problem(origin.where, messages.dotted(path), str(error.args[0])))

    # --- validation ---

    def agent(self, name: str) -> tuple[TrainerSpec | None, AgentConfig | None]:
        """The agent's trainer and validated settings."""
        at: Path = ("agents", name)
        for path in (("agents",), at):
            data = self.layers.get(path)
            if not isinstance(data, dict):
                self.problem(path, f"expected a mapping, found {messages.shown(data)}")
                return None, None
        spec, model = self._trainer(at, data)
        self.homes = messages.homes({"": TaskConfig, "agent": model})
        config = self._validate(model, data, at)
        return spec, config if isinstance(config, AgentConfig) else None

    def _trainer(self, at: Path, data: Mapping[str, Any]) -> tuple[TrainerSpec | None, type[AgentConfig]]:
        """The record of the agent's trainer, and the model of its settings (a common one if that is not known)."""
        name, algorithm = data.get("trainer"), data.get("algorithm")
        if not isinstance(name, str):
            return None, _AnyAgent
        try:
            entry = find_entry(TRAINERS, name, what="trainer")
        except TaskError as error:
            if name in known_trainers() and name not in {entry.name for entry in catalog(TRAINERS)[0]}:
                where = f"{self.layers.place((*at, 'trainer'))}: {messages.dotted((*at, 'trainer'))}"
                hint = f"pip install {known_trainers()[name]}"
                self.missing = DependencyError(f"{where}: trainer '{name}' is not installed", hint=hint)
            else:
                self.problem((*at, "trainer"), error.message, error.hint)
            return None, _AnyAgent
        spec = load_entry(entry, TrainerSpec)
        if spec.api > API_VERSION:
            raise TaskError(
                f"trainer '{entry.qualified}' ({entry.version}) needs plugin API {spec.api};"
                f" this rlcli has {API_VERSION}",
                hint="pip install --upgrade rlcli",
            )
        if isinstance(algorithm, dict):  # a library's own form
            algorithm = str(algorithm.get("class_name", next(iter(spec.algorithms)))).lower()
        if not isinstance(algorithm, str):
            return spec, _AnyAgent
        if algorithm not in spec.algorithms:
            if algorithm in spec.refused:
                reason = f"trainer '{name}' cannot run '{algorithm}': {spec.refused[algorithm]}"
                self.problem((*at, "algorithm"), reason, f"algorithms: {listing(spec.algorithms)}")
                return spec, _AnyAgent
            near = did_you_mean(algorithm, spec.algorithms) or f"algorithms: {listing(spec.algorithms)}"
            self.problem((*at, "algorithm"), f"trainer '{name}' has no algorithm '{algorithm}'", near)
            return spec, _AnyAgent
        model = load_entry(replace(entry, value=spec.algorithms[algorithm]), type)
        if not issubclass(model, AgentConfig):
            raise TaskError(f"plugin {entry.distribution} {entry.version} is broken: {model} is not an AgentConfig")
        return spec, model

    def task(self) -> TaskConfig | None:
        """The validated task; None if there are problems."""
        self.homes = self.homes or messages.homes({"": TaskConfig, "agents.NAME": AgentConfig})
        self.read_terms()
        data = {key: value for key, value in self.layers.data.items() if key not in PATCHES}
        unknown = {key: value for key, value in data.items() if key not in TaskConfig.model_fields}
        self.format = format_of_key(unknown) or self.format
        entries = term_entries(data)
        terms = {path: self._term(section, path, entry) for section, path, entry in entries}
        task = self._validate(TaskConfig, _without(data, terms), ())
        params = self._params(data)
        if self.source.task is None:
            self._require_managed(data)
        else:
            self._require_direct(data)
        if self.problems or not isinstance(task, TaskConfig):
            return None
        return _filled(task, terms, params)

    def _validate(self, model: type[BaseModel], data: Any, at: Path) -> BaseModel | None:
        try:
            context = {"open_scene": self.format is not None and self.format.spec.open_scene}
            content = with_foreign(data) if model is TaskConfig else data
            return model.model_validate_json(json.dumps(content), context=context)
        except ValidationError as error:
            self.problems += messages.problems(error, model, data, self.layers.place, at, self.homes)
            return None

    def read_terms(self) -> None:
        """Read the signatures of the task's own terms."""
        try:
            self.vocabulary = Vocabulary.of(self.source.term_files)
            self.vocabulary.own.update(self.functions)
        except SyntaxError as error:
            self.problems.append(_not_python(error))

    def _term(self, section: str, path: Path, entry: dict[str, Any]) -> TermConfig | None:
        """A term with its parameters, all of it checked against the signature of the function that it names."""
        base = SECTIONS[section]
        model = base
        name = entry.get("func")
        if "func" not in entry and (near := did_you_mean(str(path[-1]), self._siblings(path))):
            self.problem(path, f"no term '{path[-1]}'", near)  # a slip in an override
            return None
        if isinstance(name, str):
            signature = self.vocabulary.find(section, name)
            if signature is None:
                self._unknown_term(section, (*path, "func"), name)
            else:
                try:
                    model = params_model(signature, section)
                except SignatureError as error:
                    self.problems.append(Problem(f"{signature.file}:{signature.line}:1", name, str(error)))
        checked = self._validate(model, entry, path)
        return base.model_construct(**dict(checked)) if checked is not None else None

    def _siblings(self, path: Path) -> list[str]:
        terms = _mapping(self.layers.get(path[:-1]))
        return [name for name, term in terms.items() if isinstance(term, dict) and "func" in term]

    def _unknown_term(self, section: str, path: Path, name: str) -> None:
        known = self.vocabulary.names(section)
        other = self.vocabulary.other_section(section, name)
        hint = f"'{name}' is a term of {other}" if other else did_you_mean(name, known)
        what = section if section == "success" else section.removesuffix("s")
        self.problem(path, f"no {what} term '{name}'", hint or f"terms: {listing(known, 60)}")

    def _params(self, data: Mapping[str, Any]) -> dict[str, Any] | None:
        """The parameters of a direct task, checked against the Params in its source."""
        given, count = data.get("params", {}), len(self.problems)
        model = self.params_model()
        if len(self.problems) > count or not isinstance(given, dict):
            return None  # that has been said
        if model is None:
            if given:
                direct = "this task's class declares no Params" if self.source.task else "only direct tasks have params"
                self.problem(("params",), direct)
            return {}
        checked = self._validate(model, given, ("params",))
        return checked.model_dump() if checked is not None else None

    def params_model(self) -> type[BaseModel] | None:
        """The model of a direct task's parameters; None if it has none."""
        if self.source.task is None or self.source.task_file is None:
            return None
        try:
            return read_params(self.source.task_file, self.source.task.rpartition(":")[2])
        except SyntaxError as error:
            self.problems.append(_not_python(error))
        except SignatureError as error:
            self.problems.append(Problem(str(self.source.task_file), "Params", str(error)))
        return None

    def _require_managed(self, data: Mapping[str, Any]) -> None:
        for section in ("actions", "rewards"):
            if isinstance(data.get(section, {}), dict) and not any(_mapping(data.get(section)).values()):
                self.problem((section,), "a manager-based task needs at least one term here")
        groups = data.get("observations", {})
        policy = groups.get("policy", {}) if isinstance(groups, dict) else None
        if isinstance(policy, dict) and not any(isinstance(term, dict) for term in policy.values()):
            self.problem(("observations",), "needs a group 'policy' with at least one term")

    def _require_direct(self, data: Mapping[str, Any]) -> None:
        if self.format is not None and self.format.spec.check:
            key, check = self.format.spec.key, self.format.load(self.format.spec.check)
            for path, message, hint in check(data.get(key, {})):
                self.problem((key, *path), message, hint)
        for section in SECTIONS:
            if section != "success" and data.get(section):
                self.problem((section,), f"a direct task has no {section} terms; its class does this")


def term_entries(data: Mapping[str, Any]) -> list[tuple[str, Path, dict[str, Any]]]:
    """Every term of a raw configuration: (section, path, entry)."""
    found: list[tuple[str, Path, dict[str, Any]]] = []
    for section in SECTIONS:
        content = data.get(section)
        if not isinstance(content, dict):
            continue
        if section == "success":
            found.append((section, (section,), content))
        elif section == "observations":
            for group, terms in content.items():
                found += [(section, (section, group, n), t) for n, t in _mapping(terms).items() if isinstance(t, dict)]
        else:
            found += [(section, (section, n), t) for n, t in content.items() if isinstance(t, dict)]
    return found


def _without(data: Any, paths: Iterable[Path]) -> Any:
    """A copy in which null stands at these paths; nothing below them is looked at twice."""
    inner: dict[Any, list[Path]] = {}
    for path in paths:
        if path == ():
            return None
        inner.setdefault(path[0], []).append(path[1:])
    return {k: _without(v, inner[k]) if k in inner else v for k, v in data.items()} if inner else data


def _filled(task: TaskConfig, terms: Mapping[Path, TermConfig | None], params: dict[str, Any] | None) -> TaskConfig:
    """The task with its validated terms in their places; a term that is null in the data is a removed one."""
    update: dict[str, Any] = {} if params is None else {"params": params}
    for section in SECTIONS:
        if section == "success":
            update[section] = terms.get((section,))
        elif section == "observations":
            update[section] = {
                name: group.model_copy(update=_kept(terms, (section, name), group.terms), deep=False)
                for name, group in task.observations.items()
            }
        else:
            update[section] = _kept(terms, (section,), getattr(task, section))
    return task.model_copy(update=update)


def _kept(terms: Mapping[Path, TermConfig | None], at: Path, names: Iterable[str]) -> dict[str, TermConfig]:
    found = {name: terms.get((*at, name)) for name in names}
    return {name: term for name, term in found.items() if term is not None}


def _not_python(error: SyntaxError) -> Problem:
    return Problem(f"{error.filename}:{error.lineno or 1}:{error.offset or 1}", "", f"not valid Python: {error.msg}")


def _mapping(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
