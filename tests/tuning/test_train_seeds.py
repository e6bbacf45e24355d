"""Studies of several seeds: each run equals a single training, and a stopped study resumes."""

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from support.run_comparison import content, newest, rows_of

from rlcli.errors import UsageError
from rlcli.runs.overview import overview, overviews
from rlcli.runs.run_ref import list_runs
from rlcli.runs.study import read_seeds

pytestmark = pytest.mark.usefixtures("empty_folder")

SMALL = ("scene.num_envs=32", "agent.torch_threads=1", "sim.engine_threads=1", "--logger", "none")


def study_folder():
    (file,) = Path("runs").glob("*/*/study.json")
    return file.parent


@pytest.mark.parametrize(
    ("text", "seeds"), [("0..4", [0, 1, 2, 3, 4]), ("7", [7]), ("1,5,9", [1, 5, 9]), ("0..1, 8..9", [0, 1, 8, 9])]
)
def test_read_seeds(text, seeds):
    assert read_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "0..", "4..1", "1,1", "0..3,2", "a", "-1", "0..99999", "1.5", "0...3"])
def test_malformed_seeds_are_usage_error(text):
    with pytest.raises(UsageError, match="--seeds"):
        read_seeds(text)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--seeds", "0..1", "--seed", "3"), "--seed cannot be combined with --seeds"),
        (("--seeds", "0..1", "--gpus", "1"), "--gpus cannot be combined with --seeds"),
        (("--jobs", "2"), "--jobs sets how many trainings run at once"),
        (("--seeds", "3..1"), "empty"),
        (("--seeds", "0..1", "agent.learning_rat=1"), "learning_rate"),
    ],
)
def test_invalid_arguments_create_nothing(cli, words, message):
    result = cli("train", "cartpole", *words)
    assert result.code in (2, 3)
    assert message in result.err
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [(("--seed", "3"), "s is a study with its own seeds"), (("--gpus", "1"), "s is a study with one process per seed")],
)
def test_study_is_not_resumed_with_options_of_one_training(cli, words, message):
    Path("s").mkdir()
    Path("s/study.json").write_text("{}")
    result = cli("train", "--resume", "s", *words)
    assert (result.code, message in result.err) == (2, True)


@pytest.mark.parametrize("name", ["seed-1", "seed-0/train.log", "seed-0/checkpoints"])
@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_study_with_a_link_or_pipe_is_not_resumed(cli, name, kind):
    study, victim = Path("runs/cartpole/s"), Path("victim")
    (study / name).parent.mkdir(parents=True)
    victim.mkdir()
    record = {"kind": "seeds", "task": "cartpole", "seeds": [0, 1], "runs": ["seed-0", "seed-1"], "device": "cpu"}
    (study / "study.json").write_text(json.dumps(record))
    (study / name).symlink_to(victim.resolve()) if kind == "link" else os.mkfifo(study / name)
    result = cli("train", "--resume", study)
    assert result.code == 5, result.err
    assert f"{name} is {'a link' if kind == 'link' else 'not a regular file'}" in result.err
    assert not list(victim.iterdir())


def test_seeds_are_not_trained_below_torchrun(cli, monkeypatch):
    monkeypatch.setenv("RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "2")
    result = cli("train", "cartpole", "--seeds", "0..1")
    assert (result.code, "start rlcli without torchrun" in result.err) == (2, True)


@pytest.mark.slow
def test_seed_of_study_equals_single_run(cli):
    several = cli("train", "cartpole", *SMALL, "--max-iterations", 4, "--seeds", "0..2", "--jobs", 2, "--json")
    assert several.code == 0, several.err
    study = study_folder()
    assert several.json["study"] == str(study)
    assert [row["seed"] for row in several.json["runs"]] == [0, 1, 2]
    assert [row["state"] for row in several.json["runs"]] == ["finished"] * 3
    for seed in (0, 1, 2):
        alone = cli("train", "cartpole", *SMALL, "--max-iterations", 4, "--seed", seed, "--runs-dir", "alone", "--json")
        left, right = study / f"seed-{seed}", Path(alone.json["run"])
        assert rows_of(left) == rows_of(right)
        assert content(newest(left)) == content(newest(right))
        assert (left / "config.yaml").read_text() == (right / "config.yaml").read_text()
    assert {run.folder.name for run in list_runs(Path("runs"), "cartpole")} == {"seed-0", "seed-1", "seed-2"}
    assert [run.state for run in overviews(Path("runs"))] == ["finished"] * 3
    assert several.json["together"]["return"]["low"] <= several.json["together"]["return"]["iqm"]
    header, *rows = (study / "curves.csv").read_text().splitlines()
    assert header.startswith("steps,return,return_low,return_high")
    assert rows[-1].startswith(f"{4 * 32 * 16},")
    assert (study / "curves.svg").stat().st_size > 1000
    named = cli("play", "--checkpoint", study, "--viewer", "none")
    assert named.code == 5
    assert "study of several runs" in named.err
    assert f"name one, such as {study}/seed-0 (seed-0, seed-1, seed-2); `rlcli plot {study}` draws" in named.err
    again = cli("train", "--resume", study, "--json")
    assert again.code == 0, "resuming a finished study does nothing"
    assert again.json["together"] == several.json["together"]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_study_resumes(start, cli, number):
    process = start("train", "cartpole", *SMALL, "--max-iterations", 60, "--seeds", "0..2", "--jobs", 2, "--json")
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        with_metrics = [file for file in Path("runs").glob("*/*/seed-*/metrics.jsonl") if file.stat().st_size]
        if len(with_metrics) >= 2:
            break
        time.sleep(0.05)
    process.send_signal(number)
    out, err = process.communicate(timeout=120)
    assert process.returncode == (130 if number == signal.SIGINT else 75), err
    assert "--resume" in json.loads(out)["error"]["hint"]
    study = study_folder()
    states = {name: overview(study / name).state for name in ("seed-0", "seed-1", "seed-2")}
    assert states["seed-2"] == "waiting"
    assert set(states.values()) <= {"waiting", "stopped", "finished"}
    result = cli("train", "--resume", study, "--jobs", 2, "--json")
    assert result.code == 0, result.err
    alone = cli("train", "cartpole", *SMALL, "--max-iterations", 60, "--seed", 1, "--runs-dir", "alone", "--json")
    assert rows_of(study / "seed-1") == rows_of(Path(alone.json["run"]))
    assert content(newest(study / "seed-1")) == content(newest(Path(alone.json["run"])))


@pytest.mark.slow
def test_killed_study_stops_its_trainings(start):
    process = start("train", "cartpole", *SMALL, "--max-iterations", 100_000, "--seeds", "0..1", "--jobs", 1)
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and not any(
        file.stat().st_size for file in Path("runs").glob("*/*/seed-0/metrics.jsonl")
    ):
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    study = study_folder()
    while time.monotonic() < deadline and overview(study / "seed-0").state == "running":
        time.sleep(0.05)
    assert overview(study / "seed-0").state == "stopped"
    assert overview(study / "seed-0").resumable


@pytest.mark.slow
def test_failed_seed_is_named(cli):
    done = cli("train", "cartpole", *SMALL, "--max-iterations", 3, "--seeds", "0..1", "--name", "s", "--json")
    assert done.code == 0
    study = study_folder()
    (study / "seed-1" / "config.yaml").write_text("decimation: nonsense\n")
    record = json.loads((study / "seed-1" / "run.json").read_text())
    (study / "seed-1" / "run.json").write_text(json.dumps({**record, "state": "stopped"}))
    result = cli("train", "--resume", study, "--json")
    assert result.code != 0
    assert "seed-1" in result.err


@pytest.mark.slow
def test_finished_study_continues_with_new_budget(cli):
    steady = (*SMALL, "agent.schedule=constant")  # other schedules depend on the budget
    done = cli("train", "cartpole", *steady, "--max-iterations", 2, "--seeds", "4..5", "--jobs", 5, "--json")
    assert done.code == 0, done.err
    longer = cli("train", "--resume", study_folder(), "--max-iterations", 3, "--logger", "tensorboard", "--json")
    assert longer.code == 0, longer.err
    alone = cli("train", "cartpole", *steady, "--max-iterations", 3, "--seed", 5, "--runs-dir", "alone", "--json")
    assert [row["step"] for row in longer.json["runs"]] == [3 * 32 * 16] * 2
    assert rows_of(study_folder() / "seed-5") == rows_of(Path(alone.json["run"]))
    assert list((study_folder() / "seed-5").rglob("events.out.tfevents*")), "options apply to each run"


@pytest.mark.slow
def test_study_with_single_seed_has_no_interval(cli):
    done = cli("train", "cartpole", *SMALL, "--max-iterations", 2, "--seeds", "7..7", "--json")
    assert done.code == 0, done.err
    assert [(row["seed"], row["state"]) for row in done.json["runs"]] == [(7, "finished")]
    (run,) = list_runs(Path("runs"), "cartpole")
    assert run.folder == study_folder() / "seed-7"
    resumed = cli("train", "--resume", study_folder())
    assert resumed.code == 0
    assert "nan" not in resumed.out


@pytest.mark.slow
def test_full_disk_leaves_no_partial_study(cli):
    small = Path("small")
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "none", small], capture_output=True).returncode:
        pytest.skip("this user cannot mount a small file system")
    try:
        done = cli("train", "cartpole", *SMALL, "--seeds", "0..20", "--runs-dir", small)
        assert done.code == 10
        assert "No space left on device" in done.err
        assert not list(small.glob("*/*"))
    finally:
        subprocess.run(["umount", small], check=True)


@pytest.mark.slow
def test_second_ctrl_c_ends_study_at_once(start, cli):
    process = start("train", "cartpole", *SMALL, "--max-iterations", 100_000, "--seeds", "0..1", "--jobs", 2)
    deadline = time.monotonic() + 120
    while (
        time.monotonic() < deadline
        and len([file for file in Path("runs").glob("*/*/seed-*/metrics.jsonl") if file.stat().st_size]) < 2
    ):
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in err
    done = cli("train", "--resume", study_folder(), "--max-iterations", 1, "--json")
    assert done.code == 0, done.err
    assert [row["state"] for row in done.json["runs"]] == ["finished"] * 2
