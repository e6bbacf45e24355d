"""Tests of the health checks of a training: metrics of real and of sabotaged trainings."""

import json
from pathlib import Path

import pytest
import torch

from rlcli.api import make
from rlcli.cli.app import main
from rlcli.config.load import resolve
from rlcli.registry import find_task
from rlcli.training.health import CHECKS, Health

ITERATIONS = 80
HEALTHY = {
    "Train/mean_reward": lambda i: -2.0 + 0.1 * i,
    "Train/mean_episode_length": lambda i: 100.0 + i,
    "Train/success_rate": lambda i: min(1.0, max(0.0, 0.02 * (i - 20))),
    "Success/pole": lambda i: min(1.0, max(0.0, 0.02 * (i - 10))),
    "Success_Value/pole": lambda i: 2.0 / (1.0 + i),
    "Episode_Termination/time_out": lambda i: min(1.0, 0.02 * i),
    "Episode_Termination/cart_out_of_bounds": lambda i: max(0.0, 1.0 - 0.02 * i),
    "Loss/kl": lambda i: 0.01,
    "Loss/value": lambda i: 1.0,
    "Loss/explained_variance": lambda i: 0.5,
    "Loss/learning_rate": lambda i: 1e-3,
    "Policy/mean_std": lambda i: 1.0 - 0.005 * i,
}
STILL = {"Train/mean_reward": lambda i: -2.0 + 0.01 * (i % 3)}
CONSTANT = ("agent.schedule=constant", "agent.desired_kl=null")
FAILING = {"Train/success_rate": lambda i: 0.0, "Success/pole": lambda i: 0.0}


def findings(changes, *overrides, until=0.25):
    """Return the findings of a training of cartpole with these metrics, after a share of the budget."""
    resolved = resolve(find_task("cartpole"), agent="ppo", overrides=overrides)
    health = Health(resolved.task, resolved.agent, ITERATIONS)
    for iteration in range(1, round(until * ITERATIONS) + 1):
        metrics = {name: value(iteration) for name, value in {**HEALTHY, **changes}.items()}
        health.add(iteration, metrics)
    return {finding.check: finding for finding in health.findings}


def test_note_of_success_says_that_few_episodes_reached_the_time_out():
    resolved = resolve(find_task("cartpole"), agent="ppo")
    health = Health(resolved.task, resolved.agent, ITERATIONS)
    metrics = {"Success/pole": 0.0, "Success_Value/pole": 0.1, "Episode_Termination/time_out": 0.0}
    assert [note.partition("; ")[2] for note in health.notes(metrics)] == ["0.0% of the episodes reached the time-out"]
    assert "; " not in health.notes({**metrics, "Episode_Termination/time_out": 1.0})[0]


def test_termination_of_all_episodes_is_named_if_their_length_stalls_after_a_rise():
    changes = {
        "Train/mean_reward": lambda i: -1.0 if i < 10 else 0.9 + 0.01 * (i % 3),
        "Train/mean_episode_length": lambda i: 20.0 if i < 10 else 55.0 + i % 3,
        "Episode_Termination/time_out": lambda i: 0.0,
        "Episode_Termination/cart_out_of_bounds": lambda i: 1.0,
        **FAILING,
        "Success_Value/pole": lambda i: 1.04,
    }
    found = findings(changes, until=0.6)["one-termination"]
    assert "by 'cart_out_of_bounds' after 56 steps, no later than in the middle of the training" in found.message
    assert "one-termination" not in findings(changes, until=0.4)
    rising = {"Train/mean_episode_length": lambda i: 20.0 + i}
    assert "one-termination" not in findings({**changes, **rising}, until=0.6)
    assert "one-termination" not in findings({**changes, "Train/success_rate": lambda i: 0.01}, until=0.6)


@pytest.mark.parametrize(("time_outs_in", "named"), [(15, False), (2, True)])
def test_termination_of_all_episodes_is_silent_if_some_reached_the_time_out(time_outs_in, named):
    """`cartpole` with `sb3-ppo` and seed 3 learns, although its episodes are as short as at first for 30 iterations."""
    changes = {
        "Train/mean_episode_length": lambda i: 100.0 + i % 3,
        "Episode_Termination/time_out": lambda i: 0.1 * (i == time_outs_in),
        "Episode_Termination/cart_out_of_bounds": lambda i: 1.0 - 0.1 * (i == time_outs_in),
    }
    assert ("one-termination" in findings({**FAILING, **STILL, **changes})) is named


@pytest.mark.parametrize("until", [0.1, 0.25, 0.5, 1.0])
def test_healthy_training_has_no_finding(until):
    assert findings({}, until=until) == {}


@pytest.mark.parametrize(
    ("check", "changes", "figure"),
    [
        ("no-reward", {"Train/mean_reward": lambda i: 0.0}, "is 0 in all"),
        ("short-episodes", {"Train/mean_episode_length": lambda i: 1.0}, "after 1 of 300 steps"),
        ("observations", {"Health/constant/joint_pos_rel": lambda i: 1.0}, "'joint_pos_rel'"),
        ("observations", {"Health/clipped/joint_pos_rel": lambda i: 0.97}, "97%"),
        ("update-size", {"Loss/kl": lambda i: 0.3}, "is 0.3, more than 4 times 0.01"),
        ("update-size", {"Loss/kl": lambda i: 1e-9}, "1e-09"),
        ("exploration", {"Policy/mean_std": lambda i: 1.05**i}, "the bound of actions is 1"),
        ("exploration", {"Policy/mean_std": lambda i: 0.6**i}, "has fallen from"),
        ("dying-pays", {"Train/mean_episode_length": lambda i: 300 / i}, "shrink from 183 to"),
        ("value-function", {"Loss/explained_variance": lambda i: 0.0, **STILL}, "explains 0.00"),
        ("actions-at-bound", {"Health/at_bound": lambda i: 1.0}, "100%"),
    ],
)
def test_check_names_the_cause_within_a_quarter_of_the_budget(check, changes, figure):
    found = findings({**FAILING, **changes})
    assert figure in found[check].message
    assert found[check].hint


def test_training_that_does_not_move_has_findings():
    still = {name: lambda i, name=name: HEALTHY[name](1) + 1e-3 * (i % 3) for name in HEALTHY}
    found = findings({**still, **FAILING, "Episode_Termination/cart_out_of_bounds": lambda i: 1.0})
    assert {"no-progress", "one-termination"} <= {*found}


def test_training_that_lost_its_success_has_moved():
    still = {name: lambda i, name=name: HEALTHY[name](1) + 1e-3 * (i % 3) for name in HEALTHY}
    lost = {**still, **FAILING, "Train/success_rate": lambda i: 0.8 if i < 10 else 0.1}
    assert "no-progress" in findings({**still, **FAILING}, until=0.5)
    assert "no-progress" not in findings(lost, until=0.5)


def test_progress_in_the_first_iterations_counts():
    still = {name: lambda i, name=name: HEALTHY[name](1) + 1e-3 * (i % 3) for name in HEALTHY}
    early = {**still, **FAILING, "Train/mean_reward": lambda i: -9.4 if i < 3 else -0.01}
    assert "no-progress" in findings({**still, **FAILING}, until=0.5)
    assert "no-progress" not in findings(early, until=0.5)


@pytest.mark.parametrize(("every", "named"), [(19, False), (10, True)])
def test_progress_is_unknown_while_few_iterations_end_episodes(every, named):
    """All episodes end by time-out at the same time: 80 iterations have 4 or 8 values of the return."""
    resolved = resolve(find_task("cartpole"), agent="ppo")
    health = Health(resolved.task, resolved.agent, ITERATIONS)
    for iteration in range(1, ITERATIONS + 1):
        metrics = {"Train/mean_reward": 0.01 + 1e-6 * iteration, "Train/mean_episode_length": 300.0}
        ended = {"Episode_Termination/time_out": 1.0} if iteration % every == 0 else {}
        health.add(iteration, {**metrics, **ended})
    assert ("no-progress" in [finding.check for finding in health.findings]) is named


def test_adaptive_learning_rate_at_its_floor_is_found():
    changes = {**FAILING, "Loss/learning_rate": lambda i: 1e-5}
    assert "learning-rate-range" in findings(changes, "agent.schedule=adaptive")
    assert "learning-rate-range" not in findings(changes)


@pytest.mark.parametrize(("rate", "named"), [(1e-7, True), (1e-5, False), (1e-2, False), (0.1, True)])
def test_adaptive_learning_rate_that_begins_outside_its_range_is_found(rate, named):
    found = findings(FAILING, f"agent.learning_rate={rate}")
    assert ("learning-rate-range" in found) is named
    assert "learning-rate-range" not in findings({**FAILING}, f"agent.learning_rate={rate}", *CONSTANT)


def test_condition_that_blocks_success_is_named_with_its_value():
    plateau = {"Train/mean_reward": lambda i: 5.0 - 7.0 * 0.8**i, "Success_Value/pole": lambda i: 0.3}
    found = findings({**FAILING, **plateau}, until=0.5)
    assert "'pole' of success holds in 0.0%" in found["blocked-success"].message
    assert "at most 0.1" in found["blocked-success"].message


@pytest.mark.parametrize(("held_in", "named"), [(2, True), (35, False)])
def test_condition_that_a_random_policy_met_once_is_named(held_in, named):
    """Only the newer half of the 40 iterations counts."""
    plateau = {"Train/mean_reward": lambda i: 5.0 - 7.0 * 0.8**i, "Success_Value/pole": lambda i: 0.3}
    once = {"Success/pole": lambda i: 0.01 * (i == held_in)}
    assert ("blocked-success" in findings({**FAILING, **plateau, **once}, until=0.5)) is named


def test_every_check_is_on_the_page():
    page = (Path(__file__).parents[2] / "docs/guides/training-does-not-learn.md").read_text()
    assert [name for name in CHECKS if f"| `{name}` |" not in page] == []


def test_training_without_rewards_records_and_prints_the_finding(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    weights = [f"rewards.{name}.weight=0" for name in ("alive", "terminating", "pole_pos", "cart_vel", "pole_vel")]
    words = ["--num-envs", "8", "--logger", "none", "--max-iterations", "12", "episode_length_s=0.2"]
    assert main(["train", "cartpole", *weights, *words, "--agent", "sb3-ppo"]) == 0
    (file,) = Path("runs").glob("cartpole/*/run.json")
    assert "no-reward" in [finding["check"] for finding in json.loads(file.read_text())["health"]]
    assert "the return is 0 in all" in capsys.readouterr().err


@pytest.mark.parametrize(("held", "named"), [(lambda i: 0.03, True), (lambda i: 0.03 + 0.005 * i, False)])
def test_rewards_that_lead_away_from_success_are_named(held, named):
    """The return rises, but the pole is upright in as few states as at the beginning."""
    found = findings({**FAILING, "Success_Value/pole": lambda i: 1.6, "Health/held/pole": held})
    assert ("reward-without-success" in found) is named
    if named:
        assert "no more often than at the start: 'pole' in 3.0%" in found["reward-without-success"].message


@pytest.mark.parametrize(("errors", "success", "named"), [(-20.0, 0.0, True), (-20.0, 0.1, False), (2.0, 0.0, False)])
def test_rewards_that_are_lower_in_states_of_success_are_named(errors, success, named):
    gap = {"Health/reward_gap": lambda i: 0.05 * errors, "Health/reward_gap_in_errors": lambda i: errors}
    found = findings({**FAILING, **gap, "Train/success_rate": lambda i: success})
    assert ("reward-against-success" in found) is named


@pytest.mark.parametrize("weight", [1.0, -1.0])
def test_gap_of_rewards_has_the_sign_of_the_weight(weight):
    """The pole is upright in states of success, where the penalty of its angle is small."""
    others = [f"rewards.{name}.weight=0" for name in ("alive", "terminating", "cart_vel", "pole_vel")]
    env = make("cartpole", num_envs=256, overrides=[*others, f"rewards.pole_pos.weight={-weight}"])
    env.reset(seed=3)
    assert env.success_reward_gap() is None
    for _ in range(20):
        env.step(torch.zeros(256, 1))
    gap, error = env.success_reward_gap()
    assert gap * weight > 3.0 * error > 0.0


def test_resumed_run_drops_a_finding_of_iterations_after_its_checkpoint(tmp_path, monkeypatch):
    """A killed training may have recorded findings after its newest checkpoint."""
    monkeypatch.chdir(tmp_path)
    words = ["--num-envs", "8", "--logger", "none", "episode_length_s=0.2"]
    assert main(["train", "cartpole", *words, "--max-iterations", "9", "--agent", "sb3-ppo"]) == 0
    (file,) = Path("runs").glob("cartpole/*/run.json")
    finding = {"check": "no-reward", "iteration": 10, "message": "the return is 0", "hint": "other weights"}
    record = json.loads(file.read_text())
    file.write_text(json.dumps({**record, "state": "running", "health": [finding]}))
    assert main(["train", "--resume", "latest", "--max-iterations", "12"]) == 0
    assert json.loads(file.read_text())["health"] == []


@pytest.mark.parametrize(("peak", "end", "named"), [(0.5, 0.05, True), (0.5, 0.35, False), (0.2, 0.0, False)])
def test_success_that_falls_is_named_with_both_rates(peak, end, named):
    """Success rises until iteration 20, stays for 10 iterations and falls until iteration 40."""
    found = findings({"Train/success_rate": lambda i: _trapezoid(i, peak, end)}, until=0.6)
    assert ("falling-success" in found) is named
    if named:
        assert "has fallen from 50.0% to 5.0%" in found["falling-success"].message


def _trapezoid(iteration, peak, end):
    rise, fall = min(1.0, iteration / 20), min(1.0, max(0.0, (iteration - 30) / 10))
    return peak * rise - (peak - end) * fall


def test_exploration_that_ends_before_the_first_success_is_named():
    plateau = {"Train/mean_reward": lambda i: 2.0 + 0.01 * (i % 3), "Policy/mean_std": lambda i: 0.6 if i < 4 else 0.09}
    found = findings({**FAILING, **plateau}, until=0.5)["exploration"]
    assert "has fallen from 0.6 to 0.09, the return no longer rises, and no episode succeeds" in found.message
    assert "exploration" not in findings({**FAILING, **plateau, "Train/success_rate": lambda i: 0.02}, until=0.5)
    rising = {"Train/mean_reward": HEALTHY["Train/mean_reward"]}
    assert "exploration" not in findings({**FAILING, **plateau, **rising}, until=0.5)


@pytest.mark.parametrize("until", [0.2, 0.25])
def test_bound_that_no_state_reaches(until):
    """The value comes near its bound while the return rises: only the states tell that the bound is out of reach."""
    nearer = {**FAILING, "Success_Value/pole": lambda i: 1.7 * 0.9**i}
    assert findings({**nearer, "Health/held/pole": lambda i: 0.02}, until=until) == {}
    found = findings({**nearer, "Health/held/pole": lambda i: 0.0}, until=until)
    assert "'pole' of success holds in 0.0% of the episodes" in found["blocked-success"].message
    far = {**FAILING, "Success_Value/pole": lambda i: 1.7 - 0.01 * i, "Health/held/pole": lambda i: 0.0}
    assert "blocked-success" not in findings(far, until=until)
    assert "it must be at most 0" in findings(far, "success.pole.at_most=0", until=until)["blocked-success"].message


def test_training_stops_at_a_bar(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = ["--num-envs", "8", "--logger", "none", "--max-iterations", "40", "episode_length_s=0.2"]
    settings = ["agent.eval_interval=2", "agent.eval_episodes=8", "success.pole.at_most=3.2", "success.pole.hold_s=0"]
    assert main(["train", "cartpole", *settings, *words, "--until", "success=0.5"]) == 0
    (file,) = Path("runs").glob("cartpole/*/run.json")
    record = json.loads(file.read_text())
    assert (record["state"], record["iteration"], record["until"]["reached"]) == ("finished", 2, True)
    assert "success=0.5 reached after 256 steps" in capsys.readouterr().err
