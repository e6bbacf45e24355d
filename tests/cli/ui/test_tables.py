"""Tables fit the width of a terminal: nothing is truncated, and a row that is too wide becomes a block of lines."""

import io
import re
import sys

import pytest

from rlcli.cli.ui.console import console
from rlcli.cli.ui.progress_view import TrainingView, _line
from rlcli.cli.ui.tables import fill
from rlcli.evaluation.stress_parameters import read_sweeps
from rlcli.reporting.heat_map import heat_map
from rlcli.training.progress import progress_from_metrics

COLUMNS = ["RUN", "STATE", "PROGRESS", "RETURN", "SUCCESS", "AGE", "REMARK"]
ROWS = [
    ["cartpole/2026-11-21_17-35-25", "finished", "240/240", "4.934", "100.0%", "1 min", "-"],
    ["cartpole/2026-11-21_17-32-47", "interrupted: resumable", "12/240", "-1.2", "-", "4 min", ""],
]


@pytest.fixture
def terminal(monkeypatch, capsys):
    """Return a function that prints on a terminal of a given width and returns the lines."""

    def shown(width, draw):
        monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
        monkeypatch.setattr(console, "json", False)
        monkeypatch.setenv("COLUMNS", str(width))
        draw()
        return [line.rstrip() for line in re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()]

    return shown


def test_fitting_table_has_one_line_per_row(terminal):
    lines = terminal(120, lambda: console.table(COLUMNS, ROWS))
    assert len(lines) == 3
    assert lines[0].split() == COLUMNS
    assert lines[2].split() == " ".join(ROWS[1]).split()


@pytest.mark.parametrize("width", [80, 40])
def test_wide_table_becomes_blocks_without_truncation(terminal, width):
    lines = terminal(width, lambda: console.table(COLUMNS, ROWS))
    assert max(map(len, lines)) <= width
    output = "\n".join(lines)
    assert "…" not in output
    assert "RUN cartpole/2026-11-21_17-35-25" in lines
    assert "RUN cartpole/2026-11-21_17-32-47" in lines
    for name, cell in zip(COLUMNS[1:6], ROWS[0][1:6], strict=True):
        assert f"{name} {cell}" in output
    assert "STATE interrupted: resumable" in output


def test_empty_cells_are_left_out_of_blocks(terminal):
    lines = terminal(40, lambda: console.table(COLUMNS, ROWS))
    assert sum("SUCCESS" in line for line in lines) == 1
    assert not any("REMARK" in line for line in lines)


def test_long_cells_wrap_at_spaces_and_short_cells_do_not(terminal):
    found = "of four environments that began alike two parted in the third step"
    lines = terminal(60, lambda: console.table(["CHECK", "RESULT"], [["same seed, same life", found]]))
    assert lines[0].split() == ["CHECK", "RESULT"]
    assert len(lines) == 3
    assert lines[1].startswith("same seed, same life  of four")
    assert " ".join(" ".join(lines[1:]).split()) == f"same seed, same life {found}"


@pytest.mark.parametrize(("width", "headers"), [(80, 1), (24, 2)])
def test_wide_heat_map_continues_below(terminal, width, headers):
    sweeps = read_sweeps(["body_mass.pole=0.5,2", "action_delay=0:4"], 5)
    values = {(y, x): 0.11 * x + y / 100 for y in sweeps[0].values for x in sweeps[1].values}
    drawn = heat_map("success", sweeps, values, (0.0, 1.0))
    lines = terminal(width, lambda: console.heat_map("success, trained", "body_mass.pole / action_delay", drawn))
    assert max(map(len, lines)) <= width
    rows = [line.split() for line in lines if line.startswith(("0.5", "2 "))]
    assert len(rows) == 2 * headers
    light = [cell for row in rows if row[0] == "0.5" for cell in row[1:]]
    assert light == [f"{0.11 * x + 0.005:.2f}" for x in range(5)]


def test_flow_keeps_parts_whole_and_in_order():
    assert fill(["iteration 80/240", "655,360 steps", "0:23 left"], 32) == [
        "iteration 80/240  655,360 steps",
        "0:23 left",
    ]
    assert fill(["a" * 9, "b"], 5, indent=2) == ["  " + "a" * 9, "  b"]
    assert fill([], 5) == []


@pytest.mark.parametrize("width", [80, 40])
def test_live_table_keeps_numbers_with_their_units(width):
    from rich.console import Console
    from rich.live import Live

    row = {"iteration": 80, "step": 655360, "Perf/collection_time": 0.1, "Perf/learning_time": 0.05}
    view = TrainingView("rlcli train cartpole")
    screen = Console(file=io.StringIO(), width=width)
    view._live = Live(console=screen)
    screen.print(view._table(progress_from_metrics([row], 240)))
    output = screen.file.getvalue()
    for whole in ("rlcli train cartpole", "iteration 80/240", "655,360 steps", "54,613 steps/s", "0:24 left"):
        assert whole in output


def test_remaining_time_is_that_of_recent_iterations():
    """The first iteration compiles; videos, evaluations and checkpoints take time beside rollout and update."""
    parts = {"Perf/collection_time": 0.1, "Perf/learning_time": 0.1}
    rows = [{"iteration": n, "step": 100 * n, **parts} for n in (1, 2, 3)]
    assert progress_from_metrics(rows, 103).remaining_s == pytest.approx(20.0)
    for row, duration in zip(rows, (30.0, 0.3, 0.5), strict=True):
        row["Perf/iteration_time"] = duration
    progress = progress_from_metrics(rows, 103)
    assert (progress.remaining_s, progress.steps_per_s) == (pytest.approx(40.0), pytest.approx(250.0))
    assert progress_from_metrics(rows[:1], 103).remaining_s == pytest.approx(102 * 30.0)


def _rows(ended):
    """Return rows of a training; in each, `ended` says whether episodes have ended in the iteration."""
    rows = []
    for number, has_ended in enumerate(ended, 1):
        row = {"iteration": number, "step": 100 * number, "Perf/collection_time": 0.1}
        if any(ended[:number]):
            row |= {"Train/mean_reward": -2.151, "Train/mean_episode_length": 109.0, "Train/success_rate": 0.0}
        rows.append(row | ({"Episode_Termination/tilted": 1.0} if has_ended else {}))
    return rows


@pytest.mark.parametrize(
    ("ended", "note"),
    [
        ([False, False], "no episode has ended yet"),
        ([False, True], ""),
        ([True, False], "no episode ended for 1 iteration, so the figures are of older episodes"),
        ([True] + [False] * 15, "no episode ended for 15 iterations, so the figures are of older episodes"),
        ([True, False, False, True], ""),
    ],
)
def test_line_of_a_training_says_how_old_its_figures_are(ended, note):
    from rich.console import Console
    from rich.live import Live

    progress = progress_from_metrics(_rows(ended), 40)
    assert progress.no_episode == note
    assert ("(no episode" in _line(progress)) is bool(note)
    view, screen = TrainingView("rlcli train go1"), Console(file=io.StringIO(), width=120)
    view._live = Live(console=screen)
    screen.print(view._table(progress))
    assert note in screen.file.getvalue()


def test_age_of_figures_beyond_the_known_rows_is_a_lower_bound():
    progress = progress_from_metrics(_rows([True, False, False, False])[2:], 40)
    assert progress.no_episode == "no episode ended for at least 2 iterations, so the figures are of older episodes"


def test_time_left_of_a_training_with_a_threshold_is_an_upper_bound():
    progress = progress_from_metrics(_rows([True, True]), 40)
    assert not _line(progress).endswith("at most 0:03 left")
    progress.may_end_earlier = True
    assert _line(progress).endswith("at most 0:03 left")
