"""Text of messages: one line, no control characters, little of each input."""

import pytest

from rlcli.config import strict_yaml
from rlcli.config.strict_yaml import load
from rlcli.runs.safe_io import parse_json
from rlcli.safe_text import message_line, remember_given, remember_input

WORDS = "an input with spaces and 'quotes', a.dot and more " * 20


@pytest.fixture(autouse=True)
def _forget():
    yield
    remember_given([])


def test_part_of_an_input_is_cut_whatever_stands_around_it():
    remember_given([f"scene.{WORDS}=1", "short"])
    for part in (WORDS, WORDS[30:400], WORDS[7:208]):
        line = message_line(f"error: agent.{part}: unknown; short [{part}]")
        assert line.count("...") == 2
        assert len(line) < 2 * 200 + 50
        assert line.startswith(f"error: agent.{part[:90]}")
        assert "unknown; short [" in line
    assert message_line(WORDS[7:207]) == WORDS[7:207]


def test_other_long_text_of_a_message_remains():
    remember_given([WORDS])
    text = "one of " + ", ".join(f"name_{number}" for number in range(60))
    assert message_line(text) == text


@pytest.mark.parametrize("text", ["\x1b[" * 60, "it's " * 60, "\n " * 120, "\"'" * 120])
def test_escaped_input_is_cut(text):
    remember_input([text])
    for form in (text, repr(text), text.replace("'", r"\'")):
        assert len(message_line(f"no such thing: {form}!")) <= len("no such thing: !") + 203


def test_texts_of_files_are_inputs(tmp_path):
    for read in (
        lambda text: load(f'a: {{"{text}": 1}}'),
        lambda text: load(f'a: ["{text}"]'),
        lambda text: parse_json(f'{{"{text}": [1]}}', tmp_path),
        lambda text: parse_json(f'{{"a": ["{text}"]}}', tmp_path),
    ):
        remember_given([])
        strict_yaml._parse_cached.cache_clear()
        text = "other words of a file " * 15
        assert message_line(text) == text
        read(text)
        assert len(message_line(f"of {text}.")) < 210
