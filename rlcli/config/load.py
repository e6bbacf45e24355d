"""Loading of a configuration: read the task's files and the command line, merge them, validate the result.

Commands do this first, before torch and MuJoCo are imported. Precedence: schema default < task < the agent's `task:`
patch < the task's `play:` patch (play and eval only) < `--config` < overrides < flags. All mistakes are reported at
once, each with its file and line.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any, Self

from pydantic import BaseModel

from rlcli.config import messages
from rlcli.config.layers import Layers, document_origins, read
from rlcli.config.schema import AgentConfig, TaskConfig
from rlcli.config.strict_yaml import Document, Path
from rlcli.config.term_signatures import Vocabulary, term_entries
from rlcli.config.validation import MAX_AGENTS, MAX_PROBLEMS, PATCHES, TaskCheck, agent_names
from rlcli.errors import ConfigError, DependencyError, MissingModelError, Problem, TaskError
from rlcli.formats import Note
from rlcli.registry import TaskSource
from rlcli.registry.formats import Format
from rlcli.registry.models import existing_model_file
from rlcli.trainers import TrainerSpec

__all__ = ["Resolved", "agent_names", "check_all", "extensions", "missing_models", "resolve", "term_entries"]


@dataclass(frozen=True, slots=True)
class Resolved:
    """A validated configuration: the task, the chosen agent, and the origin of each value (in `layers`)."""

    source: TaskSource
    """Where the task comes from."""
    task: TaskConfig
    """Configuration of the task, with the changes of the agent, files and overrides."""
    agent: AgentConfig | None
    """Settings of the chosen agent; None for a task without agents."""
    agent_name: str | None
    """Name of the chosen agent; None for a task without agents."""
    trainer: TrainerSpec | None
    """Trainer of the agent; None without an agent."""
    layers: Layers
    """The merged values of all files, flags and overrides before validation, and the origin of each value."""
    vocabulary: Vocabulary
    """Signatures of the terms that the task may name."""
    notes: tuple[Note, ...] = ()
    """How each key of the task and of the chosen agent was translated, if another framework's format has them."""
    format: Format | None = None
    """The other framework's format in which the task is written; None: rlcli's own."""

    def place(self, path: Path) -> str:
        """Return where the value at a path was written, for a message: `file:line:column`, an override or a flag."""
        return self.layers.place(path)

    def problem(self, path: Path, message: str, hint: str | None = None) -> Problem:
        """Return a mistake in the configuration as a `Problem`, for the caller to raise in a `ConfigError`.

        Args:
            path: keys and list indices of the wrong value.
            message: what is wrong.
            hint: what to write instead.
        """
        return Problem(self.place(path), messages.dotted(path), message, hint)

    def with_num_envs(self, count: int) -> Self:
        """Return the configuration with another number of environments."""
        scene = self.task.scene.model_copy(update={"num_envs": count})
        return replace(self, task=self.task.model_copy(update={"scene": scene}))

    def without_randomness(self) -> Self:
        """Return the configuration without events, curriculum and observation noise, for tests of exact dynamics."""
        clean = {"enable_corruption": False}
        observations = {name: group.model_copy(update=clean) for name, group in self.task.observations.items()}
        changes: dict[str, Any] = {"events": {}, "curriculum": {}, "observations": observations}
        return replace(self, task=self.task.model_copy(update=changes))

    def require_agent(self) -> tuple[AgentConfig, TrainerSpec]:
        """Return the agent and its trainer, which training needs.

        Raises:
            ConfigError: if the task has no agent, or several agents and no default.
        """
        if self.agent is None or self.trainer is None:
            names = agent_names(self.layers)
            message = "this task has no agent to train"
            hint = "add agents: {default: NAME, NAME: {trainer: sb3, ...}}"
            if names:
                message, hint = (
                    "the task has several agents and no default",
                    f"choose one: --agent {' or '.join(names)}",
                )
            raise ConfigError([self.problem(("agents",), message, hint)])
        return self.agent, self.trainer


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
    """Read, merge and validate the configuration of a task.

    Args:
        source: the task.
        agent: name of the agent; None: `agents.default`. For a task without agents the result has no agent.
        device: cpu or cuda, for a default agent that differs by device.
        play: whether to apply the task's `play:` patch.
        config_file: a YAML file that is merged over the task; its key `agent:` changes the chosen agent.
        overrides: `key.path=value`; `agent.x=...` changes the chosen agent.
        flags: values of command-line flags by dotted key, applied like overrides.

    Raises:
        ConfigError: with every problem that was found.
        DependencyError: if there is no other problem, but the agent's trainer is not installed.
    """
    check = TaskCheck(source)
    changes = check.changes(overrides, flags or {})
    document = check.document(changes)
    changes = [change for change in changes if change[0] not in check.filled]
    extra = read(config_file, pipe=True) if config_file else Document({})
    origin = document_origins(extra, str(config_file), "config")

    check.read_task(document)
    check.layers.merge({key: extra.data[key] for key in PATCHES if key in extra.data}, origin)
    name = check.choose_agent(agent, device, changes)
    if "agent" in extra.data:
        check.merge_agent(extra.data["agent"], document_origins(extra, str(config_file), "config", ("agent",)), name)
    # overrides of agents and patches are applied before the patches are merged, all others after them
    early = [change for change in changes if change[0][0] in (*PATCHES, "agent")]
    check.apply(early, name)
    if name is not None:
        check.patch("agent", ("agents", name, "task"))
    if play:
        check.patch("play", ("play",))
    check.layers.merge({k: v for k, v in extra.data.items() if k not in (*PATCHES, "agent")}, origin)
    check.apply([change for change in changes if change not in early], name)

    trainer, agent_config = check.agent(name) if name is not None else (None, None)
    task = check.task()
    if check.problems or task is None:
        raise ConfigError(check.problems)
    if check.missing is not None:
        raise check.missing
    notes = tuple(note for note in check.notes if note.agent in ("", name))
    return Resolved(source, task, agent_config, name, trainer, check.layers, check.vocabulary, notes, check.format)


def check_all(source: TaskSource, *, config_file: FilePath | None = None, overrides: Sequence[str] = ()) -> list[str]:
    """Check the configuration of a task with every agent, for training and for play.

    Returns:
        The agents that could not be checked because their trainer is not installed.

    Raises:
        ConfigError: with the problems of all agents.
    """
    check = TaskCheck(source)
    check.read_task(check.document(check.changes(overrides, {})))
    names = agent_names(check.layers)
    if len(names) > MAX_AGENTS:
        message = f"the task has {len(names)} agents; at most {MAX_AGENTS} are allowed"
        raise ConfigError([Problem(check.layers.place(("agents",)), "agents", message)])
    problems: list[Problem] = []
    unchecked: list[str] = []
    for name in names or (None,):
        for play in (False, True):
            try:
                resolve(source, agent=name, play=play, config_file=config_file, overrides=overrides)
            except ConfigError as error:
                problems += error.problems
                if len(problems) > 2 * MAX_PROBLEMS:
                    raise ConfigError(problems[:MAX_PROBLEMS]) from None
            except DependencyError:
                unchecked += [name] if name and name not in unchecked else []
    if problems:
        raise ConfigError(problems)
    return unchecked


def missing_models(resolved: Resolved) -> list[str]:
    """Return one sentence for each model that the user must provide and that is not on this machine.

    Raises:
        ConfigError: if the task's folder, or a package that the task names, does not have a model file.
    """
    problems, missing = [], []
    for name, entity in resolved.task.scene.entities.items():
        if entity is None or entity.model is None:
            continue
        path, root = ("scene", "entities", name, "model"), resolved.source.root
        try:
            existing_model_file(root, entity.model)
        except MissingModelError as error:
            missing.append(f"{name}: {error.message}" + (f"; {error.hint}" if error.hint else ""))
        except TaskError as error:
            problems.append(resolved.problem(path, error.message, error.hint))
    if problems:
        raise ConfigError(problems)
    return missing


def extensions(source: TaskSource) -> tuple[Vocabulary, type[BaseModel] | None]:
    """Return the parts of a task file that depend on the task: its terms, and the parameters of a direct task.

    Returns:
        The terms that the file may name (built-in terms and the task's own), and the pydantic model of `params`;
        None instead of the model for a manager-based task, and for a direct task without parameters.

    Raises:
        ConfigError: if the source code of the task cannot be read.
    """
    check = TaskCheck(source)
    check.document()
    check.read_terms()
    params = check.params_model()
    if check.problems:
        raise ConfigError(check.problems)
    return check.vocabulary, params
