"""Shipped policies and bundles: which policy a command uses, its messages, and every command that accepts one."""

import json
import re
import shutil
from pathlib import Path

import pytest

from rlcli.registry import find_task

pytestmark = pytest.mark.usefixtures("empty_folder")

SMALL = ("scene.num_envs=8", "sim.engine_threads=1", "agent.torch_threads=1", "--logger", "none", "-q")
SHIPPED = "the policy shipped with rlcli 0.1.0"
NUMBERS = ("--viewer", "none", "--num-envs", 2)


@pytest.fixture
def folder():
    return find_task("cartpole").policy


@pytest.fixture
def copied(folder, tmp_path):
    """Copy of a shipped bundle as an untrusted folder."""
    return shutil.copytree(folder, tmp_path / "gift")


def test_play_without_runs_uses_the_shipped_policy(cli, folder):
    done = cli("play", "cartpole", *NUMBERS)
    assert done.code == 0
    assert f"checkpoint {folder} ({SHIPPED})" in done.err
    assert re.search(r"^success rate +1\.0000", done.out, re.MULTILINE)


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
def test_shipped_policy_succeeds(cli, task):
    message = cli("eval", task, "--episodes", 32, "--num-envs", 32, "--json", "--fail-under", "success=0.95").json
    assert message["passed"]
    assert (message["checkpoint"], message["chosen"]) == (str(find_task(task).policy), SHIPPED)
    played = cli("play", task, *NUMBERS, "--json").json
    assert (played["checkpoint"], played["chosen"], played["policy"]) == (message["checkpoint"], SHIPPED, "trained")
    assert not Path("runs").exists(), "an evaluation of what is shipped is kept nowhere"


def test_run_precedes_the_shipped_policy(cli, folder, only_run):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    own = cli("eval", "cartpole", "--episodes", 2, "--num-envs", 2, "--json").json
    assert own["checkpoint"].startswith(str(only_run()))
    assert own["chosen"] == "newest run of cartpole, its newest checkpoint"
    other = cli("eval", "cartpole", "--checkpoint", "shipped", "--episodes", 2, "--num-envs", 2, "--json").json
    assert (other["checkpoint"], other["chosen"]) == (str(folder), SHIPPED)
    both = cli("eval", "--compare", "shipped", "latest", "--episodes", 4, "--json", "sim.engine_threads=1")
    assert both.code == 0, both.err
    assert both.json["policies"][0]["checkpoint"] == str(folder)
    assert both.json["policies"][0]["return"]["mean"] > both.json["policies"][1]["return"]["mean"]


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("play", "coin"), 5, "there is no run of coin"),
        (("eval", "coin", "--checkpoint", "shipped"), 5, "coin ships no policy"),
        (("eval", "cartpole", "--checkpoint", "latest"), 5, "there is no run of cartpole"),
        (("eval", "--checkpoint", "shipped"), 2, "needs a task"),
        (("export", "--checkpoint", "shipped"), 2, "needs a task"),
        (("play", "cartpole-direct", "--checkpoint", "GIFT"), 2, "is a policy for cartpole, not for cartpole-direct"),
        (("play", "cartpole", "decimation=4"), 5, "step_dt  0.0166666667 s     0.0333333333 s"),
        (("export", "cartpole", "--format", "torch"), 2, "--output FILE"),
        (("autopsy", "GIFT", "3"), 2, "a bundle holds a policy, not the recorded episodes of its training"),
    ],
)
def test_invalid_policy_reference_is_refused(cli, coin, copied, words, code, message):
    words = [str(copied) if word == "GIFT" else "./coin" if word == "coin" else word for word in words]
    done = cli(*words, *(NUMBERS if words[0] == "play" else ()))
    assert (done.code, message in done.err) == (code, True), done.err


def test_bundle_is_accepted_as_a_checkpoint(cli, copied):
    assert cli("play", "--checkpoint", copied, *NUMBERS, "--json").json["chosen"] == "as named"
    assert cli("eval", "--checkpoint", copied, "--episodes", 2, "--json").json["success"]["rate"] == 1.0
    out = ("--format", "numpy", "--output", "policy.py")
    assert cli("export", "--checkpoint", copied, *out, "--json").json["metadata"]["agent"] == "sb3-ppo"
    said = cli("stress", "--checkpoint", copied, "--sweep", "body_mass=1:2:2", "--episodes", 4, "--json").json
    assert said["checkpoint"] == str(copied)
    assert said["nominal"]["success"]["rate"] == 1.0
    assert (
        "no episode was recorded: a bundle holds a policy, not the recorded episodes of its training"
        in cli("autopsy", copied).err
    )


@pytest.mark.parametrize("reference", ["shipped", "GIFT"])
def test_training_starts_from_the_weights_of_a_bundle(cli, copied, only_run, reference):
    reference = str(copied) if reference == "GIFT" else reference
    done = cli("train", "cartpole", *SMALL, "--init-from", reference, "--max-iterations", 1)
    assert done.code == 0, done.err
    record = json.loads((only_run() / "run.json").read_text())
    given = (only_run() / "checkpoints" / "000000000000" / "policy.safetensors").read_bytes()
    assert given == (copied / "policy.safetensors").read_bytes()
    assert record["init_from"].endswith("gift" if reference != "shipped" else "cartpole")


def test_exported_bundle_has_the_evaluation_of_the_run(cli, only_run):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    without = cli("export", "cartpole", "--format", "bundle", "--output", "one", "--json")
    assert without.json["metadata"]["evaluation"] is None
    assert "the bundle contains no evaluation" in without.err
    cli("eval", "cartpole", "--episodes", 4, "--num-envs", 4)
    made = cli("export", "cartpole", "--format", "bundle", "--json").json
    assert Path(made["file"]) == only_run() / "exports" / "policy"
    assert made["metadata"]["evaluation"]["episodes"] == 4
    assert made["bytes"] == sum(file.stat().st_size for file in Path(made["file"]).iterdir())
    args = ("--episodes", 4, "--num-envs", 4, "--json")
    run, bundle = (cli("eval", "--checkpoint", name, *args).json for name in (only_run(), made["file"]))
    assert bundle["return"] == run["return"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--format", "bundle", "--output", "policy.onnx"), "--format onnx"),
        (("--format", "bundle", "--verify", "--output", "x"), "without rlcli"),
        (("--format", "bundel", "--output", "x"), "did you mean 'bundle'?"),
        (("--format", "bundle", "--output", "gift/policy.json"), "is not a folder"),
    ],
)
def test_bundle_that_cannot_be_written_is_refused(cli, copied, words, message):
    done = cli("export", "--checkpoint", copied, *words)
    assert (done.code, message in done.err) == (2, True), done.err


def test_bundle_of_a_task_folder_needs_the_folder(cli, coin):
    cli("train", coin, "--max-iterations", 1, "--logger", "none", "-q")
    cli("export", coin, "--format", "bundle", "--output", "gift")
    done = cli("play", "--checkpoint", "gift", *NUMBERS)
    assert (done.code, "name the folder of the task" in done.err) == (5, True), done.err
    assert cli("play", coin, "--checkpoint", "gift", *NUMBERS).code == 0


def test_damaged_run_is_reported_instead_of_the_shipped_policy(cli, only_run):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    (only_run() / "run.json").write_text("{")
    done = cli("play", "cartpole", *NUMBERS)
    assert (done.code, "there is no valid run of cartpole" in done.err) == (5, True), done.err
