"""Generator of the reference pages: task schema, agents, terms, commands and the Python API.

`python docs/reference.py` writes the pages into `docs/reference/`, where they are committed, and the lists of public
names. `tests/docs/test_reference_pages.py` fails while a page differs from the code.
"""

from __future__ import annotations

import importlib
import inspect
import re
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import griffe
from reference_python import (
    MODULES,
    cell,
    docstring_parts,
    file_name,
    one_line,
    public_names,
    python_index,
    python_page,
    slug,
)

from rlcli.config.term_docs import TermEntry, term_entries, type_text, yaml_text

DOCS = Path(__file__).resolve().parent
PUBLIC = DOCS / "public-names.txt"
"""Public Python names, one a line; tests/docs compares them with the code."""
WORDS = DOCS / "public-words.txt"
"""Public words of task files and command lines; tests/packaging compares them with the code."""
_PROJECT = tomllib.loads((DOCS.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]
TRAINERS = {
    name: object_reference.partition(":")[0]
    for name, object_reference in _PROJECT["entry-points"]["rlcli.trainers"].items()
}
"""Built-in trainers -> the modules with their `SPEC`."""
SECTIONS = {
    "observations": "Values that the policy or the critic receives, one row per environment.",
    "actions": "Conversions of the policy's action into targets or efforts of actuators.",
    "rewards": "Values whose sum is the reward; each is multiplied by its weight and the length of a step [s].",
    "terminations": "Conditions that end an episode.",
    "events": "Changes at startup, at resets or at intervals.",
    "randomization": "Events that sample properties of the model.",
    "commands": "Goals that the policy follows, sampled again at intervals.",
    "curriculum": "Changes of the task during the training.",
    "success": "Conditions that count an episode as successful.",
}
"""Section of the terms -> what its terms are."""


def public_words() -> list[str]:
    """Return the terms, configuration keys, commands and options: users' files and scripts contain them."""
    from rlcli.config.schema import TaskConfig

    words = [f"term {section}.{entry.name}" for section, entry in _terms()]
    for model, schema in {"Task": TaskConfig.model_json_schema(), **agent_schemas("{}.{}")}.items():
        for name, fields in {model: schema, **schema.get("$defs", {})}.items():
            words += [f"key {name}.{key}" for key in fields.get("properties", {})]
    for path, command in commands():
        options = [option for parameter in command.params for option in parameter.opts if option[0] == "-"]
        words += [f"command {path}", *(f"option {path} {option}" for option in options)]
    return sorted(set(words))


def agent_schemas(title: str = "{}, {}") -> dict[str, Any]:
    """Return the JSON schemas of the built-in trainers' algorithms, by title."""
    schemas = {}
    for trainer, module_name in TRAINERS.items():
        for algorithm, reference in importlib.import_module(module_name).SPEC.algorithms.items():
            module, _, name = reference.partition(":")
            model = getattr(importlib.import_module(module), name)
            schemas[title.format(trainer, algorithm)] = model.model_json_schema()
    return schemas


def commands() -> Iterator[tuple[str, Any]]:
    """Yield every command with its words, `rlcli import sb3`, in the order of `--help`."""
    import typer

    from rlcli.cli.app import build

    def walk(path: str, command: Any) -> Iterator[tuple[str, Any]]:
        inner = getattr(command, "commands", None)
        if inner is None:
            yield path, command
        else:
            for name, each in inner.items():
                yield from walk(f"{path} {name}", each)

    return walk("rlcli", typer.main.get_command(build()))


def pages() -> dict[str, str]:
    """Return the text of every generated page, by its path in `docs/reference/`."""
    written: dict[str, Iterable[str]] = {
        "task-schema.md": _task_schema(),
        "agents.md": _agents(),
        "commands.md": _commands(),
        "terms/index.md": _terms_index(),
        "python/index.md": python_index(),
    }
    written |= {f"terms/{section}.md": _terms_page(section) for section in SECTIONS}
    package = griffe.load("rlcli", search_paths=[DOCS.parent], docstring_parser="google")
    written |= {f"python/{file_name(module)}": python_page(package, module) for module in MODULES}
    return {path: "\n".join(parts).rstrip("\n") + "\n" for path, parts in written.items()}


def write() -> None:
    """Write every page that has changed, and remove pages of modules that are gone."""
    folder, now = DOCS / "reference", pages()
    for path, text in now.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text, encoding="utf-8")
    for file in [*folder.glob("terms/*.md"), *folder.glob("python/*.md")]:
        if file.relative_to(folder).as_posix() not in now:
            file.unlink()
    names = [f"{module}.{name}\n" for module in MODULES for name in public_names(module)]
    PUBLIC.write_text("".join(names), encoding="utf-8")
    WORDS.write_text("".join(f"{word}\n" for word in public_words()), encoding="utf-8")


# Task schema and agents


def _task_schema() -> Iterator[str]:
    from rlcli.config.schema import TaskConfig

    yield "# Task schema\n"
    yield "After reading this page you can look up every key of a `task.yaml`: its type, default, unit and range."
    yield "`rlcli show TASK --schema` prints the same as a JSON Schema for editors.\n"
    yield "- A number may be written as a fraction: `dt: 1/120`."
    yield "- Sections of terms (`rewards`, `events`, ...) are mappings. You choose the names; each entry has a `func`"
    yield "  and the [keys of that term](terms/index.md)."
    yield "- Units are SI: m, s, kg, N, rad. Quaternions are (w, x, y, z).\n"
    yield from _models("Task", TaskConfig.model_json_schema())


def _agents() -> Iterator[str]:
    yield "# Agent settings\n"
    yield "After reading this page you can set every parameter of a trainer: in the task file under `agents.NAME`, or"
    yield "on the command line as `agent.KEY=VALUE`. Nested keys have dots:\n"
    yield "<!-- not run: examples of overrides; the tests of the command line train with such -->\n```sh"
    yield "rlcli train cartpole agent.learning_rate=1e-3"
    yield 'rlcli train cartpole "agent.policy.hidden=[128, 128]" --agent sb3-ppo'
    yield 'rlcli train cartpole --agent ppo "agent.actor.hidden=[128, 128]" "agent.critic.hidden=[128, 128]"\n```\n'
    yield "A heading names a trainer and an algorithm: *sb3, ppo* has the settings of `trainer: sb3` with"
    yield "`algorithm: ppo`. Headings such as *sb3, ppo: NetworkConfig* list the keys inside of a key of that type."
    yield "[The ppo trainer](ppo.md) explains the settings of `ppo`.\n"
    for title, schema in agent_schemas().items():
        yield from _models(title, schema, prefix=f"{title}: ")


def _models(title: str, schema: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """Yield the table of a model and those of the models inside it."""
    inner = {name: model for name, model in sorted(schema.get("$defs", {}).items()) if "properties" in model}
    links = {name: f"#{slug(prefix + name)}" for name in inner}
    yield from _model(f"## {title}", schema, links)
    for name, model in inner.items():
        yield from _model(f"## {prefix}{name}", _with_note(name, model, schema), links)


def _with_note(name: str, model: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """Return the model; its description says so if a key of this type has a default with other values."""
    note = ""
    for key, field in schema["properties"].items():
        default = field.get("default")
        if type_text(field).removesuffix(" or null") != name or not isinstance(default, dict):
            continue
        other = {k: v for k, v in default.items() if v != model["properties"].get(k, {}).get("default", v)}
        if other:
            note += (
                f" The defaults in this table are those of keys that are missing in a mapping `{key}: {{...}}`. Without"
                f" such a mapping, and with overrides such as `agent.{key}.{next(iter(other))}=...`, the defaults are"
                f" `{yaml_text(default)}`."
            )
    return model | {"description": model.get("description", "") + note}


def _linked(type_name: str, links: dict[str, str]) -> str:
    """Return the text of a type as the cell of a table; models are links to their sections."""
    return re.sub(
        r"\w+", lambda word: f"[{word[0]}]({links[word[0]]})" if word[0] in links else word[0], cell(type_name)
    )


def _schema_links() -> dict[str, str]:
    """Return the models of the task schema with their sections, for pages in `terms/`."""
    from rlcli.config.schema import TaskConfig

    models = TaskConfig.model_json_schema()["$defs"]
    return {name: f"../task-schema.md#{slug(name)}" for name, model in models.items() if "properties" in model}


def _model(heading: str, model: dict[str, Any], links: dict[str, str]) -> Iterator[str]:
    yield f"{heading}\n"
    if model.get("description"):
        yield one_line(model["description"]) + "\n"
    if not model.get("properties"):
        return
    yield "| key | type | default | meaning |\n| --- | --- | --- | --- |"
    for key, field in model["properties"].items():
        default = "required" if key in model.get("required", ()) else f"`{cell(yaml_text(field.get('default')))}`"
        meaning = cell(one_line(field.get("description", "")))
        yield f"| `{key}` | {_linked(type_text(field), links)} | {default} | {meaning} |"
    further = model.get("additionalProperties")
    if isinstance(further, dict):
        yield f"| any other key | {_linked(type_text(further), links)} | | A term; the key is its name. |"
    yield ""


# Terms


def _terms() -> Iterator[tuple[str, TermEntry]]:
    """Yield every built-in term with its section; randomisation terms are a section of their own here."""
    for entry in term_entries():
        yield ("randomization" if ".randomization" in entry.signature.module else entry.section), entry


def _terms_index() -> Iterator[str]:
    from rlcli.config.term_signatures import SECTIONS as MODELS

    yield "# Terms\n"
    yield "After reading this page you can find every term that a task file may name in `func`, and what it computes."
    yield "`rlcli terms PATTERN` prints the same in the terminal; `rlcli terms --task TASK` adds a task's own terms.\n"
    yield "A description ends with the shape of the term's value, such as `(num_envs, 3)`: one row per environment. The"
    yield "*root* is the topmost body of an entity. *Soft limits* are its joint limits, narrowed by"
    yield "[`soft_joint_pos_limit_factor`](../task-schema.md#entityconfig). A joint's `velocity_limit` is a key of"
    yield "`joints` or `actuators` of the entity. The *origin* of an environment is its start position on the terrain;"
    yield "without a terrain it is 0. In a unit such as [rad/s or m/s], rad and N m are for hinge joints, m and N for"
    yield "slide joints.\n"
    yield "```{toctree}\n:hidden:\n\n" + "\n".join(SECTIONS) + "\n```\n"
    yield "| section | terms | contents |\n| --- | ---: | --- |"
    counts: dict[str, int] = {}
    for section, _ in _terms():
        counts[section] = counts.get(section, 0) + 1
    for section, contents in SECTIONS.items():
        yield f"| [{section}]({section}.md) | {counts[section]} | {contents} |"
    yield "\n## Keys of every term of a section\n"
    for section, model in MODELS.items():
        keys = {**model.model_json_schema(), "description": ""}
        yield from _model(f"### {section.capitalize()}", keys, _schema_links())
    yield "## All terms\n"
    for section in SECTIONS:
        names = sorted(entry.name for where, entry in _terms() if where == section)
        yield f"- {section}: " + ", ".join(f"[{name}]({section}.md#{name})" for name in names)


def _terms_page(section: str) -> Iterator[str]:
    yield f"# {section.capitalize()}\n"
    yield f"{SECTIONS[section]} [Terms](index.md) explains *root*, *soft limits*, *velocity_limit* and *origin*.\n"
    if section in ("observations", "actions"):
        own = "`func` and `delay`"
        if section == "observations":
            own = "`func`, `modifiers`, `noise`, `bias`, `clip`, `scale`, `delay` and `history`"
        yield f"Every term also has the keys {own}."
        yield f"[Terms](index.md#{section}) explains them; [DelayConfig](../task-schema.md#delayconfig) is a delay.\n"
    if section in ("events", "randomization"):
        yield "`mode` sets when the change is made: `startup` once, at the start; `reset` when an episode starts;"
        yield "`interval` repeatedly, and then `interval_range_s` is required: the lowest and highest time between two"
        yield "changes [s]. [EventConfig](../task-schema.md#eventconfig) lists the keys of every event;"
        yield "[Events and randomisation](../../tutorials/first-task.md#events-and-randomisation) has examples.\n"
    for entry in sorted((entry for where, entry in _terms() if where == section), key=lambda entry: entry.name):
        yield from _term(entry)


def _term(entry: TermEntry) -> Iterator[str]:
    yield f"## {entry.name}\n"
    term = griffe.Docstring(_docstring(entry), parser="google")
    yield from docstring_parts(term)
    if entry.keys:
        yield "| key | type | default | meaning |\n| --- | --- | --- | --- |"
    for key in entry.keys:
        default = "required" if key.required else f"`{cell(yaml_text(key.default))}`"
        yield f"| `{key.name}` | {cell(key.type)} | {default} | {cell(key.description)} |"
    yield f"\n```yaml\n{entry.example}\n```\n"


def _docstring(entry: TermEntry) -> str:
    module = importlib.import_module(entry.signature.module)
    return inspect.getdoc(getattr(module, entry.signature.attribute)) or ""


# Commands


def _commands() -> Iterator[str]:
    yield "# Commands\n"
    yield "After reading this page you can look up every command and option of the command line."
    yield "Results are printed to stdout and messages to stderr. `--json` prints one JSON document. `KEY=VALUE`"
    yield "arguments are overrides of the [task file](task-schema.md) or, as `agent.KEY=VALUE`, of the"
    yield "[agent](agents.md). [Exit codes](exit-codes.md) are the same for all commands.\n"
    for path, command in commands():
        yield f"## {path}\n"
        yield _help_text(command) + "\n"
        yield "| option | default | meaning |\n| --- | --- | --- |"
        for parameter in command.params:
            if getattr(parameter, "hidden", False) or parameter.name == "help":
                continue
            yield f"| {cell(_spellings(parameter))} | {cell(_default_text(parameter))} | {cell(_help(parameter))} |"
        yield ""


def _help_text(command: Any) -> str:
    """Return the help of a command; its examples as a block of commands."""
    text = inspect.cleandoc(command.help or "")
    if not command.epilog:
        return text
    lines: list[str] = []
    for line in command.epilog.strip().splitlines():
        if line.startswith(" "):
            lines.insert(-1, f"# {line.strip()}")  # the explanation of the command above
        else:
            lines.append(line)
    return f"{text}\n\n<!-- not run: names of runs and files are examples; a test parses each command -->\n```sh\n" + (
        "\n".join(lines) + "\n```"
    )


def _spellings(parameter: Any) -> str:
    """Return the spellings of an option with its metavar, or the name of an argument."""
    metavar = parameter.metavar or _METAVARS.get(parameter.type_descriptor.annotation, "TEXT")
    if parameter.param_type_name == "argument":
        return f"`{parameter.metavar or parameter.name.upper()}`"
    value = "" if parameter.is_flag else f" {metavar}"
    return ", ".join(f"`{option}{value}`" for option in (*parameter.opts, *parameter.secondary_opts))


_METAVARS: dict[Any, str] = {int: "INTEGER", float: "FLOAT", Path: "PATH"}
_DEFAULT = re.compile(r"\s*\[default: (.+)\]$")


def _default_text(parameter: Any) -> str:
    """Return the default of a parameter, empty where there is none."""
    if parameter.required:
        return "required"
    named = _DEFAULT.search(parameter.help or "")
    if named:
        return named[1]
    value = parameter.default
    return f"`{value}`" if isinstance(value, (str, int, float)) and not isinstance(value, bool) and value != "" else ""


def _help(parameter: Any) -> str:
    return _DEFAULT.sub("", one_line(parameter.help or ""))


if __name__ == "__main__":
    write()
