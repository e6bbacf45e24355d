"""Form of the command modules: short bodies, and no command imports another."""

import ast
from pathlib import Path

import pytest

from rlcli.cli import commands
from rlcli.cli.commands import import_

MODULES = sorted(Path(commands.__file__).parent.glob("*.py"))
MAX_LINES = 30
SUBCOMMANDS = {
    command.callback.__wrapped__.__name__ for command in import_.app.registered_commands if not command.hidden
}


def body_lines(function):
    """Return the number of lines from the first statement after the docstring to the end."""
    body = function.body[1:] if ast.get_docstring(function) else function.body
    return body[-1].end_lineno - body[0].lineno + 1


def is_command(function):
    """Return whether a function is the body of a command: `command`, or one that a group adds with `add_command`."""
    return function.name == "command" or function.name in SUBCOMMANDS


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.stem)
def test_command_body_has_at_most_30_lines(module):
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
def test_commands_do_not_declare_common_options(module):
    functions = [node for node in ast.parse(module.read_text()).body if isinstance(node, ast.FunctionDef)]
    for function in filter(is_command, functions):
        parameters = {argument.arg for argument in function.args.args}
        assert not parameters & {"json", "quiet", "verbose", "debug"}, function.name
