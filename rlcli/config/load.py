"""From a task's files and the command line to a validated configuration: phase 1, before any heavy import.

Precedence: schema default < task < the agent's `task:` patch < the task's `play:` patch (play and eval only) <
`--config` < overrides. All errors of the phase are reported at once, each at the place it was written.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

from pydantic import BaseModel, ValidationError

from rlcli.config import messages
from rlcli.config.layers import Layers, Origin, marked, parse_override, read
from rlcli.config.schema import AgentConfig, TaskConfig, TermConfig
from rlcli.config.strict_yaml import Path
from rlcli.config.terms import SECTIONS, SignatureError, Vocabulary, params_model, read_params
from rlcli.errors import ConfigError, DependencyError, Problem, RlcliError, TaskError, did_you_mean, listing
from rlcli.registry import TRAINERS, TaskSource, catalog, find_entry, load_entry, load_object
from rlcli.rl.trainer import TrainerSpec

KNOWN_TRAINERS = {"ppo": "rlcli", "rsl-rl": "rlcli-rsl-rl", "rl-games": "rlcli-rl-games"}
"""Trainers that exist outside an installation, with the distribution to install."""


@dataclass(frozen=True, slots=True)
class Resolved:
    """A validated configuration and where each of its values comes from."""

    source: TaskSource
    task: TaskConfig
    agent: AgentConfig | None
    agent_name: str | None
    trainer: TrainerSpec | None
    layers: Layers
    vocabulary: Vocabulary

    def place(self, path: Path) -> str:
        """Where a path was written, for a message."""
        return self.layers.place(path)

    def problem(self, path: Path, message: str, hint: str | None = None) -> Problem:
        """A problem at a path of this configuration."""
        return Problem(self.place(path), messages.dotted(path), message, hint)


def resolve(
    source: TaskSource,
    *,
    agent: str | None = None,
    device: str = "cpu",
    play: bool = False,
    config_file: FilePath | None = None,
    overrides: Sequence[str] = (),
    flags: Mapping[str, Any] | None = None,
) -> Resolved:
    """Read, merge and validate.

    Args:
        source: the task.
        agent: which of its agents; None takes `agents.default`. A task without agents resolves to none.
        device: cpu or cuda, for a default that differs by device.
        play: apply the task's `play:` patch.
        config_file: a YAML file merged over the task.
        overrides: `key.path=value`; `agent.x=...` addresses the chosen agent.
        flags: values of command-line flags by dotted key, applied like overrides.

    Raises:
        ConfigError: with every problem found.
    """
    document = read(source.config, source.label)
    layers = Layers()
    layers.merge(document.data, marked(document, source.label, "task"))
    extra = read(config_file) if config_file else None
    problems: list[Problem] = []
    name = _agent_name(layers, agent, device, extra.data if extra else {}, problems)
    if name is not None:
        _patch(layers, document, source.label, "agent", ("agents", name, "task"), problems)
    if play:
        _patch(layers, document, source.label, "play", ("play",), problems)
    if extra is not None:
        data = {key: value for key, value in extra.data.items() if key != "agent"}
        layers.merge(data, marked(extra, str(config_file), "config"))
        if "agent" in extra.data:
            _merge_agent(layers, extra, str(config_file), name, problems)
    for text in overrides:
        _override(layers, text, name, problems)
    for key, value in (flags or {}).items():
        layers.set(
            _agent_path(tuple(key.split(".")), name),
            value,
            Origin("flag", f"--{key.split('.')[-1].replace('_', '-')}"),
        )
    vocabulary = _vocabulary(source, problems)
    task = _task(layers, vocabulary, source, problems)
    trainer, agent_config = _agent(layers, name, problems) if name is not None else (None, None)
    if problems or task is None:
        raise ConfigError(problems)
    return Resolved(source, task, agent_config, name, trainer, layers, vocabulary)


def _agent_name(
    layers: Layers, wanted: str | None, device: str, extra: Mapping[str, Any], problems: list[Problem]
) -> str | None:
    agents = {**_mapping(layers.get(("agents",))), **_mapping(extra.get("agents"))}
    default = agents.pop("default", None)
    if wanted is not None:
        if wanted not in agents:
            near = did_you_mean(wanted, agents) or f"agents of this task: {listing(agents)}"
            raise ConfigError([Problem("--agent", "", f"no agent '{wanted}'", near)])
        return wanted
    if isinstance(default, dict):
        chosen = default.get(device.partition(":")[0])
        default = chosen if chosen in agents else default.get("cpu")
    if default is None:
        return next(iter(agents)) if len(agents) == 1 else None
    if default not in agents:
        where = layers.place(("agents", "default"))
        problems.append(Problem(where, "agents.default", f"no agent '{default}'", f"agents: {listing(agents)}"))
        return None
    return str(default)


def _patch(layers: Layers, document: Any, label: str, layer: str, at: Path, problems: list[Problem]) -> None:
    patch = Layers(document.data).get(at)
    if patch is None:
        return
    if not isinstance(patch, dict):
        problems.append(
            Problem(layers.place(at), messages.dotted(at), f"expected a mapping, found {messages.shown(patch)}")
        )
        return
    for key in ("agents", "play"):
        if key in patch:
            path = (*at, key)
            problems.append(Problem(layers.place(path), messages.dotted(path), f"'{key}' cannot be patched here"))
            patch = {k: v for k, v in patch.items() if k != key}
    layers.merge(patch, marked(document, label, layer, at))


def _merge_agent(layers: Layers, document: Any, label: str, name: str | None, problems: list[Problem]) -> None:
    origin = marked(document, label, "config", ("agent",))
    patch = document.data["agent"]
    if name is None or not isinstance(patch, dict):
        found = "there is no agent to address" if name is None else f"expected a mapping, found {messages.shown(patch)}"
        problems.append(Problem(origin(()).where, "agent", found))
        return
    layers.merge(patch, origin, ("agents", name))


def _override(layers: Layers, text: str, name: str | None, problems: list[Problem]) -> None:
    try:
        path, value = parse_override(text)
    except ConfigError as error:
        problems.extend(error.problems)
        return
    where = f"override '{text}'"
    if path[0] == "agent" and name is None:
        problems.append(Problem(where, "agent", "this task has no agent to address"))
        return
    try:
        layers.set(_agent_path(path, name), value, Origin("override", where))
    except LookupError as error:
        problems.append(Problem(where, messages.dotted(path), str(error.args[0])))


def _agent_path(path: Path, name: str | None) -> Path:
    return ("agents", name, *path[1:]) if path[0] == "agent" and name is not None else path


def _vocabulary(source: TaskSource, problems: list[Problem]) -> Vocabulary:
    try:
        return Vocabulary.of(source.term_files)
    except SyntaxError as error:
        problems.append(
            Problem(f"{error.filename}:{error.lineno}:{error.offset}", "", f"not valid Python: {error.msg}")
        )
        return Vocabulary()


def _task(layers: Layers, vocabulary: Vocabulary, source: TaskSource, problems: list[Problem]) -> TaskConfig | None:
    data = {key: value for key, value in layers.data.items() if key not in ("agents", "play")}
    task, count = None, len(problems)
    try:
        task = TaskConfig.model_validate_json(json.dumps(data))
    except ValidationError as error:
        problems.extend(_with_siblings(messages.problems(error, TaskConfig, data, layers.place), layers))
    params: dict[Path, dict[str, Any]] = {}
    for section, path, entry in term_entries(data):
        found = _term(layers, vocabulary, section, path, entry, problems)
        if found is not None:
            params[path] = found
    direct = _params(layers, source, data, problems)
    if source.task is None:
        _require_managed(layers, data, problems)
    if task is None or len(problems) > count:
        return None
    return _filled(task, params, direct)


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


def _term(
    layers: Layers,
    vocabulary: Vocabulary,
    section: str,
    path: Path,
    entry: dict[str, Any],
    problems: list[Problem],
) -> dict[str, Any] | None:
    name = entry.get("func")
    if not isinstance(name, str):
        return None  # the schema has said so
    signature = vocabulary.find(section, name)
    if signature is None:
        hint = did_you_mean(name, vocabulary.names(section))
        other = vocabulary.other_section(section, name)
        if other and hint is None:
            hint = f"'{name}' is a term of {other}"
        kind = section.rstrip("s") if section != "success" else "success"
        where, key = layers.place((*path, "func")), messages.dotted((*path, "func"))
        problems.append(
            Problem(
                where,
                key,
                f"no {kind} term '{name}'",
                hint or f"terms: {listing(vocabulary.names(section), 60)}",
            )
        )
        return None
    if signature.error:
        problems.append(Problem(f"{signature.file}:{signature.line}:1", name, signature.error))
        return None
    model = params_model(signature, section)
    try:
        checked = model.model_validate_json(json.dumps(entry))
    except ValidationError as error:
        base = set(SECTIONS[section].model_fields)
        found = messages.problems(error, model, entry, layers.place, path)
        own = [item["loc"] for item in error.errors() if item["loc"] and item["loc"][0] not in base]
        keys = {messages.dotted((*path, loc[0])) for loc in own} | {messages.dotted(path)}
        problems.extend(
            p for p in found if any(p.path == k or p.path.startswith(k + ".") for k in keys) and _is_own(p, base, path)
        )
        return None
    return {parameter.name: getattr(checked, parameter.name) for parameter in signature.parameters}


def _is_own(problem: Problem, base: set[str], path: Path) -> bool:
    """Whether the schema has not reported this already: missing and mistyped base keys are its business."""
    below = problem.path.removeprefix(messages.dotted(path)).lstrip(".")
    missing = problem.message.removeprefix("missing key '").rstrip("'") if problem.message.startswith("missing") else ""
    return below.split(".")[0] not in base and missing not in base and not (below == "" and not missing)


def _with_siblings(found: list[Problem], layers: Layers) -> list[Problem]:
    """A term without `func` is often a mistyped name in an override: name the near ones."""
    result = []
    for problem in found:
        path = tuple(problem.path.split("."))
        siblings = [
            key for key, value in _mapping(layers.get(path[:-1])).items() if isinstance(value, dict) and "func" in value
        ]
        near = did_you_mean(path[-1], siblings) if problem.message == "missing key 'func'" else None
        result.append(Problem(problem.where, problem.path, f"no term '{path[-1]}'", near) if near else problem)
    return result


def _params(
    layers: Layers, source: TaskSource, data: Mapping[str, Any], problems: list[Problem]
) -> dict[str, Any] | None:
    given = data.get("params", {})
    if source.task is None or source.task_file is None:
        if given:
            problems.append(Problem(layers.place(("params",)), "params", "only direct tasks have params"))
        return None
    try:
        model = read_params(source.task_file, source.task.rpartition(":")[2])
    except SyntaxError as error:
        problems.append(
            Problem(f"{error.filename}:{error.lineno}:{error.offset}", "", f"not valid Python: {error.msg}")
        )
        return None
    except (SignatureError, ValueError) as error:
        problems.append(Problem(str(source.task_file), "Params", str(error)))
        return None
    if not isinstance(given, dict):
        return None
    if model is None:
        if given:
            problems.append(Problem(layers.place(("params",)), "params", "this task's class declares no Params"))
        return {}
    try:
        return model.model_validate_json(json.dumps(given)).model_dump()
    except ValidationError as error:
        problems.extend(messages.problems(error, model, given, layers.place, ("params",)))
        return None


def _require_managed(layers: Layers, data: Mapping[str, Any], problems: list[Problem]) -> None:
    problems.extend(
        Problem(layers.place((section,)), section, "a manager-based task needs at least one term")
        for section in ("actions", "rewards")
        if not any(_mapping(data.get(section)).values())
    )
    if not any(_mapping(_mapping(data.get("observations")).get("policy")).values()):
        problems.append(
            Problem(
                layers.place(("observations",)),
                "observations",
                "needs a group 'policy' with at least one term",
            )
        )


def _filled(task: TaskConfig, params: Mapping[Path, dict[str, Any]], direct: dict[str, Any] | None) -> TaskConfig:
    """The task with its terms' parameters as validated, and removed terms gone."""
    update: dict[str, Any] = {} if direct is None else {"params": direct}
    for section in SECTIONS:
        content = getattr(task, section)
        if section == "success":
            update[section] = content and _with(content, params[(section,)])
        elif section == "observations":
            update[section] = {
                group: {n: _with(t, params[section, group, n]) for n, t in terms.items() if t is not None}
                for group, terms in content.items()
            }
        else:
            update[section] = {n: _with(t, params[section, n]) for n, t in content.items() if t is not None}
    return task.model_copy(update=update)


def _with(term: TermConfig, params: dict[str, Any]) -> TermConfig:
    return term.model_copy(update=params)


def _agent(layers: Layers, name: str, problems: list[Problem]) -> tuple[TrainerSpec | None, AgentConfig | None]:
    at: Path = ("agents", name)
    data = layers.get(at)
    if not isinstance(data, dict):
        problems.append(
            Problem(layers.place(at), messages.dotted(at), f"expected a mapping, found {messages.shown(data)}")
        )
        return None, None
    for key in ("trainer", "algorithm"):
        if not isinstance(data.get(key), str):
            problems.append(Problem(layers.place(at), messages.dotted(at), f"missing key '{key}'"))
            return None, None
    spec = trainer_spec(data["trainer"], layers.place((*at, "trainer")), messages.dotted((*at, "trainer")))
    reference = spec.algorithms.get(data["algorithm"])
    if reference is None:
        near = did_you_mean(data["algorithm"], spec.algorithms) or f"algorithms: {listing(spec.algorithms)}"
        path = (*at, "algorithm")
        problems.append(
            Problem(
                layers.place(path),
                messages.dotted(path),
                f"trainer '{data['trainer']}' has no algorithm '{data['algorithm']}'",
                near,
            )
        )
        return spec, None
    model: type[BaseModel] = load_object(reference)
    try:
        config = model.model_validate_json(json.dumps(data))
    except ValidationError as error:
        problems.extend(messages.problems(error, model, data, layers.place, at))
        return spec, None
    assert isinstance(config, AgentConfig)
    return spec, config


def trainer_spec(name: str, where: str, path: str) -> TrainerSpec:
    """The record of a trainer.

    Raises:
        DependencyError: a known trainer that is not installed.
        ConfigError: an unknown one.
    """
    try:
        return load_entry(find_entry(TRAINERS, name, what="trainer"), TrainerSpec)
    except TaskError as error:
        installed = {entry.name for entry in catalog(TRAINERS)[0]}
        if name in installed:
            raise
        if name in KNOWN_TRAINERS:
            raise DependencyError(
                f"{where}: {path}: trainer '{name}' is not installed",
                hint=f"pip install {KNOWN_TRAINERS[name]}",
            ) from None
        raise ConfigError([Problem(where, path, f"no trainer '{name}'", error.hint)]) from None


def _mapping(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


__all__ = ["Resolved", "RlcliError", "resolve", "term_entries", "trainer_spec"]
