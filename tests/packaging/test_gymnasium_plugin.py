"""The plugin with Gymnasium's tasks, installed from wheels: its contents, its own tests, its README."""

import json
import os
import shutil
import subprocess
import sys
import zipfile

import pytest
from support.fenced import REPOSITORY, blocks, run_commands
from test_wheels import build, install

PLUGIN = REPOSITORY / "plugins" / "rlcli-gymnasium"
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheels")
    build(REPOSITORY, folder)
    build(PLUGIN, folder)
    return next(folder.glob("rlcli-*.whl")), next(folder.glob("rlcli_gymnasium-*.whl"))


@pytest.fixture(scope="module")
def site(wheels, tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    install(wheels, folder)
    return folder


def python(site, folder, *arguments):
    environment = {**os.environ, "PYTHONPATH": str(site), "PYTHONSAFEPATH": "1"}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=280
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_wheel_has_task_files_and_no_model(wheels):
    with zipfile.ZipFile(wheels[1]) as archive:
        inside = archive.namelist()
    assert len([name for name in inside if name.endswith(".yaml")]) == 11
    assert not [name for name in inside if name.endswith(".xml")]


def test_plugin_tests_pass_against_wheels(site, tmp_path):
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(REPOSITORY / "benchmarks", tmp_path / "benchmarks", ignore=ignored)  # its scores are tested too
    place = tmp_path / "plugins" / PLUGIN.name
    shutil.copytree(PLUGIN / "tests", place / "tests", ignore=ignored)
    shutil.copy(PLUGIN / "pyproject.toml", place)
    used = python(site, place, "-c", "import rlcli, rlcli_gymnasium as g; print(rlcli.__file__, g.__file__)")
    assert used.count(str(site)) == 2
    output = python(site, place, "-m", "pytest", "-p", "no:cacheprovider", "-m", "not slow", "tests")
    assert "passed" in output
    rows = json.loads(python(site, place, "-m", "rlcli", "list-tasks", "--json"))["tasks"]
    assert len([row for row in rows if row["distribution"] == "rlcli-gymnasium"]) == 11


def test_gymnasium_makes_plugin_tasks(site, tmp_path):
    script = "import gymnasium; print(gymnasium.make('rlcli.gym:rlcli/gym-humanoid').action_space.high[0])"
    assert python(site, tmp_path, "-c", script).strip() == "0.4"


def test_readme_commands_run(site, tmp_path):
    folder, own = tmp_path / "rlcli-gymnasium", tmp_path / "site"
    shutil.copytree(PLUGIN, folder, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(site, own)
    for left in own.glob("rlcli_gymnasium*"):
        shutil.rmtree(left)  # the README installs it
    output = run_commands([b for b in blocks(folder / "README.md") if "pytest" not in b.text], folder, site=own)
    assert "gym-hopper" in output
    assert float(output.split("return")[1].split()[0]) >= 950
