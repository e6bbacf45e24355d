"""Untrusted bundles: refused with one message; no code is executed, no file is changed, memory is limited."""

import json
import pickle
import shutil

import pytest
import safetensors.torch
import torch
from support.bad_checkpoints import PLAYED, Case, forged, named
from support.checkpoint_damage import Bomb, setting
from support.fault_sizes import amount, chosen
from support.saved_states import rehash
from test_bad_checkpoints import command, run_reader, snapshot

from rlcli.cli.app import main
from rlcli.errors import CheckpointError
from rlcli.registry import find_task
from rlcli.runs.checkpoint_reader import open_checkpoint

HELD = ("manifest.json", "policy.json", "policy.safetensors")


@pytest.fixture
def bundle_folder(tmp_path, monkeypatch):
    """A valid bundle whose policy has a normaliser."""
    monkeypatch.chdir(tmp_path)
    folder = shutil.copytree(find_task("cartpole").policy, tmp_path / "a" / "b" / "gift")
    spec = json.loads((folder / "policy.json").read_text())
    (folder / "policy.json").write_text(json.dumps({**spec, "normalize": True}))
    weights = safetensors.torch.load((folder / "policy.safetensors").read_bytes())
    for name, value in (("mean", 0.0), ("var", 1.0)):
        weights[f"normalizer.{name}"] = torch.full((4,), value, dtype=torch.float64)
    weights["normalizer.count"] = torch.tensor(100.0, dtype=torch.float64)
    (folder / "policy.safetensors").write_bytes(safetensors.torch.save(weights))
    rehash(folder, "policy.json", "policy.safetensors")
    return folder


def test_undamaged_bundle_is_accepted(bundle_folder, capfd):
    for reader in ("play", "eval", "export"):
        assert main(command(reader, bundle_folder)) == 0
    capfd.readouterr()


def bundle_damages():
    """Return damages of the entries that only a bundle has."""
    for name, *change in (
        ("bundle 2", "bundle", 2), ("bundle true", "bundle", True), ("bundle text", "bundle", "1"),
        ("no task", "task", None), ("task text", "task", "cartpole"), ("task ..", "task", "name", ".."),
        ("task a/b", "task", "name", "a/b"), ("task list", "task", "name", ["cartpole"]),
        ("task escape", "task", "name", "a\x1b[2J"), ("distribution 3", "task", "distribution", 3),
        ("agent list", "agent", ["x"]), ("agent escape", "agent", "a\x1b[2J"), ("agent long", "agent", "a" * 10**6),
        ("layout text", "layout", "x"), ("layout list", "layout", []), ("no columns", "layout", {}),
        ("columns text", "layout", "observations", "x"),
        ("name list", "layout", "observations", "policy", 0, "name", [1] * 1000),
        ("name mapping", "layout", "observations", "policy", 0, "name", dict.fromkeys(map(str, range(1000)), 1)),
        ("names of numbers", "layout", "observations", "policy", 0, "elements", [[1] * 1000]),
        ("many names", "layout", "observations", "policy", 0, "elements", ["a"] * 1000),
        ("offset list", "layout", "actions", 0, "offset", [[1] * 1000]),
        ("control period list", "layout", "step_dt", [1] * 1000),
    ):  # fmt: skip
        *path, value = change

        def damage(folder, path=path, value=value):
            file = folder / "manifest.json"
            document = json.loads(file.read_text())
            setting(*path, to=value)(document)
            file.write_text(json.dumps(document))

        yield Case(name, damage, PLAYED)


def applies(case):
    """Return whether a damage can occur in a bundle: its folder is not named after a step."""
    return case.run == "ppo" and "play" in case.readers and case.name != "step 7"


CASES = [case for case in named() if applies(case)]


@pytest.mark.parametrize("case", [*chosen(CASES, 40), *bundle_damages()], ids=lambda case: case.name)
def test_damaged_bundle_is_refused_and_unchanged(case, bundle_folder, child, capfd):
    case.damage(bundle_folder)
    before = snapshot(bundle_folder)
    readers = {"play", "export"} & set(case.readers)
    if case.name in ("layout step_dt 5.0", "many names"):  # plausible: only the task knows that they are not its own
        readers = {"play"}
    for reader in sorted(readers):
        code, out, err = run_reader(case, command(reader, bundle_folder), child, capfd)
        assert code == 5, f"{case.name}, {reader}: exit {code}\n{err}"
        assert "Traceback" not in err
        assert "\x1b[2J" not in err
        errors = [line for line in err.splitlines() if line.startswith("error:") and not line.startswith("error:   ")]
        assert len(errors) == 1, err
        assert "gift" in errors[0]
        assert max(map(len, err.splitlines())) < 1000, "a message is no copy of the file"
        assert (out, snapshot(bundle_folder)) == ("", before)
        assert not (bundle_folder.parents[2] / "executed").exists()


@pytest.mark.parametrize("case", list(forged(amount(10, 200))), ids=lambda case: case.name)
def test_rehashed_bundle_is_refused_or_gives_a_valid_policy(case, bundle_folder):
    if not (bundle_folder / case.name.split()[1]).is_file():
        assert case.name.split()[1] not in HELD  # it is of a file that a bundle does not have
        return
    case.damage(bundle_folder)
    try:
        policy = open_checkpoint(bundle_folder).policy()
    except CheckpointError:
        return
    assert all(bool(value.isfinite().all()) for value in policy.state_dict().values())


def test_pickles_beside_the_policy_are_not_read(bundle_folder, capfd):
    for name in ("policy.pkl", "policy.pt", "trainer.safetensors"):
        (bundle_folder / name).write_bytes(pickle.dumps(Bomb()))
    assert main(command("play", bundle_folder)) == 0
    assert main(command("export", bundle_folder)) == 0
    capfd.readouterr()
    assert not (bundle_folder.parents[2] / "executed").exists()
