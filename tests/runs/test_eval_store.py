"""Evaluations stored in a run: round trip, and untrusted content."""

import json

import pytest

from rlcli.errors import CheckpointError
from rlcli.runs.eval_store import read_evaluation, write_evaluation
from rlcli.runs.run import Run

MEAN = {"mean": 1.5, "std": 0.5, "low": 1.0, "high": 2.0}
SHARE = {"rate": 0.5, "low": 0.2, "high": 0.8}
DOCUMENT = {
    "schema": 1,
    "command": "eval",
    "episodes": 4,
    "seed": 42,
    "return": MEAN,
    "length": MEAN,
    "success": SHARE,
    "reward_terms": {"alive": MEAN},
    "terminations": {"time_out": SHARE},
    "diverged": 0,
    "diverged_by": {},
}


def test_read_evaluation_returns_the_newest_document(tmp_path):
    run = Run(tmp_path)
    assert read_evaluation(run, "000000000128") is None
    file = write_evaluation(run, "000000000128", DOCUMENT)
    assert file == tmp_path / "evaluations" / "000000000128.json"
    assert read_evaluation(run, "000000000128") == DOCUMENT
    write_evaluation(run, "000000000128", {**DOCUMENT, "episodes": 9})
    assert read_evaluation(run, "000000000128")["episodes"] == 9
    assert [file.name for file in file.parent.iterdir()] == ["000000000128.json"]


@pytest.mark.parametrize(
    "change",
    [
        {"command": "train"},
        {"episodes": "4"},
        {"episodes": 0},
        {"return": 1.5},
        {"return": {"mean": 1.5}},
        {"length": {**MEAN, "low": "1"}},
        {"success": {**SHARE, "rate": 7.0}},
        {"reward_terms": {"alive": 1.0}},
        {"reward_terms": {"a" * 501: MEAN}},
        {"terminations": [SHARE]},
        {"diverged_by": {"BADQACC": []}},
        {"seed": -1},
    ],
)
def test_read_evaluation_refuses_a_malformed_document(tmp_path, change):
    run = Run(tmp_path)
    write_evaluation(run, "0", DOCUMENT | change)
    with pytest.raises(CheckpointError, match="is corrupt"):
        read_evaluation(run, "0")


@pytest.mark.parametrize("text", ["", "[]", "{", '{"return": NaN}', "[" * 10_000, '{"a": 1, "a": 2}', " " * 2_000_000])
def test_read_evaluation_refuses_invalid_or_large_json(tmp_path, text):
    (tmp_path / "evaluations").mkdir()
    (tmp_path / "evaluations" / "7.json").write_text(text)
    with pytest.raises(CheckpointError):
        read_evaluation(Run(tmp_path), "7")


@pytest.mark.parametrize("name", ["../x", "", "7.json", "a", "7/../8", "7" * 31])
def test_invalid_checkpoint_name_is_refused(tmp_path, name):
    for act in (lambda: read_evaluation(Run(tmp_path), name), lambda: write_evaluation(Run(tmp_path), name, DOCUMENT)):
        with pytest.raises(CheckpointError, match="not the name"):
            act()


def test_links_are_not_followed(tmp_path):
    run, elsewhere = Run(tmp_path / "run"), tmp_path / "elsewhere"
    run.folder.mkdir()
    elsewhere.mkdir()
    (elsewhere / "7.json").write_text(json.dumps(DOCUMENT))
    (run.folder / "evaluations").symlink_to(elsewhere)
    with pytest.raises(CheckpointError, match="link"):
        read_evaluation(run, "7")
    with pytest.raises(CheckpointError, match="link"):
        write_evaluation(run, "8", DOCUMENT)
    (run.folder / "evaluations").unlink()
    (run.folder / "evaluations").mkdir()
    (run.folder / "evaluations" / "7.json").symlink_to(elsewhere / "7.json")
    with pytest.raises(CheckpointError, match="link"):
        read_evaluation(run, "7")
    assert [file.name for file in elsewhere.iterdir()] == ["7.json"]
