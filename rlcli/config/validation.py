"""Validation of a configuration against the schema, the signatures of its terms and the settings of its trainer."""

import functools
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from rlcli.config import messages, python_task
from rlcli.config.code_place import code_origin
from rlcli.config.layers import Layers, Origin, document_origins, override_place, parse_override, read, without
from rlcli.config.model_option import MODELS, OPTIONAL, given_settings, model_path
from rlcli.config.older_success import upgraded
from rlcli.config.other_framework_keys import foreign_keys, merge_translation, move_foreign_keys
from rlcli.config.schema import AgentConfig, TaskConfig, TermConfig
from rlcli.config.strict_yaml import Document, Path
from rlcli.config.term_signatures import (
    SECTIONS,
    Signature,
    SignatureError,
    Vocabulary,
    params_model,
    read_params,
    term_entries,
    with_terms,
)
from rlcli.errors import ConfigError, DependencyError, Problem, TaskError, did_you_mean, listing, pip_install
from rlcli.formats import Note
from rlcli.registry import TRAINERS, TaskSource, catalog, find_entry, formats, load_entry
from rlcli.registry.plugin_imports import load_spec
from rlcli.trainers import TrainerSpec

PATCHES = ("agents", "play")
"""Keys of a task file whose values are patches, which change other keys of the task.

Changes to these values from a --config file or an override are made first; then the patches are applied.
"""
MAX_AGENTS, MAX_PROBLEMS = 64, 50
_DEVICES = ("cpu", "cuda")


def agent_names(layers: Layers) -> list[str]:
    """Return the names of the agents in a configuration."""
    return [name for name in _mapping(layers.get(("agents",))) if name != "default"]


class _AnyAgent(AgentConfig):
    """Agent whose trainer is unknown or not installed: only the settings that all agents share are checked."""

    model_config = ConfigDict(extra="allow")

    algorithm: str | dict[str, Any]  # type: ignore[assignment]

    @model_validator(mode="after")
    def _budget(self) -> Self:
        return self  # a trainer that is not installed may have other keys for its budget


Change = tuple[Path, Any, Origin]
"""Path, new value and origin of a change from the command line."""


@dataclass(slots=True)
class TaskCheck:
    """Check of one configuration, step by step: the sources merged so far, and every problem found so far.

    `load.resolve` calls the methods in their order: `changes`, `document`, `read_task`, `choose_agent`, `merge_agent`,
    `apply` and `patch` merge the sources; `agent` and `task` validate the result. Problems are collected in `problems`.
    """

    source: TaskSource
    layers: Layers = field(default_factory=Layers)
    vocabulary: Vocabulary = field(default_factory=Vocabulary)
    problems: list[Problem] = field(default_factory=list)
    missing: DependencyError | None = None
    """Error for a trainer that is not installed; None: there is no such error."""
    locations: messages.KeyLocations = field(default_factory=dict)
    """Where each key is allowed, for hints about misplaced keys."""
    functions: dict[str, Signature] = field(default_factory=dict)
    """Own terms of a configuration in Python, by name."""
    notes: list[Note] = field(default_factory=list)
    filled: list[Path] = field(default_factory=list)  # paths of the changes that the configuration has received
    format: formats.Format | None = None
    params: type[BaseModel] | None = None  # model of the parameters of a task of another framework
    places: dict[Path, str] = field(default_factory=dict)  # `PythonTask.places`

    def document(self, changes: Iterable[Change] = ()) -> Document:
        """Return the content of the task's file. `changes` have MJCF files and required values for a task in Python."""
        file = self.source.config  # YAML: a task, or the record of a run
        recorded = upgraded(read(file, self.source.label), file) if file.suffix != ".py" else None
        if recorded is not None and self.source.python is None and self.source.value is None:
            return recorded
        known = recorded.data if recorded is not None else {}
        task = python_task.load(self.source, *given_settings(known, {path: value for path, value, _ in changes}))
        self.functions, self.notes, self.format, self.params = task.terms, task.notes, task.format, task.params
        if recorded is None:
            self.filled, self.places = task.filled, task.places
        return recorded or Document(task.data)

    def add(self, *problems: Problem) -> None:
        """Add problems to those found so far.

        Raises:
            ConfigError: if there are more than `MAX_PROBLEMS`.
        """
        self.problems += problems
        if len(self.problems) > MAX_PROBLEMS:
            text = f"there are more than {MAX_PROBLEMS} mistakes; the first ones are listed"
            raise ConfigError([Problem(self.source.label, "", text), *self.problems[:MAX_PROBLEMS]])

    def problem(self, path: Path, message: str, hint: str | None = None) -> None:
        """Add a problem with the value at a path of the merged configuration; `hint` says what to write instead."""
        self.add(Problem(self.layers.place(path), messages.dotted(path), message, hint))

    def _is_mapping(self, value: object, path: Path) -> bool:
        """Return whether the value at a path is a mapping; add a problem for any other value."""
        if not isinstance(value, dict):
            self.problem(path, f"expected a mapping, found {messages.format_value(value)}")
        return isinstance(value, dict)

    # --- merging of the sources ---

    def read_task(self, document: Document) -> None:
        """Merge the content of the task's file, which may be in another framework's format."""
        if not self._read_other_format(document):
            origin = document_origins(document, self.source.label, "task")
            self.layers.merge(document.data, lambda path: code_origin(self.places, path) or origin(path))

    def _read_other_format(self, document: Document) -> bool:
        """Merge a document in another framework's format. Return False for a document in rlcli's own format.

        Raises:
            DependencyError: if the format is known and its plugin is not installed.
        """
        unknown = foreign_keys(document.data)
        if not unknown:
            return False
        for form in formats.installed_formats():
            found = form.call("read", document, self.source)
            if found is not None:
                merge_translation(self.layers, found, form.entry)
                self.notes += found.notes
                return True
        for known in formats.missing_formats().values():
            if unknown.get(known.key):
                raise known.missing(self.source.label)
        if "scene" not in document.data:
            formats.require_format(self.source.config)
        return False

    def changes(self, overrides: Iterable[str], flags: Mapping[str, Any]) -> list[Change]:
        """Return the changes from the command line, overrides before flags."""
        found: list[Change] = []
        for text in overrides:
            try:
                found.append((*parse_override(text), Origin("override", override_place(text))))
            except ConfigError as error:
                self.add(*error.problems)
        for key, value in flags.items():
            path = tuple(key.split("."))
            found.append((path, value, Origin("flag", f"--{path[-1].replace('_', '-')}")))
        return found

    def choose_agent(self, wanted: str | None, device: str, changes: Iterable[Change]) -> str | None:
        """Return the name of the agent; None if the task has no agent, or several agents and no default.

        Args:
            wanted: the name that the user chose; None: the default agent.
            device: cpu or cuda, for a default that differs by device.
            changes: changes from the command line, which may change the default.
        """
        agents = self.layers.get(("agents",), {})
        if not self._is_mapping(agents, ("agents",)):
            return None
        names = [name for name in agents if name != "default"]

        def hint(name: str) -> str:
            return did_you_mean(name, names) or f"agents of this task: {listing(names)}"

        if wanted is not None:
            if wanted in names:
                return wanted
            self.add(Problem("--agent", "", f"the task has no agent '{wanted}'", hint(wanted)))
            return None
        self.apply([change for change in changes if change[0][:2] == ("agents", "default")], None)
        at: Path = ("agents", "default")
        default = self.layers.get(at)
        if isinstance(default, dict):
            for kind in default:
                if kind not in _DEVICES:
                    self.problem((*at, kind), f"there is no device '{kind}'", f"write one of {listing(_DEVICES)}")
            kind = device.partition(":")[0]
            at = (*at, kind if kind in default else "cpu")
            default = self.layers.get(at)
        if default is None:
            return names[0] if len(names) == 1 else None
        if default not in names:
            self.problem(at, f"the task has no agent {messages.format_value(default)}", hint(str(default)))
            return None
        return str(default)

    def merge_agent(self, patch: object, origin: Callable[[Path], Origin], name: str | None) -> None:
        """Merge the key `agent:` of a --config file into the chosen agent."""
        if name is None:
            self._report_no_agent(origin(()).where)
        elif not isinstance(patch, dict):
            self.add(Problem(origin(()).where, "agent", f"expected a mapping, found {messages.format_value(patch)}"))
        else:
            self.layers.merge(patch, origin, ("agents", name))

    def _report_no_agent(self, where: str) -> None:
        """Add the problem that the change `agent.x` at location `where` applies to no agent, because none is chosen."""
        names = agent_names(self.layers)
        if not names:
            self.add(Problem(where, "agent", "this task has no agents; add `agents:` to the task's YAML"))
        elif not self.problems:  # otherwise the choice of the agent was wrong and is reported already
            hint = f"name one: --agent {' or '.join(names)}"
            self.add(Problem(where, "agent", "the task has several agents and no default", hint))

    def patch(self, layer: str, at: Path) -> None:
        """Merge the mapping at path `at` (`play`, or `task` of an agent) over the task; origins name `layer`."""
        patch = self.layers.get(at)
        if patch is None or not self._is_mapping(patch, at):
            return
        for key in PATCHES:
            if key in patch:
                self.problem((*at, key), f"'{key}' belongs at the top level; remove it here")
        task = {key: value for key, value in patch.items() if key not in PATCHES}
        self.layers.merge(task, lambda path: Origin(layer, self.layers.place(at + path)))

    def apply(self, changes: Iterable[Change], name: str | None) -> None:
        """Set the values of overrides and flags. `agent.KEY=VALUE` changes agent `name`; None: add a problem."""
        format_keys = functools.cache(formats.format_keys)  # slow: it looks for installed plugins
        for path, value, origin in changes:
            if path[0] == "agent":
                if name is None:
                    self._report_no_agent(origin.where)
                    continue
                path = ("agents", name, *path[1:])
            # `format_keys` imports the formats, so it comes last
            unknown = foreign_keys({str(path[0]): None}).keys() - self.layers.data.keys() - {MODELS}
            if unknown and unknown <= format_keys():
                message = f"the task has no settings '{path[0]}' of another framework, so nothing would read this value"
                self.add(Problem(origin.where, messages.dotted(path), message, "remove it"))
                continue
            if path[0] == MODELS:
                form = self.format or formats.format_of_key(foreign_keys(self.layers.data))
                if not (path := model_path(path, form, self.problems)):
                    continue
                value = value["model"] if isinstance(value, dict) and value.pop(OPTIONAL, False) else value
            # null removes a term; for a term that does not exist, suggest one with a similar name
            removes = value is None and path[0] in SECTIONS and not isinstance(self.layers.get(path), dict)
            if removes and (similar := did_you_mean(str(path[-1]), _mapping(self.layers.get(path[:-1])))):
                self.add(Problem(origin.where, messages.dotted(path), "there is no such term to remove", similar))
                continue
            try:
                self.layers.set(path, value, origin)
            except LookupError as error:
                self.add(Problem(origin.where, messages.dotted(path), str(error.args[0])))

    # --- validation ---

    def agent(self, name: str) -> tuple[TrainerSpec | None, AgentConfig | None]:
        """Return the trainer of an agent and the agent's validated settings; None for each that is not valid."""
        at: Path = ("agents", name)
        for path in (("agents",), at):
            data = self.layers.get(path)
            if not self._is_mapping(data, path):
                return None, None
        spec, model = self._trainer(at, data)
        self.locations = _key_locations("agent", model)
        config = self._validate(model, data, at)
        return spec, config if isinstance(config, AgentConfig) else None

    def _trainer(self, at: Path, data: Mapping[str, Any]) -> tuple[TrainerSpec | None, type[AgentConfig]]:
        """Return the agent's trainer and the model of its settings; `_AnyAgent` if trainer or algorithm is unknown."""
        name, algorithm = data.get("trainer"), data.get("algorithm")
        if not isinstance(name, str):
            return None, _AnyAgent
        try:
            entry = find_entry(TRAINERS, name, what="trainer")
        except TaskError as error:
            if name in formats.known_trainers() and name not in {entry.name for entry in catalog(TRAINERS)[0]}:
                where = f"{self.layers.place((*at, 'trainer'))}: {messages.dotted((*at, 'trainer'))}"
                install = pip_install(formats.known_trainers()[name])
                self.missing = DependencyError(f"{where}: trainer '{name}' is not installed", hint=install)
            else:
                self.problem((*at, "trainer"), error.message, error.hint)
            return None, _AnyAgent
        spec = load_spec(entry, TrainerSpec, "trainer")
        if isinstance(algorithm, dict):  # a mapping is the form of another library, such as RSL-RL
            algorithm = str(algorithm.get("class_name", next(iter(spec.algorithms)))).lower()
        if not isinstance(algorithm, str):
            return spec, _AnyAgent
        if algorithm not in spec.algorithms:
            message, hint = f"trainer '{name}' has no algorithm '{algorithm}'", did_you_mean(algorithm, spec.algorithms)
            if algorithm in spec.refused:
                message, hint = f"trainer '{name}' cannot run '{algorithm}': {spec.refused[algorithm]}", None
            self.problem((*at, "algorithm"), message, hint or f"algorithms: {listing(spec.algorithms)}")
            return spec, _AnyAgent
        model = load_entry(replace(entry, value=spec.algorithms[algorithm]), type)
        if not issubclass(model, AgentConfig):
            raise TaskError(
                f"plugin {entry.distribution} {entry.version}: {model.__name__} is not a subclass of AgentConfig;"
                " report this bug to the plugin's authors"
            )
        return spec, model

    def task(self) -> TaskConfig | None:
        """Return the validated task; None if there are problems."""
        self.locations = self.locations or _key_locations("agents.NAME", AgentConfig)
        self.read_terms()
        data = {key: value for key, value in self.layers.data.items() if key not in PATCHES}
        self.format = formats.format_of_key(foreign_keys(data)) or self.format
        if "foreign" in data:
            message = "a task file has no key 'foreign': settings of another framework belong at the top level"
            self.problem(("foreign",), message, "write the framework's own key, such as 'oige', without 'foreign'")
        for section in [name for name in SECTIONS if isinstance(_mapping(data.get(name)).get("func"), str)]:
            func = data.pop(section)["func"]
            self.problem((section,), "a term needs a name", f"write {section}: {{NAME: {{func: {func}, ...}}}}")
        entries = term_entries(data)
        # each term is validated with the model of its own function, then removed from the data for `TaskConfig`
        terms = {path: self._term(section, path, entry) for section, path, entry in entries}
        task = self._validate(TaskConfig, without(data, terms), ())
        params = self._params(data)
        if self.source.task is None:
            self._require_managed(data)
        else:
            self._require_direct(data)
        if self.problems or not isinstance(task, TaskConfig):
            return None
        return with_terms(task, terms, params)

    def _validate(self, model: type[BaseModel], data: Any, at: Path) -> BaseModel | None:
        """Validate the data at a path with a model; if the data are not valid, add the problems and return None."""
        try:
            spec = None if self.format is None else self.format.spec
            context = {"open_scene": spec and spec.open_scene, "given_models": spec and not spec.models}
            content = move_foreign_keys(data) if model is TaskConfig else data
            return model.model_validate_json(json.dumps(content), context=context)
        except ValidationError as error:
            for problem in messages.problems(error, model, data, self.layers.place, at, self.locations):
                self.add(problem)
            return None

    def read_terms(self) -> None:
        """Read the signatures of the task's own terms into `vocabulary`."""
        try:
            self.vocabulary = Vocabulary.of(self.source.term_files)
            self.vocabulary.own.update(self.functions)
        except SyntaxError as error:
            self.add(_not_python(error))

    def _term(self, section: str, path: Path, entry: dict[str, Any]) -> TermConfig | None:
        """Return a term with its parameters, checked against the signature of its function; None if it is not valid."""
        base = SECTIONS[section]
        model = base
        name = entry.get("func")
        if "func" not in entry and (similar := did_you_mean(str(path[-1]), self._siblings(path))):
            message = f"there is no term '{path[-1]}' to change"  # a misspelt term in an override
            self.problem(path, message, f"{similar}; a new term needs 'func'")
            return None
        if isinstance(name, str):
            signature = self.vocabulary.find(section, name)
            if signature is None:
                self._report_unknown_term(section, (*path, "func"), name)
            else:
                try:
                    model = params_model(signature, section)
                except SignatureError as error:
                    self.add(Problem(f"{signature.file}:{signature.line}:1", name, str(error)))
        checked = self._validate(model, entry, path)
        return base.model_construct(**dict(checked)) if checked is not None else None

    def _siblings(self, path: Path) -> list[str]:
        """Return the names of all terms in the section (or observation group) of the term at a path."""
        return [name for name, term in _mapping(self.layers.get(path[:-1])).items() if "func" in _mapping(term)]

    def _report_unknown_term(self, section: str, path: Path, name: str) -> None:
        known, other = self.vocabulary.names(section), self.vocabulary.other_section(section, name)
        similar = f"'{name}' is a term of {other}" if other else did_you_mean(name, known)
        hint = similar or f"{self.source.without_terms_hint}terms: {listing(known, 60)}"
        what = section if section == "success" else section.removesuffix("s")
        self.problem(path, f"there is no {what} term '{name}'", hint)

    def _params(self, data: Mapping[str, Any]) -> dict[str, Any] | None:
        """Return the parameters of a direct task, checked against `Params` in its source; None if not valid."""
        values, count = data.get("params", {}), len(self.problems)
        model = self.params_model()
        if len(self.problems) > count or not isinstance(values, dict):
            return None  # the problem is reported already
        if model is None and values:
            reason = "the task's class has no Params" if self.source.task else "only direct tasks have params"
            self.problem(("params",), f"{reason}; remove this block")
        if model is None:
            return {}
        checked = self._validate(model, values, ("params",))
        return checked.model_dump() if checked is not None else None

    def params_model(self) -> type[BaseModel] | None:
        """Return the pydantic model of a direct task's parameters; None if the task has no parameters."""
        if self.params is not None or self.source.task is None or self.source.task_file is None:
            return self.params
        try:
            return read_params(self.source.task_file, self.source.task.rpartition(":")[2])
        except SyntaxError as error:
            self.add(_not_python(error))
        except SignatureError as error:
            self.add(Problem(str(self.source.task_file), "Params", str(error)))
        return None

    def _require_managed(self, data: Mapping[str, Any]) -> None:
        """Check that a manager-based task has actions, rewards and observations of the policy."""
        for section in ("actions", "rewards"):
            if isinstance(data.get(section, {}), dict) and not any(_mapping(data.get(section)).values()):
                self.problem((section,), "a manager-based task needs at least one term here")
        groups = data.get("observations", {})
        policy = groups.get("policy", {}) if isinstance(groups, dict) else None
        if isinstance(policy, dict) and not any(isinstance(term, dict) for term in policy.values()):
            self.problem(("observations",), "the observations need a group 'policy' with at least one term: add one")

    def _require_direct(self, data: Mapping[str, Any]) -> None:
        """Check that a direct task has only `success` terms, and let its format check the keys that its class reads."""
        if self.format is not None:
            key = self.format.spec.key
            for path, message, hint in self.format.call("check", data.get(key, {})) or ():
                self.problem((key, *path), message, hint)
        for section in SECTIONS:
            if section != "success" and data.get(section):
                text = f"a direct task has no {section} terms; its class implements them: delete this section"
                self.problem((section,), text)


@functools.lru_cache(maxsize=16)
def _key_locations(prefix: str, agent: type[BaseModel]) -> messages.KeyLocations:
    """Return, for each key of a task and of an agent (at path `prefix`), the dotted paths where it is allowed."""
    return messages.key_locations({"": TaskConfig, prefix: agent})


def _not_python(error: SyntaxError) -> Problem:
    return Problem(f"{error.filename}:{error.lineno or 1}:{error.offset or 1}", "", f"not valid Python: {error.msg}")


def _mapping(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
