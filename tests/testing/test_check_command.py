"""`rlcli check` and the pytest fixture, partly in separate processes."""

import json
import os
import subprocess
import sys

import pytest

from rlcli.cli.app import main
from rlcli.errors import pip_install


def check(capsys, *arguments):
    """Run `rlcli check`; return (exit code, stdout, stderr)."""
    code = main(["check", *map(str, arguments)])
    return code, *capsys.readouterr()


def test_correct_task_prints_table_and_exits_0(managed, capsys):
    code, out, err = check(capsys, managed.write(), "--quiet")  # without progress, on a slow machine
    assert code == 0
    assert out.splitlines()[0].split() == ["CHECK", "RESULT"]
    assert "partial-reset         ok" in out
    assert out.splitlines()[-1].endswith("0 errors, 0 warnings")
    assert err == ""


def test_errors_exit_9_and_print_hints(managed, capsys):
    managed.config["terminations"] = {}
    code, out, _ = check(capsys, managed.write())
    assert code == 9
    assert "truncation            error" in out
    assert "error: truncation: episode_length_s of 6 steps: episodes continue after step 6" in out
    assert "time_out: true" in out


def test_warnings_alone_exit_0(direct, capsys):
    direct.replace("self.obs_buf[:, 0].abs() > 3.0", "self.progress_buf >= 40")
    code, out, _ = check(capsys, direct.write())
    assert code == 0
    assert "termination              warning" in out
    assert out.splitlines()[-1].endswith("0 errors, 1 warning")


def test_num_envs_finds_a_defect_of_the_tenth_environment(direct, capsys):
    direct.replace(
        "self.obs_buf[:, 0].abs() > 3.0", "self.obs_buf[:, 0].abs() > 3.0\n        self.obs_buf[9:] = float('nan')"
    )
    folder, only = direct.write(), ("--only", "finite")
    assert check(capsys, folder, *only)[0] == 0
    code, out, _ = check(capsys, folder, *only, "--num-envs", "10")
    assert (code, "in 1 of 10 environments, first in environment 9" in out) == (9, True), out


def test_seed_changes_start_states_and_actions(managed, capsys):
    from rlcli.testing.task_under_test import open_task

    folder = managed.write()
    first, again, other = (
        open_task(folder, None, (), None, 8, seed).recording().obs[5]["policy"] for seed in (3, 3, 4)
    )
    assert (first == again).all()
    assert (first != other).any()
    assert check(capsys, folder, "--seed", "4")[0] == 0


@pytest.mark.parametrize("command", ["check", "lint"])
def test_fewer_than_eight_environments_are_refused(managed, capsys, command):
    code = main([command, str(managed.write()), "--num-envs", "7"])
    assert (code, "7 environments are too few" in capsys.readouterr().err) == (2, True)


def test_json_document_has_checks_and_findings(managed, capsys):
    managed.config["events"]["start"]["position"] = [0.0, 0.0]
    code, out, _ = check(capsys, managed.write(), "--json")
    document = json.loads(out)
    assert code == 9
    assert document["passed"] is False
    assert {c["name"]: c["result"] for c in document["checks"]}["start-states"] == "error"
    assert {f["where"] for f in document["findings"]} == {"between environments", "between episodes"}
    assert set(document["findings"][0]) == {"check", "severity", "where", "message", "hint"}


def test_unbuildable_task_lists_checks_not_run(managed, capsys):
    managed.config["events"]["start"]["joints"] = ["elbow"]
    code, out, _ = check(capsys, managed.write())
    assert code == 9
    assert "names                 error" in out
    assert "same-seed             not run" in out


def test_only_selects_checks_and_rejects_unknown_names(managed, capsys):
    managed.config["terminations"] = {}
    assert check(capsys, managed.write(), "--only", "start-states", "--only", "names")[0] == 0
    code, _, err = check(capsys, managed.write(), "--only", "truncate")
    assert code == 2
    assert "did you mean 'truncation'?" in err


def test_overrides_are_applied(managed, capsys):
    code, out, _ = check(capsys, managed.write(), "events.start.position=[0.2,0.2]")
    assert code == 9
    assert "start-states" in out


def test_invalid_files_exit_3_with_all_errors(managed, capsys):
    managed.config["decimation"] = -2
    managed.config["rewards"]["upright"]["wieght"] = 1.0
    code, out, err = check(capsys, managed.write())
    assert code == 3
    assert "decimation" in err
    assert "did you mean 'weight'?" in err
    assert out == ""


def test_unknown_task_exits_4(capsys):
    code, _, err = check(capsys, "cartpoel")
    assert code == 4
    assert "did you mean 'cartpole'" in err


def test_import_error_of_task_exits_4(direct, capsys):
    direct.task = "import no_such_module\n" + direct.task.replace("from __future__ import annotations\n", "")
    code, _, err = check(capsys, direct.write())
    assert code == 4
    assert "no_such_module" in err


@pytest.fixture
def plugin_of_the_future(tmp_path):
    """Installed package whose task was written for a newer rlcli."""
    site = tmp_path / "site"
    (site / "future_task").mkdir(parents=True)
    (site / "future_task" / "__init__.py").write_text(
        "from rlcli.task import TaskSpec\nTASK = TaskSpec(package=__name__, summary='Later.', api=99)\n"
    )
    (site / "future_task" / "task.yaml").write_text("this: is not looked at\n")
    info = site / "future_task-3.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: future-task\nVersion: 3.1\n")
    (info / "entry_points.txt").write_text("[rlcli.tasks]\nfuture = future_task:TASK\n")
    return site


def in_process(*arguments, path, cwd):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(path), os.environ.get("PYTHONPATH", "")])}
    return subprocess.run([sys.executable, *arguments], cwd=cwd, env=environment, capture_output=True, text=True)


def test_plugin_for_newer_api_is_rejected(plugin_of_the_future, tmp_path):
    done = in_process("-m", "rlcli", "check", "future", path=plugin_of_the_future, cwd=tmp_path)
    assert done.returncode == 4
    assert "future-task:future" in done.stderr
    assert "needs plugin API 99; this rlcli has 1" in done.stderr
    assert pip_install("--upgrade rlcli") in done.stderr


# --- the pytest plugin ---


def run_pytest(folder, test, *options):
    (folder / "test_contract.py").write_text(test)
    environment = {**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "rlcli.pytest_plugin", "-p", "no:cacheprovider", *options]
    done = subprocess.run([*command, "test_contract.py"], cwd=folder, env=environment, capture_output=True, text=True)
    return done.returncode, done.stdout + done.stderr


THREE_LINES = "def test_the_contract(rlcli_check):\n    rlcli_check('./pendulum')\n"


def test_fixture_passes_correct_task(managed, tmp_path):
    managed.write()
    code, output = run_pytest(tmp_path, THREE_LINES)
    assert code == 0, output
    assert "1 passed" in output


def test_fixture_fails_with_all_errors_without_traceback(managed, tmp_path):
    managed.config["terminations"] = {}
    managed.config["events"]["start"]["position"] = [0.2, 0.2]
    managed.write()
    code, output = run_pytest(tmp_path, THREE_LINES)
    assert code == 1
    assert "task './pendulum' fails `rlcli check`:" in output
    assert "error: truncation:" in output
    assert "error: start-states: between episodes" in output
    assert "pytest_plugin.py" not in output


def test_unused_plugin_imports_nothing_heavy(tmp_path):
    test = (
        "import sys\n\ndef test_nothing_heavy_is_loaded():\n"
        "    assert {'torch', 'mujoco', 'numpy', 'pydantic', 'rlcli.testing'}.isdisjoint(sys.modules)\n"
    )
    code, output = run_pytest(tmp_path, test, "-W", "error")
    assert code == 0, output


@pytest.mark.parametrize(("at_most", "noted"), [(3.2, True), (0.001, False)])
def test_note_names_a_condition_of_success_that_holds_from_the_start(managed, capsys, at_most, noted):
    managed.config["success"] = {"upright": {"func": "joint_error", "joints": ["hinge"], "at_most": at_most}}
    code, out, _ = check(capsys, managed.write(), "--only", "start-states")
    assert code == 0
    note = "note: start-states: success: upright holds already after the first step in all 8 environments"
    assert (note in out) is noted
