"""Sweeps: parsing, error messages, and several processes that run each trial exactly once."""

import getpass
import json
import math
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from pathlib import Path

import pytest
import yaml

from rlcli.config.layers import parse_override
from rlcli.errors import UsageError
from rlcli.tuning.search_space import Objective, read_objective, read_parameters

pytestmark = pytest.mark.usefixtures("empty_folder")

SMALL = ("scene.num_envs=16", "agent.torch_threads=1", "sim.engine_threads=1")
RATE = ("--param", "agent.learning_rate=log:1e-4:1e-2")


@pytest.mark.parametrize(
    ("text", "bounds", "log"),
    [
        ("a.b=log:1e-4:3e-3", (1e-4, 3e-3), True),
        ("a.b=0.5:2", (0.5, 2.0), False),
        ("a.b=8:64", (8, 64), False),
        ("a.b=-1:1", (-1, 1), False),
        ("a.b=elu,tanh", ("elu", "tanh"), False),
        ("a.b=[32, 32],[64, 64]", ([32, 32], [64, 64]), False),
        ("a.b=true,false", (True, False), False),
        ("a.b=1,2.5,null", (1, 2.5, None), False),
    ],
)
def test_read_parameters_of_ranges_and_choices(text, bounds, log):
    (parameter,) = read_parameters([text])
    assert (parameter.key, parameter.bounds, parameter.log) == ("a.b", bounds, log)
    for bound in bounds:
        assert parse_override(parameter.override(bound)) == (("a", "b"), bound)


@pytest.mark.parametrize(
    "text",
    ["a.b", "a.b=", "=1:2", "a.b=2:1", "a.b=1:1", "a.b=log:0:1", "a.b=x:y", "a.b=3", "a.b=1,1", "a.b=[1", "a b=1:2"],
)
def test_malformed_parameter_is_usage_error(text):
    with pytest.raises(UsageError, match="--param"):
        read_parameters([text])


def test_repeated_key_is_usage_error():
    with pytest.raises(UsageError, match="twice"):
        read_parameters(["a.b=1:2", "a.b=3:4"])


@pytest.mark.parametrize(
    ("text", "objective"),
    [
        ("return", Objective("return")),
        ("success@30s", Objective("success", seconds=30.0)),
        ("return@2e6", Objective("return", steps=2_000_000)),
        ("return@5000steps", Objective("return", steps=5000)),
        ("reward_terms.alive", Objective("reward_terms.alive")),
    ],
)
def test_read_objective(text, objective):
    found = read_objective(text)
    assert (found.key, found.seconds, found.steps) == (objective.key, objective.seconds, objective.steps)


@pytest.mark.parametrize("text", ["", "speed@@3s", "succes", "success@s", "success@-3s", "return@0s", "reward_terms."])
def test_malformed_objective_is_usage_error(text):
    with pytest.raises(UsageError, match="--objective"):
        read_objective(text)


def test_objective_reads_evaluation_document():
    document = {"success": {"rate": 0.5}, "return": {"mean": 3.0}, "reward_terms": {"alive": {"mean": 2.0}}}
    assert Objective("success").read(document) == 0.5
    assert Objective("return").read(document) == 3.0
    assert Objective("reward_terms.alive").read(document) == 2.0
    with pytest.raises(UsageError, match="has no such result"):
        Objective("length").read(document)


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ((), 2, "no --param given"),
        (("--param", "agent.learning_rat=1e-4:1e-3"), 3, "learning_rate"),
        (("--param", "agent.learning_rate=-1.0:1e-3"), 3, "learning_rate"),
        ((*RATE, "--objective", "sucess"), 2, "--objective"),
        ((*RATE, "--name", "../x"), 2, "--name"),
        ((*RATE, "--pruner", "medan"), 2, "median"),
        ((*RATE, "--storage", "nonsense"), 2, "is not the URL of a database"),
        ((*RATE, "--storage", "nodialect://host/x"), 2, "is not the URL of a database"),
        ((*RATE, "--storage", "{0}"), 2, "is not the URL of a database"),
        ((*RATE, "--storage", "{x}"), 2, "is not the URL of a database"),
        ((*RATE, "--storage", "{"), 2, "is not the URL of a database"),
        ((*RATE, "--storage", "sqlite:///x.db?timeout=abc"), 2, "is not the URL of a database"),
        ((*RATE, "--storage", "sqlite:///%00"), 2, "is not the URL of a database"),
        ((*RATE, "--storage", "postgresql://a:b@host:abc/x"), 2, "is not the URL of a database"),
        ((*RATE, "--storage", "oracle://x"), 7, "needs the database driver"),
        ((*RATE, "--objective", "return@1000", "--max-steps", "10"), 2, "limits the length"),
    ],
)
def test_invalid_arguments_start_nothing(cli, words, code, message):
    result = cli("sweep", "cartpole", *words)
    assert result.code == code, result.err
    assert message in result.err
    assert not list(Path().glob("runs/*/*/trial-*"))


@pytest.mark.parametrize("silent", [False, True], ids=["closed", "silent"])
@pytest.mark.parametrize("url", ["someone:secret@127.0.0.1:{}/none", "someone@127.0.0.1:{}/none?password=secret"])
def test_unreachable_storage_is_machine_error_without_password(cli, url, silent, monkeypatch):
    monkeypatch.setattr("rlcli.tuning.optuna_storage._CONNECT_S", 2)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        if silent:
            taken.listen()
        url = f"postgresql+psycopg://{url.format(taken.getsockname()[1])}"
        result = cli("sweep", "cartpole", *RATE, "--storage", url)
    assert result.code == 10, result.err
    assert "cannot be reached" in result.err
    assert "secret" not in result.err


def test_sweep_prints_the_best_trial_and_how_to_train_with_its_settings(cli):
    short = ("--trials", 1, "--max-iterations", 1, "--episodes", 4)
    result = cli("sweep", "cartpole", *SMALL, *RATE, *short)
    assert result.code == 0, result.err
    assert "best: trial 0" in result.err
    assert "rlcli train cartpole --config runs/cartpole/sweep-sweep/best.yaml" in result.err


@pytest.mark.slow
def test_same_sweep_is_joined_and_other_settings_are_refused(cli):
    first = cli("sweep", "cartpole", *SMALL, *RATE, "--trials", 1, "--max-iterations", 1, "--episodes", 4, "--json")
    assert first.code == 0, first.err
    for change in (["--param", "agent.gamma=0.9:0.99"], ["--objective", "success"], ["--seed", "3"], ["--minimize"]):
        other = cli("sweep", "cartpole", *SMALL, *RATE, *change, "--trials", 1, "--max-iterations", 1, "--episodes", 4)
        assert other.code == 2, other.err
        assert "is a sweep with other settings" in other.err
    again = cli("sweep", "cartpole", *SMALL, *RATE, "--trials", 1, "--max-iterations", 1, "--episodes", 4, "--json")
    assert again.json["trials"] == first.json["trials"]
    shown = cli("sweep", "show", "sweep", "--json")
    assert shown.json["trials"] == first.json["trials"]
    assert shown.json["best"]["trial"] == 0
    drawn = cli("sweep", "show", "--plot")
    assert drawn.code == 0, drawn.err
    assert Path("runs/cartpole/sweep-sweep/sweep.svg").stat().st_size > 1000
    preset = yaml.safe_load(Path(first.json["preset"]).read_text())
    assert preset["agent"]["learning_rate"] == pytest.approx(first.json["best"]["params"]["agent.learning_rate"])
    used = cli("show", "cartpole", "--config", first.json["preset"], "--json")
    assert used.code == 0, used.err
    missing = cli("sweep", "show", "other")
    assert missing.code == 5
    assert "sweep-sweep" in missing.err


def sweep(start, *words):
    return start(
        *("sweep", "cartpole", *SMALL, *RATE, "--param", "agent.n_steps=8,16", "--max-iterations", 6),
        *("--episodes", 8, "--pruner", "none", "--json", *words),
    )


def started_trials(folder):
    return [run for run in folder.glob("trial-*") if (run / "metrics.jsonl").exists()]


def assert_whole(document, trials):
    assert [trial["trial"] for trial in document["trials"]] == list(range(trials))
    assert {trial["state"] for trial in document["trials"]} == {"complete"}
    rates = [trial["params"]["agent.learning_rate"] for trial in document["trials"]]
    assert len(set(rates)) == trials, "no trial is repeated"
    for trial in document["trials"]:
        record = json.loads((Path(trial["run"]) / "run.json").read_text())
        assert record["state"] == "finished"
        config = yaml.safe_load((Path(trial["run"]) / "config.yaml").read_text())
        agent = config["agents"][record["agent"]]
        assert float(agent["learning_rate"]) == pytest.approx(trial["params"]["agent.learning_rate"])
        assert agent["n_steps"] == trial["params"]["agent.n_steps"]
        rows = [json.loads(row) for row in (Path(trial["run"]) / "metrics.jsonl").read_text().splitlines()]
        assert [row["iteration"] for row in rows] == [1, 2, 3, 4, 5, 6]


@pytest.mark.slow
@pytest.mark.timeout(1200)  # many processes on a possibly busy machine
def test_killed_and_restarted_process_completes_every_trial_once(start):
    trials = 12
    one, other = (sweep(start, "--trials", trials) for _ in range(2))
    folder = Path("runs/cartpole/sweep-sweep")
    deadline = time.monotonic() + 200
    while len(started_trials(folder)) < 3 and time.monotonic() < deadline:
        time.sleep(0.05)
    one.send_signal(signal.SIGKILL)
    one.wait()
    again = sweep(start, "--trials", trials)
    documents = []
    for process in (other, again):
        out, err = process.communicate(timeout=1100)
        assert process.returncode == 0, err
        documents.append(json.loads(out))
    assert_whole(max(documents, key=lambda document: document["ended"]), trials)
    assert len(list(folder.glob("trial-*"))) == trials


@pytest.mark.slow
def test_stopped_sweep_resumes_its_trial(start, cli):
    process = sweep(start, "--trials", 2)
    folder = Path("runs/cartpole/sweep-sweep")
    deadline = time.monotonic() + 100
    while not started_trials(folder) and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=100)
    assert process.returncode == 75, err
    assert (
        "to continue"
        in json.loads(out.rpartition("\n{")[2].join(["{", ""]) if out.count("\n{") else out)["error"]["hint"]
    )
    out, err = sweep(start, "--trials", 2).communicate(timeout=200)
    assert_whole(json.loads(out), 2)


@pytest.mark.slow
def test_time_limit_ends_training_and_policy_is_evaluated(cli):
    result = cli(
        *("sweep", "cartpole", *SMALL, *RATE, "--trials", 1, "--objective", "success@2s"),
        *("--max-iterations", 100_000, "--episodes", 8, "--json"),
    )
    assert result.code == 0, result.err
    (trial,) = result.json["trials"]
    assert trial["state"] == "complete"
    rows = [json.loads(row) for row in (Path(trial["run"]) / "metrics.jsonl").read_text().splitlines()]
    spent = sum(row["Perf/collection_time"] + row["Perf/learning_time"] for row in rows)
    assert 1.5 < spent < 10.0


@pytest.mark.slow
def test_sweep_ends_after_three_failed_trials(cli):
    words = ("--param", "agent.learning_rate=1e30,1e31,1e32", "--trials", 8, "--max-iterations", 3)
    result = cli("sweep", "cartpole", *SMALL, *words)
    assert result.code == 6, result.err
    assert "the first 3 trials failed" in result.err
    assert len(list(Path("runs/cartpole/sweep-sweep").glob("trial-*"))) == 3


@pytest.mark.slow
def test_sweep_with_single_failed_trial_is_an_error(cli):
    words = ("--param", "agent.learning_rate=1e30,1e31", "--trials", 1, "--max-iterations", 3)
    result = cli("sweep", "cartpole", *SMALL, *words, "--json")
    assert result.code == 6, result.err
    assert "the first trial failed" in result.json["error"]["message"]
    shown = cli("sweep", "show", "--json").json
    assert [(trial["state"], trial["value"]) for trial in shown["trials"]] == [("fail", None)]
    assert shown["trials"][0]["why"] in result.err
    assert (shown["best"], shown["preset"]) == (None, None)


@pytest.mark.slow
def test_trained_trial_without_result_is_only_evaluated(cli):
    words = ("sweep", "cartpole", *SMALL, *RATE, "--max-iterations", 2, "--episodes", 4)
    first = cli(*words, "--trials", 1, "--json").json
    folder = Path(first["sweep"])
    journal = (folder / "journal.log").read_text().splitlines(keepends=True)
    result_line = next(number for number, line in enumerate(journal) if '"op_code":6' in line and '"state":1' in line)
    (folder / "journal.log").write_text("".join(journal[:result_line]))
    (folder / "best.yaml").unlink()
    trained = (folder / "trial-0000" / "metrics.jsonl").read_bytes()
    again = cli(*words, "--trials", 2, "--json").json
    assert [trial["state"] for trial in again["trials"]] == ["complete"] * 2
    assert again["trials"][0]["value"] == first["trials"][0]["value"]
    assert (folder / "trial-0000" / "metrics.jsonl").read_bytes() == trained
    assert Path(again["preset"]).is_file()


@pytest.mark.slow
def test_full_disk_loses_no_trial(cli):
    small = Path("small")
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=120k", "none", small], capture_output=True).returncode:
        pytest.skip("this user cannot mount a small file system")
    words = ("sweep", "cartpole", *SMALL, *RATE, "--trials", 4, "--max-iterations", 2, "--episodes", 4)
    try:
        full = cli(*words, "--runs-dir", small)
        assert full.code == 10, full.err
        assert "No space left on device" in full.err
        subprocess.run(["mount", "-o", "remount,size=20m", small], check=True)
        done = cli(*words, "--runs-dir", small, "--json")
        assert done.code == 0, done.err
        assert [trial["state"] for trial in done.json["trials"]] == ["complete"] * 4
    finally:
        subprocess.run(["umount", small], check=True)


@pytest.mark.slow
def test_preset_equals_trial_without_budget(cli):
    Path("more.yaml").write_text("rewards: {alive: {weight: 2.0}}\nagent: {gamma: 0.9}\n")
    words = ("--param", "agent.actor.hidden.0=8:12", "--trials", 1, "--max-iterations", 1, "--episodes", 4)
    done = cli("sweep", "cartpole", "--num-envs", 16, "--agent", "ppo", "--config", "more.yaml", *words, "--json")
    assert done.code == 0, done.err
    own, plain = (
        cli("show", "cartpole", *options, "--json").json["config"]
        for options in (("--config", done.json["preset"]), ("--agent", "ppo"))
    )
    trial = yaml.safe_load((Path(done.json["best"]["run"]) / "config.yaml").read_text())
    assert own["agents"]["default"] == "ppo"
    for key in ("max_iterations", "max_steps"):
        assert own["agents"]["ppo"].pop(key) == plain["agents"]["ppo"][key]
        trial["agents"]["ppo"].pop(key)
    assert json.loads(json.dumps(own)) == json.loads(json.dumps(trial))
    assert own["agents"]["ppo"]["actor"]["hidden"][0] == done.json["best"]["params"]["agent.actor.hidden.0"]


def test_non_finite_objective_is_nan():
    assert math.isnan(Objective("values.x").read({"values": {"x": {"mean": None}}}))


def test_unknown_objective_term_fails_before_training(cli):
    for objective, message in (("reward_terms.aliv", "did you mean 'alive'"), ("terminations.nope", "time_out")):
        result = cli("sweep", "cartpole", *SMALL, *RATE, "--objective", objective)
        assert result.code == 2
        assert message in result.err
    assert not Path("runs").exists()


def postgres_programs():
    found = shutil.which("initdb")
    places = [Path(found).parent] if found else []
    return next(iter([*places, *sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)]), None)


@pytest.fixture
def database():
    """URL of an empty PostgreSQL database on the loopback interface, which stops after the test."""
    programs = postgres_programs()
    if programs is None:
        pytest.skip("PostgreSQL's server is not on this machine (apt-get install postgresql)")
    pytest.importorskip("psycopg", reason="pip install 'psycopg[binary]'")
    place = Path(tempfile.mkdtemp(prefix="rlcli-postgres-"))  # other users cannot read the folders of pytest
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    settings, user = {}, getpass.getuser()
    if os.geteuid() == 0:  # the server refuses to run as root
        user = "nobody"
        shutil.chown(place, "nobody")
        settings = {"user": "nobody"}
    data = place / "data"
    run = {"cwd": place, "check": True, "capture_output": True, **settings}
    subprocess.run([programs / "initdb", "-D", data, "-A", "trust", "-U", user], **run)
    options = f"-c listen_addresses=127.0.0.1 -p {port} -k {place}"
    subprocess.run([programs / "pg_ctl", "-D", data, "-w", "-l", place / "log", "-o", options, "start"], **run)
    try:
        yield f"postgresql+psycopg://{user}@127.0.0.1:{port}/postgres"
    finally:
        subprocess.run([programs / "pg_ctl", "-D", data, "-m", "immediate", "stop"], **run)
        shutil.rmtree(place)


@pytest.mark.slow
@pytest.mark.timeout(1200)  # many processes on a possibly busy machine
def test_machines_share_sweep_through_database(start, cli, database):
    trials = 4
    processes = [
        sweep(start, "--trials", trials, "--storage", database, "--runs-dir", folder) for folder in ("here", "there")
    ]
    documents = []
    for process in processes:
        out, err = process.communicate(timeout=1100)
        assert process.returncode == 0, err
        documents.append(json.loads(out))
    last = max(documents, key=lambda document: document["ended"])
    assert [trial["trial"] for trial in last["trials"]] == list(range(trials))
    assert {trial["state"] for trial in last["trials"]} == {"complete"}
    runs = [run.name for folder in ("here", "there") for run in Path(folder).glob("cartpole/sweep-sweep/trial-*")]
    assert sorted(runs) == [f"trial-{number:04d}" for number in range(trials)], "each was trained on one machine"
    shown = cli("sweep", "show", "here/cartpole/sweep-sweep", "--storage", database, "--json")
    assert shown.json["ended"] == trials
    assert "--storage" in cli("sweep", "show", "here/cartpole/sweep-sweep").err
