"""Progress of long commands: the text of a line, lines in a pipe, and silence with --quiet."""

import re
import subprocess
import sys
import time

import pytest

from rlcli.cli.ui.progress_view import work_line
from rlcli.progress import Work, _running, track

SHORT_WAITS = """
import sys
from rlcli.cli.ui import progress_view
progress_view._WORK_LINE_EVERY_S = 0.2
from rlcli.cli.app import main
sys.exit(main(sys.argv[1:]))
"""


def test_line_has_what_how_far_and_time_left():
    now = time.monotonic()
    command, batches, episodes = (
        Work("rlcli stress", begin=now - 20.0),
        Work("batches", 4, 1, begin=now - 15.0),
        Work("episodes", 100, 20, share=0.5, begin=now - 5.0),
    )
    assert work_line([command]) == "rlcli stress: 0:20 so far"
    # 1.5 of 4 batches in 15 s: 25 s are left
    assert work_line([command, batches, episodes]) in (
        f"rlcli stress: batches 1/4, episodes 20/100, 38%, 0:{left} left" for left in (24, 25)
    )
    assert work_line([]) == ""


def test_percentage_does_not_fall_between_two_parts():
    policies, episodes = Work("policies", 2), Work("episodes", 24, share=0.94)
    assert "policies 0/2, episodes 0/24, 47%" in work_line([policies, episodes])
    assert "policies 0/2, 47%" in work_line([policies])
    policies.advance()
    assert "policies 1/2, 50%" in work_line([policies])
    assert "policies 1/2, episodes 0/24, 50%" in work_line([policies, Work("episodes", 24)])


def test_progress_names_the_subcommand(monkeypatch):
    import typer
    from typer.testing import CliRunner

    from rlcli import progress
    from rlcli.cli.ui.options import add_command

    def body() -> None:
        """Print the name of the running operation."""
        typer.echo(progress._running[0].what)

    monkeypatch.setattr(progress, "view", None)
    app, group = typer.Typer(), typer.Typer()
    add_command(group, "sb3", body)
    add_command(group, "other", body)
    app.add_typer(group, name="import")
    assert CliRunner().invoke(app, ["import", "sb3"], prog_name="rlcli").output == "rlcli import sb3\n"


def test_works_of_threads_run_beside_each_other():
    begin = time.monotonic() - 10.1  # 38.4 s left, which no delay of this test changes to 37
    tasks, trainers = (
        Work(name, total, done, begin=begin, thread=total) for name, total, done in (("t", 20, 3), ("r", 4, 2))
    )
    assert work_line([tasks, trainers]) == "t 3/20, r 2/4, 21%, 0:38 left"
    tasks.done = 0
    assert work_line([tasks, trainers]) == "t 0/20, r 2/4, 8%, 0:10 so far"


def test_time_left_counts_down_and_disappears_when_a_part_takes_longer():
    now = time.monotonic()
    work = Work("checks", 20, 15, begin=now - 30.0, changed=now - 4.0)
    assert work_line([work]) == "checks 15/20, 75%, 0:04 left"  # 26 s / 3 - 4 s
    work.changed = now - 20.0
    assert work_line([work]) == "checks 15/20, 75%, 0:30 so far"
    work.advance()
    assert work.changed >= now


@pytest.mark.slow
def test_sweep_shows_how_many_trials_have_ended(tmp_path):
    short = ["scene.num_envs=16", "agent.torch_threads=1", "--trials", "2", "--max-iterations", "1", "--episodes", "4"]
    command = ["sweep", "cartpole", "--param", "agent.learning_rate=log:1e-4:1e-2", *short]
    done = subprocess.run([sys.executable, "-c", SHORT_WAITS, *command], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert re.search("^rlcli sweep: trials 1/2, 50%, ", done.stderr, re.MULTILINE), done.stderr


def test_work_ends_with_its_context():
    with track("outer"), track("inner", 3) as work:
        work.advance(2)
    assert work.fraction() == pytest.approx(2 / 3)
    assert _running == []


@pytest.mark.parametrize("quiet", [False, True])
def test_lines_in_a_pipe(tmp_path, quiet):
    command = ["check", "cartpole", "--only", "same-seed", *(["-q"] if quiet else [])]
    done = subprocess.run(
        [sys.executable, "-c", SHORT_WAITS, *command], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    lines = [line for line in done.stderr.splitlines() if line.startswith("rlcli check: ")]
    assert bool(lines) is not quiet
    assert "same-seed" in done.stdout
    assert "so far" not in done.stdout
