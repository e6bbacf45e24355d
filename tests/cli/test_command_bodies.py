"""The form of the command modules: short bodies, and no command that imports another."""

import ast
from pathlib import Path

import pytest

from rlcli.cli import commands

MODULES = sorted(Path(commands.__file__).parent.glob("*.py"))
MAX_LINES = 30


def body_lines(function):
    """Lines from the first statement after the docstring to the end."""
    body = function.body[1:] if ast.get_docstring(function) else function.body
    return body[-1].end_lineno - body[0].lineno + 1


def is_command(function):
    """Whether typer calls a function: `command`, or one with the decorator of a group."""
    decorators = map(ast.unparse, function.decorator_list)
    return function.name == "command" or any(text.startswith("app.command") for text in decorators)


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.stem)
def test_the_body_of_a_command_has_at_most_30_lines(module):
    functions = [node for node in ast.parse(module.read_text()).body if isinstance(node, ast.FunctionDef)]
    found = {function.name: body_lines(function) for function in functions if is_command(function)}
    assert found or module.stem == "__init__"
    assert max(found.values(), default=0) <= MAX_LINES, found


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.stem)
def test_no_command_module_imports_another(module):
    imports = [
        node for node in ast.walk(ast.parse(module.read_text())) if isinstance(node, ast.Import | ast.ImportFrom)
    ]
    assert not [text for text in map(ast.unparse, imports) if "rlcli.cli.commands" in text or "from ." in text]


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.stem)
def test_common_options_are_added_to_commands_and_not_declared(module):
    functions = [node for node in ast.parse(module.read_text()).body if isinstance(node, ast.FunctionDef)]
    for function in filter(is_command, functions):
        parameters = {argument.arg for argument in function.args.args}
        assert not parameters & {"json", "quiet", "verbose", "debug"}, function.name
