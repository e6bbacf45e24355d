"""Texts of rlcli and its plugins name only keys, commands, options and pages that exist."""

import ast
import re

import pytest
from support.fenced import REPOSITORY as ROOT

from rlcli.config.messages import key_locations
from rlcli.config.schema import TaskConfig

FILES = sorted([*ROOT.glob("rlcli/**/*.py"), *ROOT.glob("plugins/rlcli-*/rlcli_*/**/*.py")])
NOT_KEYS = {"sim.physx", "sim.add_ground_plane", "agent.obs_groups", "agent.yaml"}
"""Keys of other frameworks and of trainers of plugins, and a file."""


def texts(file):
    """The string literals of a file: (line, text, whether it is a docstring)."""
    tree = ast.parse(file.read_text())
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value, id(node) in docstrings


@pytest.fixture(scope="module")
def commands(reference):
    """Command -> its options."""
    return {
        path: {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}
        for path, command in reference.commands()
    }


def test_keys_in_messages_exist(reference):
    keys = {location for locations in key_locations({"": TaskConfig}).values() for location in locations}
    keys |= {f"agent.{key}" for schema in reference.agent_schemas().values() for key in schema["properties"]}
    named = [
        (f"{file.relative_to(ROOT)}:{line}", key)
        for file in FILES
        for line, text, is_docstring in texts(file)
        if not is_docstring and "\n" not in text  # neither docstrings nor programs
        for key in re.findall(r"(?<![\w.\"'/-])(?:sim|scene|viewer|agent)\.[a-z_]*[a-z](?![\w(*])", text)
    ]
    assert len(named) > 50
    assert [found for found in named if found[1] not in keys | NOT_KEYS] == []


def test_commands_options_and_pages_in_texts_exist(commands):
    for file in FILES:
        for line, text, _ in texts(file):
            place = f"{file.relative_to(ROOT)}:{line}"
            for page in re.findall(r"\bdocs/[\w/-]+\.md", text):
                assert (ROOT / page).exists(), f"{place}: {page}"
            for words in re.findall(r"`(rlcli [a-z][^`\n]*)", text):
                path = re.match(r"rlcli [a-z-]+(?: [a-z0-9-]+)?", words)[0]
                known = [options for name, options in commands.items() if f"{path} ".startswith(f"{name} ")]
                assert known or any(name.startswith(path) for name in commands) or "NAME" in words, f"{place}: {words}"
                unknown = set(re.findall(r"(?<=\s)--[a-z][\w-]*", words)) - {"--help", "--version"}.union(*known)
                assert not unknown or not known, f"{place}: {words}"
