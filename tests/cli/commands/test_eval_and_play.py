"""`rlcli eval` and `rlcli play`: choice of the policy, limits, results, videos and exit codes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.usefixtures("empty_folder")

SMALL = ("scene.num_envs=8", "sim.engine_threads=1", "agent.torch_threads=1", "--logger", "none", "-q")
READ = """
import json, sys, imageio.v2 as imageio, numpy as np
reader = imageio.get_reader(sys.argv[1])
frames = [frame.astype(float) for frame in reader]
meta = reader.get_meta_data()
moved = [float(np.abs(b - a).max()) for a, b in zip(frames, frames[1:])]
print(json.dumps({"fps": meta.get("fps"), "duration": meta.get("duration"), "frames": len(frames),
                  "std": min(f.std() for f in frames), "moved": moved}))
"""


def read_video(file):
    result = subprocess.run([sys.executable, "-c", READ, str(file)], capture_output=True, text=True)
    return json.loads(result.stdout)


@pytest.fixture
def trained(cli, only_run):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    return only_run()


def test_short_episodes_are_not_overrepresented(cli, coin):
    # 400 short episodes end before the first long one: counting the first to end would give a success rate of 0
    result = cli("eval", coin, "--policy", "zero", "--episodes", 400, "--json").json
    assert result["episodes"] == 400
    rate = result["success"]["rate"]
    assert 0.4 < rate < 0.6
    assert result["success"]["low"] < 0.5 < result["success"]["high"]
    assert result["length"]["mean"] == pytest.approx(1 + 99 * rate)
    assert result["return"]["mean"] == result["length"]["mean"]
    shares = {name: share["rate"] for name, share in result["terminations"].items()}
    assert shares == {"time_out": rate, "task": 1 - rate}


@pytest.mark.parametrize(("chance", "rate"), [("0.0", 1.0), ("1.0", 0.0)])
def test_success_rate_of_deterministic_outcomes(cli, coin, chance, rate):
    result = cli(
        "eval", coin, f"params.chance={chance}", "--policy", "zero", "--episodes", 5, "--json", "--num-envs", 2
    ).json
    assert result["success"]["rate"] == rate
    assert result["episodes"] == 5


def test_time_out_away_from_target_is_no_success(cli, coin):
    arguments = ("params.chance=0.0", "success.centred.target=1.0", "--policy", "zero", "--episodes", 3, "--json")
    assert cli("eval", coin, *arguments).json["success"]["rate"] == 0.0


def test_eval_is_reproducible_with_seed(cli):
    arguments = ("cartpole", "--policy", "random", "--episodes", 8, "--num-envs", 8, "--json")
    one, same, other = (cli("eval", *arguments, "--seed", seed).json["return"] for seed in (1, 1, 2))
    assert one == same != other


@pytest.mark.parametrize(
    ("limits", "failed"),
    [
        (("success=0.3",), []),
        (("success=0.99",), ["success"]),
        (("return=1", "length=1000"), ["length"]),
        (("success=0.99", "return=1000", "length=1000"), ["success", "return", "length"]),
        (("success.low=0.2", "terminations.time_out=0.3", "terminations.time_out.low=0.2"), []),
        (("success.low=0.5", "return.low=60"), ["success.low", "return.low"]),
        (("terminations.task=0.9", "terminations.task.low=0.5"), ["terminations.task", "terminations.task.low"]),
    ],
)
def test_fail_under_exits_with_9(cli, coin, limits, failed):
    options = [word for limit in limits for word in ("--fail-under", limit)]
    done = cli("eval", coin, "--policy", "zero", "--episodes", 64, "--json", *options)
    assert done.code == (9 if failed else 0)
    assert done.json["passed"] is not failed
    assert [line.split()[0] for line in done.json["failures"]] == failed
    assert ("failed: " in done.err) == bool(failed)


@pytest.mark.parametrize(
    "text",
    [
        "success",
        "success=",
        "succes=0.5",
        "success=high",
        "return=nan",
        "length=inf",
        "=1",
        "success.high=1",
        "reward=1",
    ],
)
def test_malformed_limit_is_usage_error(cli, coin, text):
    done = cli("eval", coin, "--policy", "zero", "--fail-under", text)
    assert done.code == 2
    assert text in done.err


def test_limit_of_unknown_term_suggests_name(cli, coin):
    done = cli("eval", coin, "--policy", "zero", "--episodes", 2, "--fail-under", "terminations.time_ot=0.5")
    assert done.code == 2
    assert "the evaluation has no 'time_ot' in terminations" in done.err
    assert "did you mean 'time_out'" in done.err


def test_intervals_contain_their_means(cli, coin):
    done = cli("eval", "cartpole", "--policy", "random", "--episodes", 12, "--num-envs", 4, "--json").json
    for group in ("reward_terms", "terminations"):
        for value in done[group].values():
            assert value["low"] <= value.get("mean", value.get("rate")) <= value["high"]
    assert done["terminations"]["time_out"]["low"] < done["terminations"]["time_out"]["high"]
    assert done["reward_terms"]["pole_pos"]["low"] < done["reward_terms"]["pole_pos"]["high"]


def test_single_episode_has_no_interval(cli, coin):
    arguments = ("eval", coin, "--policy", "zero", "--episodes", 1)
    assert cli(*arguments, "--json").json["return"]["low"] is None
    done = cli(*arguments, "--fail-under", "return.low=0")
    assert "unknown" in done.out
    assert done.code == 9
    assert "return.low is unknown, because there are fewer than two episodes or values that are not finite" in done.err


def test_evaluation_is_saved_in_run(cli, trained):
    from rlcli.runs.eval_store import read_evaluation
    from rlcli.runs.run import open_run

    result = cli("eval", "--checkpoint", trained, "--episodes", 4, "--json").json
    kept = read_evaluation(open_run(trained), "000000000128")
    assert kept == {key: value for key, value in result.items() if key in kept}
    assert kept["command"] == "eval"
    assert kept["return"] == result["return"]
    assert read_evaluation(open_run(trained), "000000000000") is None
    cli("eval", "--checkpoint", trained, "--episodes", 5)
    assert read_evaluation(open_run(trained), "000000000128")["episodes"] == 5  # the newest evaluation is kept


@pytest.mark.parametrize(
    "changed", [("episode_length_s=0.5",), ("--policy", "zero"), ("--stochastic",), ("--config", "more.yaml")]
)
def test_evaluation_of_changed_task_is_not_saved(cli, trained, changed):
    Path("more.yaml").write_text("episode_length_s: 0.5\n")
    assert cli("eval", "--checkpoint", trained, "--episodes", 2, *changed).code == 0
    assert not (trained / "evaluations").exists()


def test_evaluation_is_not_saved_through_link(cli, trained, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (trained / "evaluations").symlink_to(tmp_path / "elsewhere")
    done = cli("eval", "--checkpoint", trained, "--episodes", 2)
    assert not list((tmp_path / "elsewhere").iterdir())
    assert done.code in (0, 5)
    assert "link" in done.err


def test_success_limit_without_success_is_usage_error(cli, coin):
    arguments = ("success.centred=null", "--policy", "zero", "--episodes", 4)
    assert "success" not in cli("eval", coin, *arguments, "--json").json
    done = cli("eval", coin, *arguments, "--fail-under", "success=0.5")
    assert done.code == 2
    assert "defines no condition of success" in done.err
    assert cli("eval", coin, *arguments, "--fail-under", "return=0.5").code == 0


@pytest.mark.parametrize("episodes", ["0", "-1", "x"])
def test_episodes_below_one_is_usage_error(cli, coin, episodes):
    assert cli("eval", coin, "--policy", "zero", "--episodes", episodes).code == 2


@pytest.mark.parametrize("policy", ["zero", "random"])
def test_untrained_policies_need_no_checkpoint(cli, policy):
    done = cli("eval", "cartpole", "--policy", policy, "--episodes", 8, "--num-envs", 8, "--json")
    assert done.code == 0
    assert done.json["checkpoint"] is None
    assert set(done.json["reward_terms"]) == {"alive", "terminating", "pole_pos", "cart_vel", "pole_vel"}
    total = sum(term["mean"] for term in done.json["reward_terms"].values())
    assert total == pytest.approx(done.json["return"]["mean"], rel=1e-4)


def test_eval_document(cli, trained):
    result = cli("eval", "cartpole", "--episodes", 4, "--json").json
    assert result["schema"] == 1
    assert result["command"] == "eval"
    assert result["checkpoint"] == f"{trained}/checkpoints/000000000128"
    assert set(result["success"]) == {"rate", "low", "high"}
    assert set(result["return"]) == {"mean", "std", "low", "high"}
    assert result["diverged"] == 0


def test_stochastic_changes_returns(cli, trained):
    returns = [
        cli("eval", "cartpole", "--episodes", 8, "--json", *extra).json["return"]["mean"]
        for extra in ((), (), ("--stochastic",), ("--stochastic",))
    ]
    assert returns[0] == returns[1] != returns[2] == returns[3]


@pytest.mark.parametrize("command", ["play", "eval"])
def test_missing_policy_has_training_hint(cli, coin, command):
    done = cli(command, coin)
    assert done.code == 5
    assert "rlcli train coin" in done.err


@pytest.mark.parametrize("command", ["play", "eval"])
@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ((), 2),
        (("cartpol",), 4),
        (("cartpole", "--policy", "trainde"), 2),
        (("--checkpoint", "nowhere"), 5),
        (("cartpole", "--checkpoint", "latest@step:7"), 5),
        (("cartpole", "observations.policy.joint_pos_re.scale=2"), 3),
        (("cartpole-direct", "--checkpoint", "latest"), 5),
        (("cartpole", "--num-envs", "0"), 3),
    ],
)
def test_invalid_arguments_are_one_message_with_exit_code(cli, trained, command, arguments, code):
    done = cli(command, *arguments)
    assert done.code == code, done.err
    assert "error: " in done.err
    assert json.loads(cli(command, *arguments, "--json").out)["error"]["exit_code"] == code


def test_checkpoint_of_other_task_is_usage_error(cli, trained):
    done = cli("eval", "cartpole-direct", "--checkpoint", trained)
    assert done.code == 2
    assert "run of cartpole" in done.err


def test_play_without_display_prints_numbers(cli, trained):
    done = cli("play", "cartpole")
    assert done.code == 0
    assert f"checkpoint {trained}" in done.err
    assert "newest" in done.err
    assert "success rate" in done.out
    assert cli("play", "cartpole", "--json").json["video"] is None


def test_printed_values_are_of_few_episodes_unless_more_are_named(cli):
    words = ("play", "cartpole", "--policy", "zero", "--viewer", "none", "--json", "episode_length_s=1.0")
    assert cli(*words).json["episodes"] == 16
    assert cli(*words, "--num-envs", 20).json["episodes"] == 20


def test_native_viewer_without_display_is_machine_error(cli, trained):
    done = cli("play", "cartpole", "--viewer", "native")
    assert done.code == 10
    assert "no display" in done.err
    assert "--video" in done.err


def test_unknown_viewer_is_usage_error(cli):
    assert cli("play", "cartpole", "--viewer", "nativ").code == 2


# --- videos ---


@pytest.mark.slow
def test_video_has_every_step_at_control_rate(cli, trained, start):
    done = start("play", "cartpole", "--video", "x.mp4", "--num-envs", 1, "viewer.width=160", "viewer.height=120")
    out, err = done.communicate(timeout=120)
    assert done.returncode == 0, err
    assert out == "x.mp4\n"
    assert "Traceback" not in err
    result = cli("play", "cartpole", "--video", "y.mp4", "--num-envs", 1, "--json").json
    video = read_video("x.mp4")
    assert video["frames"] == result["frames"] == result["length"]["mean"]
    assert video["fps"] == pytest.approx(60, rel=1e-3)
    assert video["std"] > 1
    assert sum(change > 20 for change in video["moved"]) > len(video["moved"]) / 2


@pytest.mark.parametrize(
    ("edits", "words", "expected"),
    [
        ((("num_envs: 4", "num_envs: 64"),), [], 16),
        ((("num_envs: 4", "num_envs: 8"),), [], 8),
        ((("num_envs: 4", "num_envs: 64"), ("agents:", "play: {scene: {num_envs: 24}}\nagents:")), [], 24),
        ((), ["scene.num_envs=32"], 32),
    ],
)
def test_usual_number_of_environments_yields_to_the_users(small, edits, words, expected, monkeypatch, here):
    from rlcli.evaluation.session import PolicyRequest, find_policy

    monkeypatch.chdir(here)
    request = PolicyRequest(small(*edits), words, policy="zero", usual_envs=16)
    assert find_policy(request).resolved.task.scene.num_envs == expected


@pytest.mark.slow
def test_video_continues_after_early_termination(cli):
    play = ("play", "cartpole-direct", "--policy", "random", "--json", "viewer.width=160", "viewer.height=120")
    first = cli(*play, "--video", "first.mp4", "--num-envs", 1).json
    more = cli(*play, "--video", "more.mp4", "--num-envs", 16).json
    assert first["frames"] == first["length"]["mean"] < more["frames"]
    assert read_video("more.mp4")["frames"] == more["frames"]


@pytest.mark.slow
def test_video_ends_after_its_seconds(cli):
    play = ("play", "cartpole", "--policy", "zero", "--json", "viewer.width=160", "viewer.height=120", "--num-envs", 1)
    assert cli(*play, "--video", "x.gif", "--seconds", 0.5).json["frames"] == 10
    assert cli("play", "cartpole", "--policy", "zero", "--viewer", "none", "--seconds", 1).code == 2


@pytest.mark.slow
def test_gif_plays_in_real_time(cli, trained):
    result = cli("play", "cartpole", "--video", "x.gif", "--num-envs", 1, "--json").json
    assert result["fps"] == pytest.approx(20)
    assert result["frames"] == -(-int(result["length"]["mean"]) // 3)
    assert read_video("x.gif")["frames"] == result["frames"]


@pytest.mark.parametrize("name", ["x.avi", "x", "x.mp4/"])
def test_unknown_video_format_fails_before_heavy_imports(start, name):
    code = (
        "import sys; from rlcli.cli.app import main\n"
        f"code = main(['play', 'cartpole', '--policy', 'zero', '--video', {name + '.txt'!r}])\n"
        "print(code, [m for m in ('torch', 'mujoco') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.strip() == "2 []"
    assert "is not a video file" in result.stderr


def test_video_without_gl_is_machine_error(cli, trained, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    done = cli("play", "cartpole", "--video", "x.mp4")
    assert done.code == 10
    assert "MUJOCO_GL=disable" in done.err
    assert not list(Path().glob("*x*"))


def test_missing_imageio_is_dependency_error(cli, monkeypatch):
    import importlib.util

    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *a: None if n.startswith("imageio") else real(n, *a))
    done = cli("play", "cartpole", "--policy", "zero", "--video", "x.mp4")
    assert done.code == 7
    assert '"rlcli[video]"' in done.err


# --- a run is self-contained ---


def test_run_keeps_its_configuration_when_task_changes(cli, coin):
    assert cli("train", coin, "params.chance=0.0", *SMALL, "--max-iterations", 1).code == 0
    file = Path("coin/task.yaml")
    file.write_text(file.read_text().replace("chance: 0.5", "chance: 1.0").replace("1.0\nsim", "0.5\nsim"))
    assert cli("eval", "./coin", "--policy", "zero", "--episodes", 4, "--json").json["success"]["rate"] == 0.0
    result = cli("eval", "./coin", "--episodes", 4, "--json").json
    assert result["success"]["rate"] == 1.0
    assert result["length"]["mean"] == 100
    assert (
        cli("eval", "--checkpoint", "latest", "params.chance=1.0", "--episodes", 4, "--json").json["success"]["rate"]
        == 0.0
    )


def test_run_with_missing_task_folder_names_it(cli, coin):
    cli("train", coin, *SMALL, "--max-iterations", 1)
    Path("elsewhere").mkdir()
    Path("coin").rename("elsewhere/coin")
    done = cli("eval", "--checkpoint", "latest")
    assert done.code == 4
    (run,) = Path("runs").glob("coin/*")
    assert f"hint: if the task was moved, name its new place: rlcli eval PATH/coin --checkpoint {run}" in done.err
    assert cli("eval", "elsewhere/coin", "--checkpoint", run, "--episodes", 2).code == 0


def test_run_with_missing_distribution_names_it(cli, trained):
    record = json.loads((trained / "run.json").read_text())
    record["task"] |= {"distribution": "robot-tasks", "version": "2.5"}
    (trained / "run.json").write_text(json.dumps(record))
    done = cli("eval", "--checkpoint", trained)
    assert done.code == 4
    assert "install robot-tasks 2.5" in done.err


def test_run_of_a_package_is_played_with_the_folder_of_the_task(cli, coin):
    cli("train", coin, *SMALL, "--max-iterations", 1)
    (run,) = Path("runs").glob("coin/*")
    record = json.loads((run / "run.json").read_text())
    record["task"] |= {"name": "my-coin", "distribution": "robot-tasks", "version": "2.5", "folder": None}
    (run / "run.json").write_text(json.dumps(record))
    Path("coin").rename("my_coin")
    done = cli("eval", "--checkpoint", run)
    assert done.code == 4
    assert "or name the task's folder: rlcli play FOLDER --checkpoint" in done.err
    assert cli("eval", "./my_coin", "--checkpoint", run, "--episodes", 2).code == 0
    Path("my_coin").rename("other")
    done = cli("eval", "./other", "--checkpoint", run)
    assert done.code == 2
    assert "is a run of my-coin, not of other" in done.err


@pytest.mark.parametrize("command", [("eval", "--checkpoint"), ("train", "--max-iterations", "3", "--resume")])
def test_changed_observation_layout_is_printed_by_field(cli, trained, command):
    file = trained / "config.yaml"
    file.write_text(file.read_text().replace("joint_vel_rel:\n", "velocity:\n", 1))
    done = cli(*command, trained)
    assert done.code == 5
    (row,) = [line for line in done.err.splitlines() if "observations.policy[1]" in line]
    assert row.index("joint_vel_rel (2: slider_to_cart, cart_to_pole)") < row.index("velocity (2")
    assert "policy[0]" not in done.err


def test_corrupt_policy_names_file(cli, trained):
    file = trained / "checkpoints/000000000128/policy.safetensors"
    file.write_bytes(file.read_bytes()[:-5])
    done = cli("eval", "--checkpoint", f"{trained}@step:128")
    assert done.code == 5
    assert "policy.safetensors is corrupt" in done.err
    assert cli("eval", "--checkpoint", f"{trained}@step:0", "--episodes", 2, "-q").code == 0
