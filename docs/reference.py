"""The pages that are written from the code: configuration, terms, command line, Python."""

from __future__ import annotations

import importlib
import inspect
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PUBLIC = Path(__file__).parent / "public-names.txt"
"""What others may rely on, a name a line; tests/docs compares it with the code."""
WORDS = Path(__file__).parent / "public-words.txt"
"""Likewise what task files and command lines may say; tests/packaging compares it with the code."""
MODULES = (
    "rlcli.task",
    "rlcli.trainers",
    "rlcli.formats",
    "rlcli.errors",
    "rlcli.gym",
    "rlcli.random",
    "rlcli.registry",
    "rlcli.config.load",
    "rlcli.config.schema",
    "rlcli.reporting.task_card",
    "rlcli.envs.vec_env",
    "rlcli.envs.make",
    "rlcli.envs.build",
    "rlcli.envs.direct",
    "rlcli.envs.articulation",
    "rlcli.envs.step",
    "rlcli.envs.observers",
    "rlcli.sim.markers",
    "rlcli.sim.selection",
    "rlcli.sim.rotations",
    "rlcli.rl.trainer",
    "rlcli.rl.policy",
    "rlcli.rl.statistics",
    "rlcli.rl.optimizers",
    "rlcli.rl.rng",
    "rlcli.adapters.gymnasium",
    "rlcli.adapters.sb3",
    "rlcli.adapters.rsl_rl",
    "rlcli.testing",
)
"""Modules whose public names are the Python interface."""
TRAINERS = ("ppo", "sb3")
"""The trainers that come with rlcli, whose agents' settings are part of the configuration."""
TERMS = (
    "observations",
    "actions",
    "rewards",
    "terminations",
    "events",
    "commands",
    "curriculum",
    "success",
    "randomization",
)


def public_names(module_name: str) -> list[str]:
    """What a module defines, or says it offers, without an underscore."""
    module = importlib.import_module(module_name)
    offered = getattr(module, "__all__", None)
    if offered is not None:
        return sorted(offered)
    found = []
    for name, value in vars(module).items():
        own = _defined_in(value, module_name)
        if not name.startswith("_") and own and (inspect.isclass(value) or inspect.isfunction(value)):
            found.append(name)
    return sorted(found)


def _defined_in(value: Any, module_name: str) -> bool:
    """Whether a module, or a module of this package, defines the value."""
    place = str(getattr(value, "__module__", ""))
    return place == module_name or place.startswith(f"{module_name}.")


def public_words() -> list[str]:
    """Terms, configuration keys, commands and their options: renaming one breaks somebody's files or scripts."""
    import typer

    from rlcli.cli.app import build
    from rlcli.config.schema import TaskConfig
    from rlcli.rl.ppo.config import SPEC as PPO
    from rlcli.rl.sb3.config import SPEC as SB3

    words = [f"term {section}.{name}" for section in TERMS for name, _ in _terms_of(section)]
    models: dict[str, Any] = {"Task": TaskConfig}
    for trainer, spec in (("ppo", PPO), ("sb3", SB3)):
        for algorithm, place in spec.algorithms.items():
            module, _, name = place.partition(":")
            models[f"{trainer}.{algorithm}"] = getattr(importlib.import_module(module), name)
    for model, value in models.items():
        schema = value.model_json_schema()
        for name, fields in {model: schema, **schema.get("$defs", {})}.items():
            words += [f"key {name}.{key}" for key in fields.get("properties", {})]
    pending = [("rlcli", typer.main.get_command(build()))]
    while pending:
        path, command = pending.pop()
        inner = getattr(command, "commands", {})
        pending += [(f"{path} {name}", each) for name, each in inner.items()]
        if not inner:
            options = [option for parameter in command.params for option in parameter.opts if option[0] == "-"]
            words += [f"command {path}", *(f"option {path} {option}" for option in options)]
    return sorted(set(words))


def write(folder: Path) -> None:
    """All of the pages."""
    folder.mkdir(exist_ok=True)
    pages = {
        "index": _index,
        "configuration": _configuration,
        "terms": _terms,
        "command-line": _command_line,
        "python": _python,
    }
    for name, page in pages.items():
        text = "\n".join(page()) + "\n"
        file = folder / f"{name}.md"
        if not file.is_file() or file.read_text(encoding="utf-8") != text:
            file.write_text(text, encoding="utf-8")


def _index() -> Iterator[str]:
    yield "# Reference\n"
    yield "Written from the code of this version.\n"
    yield "```{toctree}\n:maxdepth: 1\n\nconfiguration\nterms\ncommand-line\npython\n```"


def _configuration() -> Iterator[str]:
    from rlcli.config.schema import TaskConfig
    from rlcli.trainers import TrainerSpec

    schema = TaskConfig.model_json_schema()
    yield "# Configuration\n"
    yield "Every key of a `task.yaml`, with its type, default, unit and range; for editors: `show TASK --schema`."
    yield "A number may be a fraction, `1/120`. Mappings of terms (`rewards:`, `events:`, ...) have names that you"
    yield "choose, and what `func` names has [further keys](terms.md).\n"
    yield from _models("Task", schema)
    yield "## Agents\n"
    yield "What stands in `agents.NAME`, by `trainer` and `algorithm`; `agent.KEY=VALUE` on the command line.\n"
    for trainer in TRAINERS:
        spec: TrainerSpec = importlib.import_module(f"rlcli.rl.{trainer}_config").SPEC
        for algorithm, place in spec.algorithms.items():
            module, _, name = place.partition(":")
            settings = getattr(importlib.import_module(module), name).model_json_schema()
            yield from _models(f"{trainer}, {algorithm}", settings, within=f"{trainer}, {algorithm}: ", level="###")


def _models(title: str, schema: dict[str, Any], within: str = "", level: str = "##") -> Iterator[str]:
    """A model, and those that it has inside."""
    yield from _model(f"{level} {title}", schema)
    for name, model in sorted(schema.get("$defs", {}).items()):
        if "properties" in model:
            yield from _model(f"{level} {within}{name}", model)


def _model(heading: str, model: dict[str, Any]) -> Iterator[str]:
    yield f"{heading}\n"
    if model.get("description"):
        yield _one_line(model["description"]) + "\n"
    if not model.get("properties"):
        return
    yield "| key | type | default | |\n| --- | --- | --- | --- |"
    for key, field in model["properties"].items():
        default = "required" if key in model.get("required", ()) else f"`{_cell(_default(field.get('default')))}`"
        yield f"| `{key}` | {_cell(_type(field))} | {default} | {_cell(_one_line(field.get('description', '')))} |"
    yield ""


_BOUNDS = (("minimum", ">="), ("exclusiveMinimum", ">"), ("maximum", "<="), ("exclusiveMaximum", "<"))


def _default(value: Any) -> str:
    """As a YAML has it."""
    return value if isinstance(value, str) and value else json.dumps(value)


def _type(field: dict[str, Any]) -> str:
    """The type with its range: `number > 0`, `[number >= 0, number] or null`."""
    if "$ref" in field:
        return field["$ref"].rsplit("/", 1)[-1]
    for several in ("anyOf", "oneOf", "allOf"):
        if several in field:
            written = [each for each in field[several] if not ("pattern" in each and len(field[several]) > 1)]
            return " or ".join(dict.fromkeys(_type(each) for each in written))
    if "enum" in field or "const" in field:
        return ", ".join(map(str, field.get("enum", [field.get("const")])))
    if field.get("type") == "array":
        items = field.get("prefixItems") or field.get("items")
        if isinstance(items, list):
            return "[" + ", ".join(_type(item) for item in items) + "]"
        return f"list of {_type(items)}" if isinstance(items, dict) else "list"
    if field.get("type") == "object":
        inner = field.get("additionalProperties")
        return f"mapping to {_type(inner)}" if isinstance(inner, dict) and inner else "mapping"
    bounds = [f"{sign} {field[word]}" for word, sign in _BOUNDS if word in field]
    return " ".join([str(field.get("type", "any")), " and ".join(bounds)]).strip()


def _terms() -> Iterator[str]:
    yield "# Terms\n"
    yield "What `func:` may name in each section of a task. A term's keyword parameters are its YAML keys.\n"
    for section in TERMS:
        yield f"## {section.capitalize()}\n"
        for name, value in _terms_of(section):
            yield from _term(name, value)


def _terms_of(section: str) -> Iterator[tuple[str, Any]]:
    """The terms of a section, by the names that `func:` knows them by."""
    from rlcli.config.term_signatures import snake_case

    module = importlib.import_module(f"rlcli.mdp.{section}")
    for name, value in vars(module).items():
        if name.startswith("_") or not _defined_in(value, module.__name__):
            continue
        if inspect.isclass(value) or inspect.isfunction(value):
            yield snake_case(name) if inspect.isclass(value) else name, value


def _term(name: str, value: Any) -> Iterator[str]:
    yield f"### {name}\n"
    parameters = [
        f"`{parameter.name}`" + ("" if parameter.default is parameter.empty else f" = `{parameter.default!r}`")
        for parameter in inspect.signature(value).parameters.values()
        if parameter.kind is parameter.KEYWORD_ONLY
    ]
    yield inspect.cleandoc(value.__doc__ or "").replace("\n\n", "\n\n") + "\n"
    if parameters:
        yield "Keys: " + ", ".join(parameters) + "\n"


def _command_line() -> Iterator[str]:
    import typer

    from rlcli.cli.app import build

    command = typer.main.get_command(build())
    yield "# Command line\n"
    yield "Data goes to stdout, messages to stderr; `--json` prints one document. `KEY=VALUE` are overrides of the"
    yield "[configuration](configuration.md). `--debug`, on every command, adds the traceback to an error.\n"
    yield "## Exit codes\n"
    yield "| code | kind | |\n| --- | --- | --- |\n| 0 | | It worked. |\n| 1 | bug | A mistake of rlcli's. |"
    for error in sorted(_errors(), key=lambda error: error.exit_code):
        yield f"| {error.exit_code} | {error.kind} | {_cell(_one_line(error.__doc__ or ''))} |"
    yield "| 75, 130 | stopped | It was asked to stop, by a signal or by Ctrl-C; a training can be resumed. |\n"
    yield "What one sees of each, and what to do: [when something goes wrong](../exit-codes.md).\n"
    yield from _commands(command, "rlcli")


def _errors() -> list[Any]:
    from rlcli import errors

    kinds = [e for e in vars(errors).values() if inspect.isclass(e) and issubclass(e, errors.RlcliError)]
    return [e for e in kinds if e.kind not in ("error", "stopped") and "kind" in vars(e)]


def _commands(command: Any, path: str) -> Iterator[str]:
    for name, inner in sorted(getattr(command, "commands", {}).items()):
        yield f"## {path} {name}\n"
        yield inspect.cleandoc(inner.help or "") + "\n"
        if hasattr(inner, "commands"):
            yield from _commands(inner, f"{path} {name}")
            continue
        yield "| | default | |\n| --- | --- | --- |"
        for parameter in inner.params:
            if getattr(parameter, "hidden", False) or parameter.name == "help":
                continue
            yield f"| {_cell(_names(parameter))} | {_cell(_given(parameter))} | {_cell(_help(parameter))} |"
        yield ""


def _names(parameter: Any) -> str:
    """The spellings of an option, and what it takes; of an argument, its name."""
    if not parameter.opts[0].startswith("-"):
        return f"`{(parameter.metavar or parameter.name).upper()}`"
    kind = getattr(parameter, "metavar", None) or _METAVARS.get(parameter.type_descriptor.annotation, "TEXT")
    takes = "" if parameter.is_flag else f" {kind}"
    return ", ".join(f"`{option}{takes}`" for option in (*parameter.opts, *parameter.secondary_opts))


_METAVARS: dict[Any, str] = {int: "N", float: "X", Path: "PATH"}


def _given(parameter: Any) -> str:
    """The default, where there is one that says something."""
    value = parameter.default
    if parameter.required:
        return "required"
    return f"`{value}`" if isinstance(value, (str, int, float)) and not isinstance(value, bool) and value != "" else ""


def _help(parameter: Any) -> str:
    return _one_line(getattr(parameter, "help", None) or "")


def _python() -> Iterator[str]:
    yield "# Python\n"
    yield "What plugins and scripts may rely on. Before 1.0 a minor version may change one: see the changelog.\n"
    for module_name in MODULES:
        yield f"## {module_name}\n"
        yield "```{eval-rst}"
        yield f".. automodule:: {module_name}\n   :no-index:\n"
        for name in public_names(module_name):
            value = getattr(importlib.import_module(module_name), name)
            kind = "autoclass" if inspect.isclass(value) else "autofunction" if callable(value) else "py:data"
            yield f".. {kind}:: {module_name}.{name}"
            yield "   :no-index:\n" if kind != "autoclass" else "   :members:\n   :no-index:\n"
        yield "```\n"


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    PUBLIC.write_text("".join(f"{m}.{n}\n" for m in MODULES for n in public_names(m)), encoding="utf-8")
    WORDS.write_text("".join(f"{word}\n" for word in public_words()), encoding="utf-8")
