"""Read the content of the HTML page of `rlcli report` from the files of a run.

If a part cannot be read, the page has the reason in its place.
"""

import contextlib
import json
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from rlcli.config import strict_yaml
from rlcli.config.dump import origins
from rlcli.config.layers import leaves
from rlcli.config.load import resolve
from rlcli.config.messages import dotted
from rlcli.config.other_framework_keys import move_foreign_keys
from rlcli.config.schema import TaskConfig
from rlcli.config.term_signatures import Vocabulary
from rlcli.errors import CheckpointError, RlcliError
from rlcli.reporting.card_text import number
from rlcli.reporting.curve_panels import choose
from rlcli.reporting.curves import AXES, Curve, gather
from rlcli.reporting.task_card import Card, card, task_card
from rlcli.runs.checkpoint_reader import open_checkpoint
from rlcli.runs.config_diff import as_text
from rlcli.runs.recorded_task import recorded_task, resolve_run
from rlcli.runs.run import Run

_MAX_CHARACTERS = 2000
"""Largest length of an error message on the page [characters]."""


@dataclass(frozen=True, slots=True)
class Setting:
    """Value of a run's configuration, and where the value was set: file and line, flag or override."""

    key: str
    value: str
    origin: str


@dataclass(frozen=True, slots=True)
class Chart:
    """Panel of learning curves: an SVG element, and its legend of (label, index of colour, index of line style)."""

    title: str
    svg: str
    legend: list[tuple[str, int, int]]


@dataclass(slots=True)
class Page:
    """Content of the HTML page of a run. If a part is missing, `missing` has the reason."""

    task: str
    """Name of the task."""
    name: str
    """Name of the run's folder."""
    summary: str
    """One line on what the policy does."""
    facts: list[tuple[str, str]]
    """Facts about the training, such as its seed: (name, value)."""
    card: Card | None = None
    """Tables that describe the task."""
    charts: list[Chart] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)
    """Findings of the training's health checks, a sentence each."""
    evaluation: dict[str, Any] | None = None
    """Result of an evaluation, as `rlcli eval --json` prints it."""
    checkpoint: str | None = None
    """Name of the checkpoint's folder; None: the run has no checkpoint."""
    video: bytes | None = None
    """Content of an MP4 file."""
    video_of: str = ""
    """Caption of the video: the checkpoint that it shows."""
    settings: list[tuple[str, list[Setting]]] = field(default_factory=list)
    """Sections of the configuration, each with its settings."""
    machine: list[tuple[str, str]] = field(default_factory=list)
    commands: list[tuple[str, str]] = field(default_factory=list)
    """(description, command line) of each command that the page suggests."""
    missing: dict[str, str] = field(default_factory=dict)
    """Missing part of the page -> the reason, one sentence."""


def gather_page(run: Run, checkpoint: Path | None) -> Page:
    """Return the page of a run, without evaluation and video, which `PageMedia` adds.

    Args:
        run: the run.
        checkpoint: the folder of the checkpoint that the page describes; None: the run has no checkpoint.
    """
    record = run.record
    page = Page(str(record["task"]["name"]), run.folder.resolve().name, "", [])
    page.checkpoint = checkpoint.resolve().name if checkpoint is not None else None
    document = curve = None
    with _part(page, "settings", "The configuration cannot be read", CheckpointError):
        document = run.read_config()
        page.summary = str(document.data.get("summary", ""))
        page.settings = _sections(_settings(run, document))
    with _part(page, "card", "The task cannot be described", RlcliError, ValidationError):
        page.card = _card(run, document, checkpoint)
    with _part(page, "charts", "There are no learning curves", CheckpointError):
        (curve,), _ = gather([run])
        _add_charts(curve, page)
    page.findings = run.findings()
    page.facts = list(_facts(run, curve))
    if page.checkpoint is not None and page.checkpoint.isdecimal():
        page.facts.insert(0, ("Checkpoint", f"step {int(page.checkpoint):,}"))
    page.machine = list(_machine(record))
    page.commands = list(_commands(run, checkpoint))
    return page


@contextlib.contextmanager
def _part(page: Page, name: str, failure: str, *errors: type[Exception]) -> Iterator[None]:
    """Read a part of the page in a `with` block; an error becomes the reason on the page why the part is missing.

    Args:
        page: the page.
        name: name of the part, a key of `page.missing`.
        failure: beginning of the reason, such as `There are no learning curves`.
        errors: types of errors that are handled; others are raised.
    """
    try:
        yield
    except errors as error:
        page.missing[name] = f"{failure}: {reason_of(error)}"


def _card(run: Run, document: strict_yaml.Document | None, checkpoint: Path | None) -> Card:
    """Return the task card of the run.

    If the task's code is not trusted or not installed, the card has the stored configuration without the meanings of
    terms.
    """
    layout = _layout(checkpoint)
    try:
        return task_card(resolve_run(run, play=False), layout)
    except RlcliError:
        if document is None:
            raise
    # in strict mode pydantic accepts a list for a tuple only when it reads JSON
    task = TaskConfig.model_validate_json(json.dumps(move_foreign_keys(document.data)), context={"open_scene": True})
    return card(task, Vocabulary(), name=str(run.record["task"]["name"]), layout=layout)


def _layout(checkpoint: Path | None) -> dict[str, Any] | None:
    from rlcli.runs.layout_and_deployment import LayoutRecord

    if checkpoint is not None:
        with contextlib.suppress(CheckpointError, ValidationError):
            return LayoutRecord.model_validate(open_checkpoint(checkpoint).manifest.get("layout")).model_dump()
    return None


def _add_charts(curve: Curve, page: Page) -> None:
    from rlcli.reporting.matplotlib_plots import legend_of, panel_svg

    panels = choose([curve])
    if not panels:
        page.missing["charts"] = "There are no learning curves yet: no episode has ended."
    with _part(page, "charts", "The learning curves are not plotted", RlcliError):
        page.charts = [
            Chart(panel.title, panel_svg(panel, AXES["steps"], f"chart{position}"), legend_of(panel))
            for position, panel in enumerate(panels)
        ]


def _facts(run: Run, curve: Curve | None) -> Iterator[tuple[str, str]]:
    record = run.record
    yield "Agent", str(record.get("agent") or "-")
    yield "State", str(record.get("state", "unknown"))
    yield "Started", _date(record.get("started"))
    if curve is not None:
        axes = curve.histories[0].axes
        yield "Trained", f"{axes['steps'][-1]:,.0f} steps in {axes['iterations'][-1]:,.0f} iterations"
        yield "Training time", _duration(axes["time"][-1])
    yield "Seed", str(record["seed"])
    yield "Device", str(record.get("device", "cpu"))
    if record.get("init_from"):
        yield "Weights from", str(record["init_from"])
    if record.get("resumed"):
        yield "Resumed", f"{len(record['resumed'])} time{'s' * (len(record['resumed']) != 1)}"


# --- configuration and its origins ---


def _settings(run: Run, document: strict_yaml.Document) -> list[Setting]:
    """Return every value of a run's configuration, and where it was set.

    The run records values of the command line and of `--config` files. Other values are compared with the installed
    task: if they are equal, the origin is the line of the installed task; else it is the line of the run's own file.
    """
    recorded = run.record.get("given", {})
    installed, lines = _installed(run)
    rows = []
    for path, value in leaves(document.data):
        key = dotted(path)
        if key in recorded:
            origin = str(recorded[key])
        elif key in lines and as_text(installed.get(key)) == as_text(value):
            origin = lines[key]
        else:
            line, column = document.marks.get(path, (0, 0))
            origin = f"{run.config.name}:{line}:{column}" + (" (the installed task differs)" if key in lines else "")
        text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)
        rows.append(Setting(key, text, origin))
    return rows


def _installed(run: Run) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the settings of the installed task, to compare them with the settings of the run.

    Returns:
        Dotted key -> value, and dotted key -> where the value is set; both are empty if the task cannot be read.
    """
    from rlcli.config.dump import to_data

    device = "cuda" if str(run.record.get("device", "")).startswith("cuda") else "cpu"
    try:
        source = recorded_task(run.record["task"], f"the task of {run.folder}")
        resolved = resolve(source, agent=run.record.get("agent"), device=device)
    except RlcliError:
        return {}, {}
    values = {dotted(path): value for path, value in leaves(to_data(resolved))}
    # without the folder of the task's files: the page may be read on another machine
    return values, {key: line.replace(source.label, source.config.name) for key, line in origins(resolved).items()}


def _sections(settings: list[Setting]) -> list[tuple[str, list[Setting]]]:
    sections: dict[str, list[Setting]] = {}
    for setting in settings:
        section, dot, _ = setting.key.partition(".")
        sections.setdefault(section if dot else "general", []).append(setting)
    return sorted(sections.items(), key=lambda item: item[0] != "general")


# --- versions, machine, commands ---


def _machine(record: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    task, versions, torch = record["task"], record.get("versions", {}), record.get("torch", {})
    distribution = f"{task.get('distribution')} {task.get('version') or ''}".strip()
    yield "Task from", distribution if task.get("distribution") else str(task.get("folder")).strip()
    yield "rlcli", str(record.get("rlcli", "unknown"))
    yield "Python", str(record.get("python", "unknown"))
    optional = {
        **versions,
        "Platform": record.get("platform"),
        "C library": record.get("libc"),
        "Processor": record.get("cpu", {}).get("model"),
        "GPU": f"{torch['gpu']}, CUDA {torch.get('cuda')}" if torch.get("gpu") else None,
    }
    yield from ((str(name), str(value)) for name, value in optional.items() if value)
    yield "Threads", f"engine {record.get('engine_threads', '?')}, torch {record.get('torch_threads', '?')}"
    for name, digest in record.get("sources", {}).items():
        yield f"sha256 of {'the sources of rlcli' if name == 'rlcli' else name}", str(digest)[:64]


def _commands(run: Run, checkpoint: Path | None) -> Iterator[tuple[str, str]]:
    record = run.record
    folder = shlex.quote(str(run.folder))
    command = record.get("command")
    if isinstance(command, list) and command:
        program = "rlcli" if command[0] in ("rlcli", "__main__.py") else str(command[0])
        yield "How it was trained", " ".join([shlex.quote(program), *(shlex.quote(str(word)) for word in command[1:])])
    yield "Train it again, and compare bit by bit", f"rlcli reproduce {folder}"
    if checkpoint is not None:
        yield "Evaluate it", f"rlcli eval --checkpoint {folder}"
        yield "Watch it", f"rlcli play --checkpoint {folder}"
        yield "Export it for a robot", f"rlcli export --checkpoint {folder}"


# --- texts ---


def reason_of(error: Exception) -> str:
    """Return the message of an error, and how to correct the error, as one sentence for the page."""
    if isinstance(error, RlcliError):
        text = error.message + (f" ({error.hint})" if error.hint else "")
    elif isinstance(error, ValidationError):
        first = error.errors(include_url=False, include_input=False)[0]
        text = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    else:
        text = str(error)
    text = " ".join(text.split())
    return text[:_MAX_CHARACTERS] + ("" if text.endswith((".", ")")) else ".")


def _date(text: object) -> str:
    with contextlib.suppress(ValueError):
        return datetime.fromisoformat(str(text)).strftime("%Y-%m-%d %H:%M UTC")
    return "unknown"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{number(round(seconds, 1))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
