"""`rlcli train`: run folders, exact resume, refusals, and what is left after a failure."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

pytestmark = pytest.mark.usefixtures("empty_folder")

SMALL = ("scene.num_envs=8", "sim.engine_threads=1", "agent.torch_threads=1", "--logger", "none", "-q")
TIMES = ("Perf/",)


def metrics(run):
    rows = [json.loads(line) for line in (Path(run) / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if not k.startswith(TIMES)} for row in rows]


def files_of(run, step):
    folder = Path(run) / "checkpoints" / f"{step:012d}"
    return {file.name: file.read_bytes() for file in folder.iterdir()}


def test_run_folder_contents(cli, only_run):
    done = cli("train", "cartpole", *SMALL, "--max-iterations", 2, "--name", "first", "--json")
    assert done.code == 0
    run = only_run()
    assert done.json["run"] == str(run)
    assert (done.json["step"], done.json["iteration"], done.json["state"]) == (256, 2, "finished")
    assert sorted(p.name for p in run.iterdir()) == [".lock", "checkpoints", "config.yaml", "metrics.jsonl", "run.json"]
    names = sorted(p.name for p in (run / "checkpoints").iterdir())
    assert names == ["000000000000", "000000000256", "latest"]
    assert not any(p.is_symlink() for p in run.rglob("*"))
    record = json.loads((run / "run.json").read_text())
    assert record["state"] == "finished"
    assert record["seed"] == 42
    assert record["torch_threads"] >= 1
    assert record["versions"]["mujoco"]
    assert yaml.safe_load((run / "config.yaml").read_text())["scene"]["num_envs"] == 8


def test_metrics_have_rsl_rl_names_and_one_row_per_iteration(cli, only_run):
    overrides = ("scene.num_envs=32", "episode_length_s=0.3", "agent.torch_threads=1")
    cli("train", "cartpole", *overrides, "--max-iterations", 3, "-q")
    rows = [json.loads(line) for line in (only_run() / "metrics.jsonl").read_text().splitlines()]
    assert [row["iteration"] for row in rows] == [1, 2, 3]
    assert [row["step"] for row in rows] == [512, 1024, 1536]
    wanted = {
        "Train/mean_reward", "Train/mean_episode_length", "Episode_Reward/alive", "Episode_Termination/time_out",
        "Loss/value", "Loss/surrogate", "Loss/learning_rate", "Policy/mean_std", "Perf/total_fps",
        "Perf/collection_time", "Perf/learning_time", "Perf/iteration_time",
    }  # fmt: skip
    assert wanted <= set(rows[-1])
    assert any(only_run().glob("tb/events.out.tfevents.*"))


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
def test_same_seed_gives_identical_weights(cli, weights, task):
    folders = []
    for runs, seed in (("a", 1), ("b", 1), ("c", 2)):
        cli("train", task, *SMALL, "--max-iterations", 3, "--seed", seed, "--runs-dir", runs)
        folders.append(next(Path(runs).glob("*/*")))
    first, second, third = map(weights, folders)
    assert first == second != third


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
@pytest.mark.parametrize("schedule", [(), ("agent.schedule=linear",)])
def test_resumed_run_equals_uninterrupted_run(cli, task, schedule):
    # save at 3, then make as if the process had died there
    budget = ("--max-iterations", 6, "agent.save_interval=3", "episode_length_s=0.4")
    cli("train", task, *SMALL, *schedule, *budget, "--runs-dir", "whole")
    whole = next(Path("whole").glob("*/*"))
    shutil.copytree(whole, "part/t/r")
    shutil.rmtree("part/t/r/checkpoints/000000000768")
    record = json.loads(Path("part/t/r/run.json").read_text())
    Path("part/t/r/run.json").write_text(json.dumps({**record, "state": "running"}))
    done = cli("train", "--resume", "part/t/r", "-q")
    assert done.code == 0, done.err
    assert files_of("part/t/r", 768) == files_of(whole, 768)
    assert metrics("part/t/r") == metrics(whole)


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
def test_extended_run_equals_longer_run(cli, task):
    constant = (*SMALL, "agent.schedule=constant")  # another schedule depends on the budget
    cli("train", task, *constant, "--max-iterations", 6, "--runs-dir", "six")
    cli("train", task, *constant, "--max-iterations", 3, "--runs-dir", "three")
    done = cli("train", "--resume", "latest", "--runs-dir", "three", "--max-iterations", 6, "-q", "--json")
    assert done.code == 0, done.err
    assert done.json["iteration"] == 6
    six, three = (next(Path(name).glob("*/*")) for name in ("six", "three"))
    wanted, found = files_of(six, 768), files_of(three, 768)
    for name in wanted:
        assert wanted[name] == found[name], name
    assert metrics(six) == metrics(three)
    # the new budget is the run's from now on
    assert yaml.safe_load((three / "config.yaml").read_text())["agents"]["sb3-ppo"]["max_iterations"] == 6
    assert cli("train", "--resume", "latest", "--runs-dir", "three", "--json").json["state"] == "finished"


def test_resume_of_finished_run_changes_nothing(cli, only_run):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    before = {p: p.stat().st_mtime_ns for p in only_run().rglob("*")}
    done = cli("train", "--resume", "latest")
    assert done.code == 0
    assert "is finished" in done.err
    assert {p: p.stat().st_mtime_ns for p in only_run().rglob("*")} == before


@pytest.mark.parametrize("damage", ["deleted", "truncated", "both"])
def test_finished_run_that_lost_its_last_checkpoints_is_continued(cli, only_run, damage):
    cli("train", "cartpole", *SMALL, "--max-iterations", 4, "agent.save_interval=1")
    run = only_run()
    whole, rows = files_of(run, 512), metrics(run)
    if damage != "truncated":
        shutil.rmtree(run / "checkpoints/000000000512")
    if damage != "deleted":
        left = "000000000384" if damage == "both" else "000000000512"
        os.truncate(run / "checkpoints" / left / "trainer.safetensors", 100)
    os.truncate(run / "metrics.jsonl", (run / "metrics.jsonl").stat().st_size - 37)
    named = cli("train", "--resume", f"{run.name}@step:256", "-q")
    assert named.code == 0
    assert not (run / "checkpoints/000000000512/manifest.json").exists() or damage == "truncated"
    done = cli("train", "--resume", run)
    assert done.code == 0, done.err
    last = 256 if damage == "both" else 384
    assert f"it was finished at step 512, and its newest good checkpoint has step {last}; the training" in done.err
    assert files_of(run, 512) == whole
    assert metrics(run) == rows


def test_resume_of_earlier_step_drops_later_steps(cli, only_run):
    cli("train", "cartpole", *SMALL, "--max-iterations", 4, "agent.save_interval=1")
    run = only_run()
    whole = files_of(run, 512)
    (run / "checkpoints/000000000512/policy.safetensors").write_bytes(b"damaged")
    refused = cli("train", "--resume", f"{run.name}@step:512", "--max-iterations", 5)
    assert refused.code == 5
    assert "policy.safetensors" in refused.err
    assert "@step:N" in refused.err
    assert cli("train", "--resume", f"{run.name}@step:256", "--max-iterations", 4, "-q").code == 0
    assert files_of(run, 512) == whole
    assert [row["iteration"] for row in metrics(run)] == [1, 2, 3, 4]


def test_max_steps_replaces_agent_budget(cli):
    done = cli("train", "cartpole", *SMALL, "--max-steps", 300, "--json")
    assert done.json["step"] == 384  # whole iterations of 8 x 16
    more = cli("train", "--resume", "latest", "--max-steps", 500, "-q", "--json")
    assert more.json["step"] == 512


@pytest.mark.parametrize(
    ("extra", "named"),
    [
        (("scene.num_envs=3",), "scene.num_envs=3"),
        (("cartpole", "agent.gamma=0.5"), "agent.gamma=0.5"),
        (("--num-envs", 3), "--num-envs"),
        (("--seed", 42), "--seed"),
        (("--name", "x"), "--name"),
        (("--agent", "sb3-ppo"), "--agent"),
        (("--init-from", "latest"), "--init-from"),
    ],
)
def test_resume_rejects_configuration_changes(cli, only_run, extra, named):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    done = cli("train", *extra, "--resume", "latest", "--max-iterations", 2)
    assert done.code == 2
    assert named in done.err


def test_resume_rejects_other_task(cli):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    assert cli("train", "cartpole-direct", "--resume", "latest").code == 5
    run = next(Path("runs/cartpole").iterdir())
    assert cli("train", "cartpole-direct", "--resume", run).code == 2
    assert cli("train", "cartpole", "--resume", run).code == 0


def test_init_from_loads_only_weights(cli, weights):
    cli("train", "cartpole", *SMALL, "--max-iterations", 2)
    first = next(Path("runs").glob("*/*"))
    done = cli(
        "train", "cartpole", *SMALL, "--max-iterations", 1, "--init-from", first.name, "--name", "next", "--json"
    )
    assert done.code == 0, done.err
    new = Path(done.json["run"])
    assert (new / "checkpoints/000000000000/policy.safetensors").read_bytes() == weights(first)
    assert done.json["iteration"] == 1
    assert json.loads((new / "run.json").read_text())["init_from"].startswith(str(first))


@pytest.mark.parametrize("change", ["agent.policy.hidden=[8]", "agent.policy.hidden=[32, 32, 32]"])
def test_init_from_wrong_shapes_creates_no_run(cli, change):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    done = cli("train", "cartpole", *SMALL, change, "--init-from", "latest")
    assert done.code == 5, done.err
    assert "do not fit" in done.err
    assert len(list(Path("runs").glob("*/*"))) == 1


def test_init_from_other_task_prints_differences(cli):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    done = cli("train", "cartpole-direct", *SMALL, "--init-from", "latest")
    assert done.code == 5
    assert "joint_pos_rel" in done.err
    assert "cart_pos" in done.err


@pytest.mark.parametrize(
    ("extra", "code"),
    [
        (("actions.joint_effort.joints=[slider]",), 3),
        (("agent.num_minibatches=1000",), 3),
        (("rewards.alive.wieght=2",), 3),
        (("--logger", "tensorbord"), 2),
        (("--device", "cuda:7"), 8),
        (("--device", "tpu"), 2),
        (("--agent", "ddpg"), 3),
        (("--max-iterations", 0), 3),
        (("--max-iterations", "x"), 2),
        (("--seed", -2), 2),
        (("--seed", 2**70), 2),
        (("--name", "a/b"), 2),
        (("--init-from", "nowhere"), 5),
    ],
)
def test_invalid_command_line_creates_no_run(cli, extra, code):
    done = cli("train", "cartpole", *SMALL, *extra)
    assert done.code == code, done.err
    assert done.err.startswith("error:")
    assert not list(Path().glob("runs/*/*"))


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
@pytest.mark.parametrize("envs", [1, 7, pytest.param(4096, marks=pytest.mark.slow)])
def test_train_with_any_number_of_environments(cli, task, envs):
    done = cli("train", task, *SMALL, f"scene.num_envs={envs}", "--max-iterations", 2, "--json")
    assert done.code == 0, done.err
    assert done.json["step"] == 2 * 16 * envs


def test_too_small_rollout_is_config_error(cli):
    done = cli("train", "cartpole", "scene.num_envs=1", "agent.n_steps=2", "-q")
    assert done.code == 3
    assert "4 minibatches are too many: a rollout holds n_steps x num_envs = 2 x 1 = 2 samples" in done.err


def test_diverged_learner_keeps_last_good_checkpoint(cli, only_run):
    done = cli("train", "cartpole", *SMALL, "agent.learning_rate=1e30")
    assert done.code == 6, done.err
    assert "not finite" in done.err
    assert json.loads((only_run() / "run.json").read_text())["state"] == "diverged"
    assert cli("eval", "--checkpoint", "latest", "--episodes", 4, "-q").code == 0


@pytest.mark.parametrize("rate", ["1e-5", "1e-05", "2e16", "1/3", "3.0e-4"])
def test_number_notations_survive_save_and_resume(cli, only_run, rate):
    assert cli("train", "cartpole", *SMALL, "--max-iterations", 1, f"agent.ent_coef={rate}", "--json").code in (0, 6)
    assert cli("eval", "--checkpoint", "latest", "--episodes", 1, "-q").code == 0
    assert cli("train", "--resume", "latest", "-q").code in (0, 6)


def test_diverged_simulation_stops_training(cli, only_run):
    done = cli("train", "cartpole-direct", *SMALL, "params.max_effort=1e30", "--max-iterations", 3)
    assert done.code == 6, done.err
    assert "diverged" in done.err
    assert "hint: " in done.err
    assert (only_run() / "checkpoints/000000000000/manifest.json").is_file()


def test_runs_dir_flag_overrides_environment_variable(cli, monkeypatch):
    monkeypatch.setenv("RLCLI_RUNS_DIR", "mine")
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    cli("train", "cartpole", *SMALL, "--max-iterations", 1, "--runs-dir", "given")
    assert len(list(Path("mine/cartpole").iterdir())) == len(list(Path("given/cartpole").iterdir())) == 1
    assert not Path("runs").exists()
    assert cli("eval", "--checkpoint", "latest", "--episodes", 1, "--json").json["checkpoint"].startswith("mine/")


def test_task_in_folder_trains_and_resumes(cli, coin, weights):
    for runs, budget in (("two", 2), ("one", 1)):
        assert cli("train", coin, *SMALL, "--max-iterations", budget, "--runs-dir", runs).code == 0
    assert cli("train", coin, "--resume", "latest", "--runs-dir", "one", "--max-iterations", 2, "-q").code == 0
    assert weights(next(Path("one").glob("*/*"))) == weights(next(Path("two").glob("*/*")))


def test_train_without_agent_is_config_error(cli, coin):
    file = Path("coin/task.yaml")
    file.write_text(file.read_text().partition("agents:")[0])
    done = cli("train", coin)
    assert done.code == 3
    assert "no agent" in done.err
    assert cli("eval", coin, "--policy", "random", "--episodes", 2, "-q").code == 0


def test_resume_of_locked_run_is_machine_error(cli, only_run):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    holder = subprocess.Popen(
        [sys.executable, "-c",
         "import sys; from pathlib import Path; from rlcli.runs.run import open_run;"
         "r = open_run(Path(sys.argv[1])); r.lock(); print('held', flush=True); sys.stdin.read()", str(only_run())],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    holder.stdout.readline()
    done = cli("train", "--resume", "latest", "--max-iterations", 2)
    holder.communicate()
    assert done.code == 10
    assert "another process writes to" in done.err
    done = cli("train", "--resume", "latest", "--max-iterations", 2)
    assert done.code == 0
    match = re.search(r"trained (\d+) steps in [\d.]+ s, (\d+) in the whole run", done.err)
    assert match is not None, done.err
    assert int(match[2]) == 2 * int(match[1]), "two equal iterations, one of them before the resume"


def test_resume_removes_temporary_files(cli, only_run):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    (only_run() / "checkpoints/.tmp-99-dead").mkdir()
    (only_run() / "checkpoints/.tmp-99-dead/policy.json").touch()
    assert cli("train", "--resume", "latest", "--max-iterations", 2, "-q").code == 0
    assert not list((only_run() / "checkpoints").glob(".tmp-*"))


@pytest.mark.parametrize(
    ("damage", "code"),
    [
        (lambda run: (run / "run.json").write_text("{"), 5),
        (lambda run: shutil.rmtree(run / "checkpoints"), 5),
        (lambda run: (run / "config.yaml").unlink(), 3),
        (lambda run: (run / "config.yaml").write_text("a: ["), 3),
    ],
)
def test_resume_of_damaged_run_is_one_message(cli, only_run, damage, code):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    damage(only_run())
    done = cli("train", "--resume", only_run(), "--max-iterations", 2)
    assert done.code == code, done.err
    assert done.err.splitlines()[-1].startswith(("error:", "hint:"))


@pytest.mark.parametrize("garbage", ['{"iteration": 1}', '{"iteration": "x", "policy": {}}', "[]"])
def test_resume_of_incomplete_state_is_checkpoint_error(cli, only_run, garbage):
    import hashlib

    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    folder = only_run() / "checkpoints/000000000128"
    (folder / "state.json").write_text(garbage)
    manifest = json.loads((folder / "manifest.json").read_text())
    data = garbage.encode()
    manifest["files"]["state.json"] = {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    (folder / "manifest.json").write_text(json.dumps(manifest))
    done = cli("train", "--resume", f"{only_run().name}@step:128", "--max-iterations", 2)
    assert done.code == 5, done.err


@pytest.mark.parametrize("call", ["fsync", "rename"])
def test_disk_error_during_training_is_one_message(cli, only_run, monkeypatch, call):
    cli("train", "cartpole", *SMALL, "--max-iterations", 2)

    def refuse(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, call, refuse)
    done = cli("train", "--resume", "latest", "--max-iterations", 3)
    monkeypatch.undo()
    assert done.code == 10
    assert "No space left on device" in done.err
    assert "free some space" in done.err
    assert not list(Path("runs").rglob("*.tmp-*"))


def test_deleted_run_folder_is_machine_error(cli, only_run, monkeypatch):
    from rlcli.rl.sb3.trainer import Sb3Trainer

    real = Sb3Trainer.iterate

    def iterate(self):
        shutil.rmtree("runs", ignore_errors=True)
        return real(self)

    monkeypatch.setattr(Sb3Trainer, "iterate", iterate)
    done = cli("train", "cartpole", *SMALL, "--max-iterations", 2)
    assert done.code == 10, done.err
    assert "cannot write" in done.err
    assert not Path("runs").exists()


def test_moved_run_folder_is_named_and_not_created_again(cli, only_run, monkeypatch):
    from rlcli.rl.sb3.trainer import Sb3Trainer

    real, moved = Sb3Trainer.iterate, Path("moved")

    def iterate(self):
        if not moved.exists():
            only_run().rename(moved)
        return real(self)

    monkeypatch.setattr(Sb3Trainer, "iterate", iterate)
    done = cli("train", "cartpole", *SMALL, "--max-iterations", 2)
    assert done.code == 10, done.err
    assert f"(there is no folder {Path('runs/cartpole').absolute()}/" in done.err
    assert "was moved or deleted meanwhile, put it back; then continue with `rlcli train --resume runs/" in done.err
    assert list(Path("runs").glob("*/*")) == []


def test_resume_of_a_run_with_an_oversized_latest_file_replaces_it(cli, only_run):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    latest = only_run() / "checkpoints" / "latest"
    os.truncate(latest, 6 * 2**30)
    assert cli("train", "--resume", only_run(), "--max-iterations", 2).code == 0
    assert latest.stat().st_size < 100


def test_runs_dir_that_is_a_file_is_machine_error(cli):
    Path("runs").touch()
    done = cli("train", "cartpole", *SMALL)
    assert done.code == 10
    assert "runs/cartpole" in done.err


@pytest.mark.slow
def test_full_disk_keeps_last_checkpoint(cli, start):
    small = Path("small")
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "none", small], capture_output=True).returncode:
        pytest.skip("this user cannot mount a small file system")
    try:
        process = start(
            "train", "cartpole", "--runs-dir", small, *SMALL, "--max-iterations", 300, "agent.save_interval=1"
        )
        _, err = process.communicate(timeout=120)
        assert process.returncode == 10, err
        assert "No space left on device" in err
        assert "Traceback" not in err
        (run,) = small.glob("*/*")
        steps = sorted(p.name for p in (run / "checkpoints").iterdir())
        assert not [name for name in steps if name.startswith(".tmp")]
        assert cli("eval", "--checkpoint", run, "--episodes", 2, "-q").code == 0
    finally:
        subprocess.run(["umount", small], check=True)
