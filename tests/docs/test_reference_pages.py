"""Generated reference pages: up to date, complete, with examples that are valid."""

import json

import pytest
import yaml
from support.fenced import REPOSITORY

from rlcli.config.schema import TaskConfig
from rlcli.config.term_docs import term_entries
from rlcli.config.term_signatures import SECTIONS, params_model

DOCS = REPOSITORY / "docs"


def test_committed_pages_equal_what_the_code_generates(reference):
    folder, now = DOCS / "reference", reference.pages()
    stale = [path for path, text in now.items() if not (folder / path).is_file() or (folder / path).read_text() != text]
    assert stale == [], "python docs/reference.py writes them"
    written = {
        file.relative_to(folder).as_posix() for name in ("terms", "python") for file in folder.glob(f"{name}/*.md")
    }
    assert written <= set(now), "pages of modules that are gone"


def test_every_built_in_trainer_is_in_the_guide(reference):
    text = (DOCS / "guides" / "choose-a-trainer.md").read_text(encoding="utf-8")
    assert [name for name in reference.TRAINERS if f"| `{name}` |" not in text] == []


def test_every_key_of_every_term_has_a_meaning():
    silent = [f"{entry.name}.{key.name}" for entry in term_entries() for key in entry.keys if not key.description]
    assert silent == [], "add them to rlcli/mdp/term_keys.yaml"


def test_every_meaning_is_of_a_key_that_exists():
    from rlcli.config.term_docs import _key_texts

    entries = term_entries()
    known = {key.name for entry in entries for key in entry.keys}
    known |= {f"{entry.name}.{key.name}" for entry in entries for key in entry.keys}
    for part in ("keys", "examples"):
        assert set(_key_texts()[part]) <= known
    assert set(_key_texts()["term_examples"]) <= {entry.name for entry in entries}
    assert set(_key_texts()["penalties"]) <= {entry.name for entry in entries if entry.section == "rewards"}


def test_examples_of_penalties_have_a_negative_weight():
    examples = {entry.name: entry.example for entry in term_entries() if entry.section == "rewards"}
    for name, example in examples.items():
        if name.endswith(("_penalty", "_l1", "_l2", "_cost")) and name != "track_orientation_inv_l2":
            assert "weight: -1.0" in example, name
    assert "weight: -1.0" in examples["desired_contacts"]
    assert "weight: 1.0" in examples["track_orientation_inv_l2"]
    assert "weight: 1.0" in examples["upright"]


@pytest.mark.parametrize("section", SECTIONS)
def test_example_of_every_term_is_valid(section):
    for entry in term_entries():
        if entry.section == section:
            (values,) = yaml.safe_load(entry.example)[section].values()
            params_model(entry.signature, section).model_validate_json(json.dumps(values))
            assert "VALUE" not in entry.example


def test_every_key_of_the_schemas_has_a_description(reference):
    for title, schema in {"Task": TaskConfig.model_json_schema(), **reference.agent_schemas()}.items():
        for name, model in {title: schema, **schema.get("$defs", {})}.items():
            for key, field in model.get("properties", {}).items():
                assert field.get("description") or "const" in field, f"{name}: {key}"


def test_every_option_of_every_command_has_help(reference):
    for path, command in reference.commands():
        for parameter in command.params:
            if not getattr(parameter, "hidden", False) and parameter.name != "help":
                assert (getattr(parameter, "help", None) or "").strip(), f"{path}: {parameter.name}"
