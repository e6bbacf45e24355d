"""From a task's files and the command line to a validated configuration: phase 1, before any heavy import.

Precedence: schema default < task < the agent's `task:` patch < the task's `play:` patch (play and eval only) <
`--config` < overrides. All errors of the phase are reported at once, each at the place it was written.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

from pydantic import BaseModel

from rlcli.config import messages
from rlcli.config.layers import Layers, marked, read
from rlcli.config.schema import AgentConfig, TaskConfig
from rlcli.config.strict_yaml import Document, Path
from rlcli.config.term_signatures import Vocabulary
from rlcli.config.validation import PATCHES, TaskCheck, agent_names, term_entries
from rlcli.errors import ConfigError, DependencyError, Problem
from rlcli.formats import Note
from rlcli.registry import TaskSource
from rlcli.registry.formats import Format
from rlcli.trainers import TrainerSpec

__all__ = ["Resolved", "agent_names", "check_all", "extensions", "resolve", "term_entries"]


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
    notes: tuple[Note, ...] = ()
    """What became of each key of a configuration in another tool's form; empty for one in rlcli's own."""
    format: Format | None = None
    """The format of another framework that the task is written in."""

    def place(self, path: Path) -> str:
        """Where a path was written, for a message."""
        return self.layers.place(path)

    def problem(self, path: Path, message: str, hint: str | None = None) -> Problem:
        """A problem at a path of this configuration."""
        return Problem(self.place(path), messages.dotted(path), message, hint)

    def require_agent(self) -> None:
        """Training needs an agent.

        Raises:
            ConfigError: if the task has none, or several and no default.
        """
        if self.agent is None:
            names = agent_names(self.layers)
            message = "no default among the agents" if names else "this task has no agent to train"
            hint = (
                f"--agent {' or '.join(names)}" if names else "add agents: {default: NAME, NAME: {trainer: sb3, ...}}"
            )
            raise ConfigError([self.problem(("agents",), message, hint)])


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
        config_file: a YAML file merged over the task; `agent:` in it addresses the chosen agent.
        overrides: `key.path=value`; `agent.x=...` addresses the chosen agent.
        flags: values of command-line flags by dotted key, applied like overrides.

    Raises:
        ConfigError: with every problem found.
        DependencyError: if that is all, but the agent's trainer is not installed.
    """
    check = TaskCheck(source)
    document = check.document()
    extra = read(config_file, pipe=True) if config_file else Document({})
    origin = marked(extra, str(config_file), "config")
    changes = check.changes(overrides, flags or {})

    check.read_task(document)
    check.layers.merge({key: extra.data[key] for key in PATCHES if key in extra.data}, origin)
    name = check.choose_agent(agent, device, changes)
    if "agent" in extra.data:
        check.merge_agent(extra.data["agent"], marked(extra, str(config_file), "config", ("agent",)), name)
    apart = [change for change in changes if change[0][0] in (*PATCHES, "agent")]
    check.apply(apart, name)
    if name is not None:
        check.patch("agent", ("agents", name, "task"))
    if play:
        check.patch("play", ("play",))
    check.layers.merge({k: v for k, v in extra.data.items() if k not in (*PATCHES, "agent")}, origin)
    check.apply([change for change in changes if change not in apart], name)

    trainer, agent_config = check.agent(name) if name is not None else (None, None)
    task = check.task()
    if check.problems or task is None:
        raise ConfigError(check.problems)
    if check.missing is not None:
        raise check.missing
    return Resolved(
        source, task, agent_config, name, trainer, check.layers, check.vocabulary, tuple(check.notes), check.format
    )


def check_all(source: TaskSource, *, config_file: FilePath | None = None, overrides: Sequence[str] = ()) -> list[str]:
    """Every mistake in a task's files, whichever agent and command would meet it.

    Returns:
        The agents that could not be checked because their trainer is not installed.

    Raises:
        ConfigError: with the problems of all agents, in training and in play.
    """
    check = TaskCheck(source)
    check.read_task(check.document())
    agents = check.layers.get(("agents",))
    names = [name for name in agents if name != "default"] if isinstance(agents, dict) else []
    problems: list[Problem] = []
    unchecked: list[str] = []
    for name in names or [None]:
        for play in (False, True):
            try:
                resolve(source, agent=name, play=play, config_file=config_file, overrides=overrides)
            except ConfigError as error:
                problems += error.problems
            except DependencyError:
                unchecked += [name] if name and name not in unchecked else []
    if problems:
        raise ConfigError(problems)
    return unchecked


def extensions(source: TaskSource) -> tuple[Vocabulary, type[BaseModel] | None]:
    """What a task's source adds to the schema: its terms, and the parameters of a direct task.

    Raises:
        ConfigError: if that source cannot be read.
    """
    check = TaskCheck(source)
    check.document()
    check.read_terms()
    params = check.params_model()
    if check.problems:
        raise ConfigError(check.problems)
    return check.vocabulary, params
