"""Profiles of the environment step: every stage and term of a task, with times that add up to the step's."""

import pytest

from rlcli.config.load import resolve
from rlcli.registry import find_task
from rlcli.tuning.step_profile import profile_step


def costs_of(task, *overrides):
    return profile_step(resolve(find_task(task), overrides=["scene.num_envs=128", *overrides]), 0.1)


def test_costs_of_the_stages_add_up_to_the_step():
    costs = costs_of("reach")
    stages = [cost for cost in costs if cost.term is None]
    assert sum(cost.share for cost in stages) == pytest.approx(1.0)
    shares = {cost.section: cost.share for cost in stages}
    assert all(shares[name] > 0 for name in ("physics", "actions", "rewards", "commands", "observations", "resets"))
    for cost in costs:
        whole = next(stage for stage in stages if stage.section == cost.section)
        assert 0.0 <= cost.milliseconds <= whole.milliseconds, cost


def test_every_term_has_a_row():
    task = resolve(find_task("reach")).task
    named = {(cost.section, name) for cost in costs_of("reach") if cost.term for name in cost.term.split(", ")}
    assert {("rewards", name) for name in task.rewards} <= named
    assert {("observations", f"policy.{name}") for name in task.observations["policy"].terms} <= named
    assert {("terminations", name) for name in task.terminations} <= named
    assert ("commands", "ee_pose") in named


def test_hooks_of_a_direct_task_have_rows():
    named = {cost.term for cost in costs_of("cartpole-direct")}
    assert {"get_observations", "calculate_metrics", "is_done", "reset_idx"} <= named
