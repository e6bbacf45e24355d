"""Bundles: their content, where they may be written, and equality with the checkpoint's policy."""

import json
import os
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from support.saved_states import state_of

from rlcli.errors import CheckpointError, UsageError
from rlcli.runs.checkpoint_reader import open_checkpoint
from rlcli.runs.policy_bundle import is_bundle, open_bundle, write_bundle
from rlcli.runs.run import Run
from rlcli.training.checkpoint_writer import write_checkpoint

TERM = {"unit": "m", "scale": None, "clip": None}
LAYOUT = {
    "observations": {"policy": [{"name": "x", "size": 3, "elements": [], "history": 1, "modifiers": [], **TERM}]},
    "actions": [{"name": "a", "size": 2, "elements": [], "offset": None, "limits": None, **TERM}],
    "step_dt": 0.02,
    "dt": 0.01,
    "decimation": 2,
}
MANIFEST = {
    "iteration": 3,
    "task": {"name": "arm", "distribution": None, "version": None, "folder": "/home/somebody/arm", "file": "task.yaml"},
    "agent": "ppo",
    "trainer": "sb3",
    "seed": 7,
    "layout": LAYOUT,
    "versions": {"rlcli": "0.1.0"},
}
EVALUATION = {
    "command": "eval",
    "checkpoint": "/home/somebody/runs/arm/1/checkpoints/000000000064",
    "episodes": 100,
    "seed": 42,
    "success": {"rate": 0.9, "low": 0.8, "high": 0.95},
    "values": {"speed": {"mean": 1.0, "std": 0.1, "low": 0.9, "high": 1.1}},
}


@pytest.fixture
def saved(tmp_path):
    folder = tmp_path / "runs" / "arm" / "1" / "checkpoints"
    folder.mkdir(parents=True)
    write_checkpoint(folder, 64, state_of(), MANIFEST)
    return open_checkpoint(folder / "000000000064")


@pytest.fixture
def run(saved):
    record = {"device": "cuda:0", "torch": {"gpu": "NVIDIA H200"}, "cpu": {"model": "AMD EPYC"}, "trained_s": 12.34}
    return Run(saved.folder.parents[1], record)


def test_bundle_has_only_the_policy_of_the_checkpoint(saved, run, tmp_path):
    bundle = write_bundle(saved, tmp_path / "out" / "policy", run, EVALUATION)
    assert sorted(os.listdir(bundle.folder)) == ["manifest.json", "policy.json", "policy.safetensors"]
    obs = torch.randn(5, 3)
    assert torch.equal(open_checkpoint(bundle.folder).policy()(obs), saved.policy()(obs))
    with pytest.raises(CheckpointError, match="has no trainer"):
        open_checkpoint(bundle.folder).state()


def test_bundle_manifest_records_task_and_training(saved, run, tmp_path):
    manifest = write_bundle(saved, tmp_path / "policy", run, EVALUATION).manifest
    assert (manifest["step"], manifest["iteration"], manifest["agent"], manifest["seed"]) == (64, 3, "ppo", 7)
    assert manifest["origin"]["gpu"] == "NVIDIA H200"
    assert (manifest["origin"]["device"], manifest["origin"]["trained_s"]) == ("cuda", 12.3)
    assert manifest["evaluation"]["success"]["rate"] == 0.9
    assert manifest["evaluation"]["values"]["speed"]["mean"] == 1.0
    assert manifest["layout"] == LAYOUT


def test_bundle_has_no_local_paths_and_is_deterministic(saved, run, tmp_path):
    one, two = (write_bundle(saved, tmp_path / name / "policy", run, EVALUATION).folder for name in ("a", "b"))
    for file in one.iterdir():
        data = file.read_bytes()
        assert data == (two / file.name).read_bytes()
        assert b"somebody" not in data
        assert str(tmp_path).encode() not in data
    with safe_open(one / "policy.safetensors", "pt") as tensors:
        assert not tensors.metadata()


def test_bundle_of_a_bundle_keeps_its_training_record(saved, run, tmp_path):
    first = write_bundle(saved, tmp_path / "first", run, EVALUATION)
    second = write_bundle(open_checkpoint(first.folder), tmp_path / "second", None, None)
    assert second.manifest == first.manifest


def test_write_bundle_replaces_an_older_bundle(saved, tmp_path):
    target = tmp_path / "policies" / "arm"
    write_bundle(saved, target, None, None)
    folder = saved.folder.parent
    write_checkpoint(folder, 128, state_of(seed=1), MANIFEST)
    newer = open_checkpoint(folder / "000000000128")
    assert write_bundle(newer, target, None, None).manifest["step"] == 128
    assert os.listdir(target.parent) == ["arm"]


@pytest.mark.parametrize("kind", ["folder", "file", "link"])
def test_write_bundle_does_not_replace_other_files(saved, tmp_path, kind):
    target = tmp_path / "precious"
    if kind == "file":
        target.write_text("mine")
    else:
        place = target if kind == "folder" else tmp_path / "elsewhere"
        place.mkdir()
        (place / "thesis.txt").write_text("mine")
        if kind == "link":
            target.symlink_to(place)
    why = {"folder": "is not a bundle", "file": "is not a folder", "link": "is a link"}[kind]
    with pytest.raises(UsageError, match=f"precious .*{why}"):
        write_bundle(saved, target, None, None)
    kept = target if kind == "file" else target / "thesis.txt"
    assert kept.read_text() == "mine"


def test_write_bundle_refuses_a_checkpoint_with_another_layout(saved, tmp_path):
    file = saved.folder / "manifest.json"
    document = json.loads(file.read_text())
    document["layout"]["observations"]["policy"][0]["size"] = 4
    file.write_text(json.dumps(document))
    with pytest.raises(CheckpointError, match="4 columns of observations, expected 3"):
        write_bundle(open_checkpoint(saved.folder), tmp_path / "policy", None, None)
    assert not (tmp_path / "policy").exists()


def test_open_bundle_refuses_another_version(saved, tmp_path):
    folder = write_bundle(saved, tmp_path / "policy", None, None).folder
    document = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps({**document, "bundle": 2}))
    with pytest.raises(CheckpointError, match="bundle version 2; this rlcli reads 1"):
        open_bundle(folder)


def test_is_bundle_is_false_for_a_checkpoint_of_a_run(saved):
    assert not is_bundle(saved.folder)
    assert not is_bundle(saved.folder / "nowhere")
    assert not is_bundle(Path("x" * 5000))
