"""The built-in tasks: each has a page, a bar, and results that fit both."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

REPOSITORY = Path(__file__).parents[2]
sys.path.insert(0, str(REPOSITORY / "benchmarks"))

import zoo  # noqa: E402
import zoo_curves  # noqa: E402
import zoo_pages  # noqa: E402

from rlcli.config.load import resolve  # noqa: E402
from rlcli.deploy.env_description import describe  # noqa: E402
from rlcli.envs.make import make_env  # noqa: E402
from rlcli.registry import find_task  # noqa: E402
from rlcli.runs.checkpoint_fit import require_fit  # noqa: E402
from rlcli.runs.checkpoint_reader import open_checkpoint  # noqa: E402
from rlcli.runs.layout_and_deployment import deployment_differences  # noqa: E402
from rlcli.runs.policy_bundle import open_bundle  # noqa: E402
from rlcli.testing import check_task, lint_task  # noqa: E402
from rlcli.testing.host_sync import HostSyncGuard  # noqa: E402

ENTRIES = zoo.entries()
TASKS = zoo_pages.built_in()
TRAINED = sorted(file.stem for file in (zoo.ZOO / "results").glob("*.json"))
MEGABYTE = 1_000_000
NEEDS_SKILL = {"lift-cube": {("silent-reward", f"rewards.{x}") for x in ("grasping", "lifting", "goal", "goal_fine")}}
"""Remarks that are true of an untrained policy alone: no fixed policy of `lint` grasps the cube."""


@pytest.mark.parametrize("task", TASKS)
def test_task_has_page_bar_summary_and_success(task):
    page = zoo.ZOO / f"{task}.md"
    assert page.is_file()
    entry, resolved = ENTRIES[task], resolve(find_task(task))
    assert entry.tier in ("A", "B")
    assert entry.bar
    assert resolved.task.summary.endswith(".")
    assert "\n" not in resolved.task.summary
    assert resolved.task.success is not None
    text = page.read_text(encoding="utf-8")
    assert [name for name in zoo_pages.BLOCKS if zoo_pages.block(text, name) is None] == []
    assert text.startswith("# ")


@pytest.mark.parametrize("task", TASKS)
def test_lint_passes(task):
    assert {(remark.rule, remark.where) for remark in lint_task(task)} == NEEDS_SKILL.get(task, set())


@pytest.mark.parametrize("task", TASKS)
def test_success_runs_without_host_sync(task):
    env = make_env(resolve(find_task(task), flags={"scene.num_envs": 2}))
    env.reset()
    with HostSyncGuard():
        assert env.compute_success().shape == (2,)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_contract(task):
    assert check_task(task) == []


@pytest.mark.parametrize("task", TASKS)
def test_generated_parts_of_page_are_current(task):
    text = (zoo.ZOO / f"{task}.md").read_text(encoding="utf-8")
    assert text == zoo_pages.filled(text, zoo.ZOO, ENTRIES[task]), "python benchmarks/zoo.py pages"


def test_index_lists_every_task():
    text = (zoo.ZOO / "index.md").read_text(encoding="utf-8")
    assert [task for task in TASKS if f"({task}.md)" not in text] == [], "python benchmarks/zoo.py pages"


@pytest.mark.parametrize("task", TRAINED)
def test_results_belong_to_shipped_policy_and_reach_bar(task):
    rows = json.loads((zoo.ZOO / "results" / f"{task}.json").read_text(encoding="utf-8"))
    bundle = open_bundle(find_task(task).policy)
    (own,) = [
        row for row in rows if row["seed"] == bundle.manifest["seed"] and row["agent"] == bundle.manifest["agent"]
    ]
    assert own["steps"] == bundle.manifest["step"]
    assert own["evaluation"]["return"] == bundle.manifest["evaluation"]["return"]
    assert ENTRIES[task].missed(own["evaluation"]) == []
    assert own["evaluation"]["episodes"] >= ENTRIES[task].episodes


@pytest.mark.parametrize("task", [task for task in TASKS if find_task(task).policy is not None])
def test_shipped_policy_is_small_and_fits_task(task):
    folder = find_task(task).policy
    assert sum(file.stat().st_size for file in folder.iterdir()) <= 2.5 * MEGABYTE
    checkpoint, bundle = open_checkpoint(folder), open_bundle(folder)
    assert bundle.manifest["task"]["name"] == task
    assert checkpoint.policy().spec.observation_size > 0
    one = resolve(find_task(task), agent=bundle.manifest["agent"], play=True, flags={"scene.num_envs": 1})
    env = make_env(one)
    require_fit(checkpoint, env.layout)
    assert deployment_differences(checkpoint, env.layout.record(), describe(env), randomized=False) == []
    env.close()
    assert bundle.manifest["evaluation"] is not None, "export it after rlcli eval"


@pytest.mark.parametrize("task", TRAINED)
def test_curves_and_pictures_are_small_and_valid(task):
    svg = zoo.ZOO / "curves" / f"{task}.svg"
    assert svg.stat().st_size < 60_000
    root = ElementTree.parse(svg).getroot()
    assert any(
        task.removesuffix("-direct") in "".join(text.itertext())
        for text in root.iter("{http://www.w3.org/2000/svg}text")
    )
    head, *rows = (zoo.ZOO / "curves" / f"{task}.csv").read_text(encoding="utf-8").splitlines()
    assert head.startswith("seed,steps,seconds,")
    assert len(rows) > 1
    assert all(row.count(",") == head.count(",") for row in rows)
    assert (zoo.ZOO / "pictures" / f"{task}.jpg").stat().st_size < 80_000


def evaluation(success=0.9, **values):
    middle = {"std": 0.1, "low": 0.0, "high": 1.0}
    return {
        "success": {"rate": success, "low": 0.0, "high": 1.0},
        "return": {"mean": 1.0, **middle},
        "length": {"mean": 10.0, **middle},
        "reward_terms": {},
        "terminations": {},
        "values": {name: {"mean": value, **middle} for name, value in values.items()},
    }


@pytest.mark.parametrize(
    ("bar", "found", "message"),
    [
        ({"success": 0.9}, evaluation(0.9), []),
        ({"success": 0.95}, evaluation(0.9), ["success is 0.9, below 0.95"]),
        ({"speed": 5.0}, evaluation(speed=5.5), []),
        ({"speed": 5.0}, evaluation(speed=4.0), ["speed is 4, below 5"]),
        ({"error": {"max": 0.25}}, evaluation(**{"walk/error": 0.2}), []),
        ({"error": {"max": 0.25}}, evaluation(**{"walk/error": 0.3}), ["error is 0.3, above 0.25"]),
        ({"speed": 5.0}, evaluation(), ["speed is unknown"]),
        ({"success": 0.95, "length": 20}, evaluation(), ["success is 0.9, below 0.95", "length is 10, below 20"]),
    ],
)
def test_bar_is_missed_by_value_on_wrong_side(bar, found, message):
    assert zoo.Entry("x", "A", "cpu", 1, bar).missed(found) == message


def test_recorded_command_omits_output_folder():
    words = ["__main__.py", "train", "ant", "--seed", "3", "--runs-dir", "/home/x", "--name=y", "agent.gamma=1", "-q"]
    assert zoo._command(words) == "rlcli train ant --seed 3 agent.gamma=1"


def test_page_without_results(tmp_path):
    text = "# X\n\n<!-- results -->\n<!-- end results -->\n\n<!-- curves -->\nold\n<!-- end curves -->\n"
    filled = zoo_pages.filled(text, tmp_path, ENTRIES["cartpole"])
    assert "Not trained yet." in zoo_pages.block(filled, "results")
    assert zoo_pages.block(filled, "curves") == ""
    assert zoo_pages.filled(filled, tmp_path, ENTRIES["cartpole"]) == filled


def test_results_show_when_a_bar_was_reached(tmp_path):
    """A training without `--until` and one that missed the bar have their own texts."""
    (row, *_) = zoo_pages.rows_of(zoo.ZOO, "cartpole")
    until = {"bar": "success=0.97", "reached": True, "seconds": 90.0, "step": 1_250_000}
    rows = [{**row, "until": until}, {**row, "until": {**until, "reached": False}}, row]
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "cartpole.json").write_text(json.dumps(rows))
    lines = zoo_pages.results(tmp_path, ENTRIES["cartpole"]).splitlines()
    cells = [line.split("|")[6].strip() for line in lines if line.startswith("|")]
    assert cells == ["bar reached after", "---:", "success=0.97: 1.25 M, 1.5 min", "success=0.97: not reached", "-"]


def test_thick_line_is_median_of_seeds():
    class RunCurves:
        def __init__(self, seed, level):
            self.run = type("Run", (), {"record": {"seed": seed}})
            self.axes = {"steps": np.arange(1.0, 301.0) * 1000, "time": np.arange(1.0, 301.0)}
            self.metrics = {zoo_curves.RETURN: np.full(300, level), zoo_curves.SUCCESS: np.linspace(0.0, level, 300)}

    runs = [RunCurves(1, 0.1), RunCurves(2, 0.9), RunCurves(3, 0.5)]
    lines = [row.split(",") for row in zoo_curves.table(runs).splitlines()]
    assert lines[0] == ["seed", "steps", "seconds", "success", "return"]
    assert len(lines) == 1 + 3 * zoo_curves.ROWS
    assert [row[0] for row in lines[1 :: zoo_curves.ROWS]] == ["1", "2", "3"]
    assert lines[-1] == ["3", "300000", "300.0", "0.5", "0.5"]
    root = ElementTree.fromstring(zoo_curves.drawing("x", runs))
    thick = [line for line in root.iter("{http://www.w3.org/2000/svg}polyline") if line.get("stroke-width") == "2.2"]
    bottom, top = zoo_curves._HEIGHT - zoo_curves._BOTTOM, zoo_curves._TOP
    ends = float(thick[0].get("points").split()[-1].split(",")[1])
    assert ends == pytest.approx(bottom - (bottom - top) * 0.5, abs=0.1)  # success 0.5 of 0 to 1


@pytest.mark.slow
def test_learn_writes_results_curves_and_policy(tmp_path):
    copy = tmp_path / "repository"
    for part in ("benchmarks", "docs/reference/zoo", "tasks"):
        shutil.copytree(REPOSITORY / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
    for folder in ("results", "curves", "pictures"):
        shutil.rmtree(copy / "docs" / "reference" / "zoo" / folder)
    shutil.rmtree(copy / "tasks" / "rlcli_tasks" / "cartpole" / "policies")

    def run(*arguments):
        environment = {**os.environ, "PYTHONPATH": f"{copy / 'tasks'}:{REPOSITORY}"}
        command = [sys.executable, str(copy / "benchmarks" / "zoo.py"), *arguments]
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=280)

    held = copy / "docs" / "reference" / "zoo" / "zoo.yaml"
    text = held.read_text()
    short, before = "minutes: 90, episodes: 16, ", "minutes: 1, bar: {success: 0.95}"
    assert before in text
    held.write_text(text.replace(before, short + "bar: {success: 2.0}", 1))
    learned = run("learn", "cartpole", "agent.max_iterations=5", "--seed", "5", "--runs-dir", "runs")
    assert learned.returncode == 9, learned.stderr
    assert "below 2" in learned.stderr
    (line,) = (tmp_path / "runs" / "learn.jsonl").read_text().splitlines()
    logged = json.loads(line)
    assert (logged["task"], logged["seed"], logged["device"]) == ("cartpole", 5, "cpu")
    assert logged["minutes"] > 0
    assert "mujoco" in logged["machine"]
    folder = next((tmp_path / "runs" / "cartpole").iterdir())
    held.write_text(text.replace(before, short + "bar: {success: 0.0}", 1))
    message = subprocess.run(
        [sys.executable, "-m", "rlcli", "eval", "--checkpoint", str(folder), "--episodes", "16", "--num-envs", "16",
         "--json"], cwd=tmp_path, capture_output=True, text=True, timeout=280,
    )  # fmt: skip
    shutil.rmtree(folder / "evaluations")  # as on another machine, where only the document was kept
    (tmp_path / "runs" / "cartpole.eval.json").write_text(message.stdout)
    collected = run("collect", "--all", "runs", "--ship")
    assert collected.returncode == 0, collected.stderr
    assert "cartpole, seed 5: required result reached" in collected.stdout
    assert (copy / "docs" / "reference" / "zoo" / "pictures" / "cartpole.jpg").stat().st_size < 80_000
    (row,) = json.loads((copy / "docs" / "reference" / "zoo" / "results" / "cartpole.json").read_text())
    assert (row["seed"], row["agent"], row["evaluation"]["episodes"]) == (5, "sb3-ppo", 16)
    assert row["evaluation"]["return"] == json.loads(message.stdout)["return"]
    shipped = copy / "tasks" / "rlcli_tasks" / "cartpole" / "policies" / "cartpole"
    assert open_bundle(shipped).manifest["evaluation"]["return"] == row["evaluation"]["return"]
    page = (copy / "docs" / "reference" / "zoo" / "cartpole.md").read_text()
    assert "| 5 | `sb3-ppo` |" in page
    assert "curves/cartpole.svg" in page
