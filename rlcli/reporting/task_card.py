"""The card of a task: what its Markov decision process is, in tables, from its configuration and docstrings.

Nothing is built or imported. What only the compiled model knows, the size of a term and the joints behind it, is in a
layout: the `layout` of a checkpoint's manifest, or the `task.layout.json` that a task ships.
"""

from __future__ import annotations

import ast
import contextlib
import html
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rlcli.config.load import Resolved
from rlcli.config.schema import ObservationConfig, ObservationGroupConfig, TaskConfig, TermConfig
from rlcli.config.source_classes import lineage
from rlcli.config.term_signatures import SECTIONS, SELECTORS, SignatureError, Vocabulary, first_paragraph, read_params
from rlcli.registry import TaskSource
from rlcli.reporting.card_text import columns_text, modifier_text, noise_text, number, span, text_of, when_text

CODE, NUMBER, TEXT = "code", "number", "text"
"""Kinds of columns."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table: its title, and whether it holds names, numbers or sentences."""

    title: str
    kind: str = TEXT


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of plain text; what stands between backticks is a name."""

    title: str
    note: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class Card:
    """What a task is."""

    name: str
    summary: str
    facts: tuple[tuple[str, str], ...]
    tables: tuple[Table, ...]


def task_card(resolved: Resolved, layout: Mapping[str, Any] | None = None) -> Card:
    """The card of a resolved task; `layout` as `rlcli.envs.vec_env.Layout.record` gives it."""
    source = resolved.source
    return card(resolved.task, resolved.vocabulary, name=source.name, source=source, layout=layout)


def card(
    task: TaskConfig,
    vocabulary: Vocabulary,
    *,
    name: str,
    source: TaskSource | None = None,
    layout: Mapping[str, Any] | None = None,
) -> Card:
    """The card of a configuration.

    Args:
        task: the configuration.
        vocabulary: where its terms are looked up.
        name: of the task.
        source: its files; None where they are not at hand: then a direct task's docstrings are left out.
        layout: sizes, units and elements as compiled; None leaves them out.
    """
    layout = layout or {}
    tables = [
        *_observations(task, vocabulary, layout),
        _actions(task, vocabulary, layout),
        _actuators(task),
        *_direct(task, source),
        _rewards(task, vocabulary),
        _terminations(task, vocabulary),
        _success(task, vocabulary),
        _commands(task, vocabulary),
        _events(task, vocabulary),
        _curriculum(task, vocabulary),
        _sensors(task),
    ]
    shown = (_without_empty_columns(table) for table in tables if table is not None and table.rows)
    return Card(name, task.summary, tuple(_facts(task, layout)), tuple(shown))


def markdown(content: Card, level: int = 1) -> str:
    """A card as Markdown, whose headings begin at a level."""
    lines = [f"{'#' * level} {_cell(content.name)}", "", _cell(content.summary), ""]
    lines += ["| | |", "| --- | --- |", *(f"| {_cell(key)} | {_cell(value)} |" for key, value in content.facts), ""]
    for table in content.tables:
        lines += [f"{'#' * (level + 1)} {_cell(table.title)}", ""]
        lines += [_cell(table.note), ""] if table.note else []
        lines.append(f"| {' | '.join(column.title for column in table.columns)} |")
        lines.append(f"| {' | '.join('---:' if c.kind == NUMBER else '---' for c in table.columns)} |")
        for row in table.rows:
            cells = (
                f"`{text}`" if column.kind == CODE and text and "`" not in text else _cell(text)
                for column, text in zip(table.columns, row, strict=True)
            )
            lines.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


# --- the tables ---

_KINDS = {
    **dict.fromkeys(("Term", "Of", "Name", "Drives", "Condition", "Hook"), CODE),
    **dict.fromkeys(("Size", "Scale", "Weight"), NUMBER),
}
"""Title of a column -> its kind; others are text."""


def _columns(*titles: str) -> tuple[Column, ...]:
    return tuple(Column(title, _KINDS.get(title, TEXT)) for title in titles)


def _facts(task: TaskConfig, layout: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    rate = 1.0 / task.step_dt
    yield "Control period", f"{number(task.step_dt)} s ({number(rate)} Hz), {task.decimation} physics steps each"
    yield "Physics step", f"{number(task.sim.dt)} s"
    yield "Episode", f"{number(task.episode_length_s)} s, {task.max_episode_length:,} steps"
    for kind, title in (("observations", "Observation"), ("actions", "Action")):
        terms = layout.get(kind, [])
        terms = terms.get("policy", []) if isinstance(terms, Mapping) else terms
        if terms:
            yield title, columns_text(sum(term["size"] for term in terms))
    for clip, title in (
        (task.clip_observations, "Observations are clipped to"),
        (task.clip_actions, "Actions are clipped to"),
    ):
        if clip is not None:
            yield title, f"±{number(clip)}"
    yield "Environments", f"{task.scene.num_envs:,}"
    for name, entity in task.scene.entities.items():
        shape = f"{entity.shape} {text_of(entity.size)}" if entity.shape else str(entity.model)
        yield f"Entity {name}", shape
    ground = task.scene.terrain
    yield "Ground", "a plane" if ground is None and task.scene.ground else "none" if ground is None else ground.kind
    yield "Gravity", f"{text_of(task.sim.gravity)} m/s²"


def _observations(task: TaskConfig, vocabulary: Vocabulary, layout: Mapping[str, Any]) -> Iterable[Table | None]:
    compiled = layout.get("observations", {})
    if not task.observations:
        yield from (_compiled_observations(f"Observations: {group}", terms) for group, terms in compiled.items())
        return
    titles = ("Term", "What", "Unit", "Size", "Of", "Parameters", "Modifiers", "Noise", "Bias", "Clip", "Scale")
    columns = _columns(*titles, "Delay", "History")
    for name, group in task.observations.items():
        known = {term["name"]: term for term in compiled.get(name, [])}
        rows = [
            _observation(term, config, group, vocabulary, known.get(term, {}))
            for term, config in group.terms.items()
            if config is not None
        ]
        note = "" if group.enable_corruption else "Without noise, bias and delay."
        size = sum(term["size"] for term in known.values())
        yield Table(
            f"Observations: {name}", f"{columns_text(size)}. {note}".strip() if size else note, columns, tuple(rows)
        )


def _observation(
    name: str,
    config: ObservationConfig,
    group: ObservationGroupConfig,
    vocabulary: Vocabulary,
    known: Mapping[str, Any],
) -> tuple[str, ...]:
    what, unit = _meaning("observations", config, vocabulary)
    noisy = group.enable_corruption
    delay = config.delay if noisy else None
    history = group.history or config.history or 1
    return (
        name,
        what,
        known.get("unit") or unit,
        str(known.get("size", "")),
        ", ".join(known.get("elements", [])),
        _parameters("observations", config, vocabulary),
        "; ".join(modifier_text(modifier.model_dump()) for modifier in config.modifiers),
        noise_text(config.noise) if noisy else "",
        noise_text(config.bias) if noisy else "",
        text_of(config.clip) if config.clip is not None else "",
        f"x {text_of(config.scale)}" if config.scale is not None else "",
        f"{text_of(delay.steps)} steps" if delay is not None else "",
        f"{history} steps" if history > 1 else "",
    )


def _compiled_observations(title: str, terms: Sequence[Mapping[str, Any]]) -> Table:
    """Return the observations of a direct task, which only the layout has."""
    rows = [
        (term["name"], term.get("unit", ""), str(term["size"]), text_of(term["clip"]) if term.get("clip") else "")
        for term in terms
    ]
    note = f"{columns_text(sum(term['size'] for term in terms))}."
    return Table(title, note, _columns("Name", "Unit", "Size", "Clip"), tuple(rows))


def _actions(task: TaskConfig, vocabulary: Vocabulary, layout: Mapping[str, Any]) -> Table:
    known = {term["name"]: term for term in layout.get("actions", [])}
    rows = []
    for name, config in task.actions.items():
        if config is None:
            continue
        what, unit = _meaning("actions", config, vocabulary)
        term = known.pop(name, {})
        parameters = _parameters("actions", config, vocabulary)
        rows.append((name, what, term.get("unit") or unit, parameters, *_compiled_action(term)))
    if not task.actions:
        rows = [(name, "", term.get("unit", ""), "", *_compiled_action(term)) for name, term in known.items()]
    columns = _columns("Term", "What", "Unit", "Parameters", "Size", "Drives", "Limits")
    return Table("Actions", "", columns, tuple(rows))


def _compiled_action(term: Mapping[str, Any]) -> tuple[str, str, str]:
    pairs = term.get("limits") or term.get("clip") or []
    texts = [
        f"[{'-∞' if low is None else number(low)}, {'∞' if high is None else number(high)}]" for low, high in pairs
    ]
    limits = texts[0] if texts and len(set(texts)) == 1 else ", ".join(texts)
    return str(term.get("size", "")), ", ".join(term.get("elements", [])), limits


def _terms(
    section: str,
    terms: Mapping[str, TermConfig | None],
    vocabulary: Vocabulary,
    cells: Callable[[Any, str, str], tuple[str, ...]],
) -> tuple[tuple[str, ...], ...]:
    """Return a row for each term: its name, what `cells` makes of its settings, meaning and unit, and parameters."""
    return tuple(
        (name, *cells(config, *_meaning(section, config, vocabulary)), _parameters(section, config, vocabulary))
        for name, config in terms.items()
        if config is not None
    )


def _rewards(task: TaskConfig, vocabulary: Vocabulary) -> Table:
    rows = _terms("rewards", task.rewards, vocabulary, lambda term, what, unit: (number(term.weight), what))
    scaled = f" x {number(task.step_dt)} s" if task.reward_dt_scaling else ""
    note = f"The reward of a step is the sum of weight x value{scaled} over the terms."
    return Table("Rewards", note, _columns("Term", "Weight", "Value", "Parameters"), rows)


def _terminations(task: TaskConfig, vocabulary: Vocabulary) -> Table:
    rows = _terms(
        "terminations",
        task.terminations,
        vocabulary,
        lambda term, what, unit: ("truncates" if term.time_out else "terminates", what),
    )
    note = "An episode that is truncated ran out of time: its last state has a future, which is bootstrapped."
    return Table("Terminations", note, _columns("Term", "What it does", "When", "Parameters"), rows)


def _success(task: TaskConfig, vocabulary: Vocabulary) -> Table:
    terms = {task.success.func: task.success} if task.success else {}
    rows = _terms("success", terms, vocabulary, lambda term, what, unit: (what,))
    hold = number(task.success.hold_s) if task.success else ""
    note = f"An episode succeeds if time ended it and this held during its last {hold} s."
    return Table("Success", note, _columns("Condition", "When", "Parameters"), rows)


def _commands(task: TaskConfig, vocabulary: Vocabulary) -> Table:
    rows = _terms(
        "commands",
        task.commands,
        vocabulary,
        lambda term, what, unit: (what, unit, f"every {span(term.resampling_time_s)} s"),
    )
    return Table("Commands", "", _columns("Term", "What", "Unit", "Drawn anew", "Ranges"), rows)


def _events(task: TaskConfig, vocabulary: Vocabulary) -> Table:
    rows = _terms("events", task.events, vocabulary, lambda term, what, unit: (when_text(term), what))
    columns = _columns("Term", "When", "What", "Ranges and parameters")
    return Table("Events and randomisation", "", columns, rows)


def _curriculum(task: TaskConfig, vocabulary: Vocabulary) -> Table:
    rows = _terms("curriculum", task.curriculum, vocabulary, lambda term, what, unit: (what,))
    return Table("Curriculum", "", _columns("Term", "What", "Parameters"), rows)


def _sensors(task: TaskConfig) -> Table:
    rows = [
        (name, sensor.kind, text_of(sensor.model_dump(exclude={"kind"}, exclude_defaults=True)))
        for name, sensor in task.scene.sensors.items()
    ]
    return Table("Sensors", "", _columns("Name", "Kind", "Settings"), tuple(rows))


def _actuators(task: TaskConfig) -> Table:
    """The models of what drives joints; of MuJoCo's own actuators the MJCF tells."""
    rows = [
        (
            name,
            actuator.kind,
            text_of(actuator.joints),
            text_of(actuator.model_dump(exclude={"kind", "joints"}, exclude_none=True)),
        )
        for entity in task.scene.entities.values()
        for name, actuator in entity.actuators.items()
    ]
    columns = _columns("Name", "Kind", "Joints", "Settings")
    return Table("Actuators", "", columns, tuple(rows))


# --- direct tasks ---

_HOOKS = {
    "set_up_scene": "Scene",
    "reset": "Start of an episode",
    "reset_idx": "Start of an episode",
    "pre_physics_step": "Actions",
    "get_observations": "Observations",
    "get_states": "States of the critic",
    "calculate_metrics": "Reward",
    "is_done": "Termination",
}
"""Hook -> what it decides."""


def _direct(task: TaskConfig, source: TaskSource | None) -> Iterable[Table]:
    """Parameters and docstrings of a direct task's class, read from its source."""
    values = task.params | {key: value for block in task.foreign.values() for key, value in _flat(block).items()}
    described: dict[str, tuple[str, str]] = {}
    hooks: list[tuple[str, str, str]] = []
    if source is not None and source.task and source.task_file is not None:
        class_name = source.task.rpartition(":")[2]
        with contextlib.suppress(OSError, SyntaxError, SignatureError, ValueError, RecursionError):
            hooks = _hooks(source.task_file, class_name)
            params = read_params(source.task_file, class_name)
            described = {
                key: (field.description or "", "" if field.is_required() else text_of(field.default))
                for key, field in (params.model_fields.items() if params else ())
            }
    rows = [(key, text_of(value), *described.get(key, ("", ""))) for key, value in values.items()]
    columns = (Column("Parameter", CODE), Column("Value", NUMBER), Column("What"), Column("Default", NUMBER))
    yield Table("Parameters", "", columns, tuple(rows))
    note = "What the docstrings of the task's class say; its code is the definition."
    yield Table("In the task's words", note, _columns("Decides", "Hook", "What"), tuple(hooks))


def _hooks(file: Path, class_name: str) -> list[tuple[str, str, str]]:
    docstrings = _docstrings(file, class_name)
    found = [("Task", class_name, docstrings.get("", ""))]
    found += [(decides, name, docstrings.get(name, "")) for name, decides in _HOOKS.items()]
    return [(decides, name, first_paragraph(text)) for decides, name, text in found if text]


def _docstrings(file: Path, class_name: str) -> dict[str, str]:
    """Method -> docstring, of a class and of the bases that a task has in files of its own; "" is the class itself."""
    found: dict[str, str] = {}
    for source in reversed(lineage(file, class_name)):
        functions = [inner for inner in source.node.body if isinstance(inner, ast.FunctionDef)]
        found |= {inner.name: text for inner in functions if (text := ast.get_docstring(inner))}
        found[""] = ast.get_docstring(source.node) or ""
    return found


def _flat(value: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, item in value.items():
        flat |= _flat(item, f"{prefix}{key}.") if isinstance(item, Mapping) and item else {f"{prefix}{key}": item}
    return flat


# --- cells ---

_SHAPE = re.compile(r"\s*\((?:num_envs|n),[^()]*\)(?: each)?")
_UNIT = re.compile(r"\[([^\]]+)\]")


def _meaning(section: str, config: TermConfig, vocabulary: Vocabulary) -> tuple[str, str]:
    """What a term's docstring says, without shapes, and its unit."""
    signature = vocabulary.find(section, config.func)
    if signature is None or not signature.description:
        return f"`{config.func}`", ""
    said = _SHAPE.sub("", signature.description).strip()
    unit = _UNIT.search(signature.summary)
    return said, unit[1] if unit else ""


def _parameters(section: str, config: TermConfig, vocabulary: Vocabulary) -> str:
    """The parameters of a term; the entity only where it is not the usual one, selectors where they select."""
    signature = vocabulary.find(section, config.func)
    known = {p.name: p for p in signature.parameters} if signature else {}
    given = {key: value for key, value in config.params.items() if key not in SECTIONS[section].model_fields}
    parts = []
    for key, value in given.items():
        parameter = known.get(key)
        quiet = parameter is not None and parameter.alias is not None and value == parameter.default
        if value is None or (quiet and (parameter is None or parameter.alias not in SELECTORS or value == ".*")):
            continue
        parts.append(f"`{key}` = {text_of(value)}")
    return ", ".join(parts)


def _without_empty_columns(table: Table) -> Table:
    kept = [i for i in range(len(table.columns)) if any(row[i] for row in table.rows)]
    rows = tuple(tuple(row[i] for i in kept) for row in table.rows)
    return Table(table.title, table.note, tuple(table.columns[i] for i in kept), rows)


def _cell(text: str) -> str:
    """Text in Markdown, where only what stands between backticks is more than text."""
    parts = " ".join(text.split()).split("`")
    plain = [re.sub(r"([\\*_\[\]#])", r"\\\1", html.escape(part, quote=False)) for part in parts[::2]]
    codes = [f"`{part}`" for part in parts[1::2]]
    if len(parts) % 2 == 0:  # one without its twin
        return "".join(plain[i] + (codes[i] if i < len(codes) else "") for i in range(len(plain)))
    return "".join(a + b for a, b in zip(plain, [*codes, ""], strict=True))
