"""Content of a run's page, gathered from its files. Each part is gathered on its own: one may be missing."""

from __future__ import annotations

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
from rlcli.config.foreign_keys import move_foreign_keys
from rlcli.config.layers import leaves
from rlcli.config.load import resolve
from rlcli.config.messages import dotted
from rlcli.config.schema import TaskConfig
from rlcli.config.term_signatures import Vocabulary
from rlcli.errors import CheckpointError, RlcliError
from rlcli.reporting.card_text import number
from rlcli.reporting.curves import AXES, Curve, gather
from rlcli.reporting.panels import choose
from rlcli.reporting.task_card import Card, card, task_card
from rlcli.runs.checkpoint import open_checkpoint
from rlcli.runs.config_diff import as_text
from rlcli.runs.restore import recorded_task, resolve_run
from rlcli.runs.run import Run

_MOST_CHARACTERS = 2000
"""Of a text that the page shows."""


@dataclass(frozen=True, slots=True)
class Setting:
    """A value of the configuration and where it was written."""

    key: str
    value: str
    origin: str


@dataclass(frozen=True, slots=True)
class Chart:
    """A panel of learning curves: an SVG element, and beside it (label, colour, style of the line) of what is in it."""

    title: str
    svg: str
    legend: list[tuple[str, int, int]]


@dataclass(slots=True)
class Page:
    """Content of the page. A missing part has its reason in `missing`."""

    task: str
    name: str
    summary: str
    facts: list[tuple[str, str]]
    card: Card | None = None
    charts: list[Chart] = field(default_factory=list)
    evaluation: dict[str, Any] | None = None
    checkpoint: str | None = None
    video: bytes | None = None
    video_of: str = ""
    settings: list[tuple[str, list[Setting]]] = field(default_factory=list)
    """Section -> its values."""
    machine: list[tuple[str, str]] = field(default_factory=list)
    commands: list[tuple[str, str]] = field(default_factory=list)
    """(what it does, command) each."""
    missing: dict[str, str] = field(default_factory=dict)
    """Part -> one sentence why it is not there."""


def gather_page(run: Run, checkpoint: Path | None) -> Page:
    """Gather everything but evaluation and video, which may have to be made.

    Args:
        run: the run.
        checkpoint: the folder of the checkpoint that the page is about; None: it has none.
    """
    record = run.record
    page = Page(str(record["task"]["name"]), run.folder.resolve().name, "", [])
    page.checkpoint = checkpoint.resolve().name if checkpoint is not None else None
    try:
        document = run.read_config()
        page.summary = str(document.data.get("summary", ""))
        page.settings = _sections(_settings(run, document))
    except CheckpointError as error:
        document = None
        page.missing["settings"] = f"The configuration cannot be read: {reason_of(error)}"
    try:
        page.card = _card(run, document, checkpoint)
    except (RlcliError, ValidationError) as error:
        page.missing["card"] = f"The task cannot be described: {reason_of(error)}"
    curve = None
    try:
        (curve,), _ = gather([run])
        _add_charts(curve, page)
    except CheckpointError as error:
        page.missing["charts"] = f"There are no learning curves: {reason_of(error)}"
    page.facts = list(_facts(run, curve))
    if page.checkpoint is not None and page.checkpoint.isdecimal():
        page.facts.insert(0, ("Checkpoint", f"step {int(page.checkpoint):,}"))
    page.machine = list(_machine(record))
    page.commands = list(_commands(run, checkpoint))
    return page


def _card(run: Run, document: strict_yaml.Document | None, checkpoint: Path | None) -> Card:
    """The card of the task as the run has it; of a stranger's task without what its own code says."""
    layout = _layout(checkpoint)
    try:
        return task_card(resolve_run(run, play=False), layout)
    except RlcliError:
        if document is None:
            raise
    # pydantic is strict about lists and tuples but where it reads JSON
    task = TaskConfig.model_validate_json(json.dumps(move_foreign_keys(document.data)), context={"open_scene": True})
    return card(task, Vocabulary(), name=str(run.record["task"]["name"]), layout=layout)


def _layout(checkpoint: Path | None) -> dict[str, Any] | None:
    from rlcli.runs.checkpoint_manifest import LayoutRecord

    if checkpoint is None:
        return None
    try:
        return LayoutRecord.model_validate(open_checkpoint(checkpoint).manifest.get("layout")).model_dump()
    except (CheckpointError, ValidationError):
        return None


def _add_charts(curve: Curve, page: Page) -> None:
    from rlcli.reporting.figures import legend_of, panel_svg

    panels = choose([curve])
    if not panels:
        page.missing["charts"] = "There are no learning curves yet: no episode has ended."
    try:
        page.charts = [
            Chart(panel.title, panel_svg(panel, AXES["steps"], f"chart{position}"), legend_of(panel))
            for position, panel in enumerate(panels)
        ]
    except RlcliError as error:
        page.missing["charts"] = f"The learning curves are not drawn: {reason_of(error)}"


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
        yield "Resumed", f"{len(record['resumed'])} times"


# --- configuration and where it was written ---


def _settings(run: Run, document: strict_yaml.Document) -> list[Setting]:
    """Every value of a run and its origin.

    What the command line or a `--config` file gave is recorded in the run. For the others the task is looked at as it
    is installed now: where it has the same value, that is the place; where not, it is a line of the run's own file.
    """
    given = run.record.get("given", {})
    now, places = _installed(run)
    rows = []
    for path, value in leaves(document.data):
        key = dotted(path)
        if key in given:
            origin = str(given[key])
        elif key in places and as_text(now.get(key)) == as_text(value):
            origin = places[key]
        else:
            line, column = document.marks.get(path, (0, 0))
            origin = f"{run.config.name}:{line}:{column}" + (" (the installed task differs)" if key in places else "")
        rows.append(Setting(key, _value(value), origin))
    return rows


def _installed(run: Run) -> tuple[dict[str, Any], dict[str, str]]:
    """The task of a run as it is installed: key -> value, key -> origin; nothing where it cannot be had."""
    from rlcli.config.dump import to_data

    device = "cuda" if str(run.record.get("device", "")).startswith("cuda") else "cpu"
    try:
        source = recorded_task(run.record["task"], f"the task of {run.folder}")
        resolved = resolve(source, agent=run.record.get("agent"), device=device)
    except RlcliError:
        return {}, {}
    values = {dotted(path): value for path, value in leaves(to_data(resolved))}
    # of a file of the task its name is enough; the page may be read on another machine
    return values, {key: place.replace(source.label, source.config.name) for key, place in origins(resolved).items()}


def _sections(settings: list[Setting]) -> list[tuple[str, list[Setting]]]:
    sections: dict[str, list[Setting]] = {}
    for setting in settings:
        head = setting.key.partition(".")[0]
        sections.setdefault(head if head != setting.key else "general", []).append(setting)
    return sorted(sections.items(), key=lambda item: item[0] != "general")


def _value(value: object) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)


# --- versions, machine, commands ---


def _machine(record: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    task, versions, cpu = record["task"], record.get("versions", {}), record.get("cpu", {})
    owner = (
        f"{task.get('distribution')} {task.get('version') or ''}" if task.get("distribution") else task.get("folder")
    )
    yield "Task from", str(owner).strip()
    yield "rlcli", str(record.get("rlcli", "unknown"))
    yield "Python", str(record.get("python", "unknown"))
    yield from ((str(name), str(version)) for name, version in versions.items() if version)
    for key, title in (("platform", "Platform"), ("libc", "C library")):
        if record.get(key):
            yield title, str(record[key])
    if cpu.get("model"):
        yield "Processor", str(cpu["model"])
    torch = record.get("torch", {})
    if torch.get("gpu"):
        yield "GPU", f"{torch['gpu']}, CUDA {torch.get('cuda')}"
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
        yield "Take it to a robot", f"rlcli export --checkpoint {folder}"


# --- texts ---


def reason_of(error: Exception) -> str:
    """Return an error as one sentence for the page."""
    if isinstance(error, RlcliError):
        text = error.message + (f" ({error.hint})" if error.hint else "")
    elif isinstance(error, ValidationError):
        first = error.errors(include_url=False, include_input=False)[0]
        text = f"{'.'.join(map(str, first['loc']))}: {first['msg']}"
    else:
        text = str(error)
    text = " ".join(text.split())
    return text[:_MOST_CHARACTERS] + ("" if text.endswith((".", ")")) else ".")


def _date(text: object) -> str:
    try:
        return datetime.fromisoformat(str(text)).strftime("%Y-%m-%d %H:%M UTC")
    except ValueError:
        return "unknown"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{number(round(seconds, 1))} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
