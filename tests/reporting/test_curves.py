"""Learning curves: reading of runs, grouping by settings, and statistics over seeds."""

import json
import os

import numpy as np
import pytest
from support.written_runs import learning, write_metrics, write_run

from rlcli.errors import CheckpointError, UsageError
from rlcli.reporting.curve_panels import choose
from rlcli.reporting.curves import align, gather, interval, iqm, read_history
from rlcli.reporting.matplotlib_plots import _legend_text


def column(*values):
    return np.array(values, dtype=float)[:, None]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([3.0], 3.0),
        ([1.0, 2.0, 6.0], 3.0),  # a quarter of three is none: their mean
        ([0.0, 1.0, 2.0, 100.0], 1.5),
        ([-50.0, 1.0, 2.0, 3.0, 90.0], 2.0),
        ([9.0, 1.0, 8.0, 2.0, 3.0, 4.0, 5.0, -100.0], 3.5),  # 2, 3, 4, 5 are left
    ],
)
def test_iqm_cuts_quarter_at_each_end(values, expected):
    assert iqm(column(*values))[0] == pytest.approx(expected)


def test_interval_is_percentile_bootstrap_over_runs():
    values = column(1.0, 2.0, 3.0, 4.0, 10.0)
    low, high = interval(values)
    means = sorted(iqm(values[np.array(p)])[0] for p in np.ndindex(5, 5, 5, 5, 5))  # every resample there is
    exact = np.percentile(means, [2.5, 97.5])
    assert low[0] == pytest.approx(exact[0], abs=0.35)
    assert high[0] == pytest.approx(exact[1], abs=0.35)
    assert low[0] < iqm(values)[0] < high[0]


def test_interval_coverage_is_near_nominal():
    draws = np.random.default_rng(1).normal(5.0, 1.0, (10, 400))  # 400 experiments of ten seeds
    low, high = interval(draws)
    assert 0.84 < np.mean((low < 5.0) & (high > 5.0)) < 0.98  # of few seeds a percentile bootstrap is a little narrow


def test_interval_is_independent_of_number_of_points():
    values = np.random.default_rng(0).normal(size=(5, 900))
    low, high = interval(values)
    again, _ = interval(values[:, :1])
    assert np.array_equal(interval(values)[0], low)
    assert again[0] == low[0]
    assert np.all(low <= high)


def test_align_uses_common_range():
    x, values = align([(np.array([0.0, 10.0, 20.0]), np.array([0.0, 1.0, 2.0])), (np.array([5.0, 15.0]), np.zeros(2))])
    assert x.tolist() == [5.0, 10.0, 15.0]
    assert values[0].tolist() == [0.5, 1.0, 1.5]
    assert align([(np.array([0.0, 1.0]), np.zeros(2)), (np.array([2.0, 3.0]), np.zeros(2))]) is None


def test_read_history_has_all_axes(tmp_path):
    history = read_history(write_run(tmp_path, rows=learning(3)))
    assert history.axes["steps"].tolist() == [100, 200, 300]
    assert history.axes["iterations"].tolist() == [1, 2, 3]
    assert history.axes["time"].tolist() == [2, 4, 6]
    assert history.metrics["Train/mean_reward"].tolist() == [1, 2, 3]


def test_missing_metric_in_iteration_is_skipped(tmp_path):
    rows = [(1, 10, {}), (2, 20, {"Train/mean_reward": 5.0}), (3, 30, {}), (4, 40, {"Train/mean_reward": 7.0})]
    (curve,), _ = gather([write_run(tmp_path, rows=rows)])
    line = curve.line("Train/mean_reward")
    assert (line.x.tolist(), line.middle.tolist()) == ([20, 40], [5, 7])


@pytest.mark.parametrize(
    "line",
    [
        "not json",
        "[1, 2]",
        '{"iteration": 3}',
        '{"iteration": "3", "step": 300}',
        '{"iteration": 3, "step": 1' + "0" * 40 + "}",
        '{"iteration": 3, "step": 50}',
        '{"iteration": 2, "step": 300}',
        '{"iteration": 3, "step": 300, "Train/mean_reward": 1',
        '{"iteration": 3, "step": ' + "9" * 5000 + "}",
        "[" * 100_000,
    ],
)
def test_rows_before_corrupt_line_are_read_with_a_warning(tmp_path, line, caplog):
    run = write_run(tmp_path, rows=learning(2))
    with run.metrics.open("a") as file:
        file.write(line + "\n" + json.dumps({"iteration": 4, "step": 400}) + "\n")
    assert read_history(run).axes["steps"].tolist() == [100, 200]
    assert "the rows from there on are left out" in caplog.text


def test_non_numeric_values_are_not_metrics(tmp_path):
    odd = {"text": "x", "yes": True, "list": [1], "huge": 10**400, "none": None}
    run = write_run(tmp_path, rows=[(1, 10, {"Loss/value": 1.0, **odd})])
    with run.metrics.open("a") as file:
        file.write('{"iteration": 2, "step": 20, "Loss/value": Infinity, "nan": NaN}\n')
    assert list(read_history(run).metrics) == ["Loss/value"]


def test_run_without_metrics_is_rejected_by_name(tmp_path):
    run = write_run(tmp_path)
    with pytest.raises(CheckpointError, match=f"{run.folder.name} has no metrics yet"):
        gather([run])
    run.metrics.unlink()
    with pytest.raises(CheckpointError, match="has no metrics yet"):
        read_history(run)


def test_runs_with_different_seeds_are_one_curve(tmp_path):
    runs = [write_run(tmp_path, seed=seed, rows=learning(scale=seed)) for seed in (1, 2, 3, 4)]
    (curve,), notes = gather(runs)
    assert (curve.label, curve.seeds, notes) == ("cartpole, sb3-ppo (4 seeds)", [1, 2, 3, 4], [])
    line = curve.line("Train/mean_reward")
    assert line.middle.tolist() == pytest.approx([2.5 * i for i in range(1, 11)])
    assert np.all((line.low < line.middle) & (line.middle < line.high))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"overrides": ["rewards.cart_vel.weight=-0.5"]}, "cart_vel.weight=-0.5"),
        ({"overrides": ["agent.gamma=0.5"]}, "sb3-ppo.gamma=0.5"),
        ({"agent": "sac"}, "sac"),
        ({"task": "cartpole-direct"}, "cartpole-direct"),
        ({"sources": {"task.py": "changed"}}, "source of task.py=changed"),
        ({"init_from_sha256": "ab"}, "init_from=ab"),
        ({"device": "cuda:0"}, "device=cuda"),
    ],
)
def test_runs_with_different_settings_are_separate_curves(tmp_path, change, message):
    curves, _ = gather([write_run(tmp_path, rows=learning()), write_run(tmp_path, seed=2, rows=learning(), **change)])
    one, other = (curve.label for curve in curves)
    assert message in other
    assert message not in one


def test_label_names_three_settings(tmp_path):
    terms = ("alive", "terminating", "pole_pos", "cart_vel")
    runs = [
        write_run(
            tmp_path, overrides=[f"rewards.{term}.weight={n}" for term in terms], sources={"a": n}, rows=learning()
        )
        for n in (2, 3)
    ]
    labels = [curve.label for curve in gather(runs)[0]]
    assert all("and 2 more" in label for label in labels)
    assert len(set(labels)) == 2


def test_label_in_a_legend_has_several_lines_instead_of_being_cut():
    setting = "agents.ppo.learning_rate=0.0013159490962126022, "
    labels = [setting * 2 + f"rewards.alive.weight={weight}" for weight in (1, 2)]
    lines = [_legend_text(label).split("\n") for label in labels]
    assert [" ".join(each) for each in lines] == labels
    assert max(len(line) for each in lines for line in each) <= 64
    assert _legend_text("x" * 300).endswith("…")


def test_duplicate_seed_is_dropped_and_short_run_noted(tmp_path):
    runs = [
        write_run(tmp_path, seed=1, rows=learning(10, scale=5.0)),
        write_run(tmp_path, seed=1, rows=learning(10)),
        write_run(tmp_path, seed=2, rows=learning(4)),
    ]
    (curve,), notes = gather([*runs, runs[2]])
    assert curve.seeds == [1, 2]
    assert curve.line("Train/mean_reward").middle.tolist() == [1, 2, 3, 4]
    assert any(str(runs[0].folder) in note and "left out" in note for note in notes)
    assert any(str(runs[2].folder) in note and "ends at step 400" in note for note in notes)


def test_different_step_counts_are_interpolated(tmp_path):
    runs = [
        write_run(tmp_path, seed=1, rows=learning(4, steps=100, scale=1.0)),
        write_run(tmp_path, seed=2, rows=learning(8, steps=50, scale=0.5)),
    ]
    (curve,), _ = gather(runs)
    line = curve.line("Train/mean_reward")
    assert line.x.tolist() == [100, 150, 200, 250, 300, 350, 400]
    assert line.middle == pytest.approx(line.x / 100)


def test_unreadable_run_is_left_out_with_note(tmp_path):
    good, empty, broken = write_run(tmp_path, rows=learning()), write_run(tmp_path), write_run(tmp_path, config="a: [")
    (curve,), notes = gather([good, empty, broken])
    assert [h.run.folder for h in curve.histories] == [good.folder]
    assert len(notes) == 2
    with pytest.raises(CheckpointError, match=r"config.yaml:1:\d+ is corrupt"):
        gather([broken])


def test_fifo_as_configuration_does_not_block(tmp_path):
    run = write_run(tmp_path, rows=learning())
    run.config.unlink()
    os.mkfifo(run.config)
    with pytest.raises(CheckpointError, match="not a regular file"):
        gather([run])


def test_default_panels_of_one_curve(tmp_path):
    curves, _ = gather([write_run(tmp_path, rows=learning())])
    panels = choose(curves)
    assert [panel.title for panel in panels] == [
        "Return", "Success", "Episode length", "Reward terms", "Why episodes ended",
    ]  # fmt: skip
    assert [item.label for item in panels[3].items] == ["alive", "effort"]
    assert panels[4].stacked


def test_success_of_evaluations_has_its_own_panel(tmp_path):
    curves, _ = gather([write_run(tmp_path, rows=learning(**{"Eval/success_rate": 0.97}))])
    titles = [panel.title for panel in choose(curves)]
    assert titles[1:3] == ["Success", "Success in evaluations"]
    assert [panel.title for panel in choose(curves, ["success"])] == ["Success", "Success in evaluations"]
    assert choose(curves)[2].items[0].line.middle == pytest.approx(0.97)


def test_panels_of_several_curves(tmp_path):
    runs = [write_run(tmp_path, rows=learning()), write_run(tmp_path, agent="sac", rows=learning())]
    panels = choose(gather(runs)[0])
    assert [len(panel.items) for panel in panels[:5]] == [2] * 5
    assert [panel.subtitle for panel in panels if panel.stacked] == [
        "sb3-ppo, scene.num_envs=512", "sac, scene.num_envs=256",
    ]  # fmt: skip


def test_metrics_are_selected_by_name_short_name_and_group(tmp_path):
    curves, _ = gather([write_run(tmp_path, rows=learning(**{"Loss/kl": 1.0}))])
    titles = [panel.title for panel in choose(curves, ["success", "Episode_Reward/alive", "Loss"])]
    assert titles == ["Success", "Reward: alive", "Loss/value", "Loss/kl"]


@pytest.mark.parametrize(
    ("name", "near"), [("retrun", "'return'"), ("alvie", "'Episode_Reward/alive'"), ("loss/value", "'Loss/value'")]
)
def test_unknown_metric_error_lists_valid_names(tmp_path, name, near):
    curves, _ = gather([write_run(tmp_path, rows=learning())])
    with pytest.raises(UsageError) as caught:
        choose(curves, [name])
    assert near in caught.value.hint
    assert all(known in caught.value.hint for known in ("terminations", "Loss/value", "Episode_Reward/effort"))


def test_run_without_ended_episode_has_no_default_panels(tmp_path):
    run = write_run(tmp_path)
    write_metrics(run, [(1, 10, {"Loss/value": 1.0})])
    assert choose(gather([run])[0]) == []
