"""Wheels of rlcli and of a plugin, built and installed together, used from another folder."""

import json
import os
import runpy
import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from email.parser import Parser

import pytest
import yaml
from support.fenced import REPOSITORY, Block, blocks, run_commands, shortened, success_rate, success_rates, write_files
from support.source_copies import copy_sources

import rlcli

ACROBOT = REPOSITORY / "plugins" / "rlcli-example-acrobot"
TRAINERS = ("rlcli-rsl-rl", "rlcli-rl-games")
pytestmark = pytest.mark.slow


def build(source, folder):
    """Build a wheel from a copy of the sources, so that no build files are left in them."""
    copy = folder / "source" / source.name
    copy_sources(source, copy, "tests")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(copy)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def install(wheels, site):
    options = ["-q", "--disable-pip-version-check", "--no-deps", "--no-index", "--target", str(site)]
    subprocess.run([sys.executable, "-m", "pip", "install", *options, *map(str, wheels)], check=True)


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheels")
    build(REPOSITORY, folder)
    build(ACROBOT, folder)
    ours, theirs = sorted(folder.glob("rlcli-*.whl")), sorted(folder.glob("rlcli_example_acrobot-*.whl"))
    assert (len(ours), len(theirs)) == (1, 1)
    return ours[0], theirs[0]


@pytest.fixture(scope="module")
def site(wheels, tmp_path_factory):
    """Folder in which only the two wheels are installed; their dependencies come from this environment."""
    folder = tmp_path_factory.mktemp("site")
    install(wheels, folder)
    return folder


@pytest.fixture
def elsewhere(site, tmp_path):
    """Run a command outside of the repository, with the installed rlcli."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(site),
        "PYTHONSAFEPATH": "1",
        "HOME": str(tmp_path),
        "XDG_CACHE_HOME": str(tmp_path / "cache"),
    }

    def run(*arguments, code=0):
        done = subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=280
        )
        assert done.returncode == code, f"{arguments}: exit {done.returncode}\n{done.stdout}\n{done.stderr}"
        return done

    return run


def test_rlcli_wheel_is_pure_small_and_unpinned(wheels):
    ours = wheels[0]
    assert ours.name.endswith("-py3-none-any.whl")
    with zipfile.ZipFile(ours) as archive:
        sizes = {entry.filename: entry.compress_size for entry in archive.infolist()}
        policies = sum(size for name, size in sizes.items() if "/policies/" in name)
        assert 0 < policies < 20_000_000
        assert sum(sizes.values()) - policies < 1_000_000
        (name,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
        metadata = Parser().parsestr(archive.read(name).decode())
    requirements = metadata.get_all("Requires-Dist")
    assert len(requirements) > 10
    assert [r for r in requirements if "==" in r.partition(";")[0]] == []


def test_rlcli_wheel_has_task_files_and_no_tests(wheels):
    with zipfile.ZipFile(wheels[0]) as archive:
        inside = set(archive.namelist())
    for root, package in ((REPOSITORY / "tasks", "rlcli_tasks"), (REPOSITORY, "rlcli")):
        files = {f.relative_to(root).as_posix() for f in (root / package).rglob("*") if f.is_file()}
        assert {f for f in files if "__pycache__" not in f} <= inside
    assert {"rlcli_tasks/index.json", "rlcli_tasks/cartpole/task.yaml", "rlcli_tasks/cartpole/cartpole.xml"} <= inside
    with zipfile.ZipFile(wheels[0]) as archive:
        assert archive.read("rlcli/constraints.txt") == (REPOSITORY / "constraints.txt").read_bytes()
    assert {name.split("/")[0] for name in inside} == {"rlcli", "rlcli_tasks", f"rlcli-{rlcli.__version__}.dist-info"}


def test_plugin_wheel_has_task_and_requires_rlcli(wheels):
    with zipfile.ZipFile(wheels[1]) as archive:
        inside = archive.namelist()
        metadata = archive.read(next(n for n in inside if n.endswith("METADATA"))).decode()
    assert {f"rlcli_example_acrobot/{n}" for n in ("task.yaml", "acrobot.xml", "terms.py")} <= set(inside)
    assert "Requires-Dist: rlcli>=0.1" in metadata


def test_installed_wheels_list_check_train_and_play(elsewhere, site):
    place = elsewhere("-c", "import rlcli, rlcli_tasks; print(rlcli.__file__); print(rlcli_tasks.__file__)").stdout
    assert [line.startswith(str(site)) for line in place.splitlines()] == [True, True]
    rows = json.loads(elsewhere("-m", "rlcli", "list-tasks", "--json").stdout)["tasks"]
    assert [(r["name"], r["distribution"]) for r in rows if r["name"] == "acrobot"] == [
        ("acrobot", "rlcli-example-acrobot")
    ]
    for name in ("acrobot", "cartpole", "cartpole-direct"):
        assert json.loads(elsewhere("-m", "rlcli", "check", name, "--json").stdout)["passed"] is True
    elsewhere("-m", "rlcli", "train", "acrobot", "--max-iterations", "2", "--num-envs", "16")
    elsewhere("-m", "rlcli", "play", "acrobot", "--video", "acrobot.gif")
    elsewhere("-m", "rlcli", "eval", "acrobot", "--episodes", "8", "--fail-under", "success=0.99", code=9)


@pytest.mark.parametrize("task", ["cartpole", "cartpole-direct"])
def test_built_in_task_works_after_installation(elsewhere, tmp_path, task):
    done = elsewhere("-m", "rlcli", "play", task, "--video")
    assert f"(the policy shipped with rlcli {rlcli.__version__})" in done.stderr
    assert (tmp_path / "play.mp4").stat().st_size > 10_000
    assert (
        json.loads(elsewhere("-m", "rlcli", "eval", task, "--episodes", "16", "--json").stdout)["success"]["rate"] > 0.9
    )
    assert not (tmp_path / "runs").exists()


def test_plugin_readme_commands_run(site, tmp_path):
    folder = tmp_path / "rlcli-example-acrobot"
    shutil.copytree(ACROBOT, folder, ignore=shutil.ignore_patterns("__pycache__"))
    own = tmp_path / "site"
    shutil.copytree(site, own)
    for left in own.glob("rlcli_example_acrobot*"):
        shutil.rmtree(left)  # the README installs it
    output = run_commands(blocks(folder / "README.md"), folder, site=own)
    assert success_rate(output) >= 0.99
    assert "acrobot: 0 errors, 0 warnings" in output
    assert "6 passed" in output
    assert (folder / "acrobot.gif").stat().st_size > 10_000


def test_plugins_of_page_are_installed_and_train(site, tmp_path):
    own = tmp_path / "site"
    shutil.copytree(site, own)
    found = blocks(REPOSITORY / "docs" / "tutorials" / "first-plugin.md")
    output = run_commands(found, tmp_path, site=own)
    for name in ("my-arm", "my-direct-arm"):
        assert f"{name}: 0 errors, 0 warnings" in output
        assert (tmp_path / name / f"{name}.gif").stat().st_size > 10_000
    assert "4 passed" in output
    assert "2 passed" in output
    assert min(success_rates(output)) > 0.9
    shown = [block for block in found if block.file]
    assert len(shown) == 6
    for block in shown:
        assert (tmp_path / block.file).read_text(encoding="utf-8") == block.text, block.file


@pytest.mark.parametrize("name", TRAINERS)
def test_trainer_plugin_tests_pass_against_wheels(name, site, tmp_path):
    own = tmp_path / "site"
    shutil.copytree(site, own)
    build(REPOSITORY / "plugins" / name, tmp_path)
    (wheel,) = tmp_path.glob("*.whl")
    install([wheel], own)
    folder = tmp_path / name
    shutil.copytree(REPOSITORY / "plugins" / name / "tests", folder / "tests")
    shutil.copy(REPOSITORY / "plugins" / name / "pyproject.toml", folder)
    environment = {**os.environ, "PYTHONPATH": str(own), "PYTHONSAFEPATH": "1"}
    command = [sys.executable, "-m", "pytest", "-m", "not slow", "-v"]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stdout[-4000:]
    assert int(done.stdout.partition(" passed")[0].split()[-1]) > 20
    where = [sys.executable, "-c", f"import {name.replace('-', '_')} as package; print(package.__file__)"]
    place = subprocess.run(where, cwd=folder, env=environment, capture_output=True, text=True, check=True).stdout
    assert place.startswith(str(own))


@pytest.mark.parametrize("name", ["rlcli-isaaclab", "rlcli-oige"])
def test_format_wheel_has_files_and_entry_point(name, wheels, tmp_path):
    package = name.replace("-", "_")
    build(REPOSITORY / "plugins" / name, tmp_path)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
        points = archive.read(next(n for n in inside if n.endswith("entry_points.txt"))).decode()
    folder = REPOSITORY / "plugins" / name
    files = {f.relative_to(folder).as_posix() for f in (folder / package).rglob("*") if f.is_file()}
    assert {f for f in files if "__pycache__" not in f} <= inside
    assert f"{package}/py.typed" in inside
    assert f"{name.removeprefix('rlcli-')} = {package}.format:SPEC" in points
    with zipfile.ZipFile(wheels[0]) as archive:
        assert not [n for n in archive.namelist() if name.removeprefix("rlcli-") in n]


def with_plugin_left_out(name, site, folder):
    """Return copies of the plugin and of `site` in `folder`, for the installation steps of the plugin's README."""
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(REPOSITORY / "plugins" / name, folder / name, ignore=ignored)
    shutil.copytree(site, folder / "site")
    found = [shortened(block) for block in blocks(folder / name / "README.md")]
    return folder / name, [block for block in found if "pytest" not in block.text]  # its tests have a test here


@pytest.mark.parametrize(
    ("name", "trained"),
    [
        ("rlcli-rsl-rl", ["cartpole", "ball-balance"]),
        ("rlcli-rl-games", ["cartpole-direct", "ant-direct", "ball-balance"]),
    ],
)
def test_trainer_plugin_readme_works(name, trained, site, tmp_path):
    folder, found = with_plugin_left_out(name, site, tmp_path)
    (agents,) = [block.text for block in found if block.language == "yaml"]
    (folder / "agents.yaml").write_text(agents)
    (agent,) = yaml.safe_load(agents)["agents"]
    train = f"rlcli train ball-balance --config agents.yaml --agent {agent} --num-envs 512 --max-iterations 2\n"
    found = [replace(block, text=block.text.replace("learn(10)", "learn(1)")) for block in found]
    output = run_commands(
        [*found, Block("sh", None, train)], folder, site=tmp_path / "site", languages=("sh", "python")
    )
    assert 0.0 <= success_rate(output) <= 1.0
    for task in trained:
        (run,) = (folder / "runs" / task).iterdir()
        assert json.loads((run / "run.json").read_text())["state"] == "finished"


def test_menagerie_readme_commands_run_with_stand_in(site, tmp_path):
    folder, found = with_plugin_left_out("rlcli-menagerie", site, tmp_path)
    robot = runpy.run_path(str(folder / "tests" / "conftest.py"))["go1"](driven=True)
    for file in ("unitree_go1/go1.xml", "my_go1/scene_free.xml"):
        place = folder / "home" / "mujoco_menagerie" / file
        place.parent.mkdir(parents=True)
        place.write_text(robot)
    few = "rlcli train go1-velocity --num-envs 64"
    texts = [block.text.replace(" --device cuda", "").replace("rlcli train go1-velocity", few) for block in found]
    found = [replace(block, text=text) for block, text in zip(found, texts, strict=True)]
    output = run_commands(found, folder, site=tmp_path / "site")
    assert "go1-velocity: 0 errors" in output
    assert 0.0 <= success_rate(output) <= 1.0
    assert len(list((folder / "runs" / "go1-velocity").iterdir())) == 2


def test_trainer_of_page_works(site, tmp_path):
    own = tmp_path / "site"
    shutil.copytree(site, own)
    found = blocks(REPOSITORY / "docs" / "guides" / "write-a-trainer.md")
    write_files(found, tmp_path)
    output = run_commands(found, tmp_path, site=own)
    assert 0.0 <= success_rate(output) <= 1.0
    (run,) = (tmp_path / "my-learner" / "runs" / "cartpole").glob("*-first")
    record = json.loads((run / "run.json").read_text())
    assert (record["state"], record["iteration"]) == ("finished", 8)
