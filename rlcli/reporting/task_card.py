"""Task cards: tables that describe a task's observations, actions, rewards and so on.

A card is made from the configuration and the docstrings of terms; no environment is built, and no code of the task is
imported. Sizes of terms and names of joints come from the compiled model, so they are read from a layout: the `layout`
of a checkpoint's manifest, or the `task.layout.json` that a task ships.
"""

import ast
import contextlib
import html
import itertools
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rlcli.config.class_search import ClassSearch
from rlcli.config.layers import leaves
from rlcli.config.load import Resolved
from rlcli.config.messages import dotted
from rlcli.config.schema import (
    DelayConfig,
    ObservationConfig,
    ObservationGroupConfig,
    TaskConfig,
    TermConfig,
    bound_text,
)
from rlcli.config.term_signatures import SECTIONS, SELECTORS, SignatureError, Vocabulary, first_paragraph, read_params
from rlcli.registry import TaskSource
from rlcli.reporting.card_text import columns_text, modifier_text, noise_text, number, span, text_of, when_text

CODE, NUMBER, TEXT = "code", "number", "text"
"""Kinds of columns in a table, which set their font and alignment: names in code, numbers, sentences."""


@dataclass(frozen=True, slots=True)
class Column:
    """Column of a table: its title, and whether it contains names, numbers or sentences."""

    title: str
    """Heading of the column, such as `Weight`."""
    kind: str = TEXT
    """`code` (names), `number` or `text` (sentences)."""


@dataclass(frozen=True, slots=True)
class Table:
    """Table of plain text; text between backticks is a name."""

    title: str
    """Heading above the table, such as `Rewards`."""
    note: str
    """Sentence above the table; may be empty."""
    columns: tuple[Column, ...]
    """Columns from left to right."""
    rows: tuple[tuple[str, ...], ...]
    """Cells of each row, one for each column."""


@dataclass(frozen=True, slots=True)
class Card:
    """Content of a task card: name, summary, facts and tables."""

    name: str
    """Name of the task."""
    summary: str
    """One line on what the policy does."""
    facts: tuple[tuple[str, str], ...]
    """Facts that need no table, such as the control period: (name, value)."""
    tables: tuple[Table, ...]
    """One table for each section of the task: observations, actions, rewards, ..."""


def task_card(resolved: Resolved, layout: Mapping[str, Any] | None = None) -> Card:
    """Return the task card of a resolved configuration; use this function where the task is installed.

    Args:
        resolved: the configuration.
        layout: sizes and units of the terms' columns, from `rlcli.envs.layout.Layout.record`; None leaves them out.
    """
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
    """Return the task card of a configuration whose task may be missing, such as the stored one of a run.

    For an installed task, `task_card` calls this function with its vocabulary, name and source.

    Args:
        task: the configuration.
        vocabulary: the signatures of its terms.
        name: the task's name.
        source: the task's files; None leaves out the docstrings of a direct task.
        layout: sizes, units and element names of the terms' columns, from `rlcli.envs.layout.Layout.record`; None
            leaves them out.
    """
    layout = layout or {}
    tables = [
        *_observations(task, vocabulary, layout),
        _actions(task, vocabulary, layout),
        _actuators(task),
        *_direct(task, source),
        *_term_tables(task, vocabulary),
        _sensors(task),
    ]
    shown = (_without_empty_columns(table) for table in tables if table.rows)
    return Card(name, task.summary, tuple(_facts(task, layout)), tuple(shown))


def markdown(content: Card, level: int = 1) -> str:
    """Return a task card as Markdown; `level` is the level of its first heading, 1 for `#`."""
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
    **dict.fromkeys(("Term", "Elements", "Name", "Drives", "Condition", "Hook"), CODE),
    **dict.fromkeys(("Size", "Scale", "Weight"), NUMBER),
}
"""Title of a column -> its kind; columns with other titles are text."""


def _columns(*titles: str) -> tuple[Column, ...]:
    return tuple(Column(title, _KINDS.get(title, TEXT)) for title in titles)


def _facts(task: TaskConfig, layout: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    rate = 1.0 / task.step_dt
    steps = "one physics step" if task.decimation == 1 else f"{task.decimation} physics steps"
    yield "Control period", f"{number(task.step_dt)} s ({number(rate)} Hz), {steps} each"
    yield "Physics step", f"{number(task.sim.dt)} s"
    yield "Episode", f"{number(task.episode_length_s)} s, {task.max_episode_length:,} steps"
    for kind, title in (("observations", "Observation"), ("actions", "Action")):
        terms = layout.get(kind, [])
        terms = terms.get("policy", []) if isinstance(terms, Mapping) else terms
        if terms:
            yield title, columns_text(sum(term["size"] for term in terms))
    for kind, clip in (("Observations", task.clip_observations), ("Actions", task.clip_actions)):
        if clip is not None:
            yield f"{kind} are clipped to", f"±{number(clip)}"
    yield "Environments", f"{task.scene.num_envs:,}"
    for name, entity in task.scene.entities.items():
        shape = f"{entity.shape} {text_of(entity.size)}" if entity.shape else str(entity.model)
        yield f"Entity {name}", shape
    ground = task.scene.terrain
    yield "Ground", "a plane" if ground is None and task.scene.ground else "none" if ground is None else ground.kind
    yield "Gravity", f"{text_of(task.sim.gravity)} m/s²"


def _observations(task: TaskConfig, vocabulary: Vocabulary, layout: Mapping[str, Any]) -> Iterable[Table]:
    compiled = layout.get("observations", {})
    if not task.observations:  # a direct task, whose observations are in the layout only
        for group, terms in compiled.items():
            rows = [(t["name"], t.get("unit", ""), str(t["size"]), text_of(t.get("clip") or "")) for t in terms]
            note = f"{columns_text(sum(term['size'] for term in terms))}."
            yield Table(f"Observations: {group}", note, _columns("Name", "Unit", "Size", "Clip"), tuple(rows))
        return
    titles = (
        "Term",
        "Meaning",
        "Unit",
        "Size",
        "Elements",
        "Parameters",
        "Modifiers",
        "Noise",
        "Bias",
        "Clip",
        "Scale",
    )
    columns = _columns(*titles, "Delay", "History")
    for name, group in task.observations.items():
        layouts = {term["name"]: term for term in compiled.get(name, [])}
        cells = [
            _observation(term, config, group, vocabulary, layouts.get(term, {}))
            for term, config in group.terms.items()
            if config is not None
        ]
        note = "" if group.enable_corruption else "Without noise, bias and delay."
        size = sum(term["size"] for term in layouts.values())
        note = f"{columns_text(size)}. {note}".strip() if size else note
        yield Table(f"Observations: {name}", note, columns, tuple(cells))


def _observation(
    name: str,
    config: ObservationConfig,
    group: ObservationGroupConfig,
    vocabulary: Vocabulary,
    layout: Mapping[str, Any],
) -> tuple[str, ...]:
    meaning, unit = _meaning("observations", config, vocabulary)
    noisy = group.enable_corruption
    delay = config.delay if noisy else None
    history = group.history or config.history or 1
    return (
        name,
        meaning,
        layout.get("unit") or unit,
        str(layout.get("size", "")),
        ", ".join(layout.get("elements", [])),
        _parameters("observations", config, vocabulary),
        "; ".join(modifier_text(modifier.model_dump()) for modifier in config.modifiers),
        noise_text(config.noise) if noisy else "",
        noise_text(config.bias) if noisy else "",
        text_of(config.clip) if config.clip is not None else "",
        f"x {text_of(config.scale)}" if config.scale is not None else "",
        _delay(delay),
        f"{history} steps" if history > 1 else "",
    )


def _delay(config: DelayConfig | None) -> str:
    if config is None:
        return ""
    return f"{text_of(config.steps)} steps" if config.steps is not None else f"{text_of(config.seconds)} s"


def _actions(task: TaskConfig, vocabulary: Vocabulary, layout: Mapping[str, Any]) -> Table:
    layouts = {term["name"]: term for term in layout.get("actions", [])}
    rows = []
    for name, config in task.actions.items():
        if config is None:
            continue
        meaning, unit = _meaning("actions", config, vocabulary)
        term = layouts.get(name, {})
        parameters = _parameters("actions", config, vocabulary)
        rows.append(
            (name, meaning, term.get("unit") or unit, parameters, *_compiled_action(term), _delay(config.delay))
        )
    if not task.actions:
        rows = [(name, "", term.get("unit", ""), "", *_compiled_action(term), "") for name, term in layouts.items()]
    columns = _columns("Term", "Meaning", "Unit", "Parameters", "Size", "Drives", "Limits", "Delay")
    return Table("Actions", "", columns, tuple(rows))


def _compiled_action(term: Mapping[str, Any]) -> tuple[str, str, str]:
    pairs = term.get("limits") or term.get("clip") or []
    texts = [
        f"[{'-∞' if low is None else number(low)}, {'∞' if high is None else number(high)}]" for low, high in pairs
    ]
    limits = texts[0] if texts and len(set(texts)) == 1 else ", ".join(texts)
    return str(term.get("size", "")), ", ".join(term.get("elements", [])), limits


def _term_tables(task: TaskConfig, vocabulary: Vocabulary) -> Iterable[Table]:
    """Yield the tables of the task's sections (rewards, terminations, events, ...), with one row for each term."""

    def table(
        section: str, note: str, titles: tuple[str, ...], cells: Callable[[Any, str, str], tuple[str, ...]]
    ) -> Table:
        """Return the table of a section.

        `cells(config, meaning, unit)` returns the cells of a term's row between its name and its parameters.
        """
        terms = getattr(task, section)
        rows = [
            (name, *cells(config, *_meaning(section, config, vocabulary)), _parameters(section, config, vocabulary))
            for name, config in terms.items()
            if config is not None
        ]
        title = "Events and randomisation" if section == "events" else section.capitalize()
        return Table(title, note, _columns(*titles), tuple(rows))

    scaled = f" x {number(task.step_dt)} s" if task.reward_dt_scaling else ""
    note = f"The reward of a step is the sum of weight x value{scaled} over the terms."
    titles: tuple[str, ...] = ("Term", "Weight", "Value", "Parameters")
    yield table("rewards", note, titles, lambda term, meaning, unit: (number(term.weight), meaning))
    note = "A truncated episode ran out of time: the value of its last state is bootstrapped."
    titles = ("Term", "What it does", "When", "Parameters")
    ends = {True: "truncates", False: "terminates"}
    yield table("terminations", note, titles, lambda term, meaning, unit: (ends[term.time_out], meaning))
    note = "An episode succeeds if it ends by time-out and each condition held during its last seconds."
    yield table("success", note, ("Condition", "Value", "Must be", "For [s]", "Parameters"), _condition_cells)
    titles = ("Term", "Meaning", "Unit", "Resampled", "Ranges")
    yield table(
        "commands", "", titles, lambda term, meaning, unit: (meaning, unit, f"every {span(term.resampling_time_s)} s")
    )
    titles = ("Term", "When", "Meaning", "Ranges and parameters")
    yield table("events", "", titles, lambda term, meaning, unit: (when_text(term), meaning))
    yield table("curriculum", "", ("Term", "Meaning", "Parameters"), lambda term, meaning, unit: (meaning,))


def _condition_cells(term: Any, meaning: str, unit: str) -> tuple[str, ...]:
    value = meaning.removeprefix("Return ")
    return value[:1].upper() + value[1:], bound_text(term.model_dump()) or "true", number(term.hold_s)


def _sensors(task: TaskConfig) -> Table:
    rows = [
        (name, sensor.kind, text_of(sensor.model_dump(exclude={"kind"}, exclude_defaults=True)))
        for name, sensor in task.scene.sensors.items()
    ]
    return Table("Sensors", "", _columns("Name", "Kind", "Settings"), tuple(rows))


def _actuators(task: TaskConfig) -> Table:
    """Return the table of actuator models; actuators of the MJCF are not part of the configuration and are left out."""
    rows = []
    for entity in task.scene.entities.values():
        for name, actuator in entity.actuators.items():
            settings = actuator.model_dump(exclude={"kind", "joints"}, exclude_none=True)
            rows.append((name, actuator.kind, text_of(actuator.joints), text_of(settings)))
    return Table("Actuators", "", _columns("Name", "Kind", "Joints", "Settings"), tuple(rows))


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
"""Hook (method) of a direct task -> the part of the task that it computes."""


def _direct(task: TaskConfig, source: TaskSource | None) -> Iterable[Table]:
    """Yield two tables of a direct task: its parameters, and the docstrings of its class, read from its source file."""
    foreign = (leaf for block in task.foreign.values() if block for leaf in leaves(block))
    values = task.params | {dotted(path): value for path, value in foreign}
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
    columns = (Column("Parameter", CODE), Column("Value", NUMBER), Column("Meaning"), Column("Default", NUMBER))
    yield Table("Parameters", "", columns, tuple(rows))
    note = "The docstrings of the task's class. Its code is the definition."
    yield Table("Docstrings of the task", note, _columns("Part of the task", "Hook", "Meaning"), tuple(hooks))


def _hooks(file: Path, class_name: str) -> list[tuple[str, str, str]]:
    """Return a row for the class of a direct task and for each of its hooks (methods) that has a docstring.

    A row is: the part of the task that the hook computes, the hook's name, and the first paragraph of its docstring.
    """
    docstrings: dict[str, str] = {}
    # base classes come first, so that the hooks of a class replace those of its bases
    for source in reversed(ClassSearch().lineage(file, class_name)):
        functions = [inner for inner in source.node.body if isinstance(inner, ast.FunctionDef)]
        docstrings |= {inner.name: text for inner in functions if (text := ast.get_docstring(inner))}
        docstrings[class_name] = ast.get_docstring(source.node) or ""
    decisions = {class_name: "Task", **_HOOKS}
    return [(decides, n, first_paragraph(docstrings[n])) for n, decides in decisions.items() if docstrings.get(n)]


# --- cells ---

_SHAPE = re.compile(r"\s*\((?:num_envs|n),[^()]*\)(?: each)?")
_UNIT = re.compile(r"\[([^\]]+)\]")


def _meaning(section: str, config: TermConfig, vocabulary: Vocabulary) -> tuple[str, str]:
    """Return the description of a term without shapes, and its unit; the unit is empty if the docstring has none.

    The description is the first paragraph of the docstring, or the term's name if there is no docstring.
    """
    signature = vocabulary.find(section, config.func)
    if signature is None or not signature.description:
        return f"`{config.func}`", ""
    description = _SHAPE.sub("", signature.description).strip()
    unit = _UNIT.search(signature.summary)
    return description, unit[1] if unit else ""


def _parameters(section: str, config: TermConfig, vocabulary: Vocabulary) -> str:
    """Return a term's parameters as text, such as `std` = 0.5.

    The text leaves out selectors that match all joints, bodies or other elements (`.*`), and default values that name
    an entity, command or sensor, unless the term's docstring mentions the parameter.
    """
    signature = vocabulary.find(section, config.func)
    parameters = {p.name: p for p in signature.parameters} if signature else {}
    parts = []
    for key, value in config.params.items():
        if value is None or key in SECTIONS[section].model_fields:
            continue
        parameter = parameters.get(key)
        is_default = parameter is not None and parameter.alias is not None and value == parameter.default
        is_named = signature is not None and f"`{key}`" in signature.description
        is_trivial = parameter is not None and (parameter.alias not in SELECTORS or value == ".*")
        if is_default and is_trivial and not is_named:
            continue
        parts.append(f"`{key}` = {text_of(value)}")
    return ", ".join(parts)


def _without_empty_columns(table: Table) -> Table:
    kept = [i for i in range(len(table.columns)) if any(row[i] for row in table.rows)]
    rows = tuple(tuple(row[i] for i in kept) for row in table.rows)
    return Table(table.title, table.note, tuple(table.columns[i] for i in kept), rows)


def _cell(text: str) -> str:
    """Return text for a Markdown cell, with all markup escaped, except code between backticks."""
    parts = " ".join(text.split()).split("`")
    plain = [re.sub(r"([\\*_\[\]#])", r"\\\1", html.escape(part, quote=False)) for part in parts[::2]]
    codes = [f"`{part}`" for part in parts[1::2]]
    return "".join(a + b for a, b in itertools.zip_longest(plain, codes, fillvalue=""))
