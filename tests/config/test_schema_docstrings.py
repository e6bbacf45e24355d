"""Docstrings below fields become descriptions in the JSON Schema."""

from __future__ import annotations

import importlib
import sys

from pydantic import ConfigDict, Field

from rlcli.config.dump import json_schema
from rlcli.config.schema import StrictModel
from rlcli.config.term_signatures import Vocabulary


class Outer:
    class Settings(StrictModel):
        gain: float = 1.0
        """Of the motors [N m / rad].

        Its sign is kept.
        """
        bare: int = 0


class Further(Outer.Settings):
    gain: float = 2.0
    more: str = ""
    """Whatever else."""


def described(model):
    return {name: field.get("description") for name, field in model.model_json_schema()["properties"].items()}


def test_field_docstrings_become_descriptions():
    assert described(Outer.Settings) == {"gain": "Of the motors [N m / rad].\n\nIts sign is kept.", "bare": None}


def test_inherited_field_uses_first_docstring_in_mro():
    gain = "Of the motors [N m / rad].\n\nIts sign is kept."
    assert described(Further) == {"gain": gain, "bare": None, "more": "Whatever else."}


def test_class_in_function_is_described():
    class Inner(StrictModel):
        size: int = 1
        """In metres."""

    assert described(Inner) == {"size": "In metres."}


def test_alias_and_own_description_are_kept():
    class Own(StrictModel):
        model_config = ConfigDict(json_schema_extra={"title": "Mine"})

        size: int = Field(1, alias="Size")
        """In metres."""

    assert described(Own) == {"Size": "In metres."}
    assert Own.model_json_schema()["title"] == "Mine"


FOUND = """
from rlcli.config.schema import StrictModel
try:
    import nosuch
except ImportError:
    class Instead(StrictModel):
        size: int = 1
        'Of what is there.'
if True:
    class Twice(StrictModel):
        size: int = 1
        'One.'
else:
    class Twice(StrictModel):
        size: int = 1
        'The other.'
"""


def test_removed_module_is_still_described(tmp_path, monkeypatch):
    (tmp_path / "found_once.py").write_text(FOUND)
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("found_once")
    del sys.modules["found_once"]
    assert described(module.Instead) == {"size": "Of what is there."}
    assert described(module.Twice) == {"size": None}  # nothing rather than the wrong one


def test_class_without_source_has_no_descriptions():
    scope = {"StrictModel": StrictModel, "__name__": "typed"}
    exec('class Typed(StrictModel):\n    size: int = 1\n    """In metres."""\n', scope)
    assert described(scope["Typed"]) == {"size": None}


def test_every_task_section_has_description():
    assert all(section.get("description") for section in json_schema(Vocabulary())["properties"].values())
