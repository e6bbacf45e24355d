"""`sweep compare`: time to a threshold with the best trial's settings and the task's own."""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rlcli.errors import UsageError
from rlcli.training.time_to_threshold import Threshold, TimeToThreshold, median, read_threshold, time_to_threshold

pytestmark = pytest.mark.usefixtures("empty_folder")

SMALL = ("scene.num_envs=16", "agent.torch_threads=1", "sim.engine_threads=1")
FOLDER = Path("runs/cartpole/sweep-sweep")


def row(iteration, seconds, **evaluation):
    rates = {"Perf/collection_time": seconds * 0.75, "Perf/learning_time": seconds * 0.25}
    return {"iteration": iteration, "step": iteration * 100, **rates, **evaluation}


def test_read_threshold():
    assert read_threshold("success=0.99") == Threshold("success", 0.99)
    assert read_threshold("return=-3e2") == Threshold("return", -300.0)


@pytest.mark.parametrize("text", ["", "success", "success=", "success=1.5", "success=0", "return=nan", "speed=1", "=1"])
def test_malformed_threshold_is_usage_error(text):
    with pytest.raises(UsageError, match="--until"):
        read_threshold(text)


def test_time_to_threshold_sums_rollouts_and_updates():
    rates = [None, 0.5, None, 0.99, 0.2]
    rows = [row(i, 2.0, **({} if rate is None else {"Eval/success_rate": rate})) for i, rate in enumerate(rates, 1)]
    assert time_to_threshold(rows, Threshold("success", 0.99)) == TimeToThreshold(8.0, 400, 4)
    assert time_to_threshold(rows, Threshold("success", 0.5)) == TimeToThreshold(4.0, 200, 2)
    assert time_to_threshold(rows, Threshold("success", 1.0)) is None
    assert time_to_threshold(rows, Threshold("return", 0.0)) is None, "the rows have no return"


def test_median_counts_unreached_seeds_as_infinite():
    assert median([3.0, None, 1.0]) == 3.0
    assert median([None, None, 1.0]) is None


@pytest.fixture(scope="module")
def runs_with_a_sweep(tmp_path_factory):
    """The runs folder of a finished sweep with one trial."""
    folder = tmp_path_factory.mktemp("swept")
    words = [
        "--param",
        "agent.learning_rate=log:1e-4:1e-2",
        "--trials",
        "1",
        "--max-iterations",
        "1",
        "--episodes",
        "4",
    ]
    subprocess.run([sys.executable, "-m", "rlcli", "sweep", "cartpole", *SMALL, *words], cwd=folder, check=True)
    return folder / "runs"


@pytest.fixture
def swept(empty_folder, runs_with_a_sweep):
    shutil.copytree(runs_with_a_sweep, "runs")


def rows_of(run):
    return [json.loads(line) for line in (Path(run) / "metrics.jsonl").read_text().splitlines()]


@pytest.mark.slow
@pytest.mark.usefixtures("swept")
def test_compare_trains_both_arms_until_threshold(cli):
    words = ("sweep", "compare", "sweep", "--seeds", "0..1", "--until", "length=1", "--episodes", 4)
    done = cli(*words, "--json")
    assert done.code == 0, done.err
    compared = done.json["compared"]
    order = [(one["policy"], one["seed"]) for one in compared]
    assert order == [("default", 0), ("best", 0), ("best", 1), ("default", 1)], "a slow period affects both arms"
    for one in compared:
        assert one["state"] == "reached"
        first = rows_of(one["run"])[0]
        assert one["steps"] == first["step"]
        assert one["seconds"] == pytest.approx(first["Perf/collection_time"] + first["Perf/learning_time"])
        assert first["Eval/mean_episode_length"] >= 1
        record = json.loads((Path(one["run"]) / "run.json").read_text())
        assert record["seed"] == one["seed"]
        given = [where for where in record["given"].values() if "learning_rate" in where]
        assert len(given) == (one["policy"] == "best")
    best = sorted(one["seconds"] for one in compared if one["policy"] == "best")
    assert done.json["medians"]["best"]["seconds"] == pytest.approx(sum(best) / 2)
    medians = done.json["medians"]
    assert done.json["ratios"]["seconds"] == pytest.approx(medians["best"]["seconds"] / medians["default"]["seconds"])
    again = cli(*words)
    assert again.code == 0
    assert "4 trainings, each of at most " in again.err
    assert len(list(FOLDER.glob("compare-*"))) == 4, "finished trainings are not repeated"
    lines = again.out.splitlines()
    assert lines[0].split() == ["SEED", "DEFAULT", "S", "STEPS", "TRIAL", "0", "S", "STEPS"]
    assert [line.split()[0] for line in lines[1:]] == ["0", "1", "median", "ratio"]
    assert f"{compared[0]['seconds']:.2f}" in lines[1]
    json_again = cli(*words, "--json").json
    assert json_again["medians"] == medians
    assert cli("sweep", "show", "--json").json["trials"][0]["trial"] == 0, "the sweep is unchanged"


@pytest.mark.slow
@pytest.mark.usefixtures("swept")
def test_unreached_threshold_has_no_time(cli):
    words = ("--seeds", "3", "--until", "success=1", "--max-iterations", 2, "--episodes", 4)
    done = cli("sweep", "compare", *words, "--json")
    assert done.code == 0, done.err
    assert {one["state"] for one in done.json["compared"]} == {"not reached"}
    assert [len(rows_of(one["run"])) for one in done.json["compared"]] == [2, 2]
    assert done.json["medians"]["best"] == {"seconds": None, "steps": None}
    assert done.json["ratios"] == {"seconds": None, "steps": None}
    longer = cli("sweep", "compare", *words, "--max-iterations", 3, "--json")
    assert [len(rows_of(one["run"])) for one in longer.json["compared"]] == [3, 3], "another budget has other runs"


@pytest.mark.slow
@pytest.mark.usefixtures("swept")
def test_stopped_comparison_resumes(cli, start):
    words = ("sweep", "compare", "--seeds", "0", "--until", "success=1", "--max-iterations", 30, "--episodes", 4)
    process = start(*words, "--json")
    deadline = time.monotonic() + 100
    while time.monotonic() < deadline and not any(file.stat().st_size for file in FOLDER.glob("compare-*/metrics*")):
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=100)
    assert process.returncode == 130, err
    assert "to continue" in json.loads(out)["error"]["hint"]
    done = cli(*words, "--json")
    assert done.code == 0, done.err
    assert len(list(FOLDER.glob("compare-*"))) == 2
    for one in done.json["compared"]:
        rows = rows_of(one["run"])
        assert [each["iteration"] for each in rows] == list(range(1, len(rows) + 1))
        assert one["state"] == ("reached" if len(rows) < 30 else one["state"])


@pytest.mark.slow
@pytest.mark.usefixtures("swept")
@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (("--until", "sucess=1"), 2, "--until"),
        (("--seeds", "3..1"), 2, "is empty"),
        (("other",), 5, "no sweep 'other'"),
        (("sweep", "second"), 2, "more than one sweep is named"),
        (("agent.learning_rat=1",), 3, "learning_rate"),
        (("--trials", "3"), 2, "--trials is not an option of sweep compare"),
    ],
)
def test_invalid_arguments_train_nothing(cli, words, code, message):
    result = cli("sweep", "compare", *words)
    assert result.code == code, result.err
    assert message in result.err
    assert not list(FOLDER.glob("compare-*"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("show", "--trials", "3"), "--trials is not an option of sweep show"),
        (("cartpole", "--plot"), "rlcli sweep show"),
        (("cartpole", "--until", "success=1"), "rlcli sweep compare"),
    ],
)
def test_option_of_other_form_is_usage_error(cli, words, message):
    result = cli("sweep", *words)
    assert result.code == 2
    assert message in result.err
