"""`rlcli stress`: variants of a task that are simulated together and equal separate evaluations."""

import json
import sys
from pathlib import Path

import pytest

from rlcli.cli.ui.console import console
from rlcli.evaluation.stress_parameters import grid, read_sweeps
from rlcli.reporting.heat_map import heat_map

pytestmark = pytest.mark.usefixtures("empty_folder")

SHORT = ("episode_length_s=0.4",)
LQR = ("cartpole", "--policy", "lqr", "sim.engine_threads=1", "--json")
SMALL = ("scene.num_envs=8", "sim.engine_threads=1", "agent.torch_threads=1", "--logger", "none", "-q")


def of(document, **at):
    """Return the summary of one variant."""
    (found,) = [
        point for point in document["points"] if point["at"] == {k.replace("__", "."): v for k, v in at.items()}
    ]
    return found


def test_nominal_and_factor_1_equal_eval(cli):
    done = cli("stress", *LQR, "--sweep", "body_mass.pole=1,3", "--sweep", "action_delay=0,2", "--episodes", 12)
    message = cli("eval", *LQR, "--episodes", 12, "--num-envs", 12).json
    keys = ("episodes", "return", "length", "success", "reward_terms", "terminations", "diverged")
    numbers = {key: message[key] for key in keys}
    assert {key: done.json["nominal"][key] for key in keys} == numbers
    point = of(done.json, body_mass__pole=1.0, action_delay=0.0)
    assert {key: point[key] for key in keys} == numbers
    others = [point["return"] for point in done.json["points"]]
    assert len({json.dumps(value) for value in others}) == 4  # and every other variant is another one


def test_stochastic_actions_are_equal_in_every_variant(cli, only_run):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    for words in (("cartpole", "--policy", "random"), ("--checkpoint", only_run(), "--stochastic")):
        done = cli("stress", *words, *SHORT, "--sweep", "body_mass.pole=1,8", "--episodes", 6, "--json").json
        message = cli("eval", *words, *SHORT, "--episodes", 6, "--num-envs", 6, "--json").json["return"]
        assert done["nominal"]["return"] == of(done, body_mass__pole=1.0)["return"] == message
        assert of(done, body_mass__pole=8.0)["return"] != message


def test_fewer_envs_than_episodes_equals_eval(cli):
    done = cli("stress", *LQR, *SHORT, "--sweep", "gravity=1,2", "--episodes", 7, "--num-envs", 3).json
    message = cli("eval", *LQR, *SHORT, "--episodes", 7, "--num-envs", 3).json
    assert done["num_envs"] == 3
    words = ("scene.num_envs=3", "--sweep", "gravity=1,2", "--episodes", 7)
    assert cli("stress", *LQR, *SHORT, *words).json["points"] == done["points"]
    assert done["nominal"]["return"] == message["return"]
    assert of(done, gravity=1.0)["return"] == message["return"]


def test_random_task_draws_equal_numbers_in_every_variant(cli, coin):
    arguments = ("stress", coin, "--policy", "zero", "--json", "--episodes", 200)
    done = cli(*arguments, "--sweep", "body_mass=0.5:2", "--sweep", "action_delay=0:2").json
    rates = [done["nominal"]["success"], *(point["success"] for point in done["points"])]
    assert len(done["points"]) == 15
    assert all(rate == rates[0] for rate in rates)
    assert rates[0]["low"] < 0.5 < rates[0]["high"]
    assert 0.4 < rates[0]["rate"] < 0.6


@pytest.mark.slow
def test_success_decreases_with_pole_mass_and_delay(cli):
    sweeps = ("--sweep", "body_mass.pole=1:16:3", "--sweep", "action_delay=0:2")
    done = cli("stress", *LQR, *sweeps, "--episodes", 100).json
    rate = {tuple(point["at"].values()): point["success"] for point in done["points"]}
    assert rate[1.0, 0.0]["rate"] > 0.98
    assert rate[16.0, 2.0]["high"] < rate[1.0, 0.0]["low"]
    for (mass, delay), here in rate.items():
        for heavier, later in ((4 * mass, delay), (mass, delay + 1)):
            if (heavier, later) in rate:
                assert rate[heavier, later]["low"] <= here["high"]


def test_against_lqr_adds_its_results(cli):
    words = ("stress", "cartpole", "--policy", "zero", "--against", "lqr", "--sweep", "gravity=1,1.5", "--episodes", 8)
    done = cli(*words, "sim.engine_threads=1", "--json").json
    assert done["nominal"]["success"]["rate"] == 0.0
    assert done["against"]["policy"] == "lqr"
    assert done["against"]["nominal"]["success"]["rate"] == 1.0
    assert [point["at"] for point in done["against"]["points"]] == [point["at"] for point in done["points"]]
    text = cli(*words, "sim.engine_threads=1").out
    assert "LQR SUCCESS" in text
    assert "success, zero" in text
    assert "success, lqr" in text
    assert "nominal" in text
    assert "worst variant of the grid: gravity" in text


def test_limits_apply_to_the_worst_variant_and_search(cli):
    words = (
        "stress",
        *LQR,
        *SHORT,
        "--sweep",
        "action_delay=0:8:3",
        "--sweep",
        "body_mass.pole=1:2:2",
        "--episodes",
        6,
    )
    done = cli(*words, "--fail-under", "success=0.9")
    assert done.code == 9
    assert done.json["worst"]["success"]["rate"] == 0.0
    assert done.json["worst"]["return"]["mean"] == min(point["return"]["mean"] for point in done.json["points"])
    assert done.json["passed"] is False
    assert done.json["failures"][0].startswith("at action_delay ")
    assert "failed: at action_delay" in done.err
    more = cli(*words, "--worst", 12, "--fail-under", "length=1")
    assert more.code == 0
    assert 6 <= len(more.json["searched"]) <= 12  # what the grid has is not run twice
    assert more.json["points"] == done.json["points"]
    for point in more.json["searched"]:
        assert point["at"]["action_delay"] in range(9)
        assert 1.0 <= point["at"]["body_mass.pole"] <= 2.0
    everything = [*more.json["points"], *more.json["searched"]]
    assert more.json["worst"]["return"]["mean"] == min(
        point["return"]["mean"] for point in everything if point["success"]["rate"] == 0.0
    )


def test_stress_repeats_with_its_seed(cli):
    words = (
        "stress",
        "cartpole",
        "--policy",
        "lqr",
        *SHORT,
        "--sweep",
        "observation_noise=0:0.2:2",
        "--episodes",
        4,
        "--json",
    )
    one, same, other = (cli(*words, "--seed", seed).json["points"] for seed in (1, 1, 2))
    assert one == same != other


def test_task_without_success_uses_the_return(cli, coin):
    words = (
        "stress",
        coin,
        "success.centred=null",
        "--policy",
        "zero",
        "--sweep",
        "gravity=abs:0:1:2",
        "--episodes",
        4,
    )
    done = cli(*words)
    assert done.code == 2  # the task has no gravity, so that it has no direction
    done = cli(*words[:-3], "body_mass=1:2:2", "--episodes", 4)
    assert done.code == 0, done.err
    assert done.out.splitlines()[0].split()[:2] == ["body_mass", "RETURN"]
    assert "SUCCESS" not in done.out
    done = cli(*words[:-3], "body_mass=1:2:2", "--fail-under", "success=0.5")
    assert done.code == 2
    assert "defines no condition of success" in done.err


def test_stress_accepts_run_checkpoint_and_task(cli, only_run):
    cli("train", "cartpole", *SMALL, "--max-iterations", 1)
    run = only_run()
    tail = (*SHORT, "--sweep", "body_mass.pole=1:2:2", "--episodes", 2, "--json")
    words = ((run,), (run.name,), ("latest",), (f"{run}@step:128",), ("cartpole",), ("--checkpoint", run))
    message = [cli("stress", *word, *tail).json for word in words]
    assert {document["checkpoint"] for document in message} == {f"{run}/checkpoints/000000000128"}
    assert all(document["points"] == message[0]["points"] for document in message)
    assert cli("stress", f"{run}@step:0", *tail).json["points"] != message[0]["points"]
    assert not (run / "evaluations").exists()


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ((), 2, "no run, task or checkpoint given"),
        (("cartpole",), 2, "no --sweep given"),
        (("cartpole", "--sweep", "gravity"), 2, "is not NAME=LOW:HIGH"),
        (("cartpole", "--policy", "zero", "--sweep", "gravty=1:2"), 2, "did you mean 'gravity'"),
        (("cartpole", "--policy", "zero", "--sweep", "body_mass.pol=1:2"), 2, "did you mean 'pole'"),
        (("cartpole", "--policy", "zero", "--sweep", "gravity=1:2", "--against", "lqrr"), 2, "did you mean 'lqr'"),
        (("cartpole", "--policy", "zero", "--sweep", "gravity=1:2", "--against", "trained"), 2, "--against trained"),
        (("cartpole", "--sweep", "gravity=1:2", "--fail-under", "succes=1"), 2, "--fail-under"),
        (("cartpole", "--sweep", "gravity=1:2", "-o", "x.jpg"), 2, "is not a picture"),
        (("cartpole", "--sweep", "gravity=1:2", "-o", "nowhere/x.png"), 10, "no folder"),
        (("cartpole", "--sweep", "gravity=1:2:200", "--sweep", "push=0:1:200"), 2, "40,000 variants"),
        (("cartpol", "--sweep", "gravity=1:2"), 4, "did you mean 'cartpole"),
        (("cartpole", "--checkpoint", "latest", "--sweep", "gravity=1:2"), 5, "rlcli train cartpole"),
        (("latest", "--sweep", "gravity=1:2"), 5, "no run"),
        (
            ("ant-direct", "--policy", "lqr", "--sweep", "gravity=1:2"),
            2,
            "an LQR (linear-quadratic regulator) of ant-direct cannot be computed, because",
        ),
    ],
)
def test_stress_usage_errors(cli, words, code, message):
    done = cli("stress", *words)
    assert done.code == code, done.err
    assert message in done.err
    assert json.loads(cli("stress", *words, "--json").out)["error"]["exit_code"] == code
    assert not list(Path().iterdir())


def test_missing_matplotlib_error_has_the_pip_line(cli, monkeypatch):
    import importlib.util

    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *a: None if n == "matplotlib" else real(n, *a))
    done = cli("stress", "cartpole", "--policy", "zero", "--sweep", "gravity=1:2", "-o", "x.png")
    assert done.code == 7
    assert '"rlcli[plot]"' in done.err


@pytest.mark.parametrize("name", ["map.png", "map.svg"])
def test_heat_map_is_written(cli, name):
    words = ("stress", *LQR[:-1], "--sweep", "body_mass.pole=1:2:2", "--sweep", "push.slider_to_cart=0:1:3", *SHORT)
    words += ("--against", "zero", "--episodes", 2)
    done = cli(*words, "-o", name)
    assert done.code == 0, done.err
    assert f"wrote {name}" in done.err
    content = Path(name).read_bytes()
    if name.endswith("svg"):
        text = content.decode()
        for word in ("success, lqr", "success, zero", "body_mass.pole [factor]", "push.slider_to_cart [m/s or rad/s]"):
            assert f"<!-- {word} -->" in text
        assert text.count("<!-- 0.00 -->") >= 6  # zero succeeds in none of the variants
        cli(*words, "-o", "again.svg")
        assert Path("again.svg").read_bytes() == content
    else:
        assert content[:4] == b"\x89PNG"


# --- maps ---


def test_heat_map_of_three_sweeps_shows_the_worst_of_the_third():
    sweeps = read_sweeps(["gravity=1,2", "action_delay=0:2", "push=0,1"], 5)
    values = {at: at[0] + 10 * at[1] - 100 * at[2] for at in grid(sweeps)}
    found = heat_map("success", sweeps, values)
    assert found.rows.values == ("1", "2")
    assert found.columns.values == ("0", "1", "2")
    assert found.cells == ((-99, -89, -79), (-98, -88, -78))
    assert found.title == "success, the worst over push"
    assert (found.share(found.low), found.share(found.high)) == (0.0, 1.0)


def test_heat_map_of_one_sweep_is_a_row():
    sweeps = read_sweeps(["gravity=1,2,3"], 5)
    found = heat_map("success", sweeps, {(1.0,): 0.5, (2.0,): 0.2, (3.0,): 0.9})
    assert (found.rows.values, found.columns.values, found.cells) == (("",), ("1", "2", "3"), ((0.5, 0.2, 0.9),))


def test_heat_map_on_a_terminal_has_colours(capfd, monkeypatch):
    sweeps = read_sweeps(["gravity=1,2"], 5)
    found = heat_map("success", sweeps, {(1.0,): 1.0, (2.0,): 0.0})
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    for name, value in (("FORCE_COLOR", "1"), ("COLORTERM", "truecolor"), ("TERM", "xterm-256color")):
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setattr(console, "json", False)
    console.heat_map("success", "gravity", found)
    text = capfd.readouterr().out
    assert "48;2;0;200;64" in text  # green behind the 1
    assert "48;2;225;0;64" in text  # red behind the 0
