"""`rlcli bench`: measurements, recommendation, and the preset for a training."""

import json
import signal
from pathlib import Path

import pytest

from rlcli.config.load import resolve
from rlcli.registry import find_task
from rlcli.training import job
from rlcli.tuning import bench
from rlcli.tuning.bench import Bench, Pace

pytestmark = pytest.mark.usefixtures("empty_folder")

SHORT_PACE = Pace(block_s=0.0, blocks=3, rounds=1, longest_s=100.0)


@pytest.fixture
def short_measurements(monkeypatch):
    """Measure few sizes on one core with one call each: the tests need rows, not exact times."""
    monkeypatch.setattr(bench, "QUICK", SHORT_PACE)
    monkeypatch.setattr(bench, "SIZES", (4, 8))
    for module in (bench, job):
        monkeypatch.setattr(module, "available_cores", lambda: 1)


def test_comparable_rows_have_equal_samples_and_minibatches(coin, cli, short_measurements):
    done = cli("bench", coin, "--quick", "--json")
    found = done.json
    assert (done.code, found["schema"], found["command"], found["state"]) == (0, 1, "bench", "finished")
    assert (found["task"], found["agent"], found["preset"]) == ("coin", "ppo", None)
    assert [row["num_envs"] for row in found["environment"]][:2] == [4, 8]
    assert all(row["steps_per_s"] > 0 and 0 <= row["physics"] <= 1 for row in found["environment"])
    rows = found["training"]
    assert {(row["num_envs"], row["horizon"]) for row in rows} >= {(32, 8), (16, 16), (64, 4)}
    assert {row["samples"] for row in rows} == {256}
    assert {row["minibatches"] for row in rows if row["alike"]} == {2}
    assert {row["minibatches"] for row in rows if not row["alike"]} == {1, 4}
    assert all(abs(sum(row["shares"].values()) - 1.0) < 1e-6 for row in rows)
    best = found["recommended"]
    assert best["scene.num_envs"] * best["agent.n_steps"] == 256
    assert best["agent.num_minibatches"] == 2
    assert found["machine"]["cores"] >= 1


def test_threads_are_measured_up_to_number_of_cores(coin, cli, short_measurements, monkeypatch):
    monkeypatch.setattr(bench, "available_cores", lambda: 3)
    found = cli("bench", coin, "--quick", "--json").json
    tried = {(row["engine_threads"], row["torch_threads"]) for row in found["training"]}
    assert {engine for engine, _ in tried} == {update for _, update in tried} == {1, 2, 3}
    rows = [row for row in found["environment"] if row["num_envs"] == 32]
    assert {(row["engine_threads"], row["workers"]) for row in rows} == {(2, 1), (3, 1), (1, 2), (1, 3)}
    assert {row["workers"] for row in found["training"]} == {1, 2, 3}


def test_preset_can_be_trained(coin, cli, short_measurements, only_run):
    done = cli("bench", coin, "--quick", "--save-preset", "fast", "--json")
    assert (done.code, done.json["preset"]) == (0, "fast.yaml")
    assert "samples" in Path("fast.yaml").read_text().splitlines()[2]
    assert cli("train", coin, "--config", "fast.yaml", "--max-iterations", 1, "-q").code == 0
    best, record = done.json["recommended"], json.loads((only_run() / "run.json").read_text())
    assert record["torch_threads"] == best["agent.torch_threads"]
    assert record["engine_threads"] == best["sim.engine_threads"]


def test_preset_has_user_changes_and_recommendation(coin, cli, short_measurements):
    Path("mine.yaml").write_text("agent: {gamma: 0.9, policy: {hidden: [8, 8]}}\nparams: {chance: 0.1}\n")
    words = ["bench", coin, "params.chance=0.25", "--config", "mine.yaml", "--num-envs", 16, "--agent", "ppo"]
    assert cli(*words, "--quick", "--save-preset", "p.yaml", "-q").code == 0
    resolved = resolve(find_task(coin), config_file=Path("p.yaml"))
    assert resolved.agent_name == "ppo"
    assert (resolved.agent.gamma, list(resolved.agent.policy.hidden)) == (0.9, [8, 8])
    assert resolved.task.params["chance"] == 0.25
    assert resolved.task.scene.num_envs * resolved.agent.n_steps == 16 * 8


def test_preset_names_chosen_agent(cli, short_measurements):
    words = ["--agent", "ppo", "--num-envs", 8, "agent.num_steps=4", "--quick", "--save-preset", "p.yml", "-q"]
    assert cli("bench", "cartpole", *words).code == 0
    resolved = resolve(find_task("cartpole"), config_file=Path("p.yml"))
    assert (resolved.agent_name, resolved.agent.num_steps * resolved.task.scene.num_envs) == ("ppo", 32)


def test_preset_replaces_file_only_with_overwrite(coin, cli, short_measurements):
    Path("p.yaml").write_text("# mine\n")
    done = cli("bench", coin, "--quick", "--save-preset", "p")
    assert (done.code, done.out, Path("p.yaml").read_text()) == (2, "", "# mine\n")
    assert "--overwrite" in done.err
    assert cli("bench", coin, "--quick", "--save-preset", "p", "--overwrite", "-q").code == 0
    assert "num_envs" in Path("p.yaml").read_text()


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["./coin", "--agent", "pppo"], 3, "no agent 'pppo'"),
        (["./coin", "agent.gama=0.9"], 3, "gama"),
        (["./coin", "--num-envs", "0"], 3, "num_envs"),
        (["cartpoel"], 4, "cartpole"),
        (["./coin", "--save-preset", "no/such/p.yaml"], 10, "no folder"),
        (["./coin", "--save-preset", "coin.yaml/"], 2, "exists"),
        (["./coin", "--save-preset", ""], 2, "empty word after --save-preset"),
        ([], 2, "TASK"),
    ],
)
def test_invalid_arguments_fail_before_measuring(coin, cli, words, code, message, monkeypatch):
    monkeypatch.setattr(Bench, "run", lambda self: pytest.fail("measured"))
    Path("coin.yaml").write_text("")
    done = cli("bench", *words)
    assert (done.code, done.out) == (code, "")
    assert message.lower() in done.err.lower()
    assert done.err.count("error:") == 1


def test_sizes_beyond_memory_are_left_out(coin, cli, short_measurements, monkeypatch):
    monkeypatch.setattr(bench, "SIZES", (4, 8, 1 << 20))
    monkeypatch.setattr(bench, "available_memory", lambda: 64 << 20)
    rows = cli("bench", coin, "--quick", "--json").json["environment"]
    assert [row["left_out"] is None for row in rows[:3]] == [True, True, False]
    assert "GiB" in rows[2]["left_out"]
    assert rows[2]["steps_per_s"] is None


def test_single_size_is_measured_with_several_thread_counts(coin, cli, short_measurements, monkeypatch):
    monkeypatch.setattr(bench, "SIZES", (4,))
    monkeypatch.setattr(bench, "available_cores", lambda: 2)
    rows = cli("bench", coin, "--quick", "--json", "--num-envs", "4").json["environment"]
    assert {row["num_envs"] for row in rows} == {4}
    assert len(rows) > 1


def test_sizes_with_indivisible_rollout_are_left_out(coin, cli, short_measurements):
    rows = cli("bench", coin, "agent.n_steps=1", "--num-envs", 2, "--quick", "--json").json["training"]
    assert {(row["num_envs"], row["horizon"]) for row in rows} == {(2, 1), (1, 2)}


def test_unknown_horizon_keeps_sizes(coin, cli, short_measurements, monkeypatch):
    monkeypatch.setattr(bench, "HORIZONS", ())
    found = cli("bench", coin, "--quick", "--json").json
    assert {row["num_envs"] for row in found["training"]} == {32}
    assert set(found["recommended"]) == {
        "scene.num_envs", "scene.workers", "sim.engine_threads", "agent.torch_threads", "agent.num_minibatches"
    }  # fmt: skip


def test_off_policy_agents_keep_updates_per_sample(cli, short_measurements):
    words = ["--agent", "sac", "--num-envs", 8, "agent.learning_starts=1", "--quick", "--json"]
    found = cli("bench", "cartpole", *words).json
    assert {row["samples"] for row in found["training"]} == {64}
    assert {row["minibatches"] for row in found["training"]} == {None}
    assert "agent.train_freq" in found["recommended"]


@pytest.mark.slow
@pytest.mark.parametrize("words", [(), ("--json",)])
def test_ctrl_c_prints_measurements_so_far(coin, start, words):
    process = start("bench", coin, "--save-preset", "p.yaml", *words)
    first = process.stderr.readline()
    while "envs" not in first:
        first = process.stderr.readline()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert "no preset was written" in err
    assert not Path("p.yaml").exists()
    if words:
        found = json.loads(out)
        assert (found["state"], found["recommended"]) == ("stopped", None)
        assert found["environment"][0]["num_envs"] == 16
    else:
        assert out.splitlines()[1].split()[0] == "16"
