"""`rlcli eval --compare`: policies in the same episodes."""

import json
import shutil

import pytest

from rlcli.registry import find_task

pytestmark = pytest.mark.usefixtures("empty_folder")

SMALL = ("scene.num_envs=8", "sim.engine_threads=1", "agent.torch_threads=1", "--logger", "none", "-q")


TRAINED = {
    "cartpole": ("cartpole",),
    "changed": ("cartpole", "rewards.alive.weight=3.0", "episode_length_s=2.0"),
    "other": ("cartpole", "--num-envs", 4, "viewer.width=64"),
    "direct": ("cartpole-direct",),
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """trained(name) -> the folder of a run, which is trained only once."""
    from rlcli.cli.app import main

    folder, runs = tmp_path_factory.mktemp("compared"), {}

    def find(name):
        if name not in runs:
            words = [*TRAINED[name], *SMALL, "--max-iterations", 1, "--runs-dir", folder / name]
            assert main(["train", *map(str, words)]) == 0
            (runs[name],) = (folder / name).glob("*/*")
        return runs[name]

    return find


def test_compare_a_policy_with_itself_finds_no_difference(cli, trained):
    run = trained("cartpole")
    done = cli("eval", "--compare", run, run, "--episodes", 20, "--json").json
    one, same = done["policies"]
    assert {**one, "name": ""} == {**same, "name": ""}
    (compared,) = done["comparisons"]
    for metric in ("success", "return", "length"):
        assert compared[metric]["difference"] == {"mean": 0.0, "low": 0.0, "high": 0.0}
        assert compared[metric]["improvement"] == {"probability": 0.5, "low": 0.5, "high": 0.5}


def test_compare_has_the_numbers_of_eval(cli, trained):
    run = trained("cartpole")
    done = cli("eval", "--compare", run, f"{run}@step:0", "lqr", "--episodes", 10, "--json").json
    assert [policy["policy"] for policy in done["policies"]] == ["trained", "trained", "lqr"]
    keys = ("episodes", "success", "return", "length", "reward_terms", "terminations")
    alone = [
        cli("eval", "--checkpoint", run, "--episodes", 10, "--num-envs", 10, "--json").json,
        cli("eval", "--checkpoint", f"{run}@step:0", "--episodes", 10, "--num-envs", 10, "--json").json,
        cli("eval", "cartpole", "--policy", "lqr", "--episodes", 10, "--num-envs", 10, "--json").json,
    ]
    for policy, message in zip(done["policies"], alone, strict=True):
        assert {key: policy[key] for key in keys} == {key: message[key] for key in keys}
    versus_lqr = done["comparisons"][1]
    assert (versus_lqr["left"], versus_lqr["right"]) == (str(run), "lqr")
    assert versus_lqr["return"]["improvement"]["probability"] < 0.2
    gap = versus_lqr["return"]["difference"]
    assert gap["low"] < gap["mean"] < gap["high"] < 0
    means = [policy["return"]["mean"] for policy in done["policies"]]
    assert gap["mean"] == pytest.approx(means[0] - means[2])


def test_compare_uses_the_same_random_numbers(cli, coin, only_run):
    cli("train", coin, *SMALL, "--max-iterations", 1)
    run = only_run()
    done = cli("eval", "--compare", run, "zero", "--episodes", 100, "--json").json
    assert 0.35 < done["policies"][0]["success"]["rate"] < 0.65
    assert done["comparisons"][0]["return"]["difference"]["mean"] == 0.0
    assert done["comparisons"][0]["success"]["improvement"]["probability"] == 0.5


def test_compare_prints_a_table(cli, trained):
    run = trained("cartpole")
    done = cli("eval", "--compare", run, "zero", "--episodes", 4, "episode_length_s=0.5")
    assert done.code == 0, done.err
    first, *_ = done.out.splitlines()
    assert (
        first
        == "cartpole: the same 4 episodes for each, seed 42; at most 30 steps of 0.0166667 s, episode_length_s=0.5"
    )
    assert "P(IMPROVEMENT)" in done.out
    assert f"return: {run.name} - zero" in done.out


def test_compare_refuses_tasks_with_different_settings(cli, trained):
    one, other = trained("cartpole"), trained("changed")
    done = cli("eval", "--compare", one, other)
    assert done.code == 3
    assert "episode_length_s: the value is 2.0 here, but 5.0 in" in done.err
    assert "rewards.alive.weight: the value is 3.0" in done.err
    assert done.err.count("error: ") == 2
    problems = json.loads(cli("eval", "--compare", one, other, "--json").out)["error"]["problems"]
    assert [problem["path"] for problem in problems] == ["episode_length_s", "rewards.alive.weight"]
    alike = ("rewards.alive.weight=1.0", "episode_length_s=1.0")
    assert cli("eval", "--compare", one, other, *alike, "--episodes", 2).code == 0


def test_compare_ignores_num_envs_of_the_training(cli, trained):
    one, other = trained("cartpole"), trained("other")
    assert cli("eval", "--compare", one, other, "--episodes", 2).code == 0


def test_compare_refuses_different_tasks(cli, trained):
    one, other = trained("cartpole"), trained("direct")
    done = cli("eval", "--compare", one, other)
    assert done.code == 2
    assert "compare policies of one task" in done.err
    assert "for cartpole-direct" in done.err


def test_compare_names_the_origin_of_different_tasks_with_the_same_name(cli, trained, tmp_path):
    folder = tmp_path / "copy" / "cartpole"
    shutil.copytree(find_task("cartpole").root, folder, ignore=shutil.ignore_patterns("*.py"))
    assert cli("train", folder, *SMALL, "--max-iterations", 1, "--runs-dir", tmp_path / "runs").code == 0
    (run,) = (tmp_path / "runs").glob("*/*")
    done = cli("eval", "--compare", trained("cartpole"), run)
    assert done.code == 2
    assert f"is for cartpole ({find_task('cartpole').distribution})" in done.err
    assert f"for cartpole ({folder})" in done.err


def test_limits_apply_to_the_first_policy(cli, trained):
    run = trained("cartpole")
    words = ("eval", "--compare", run, "lqr", "--episodes", 6, "--json")
    done = cli(*words, "--fail-under", "success=0.9")
    assert done.code == 9
    assert done.json["failures"]
    assert cli("eval", "--compare", "lqr", run, "--episodes", 6, "--fail-under", "success=0.9").code == 0


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ((), 2, "--compare needs at least two policies, found: (none)"),
        (("nowhere",), 2, "--compare needs at least two policies, found: nowhere"),
        (("lqr", "zero"), 2, "--compare needs at least one run"),
        (("nowhere", "zero"), 5, "no run 'nowhere'"),
        (("a", "b", "--checkpoint", "c"), 2, "--compare cannot be combined with"),
        (("a", "b", "--policy", "zero"), 2, "--compare cannot be combined with"),
        (("a", "b", "--record", "x.safetensors"), 2, "--compare cannot be combined with"),
    ],
)
def test_compare_usage_errors(cli, words, code, message):
    done = cli("eval", "--compare", *words)
    assert done.code == code, done.err
    assert message in done.err
