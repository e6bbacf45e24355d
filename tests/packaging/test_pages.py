"""Commands and examples of the documentation work as written."""

import re
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
import yaml
from support.fenced import REPOSITORY, Block, blocks, page_path, run_commands, success_rate, write_files
from support.worlds import CRITTER, CRITTER_TASK, build, edited, write
from support.written_runs import learning, write_run

import rlcli.errors
from rlcli.evaluation.stress_parameters import PHYSICAL, SIGNALS
from rlcli.testing import CHECKS, RULES

DOCS = REPOSITORY / "docs"
README = REPOSITORY / "README.md"
EVALUATION = DOCS / "guides" / "evaluate.md"


@pytest.mark.slow
def test_evaluation_page_works(tmp_path):
    train = Block("sh", None, "rlcli train cartpole --max-iterations 2 --logger none\n")
    found = [replace(b, text=re.sub("(episodes) [0-9]+ --fail-under .*", r"\1 4", b.text)) for b in blocks(EVALUATION)]
    output = run_commands([train, *found], tmp_path)
    assert "P(IMPROVEMENT)" in output
    assert "LQR SUCCESS" in output
    assert (tmp_path / "map.png").read_bytes()[:4] == b"\x89PNG"


def test_evaluation_page_lists_every_stress_parameter():
    text = EVALUATION.read_text(encoding="utf-8")
    assert all(f"`{name}`" in text for name in (*PHYSICAL, *SIGNALS))


@pytest.mark.slow
def test_determinism_page_works(tmp_path):
    assert run_commands(blocks(DOCS / "explanation" / "determinism.md"), tmp_path).count("no difference") == 2


@pytest.mark.slow
def test_plots_and_reports_page_works(tmp_path):
    for seed in (1, 2):
        write_run(tmp_path / "runs", seed=seed, rows=learning())
    page = DOCS / "guides" / "plots-and-reports.md"
    output = run_commands(blocks(page, "## Learning curves", "## A report of a run"), tmp_path)
    output += run_commands(blocks(page, "## A report of a run", "## The card"), tmp_path)
    for file in ("curves.svg", "curves.png", "losses.pdf", "cartpole.html"):
        assert file in output
        assert (tmp_path / file).stat().st_size > 5_000


def test_task_card_of_page_is_printed(capsys):
    (block,) = blocks(DOCS / "guides" / "plots-and-reports.md", "## The card of a task")
    exec(compile(block.text, "plots-and-reports.md", "exec"), {})
    assert "| `pole_pos` | -1 | Sum of the squared deviations" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(("page", "folder"), [("first-task.md", "my_task"), ("direct-task.md", "my_arm")])
def test_task_of_page_checks_trains_and_learns(page, folder, tmp_path):
    found = blocks(page_path(page))
    write_files(found, tmp_path)
    output = run_commands(found, tmp_path)
    assert f"./{folder}: 0 errors, 0 warnings" in output
    assert success_rate(output) > 0.9


@pytest.mark.parametrize("number", range(3))
def test_scenes_of_page_build_and_run(number, tmp_path):
    found = [
        b
        for b in blocks(DOCS / "tutorials" / "first-task.md", "## Scenes", "## Events and randomisation")
        if b.language == "yaml"
    ]
    assert len(found) == 3
    part = yaml.safe_load(found[number].text)
    part["scene"]["entities"]["robot"]["joints"] = {".*": {"kp": 20.0, "kv": 0.5}}  # the critter has no servos
    task = edited(CRITTER_TASK, **part)
    env = build(write(tmp_path / "task", task, quadruped_xml=CRITTER), 3)
    env.reset()
    env.step(torch.zeros(3, 4))
    entities, sensors = part["scene"]["entities"], part["scene"].get("sensors", {})
    assert list(env.entities) == list(entities)
    assert list(env.sensors) == list(sensors)
    names = ["leg_fl", "ray_0", "ray_0", "eye", "above"]
    assert [sensor.names[0] for sensor in env.sensors.values()] == names[: len(sensors)]
    env.close()
    assert (env.terrain is None) == ("terrain" not in part["scene"])


def test_sections_of_task_page_work_together(tmp_path):
    found = blocks(page_path("first-task.md"), "## Observations", "## Start from your own robot")
    parts = [yaml.safe_load(block.text) for block in found if block.language == "yaml"]
    (terms,) = [block.text for block in found if block.language == "python"]
    assert [list(part) for part in parts] == [
        ["observations"],
        ["commands", "observations", "rewards"],
        ["actions"],
        ["scene", "actions"],
        ["curriculum"],
    ]
    task = {"rewards": {"effort": {"func": "action_l2", "weight": -0.01}},
            "terminations": {"fallen": {"func": "bad_orientation", "limit_angle": 1.2}}}  # fmt: skip
    task = yaml.safe_load(edited(CRITTER_TASK, **task)) | {"observations": {}, "actions": {}}
    for part in parts:
        task = merged(task, part)
    task["curriculum"]["smooth"] |= {"begin": 0, "end": 10}
    task["scene"]["entities"]["robot"]["joints"] = {}
    task["commands"]["high"] = {"func": "root_height", "resampling_time_s": [9, 9], "height": [0.4, 0.5]}
    folder = write(tmp_path / "task", yaml.safe_dump(task, sort_keys=False), critter_xml=CRITTER, terms_py=terms)
    env = build(folder, 3)
    obs = env.reset()
    assert obs["policy"].shape == (3, 3 + 3 + 3 * 4 + 4 + 4 + 3 + 3)
    assert obs["critic"].shape == (3, 3 + 4)
    for _ in range(12):
        step = env.step(torch.zeros(3, 4))
    assert step.obs["policy"].isfinite().all()
    assert env.extras()["Curriculum/smooth"] == pytest.approx(-0.1)
    assert torch.equal(env.markers()[-1].center[:, 2], env.command_manager.get_command("high")[:, 0])
    assert [actuator.joints for actuator in env.entities["robot"].actuators] == [[0, 1], [2, 3]]


def merged(task, part):
    """Return a mapping merged with another one, nested mappings included."""
    both = {key: merged(task[key], part[key]) for key in task.keys() & part.keys() if isinstance(part[key], dict)}
    return {**task, **part, **both}


@pytest.mark.slow
def test_isaac_lab_examples_train(tmp_path):
    found = blocks(page_path("isaac-lab.md"))
    write_files(found, tmp_path)
    output = run_commands(found, tmp_path)
    assert "swing_env_cfg.py:SwingEnvCfg: valid (files and model)" in output
    assert "episodes" in output


@pytest.mark.slow
@pytest.mark.parametrize("number", range(3))
def test_scripts_for_other_libraries_run(number, tmp_path):
    found = [block.text for block in blocks(page_path("external-environments.md")) if block.language == "python"]
    assert len(found) == 3
    done = subprocess.run([sys.executable, "-c", found[number]], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert re.fullmatch(r"(steps (512|1024)|best return \S+)\n", done.stdout)


@pytest.mark.slow
def test_readme_example_task_works(tmp_path):
    found = blocks(README, "## A task of your own", "## Licence")
    write_files(found, tmp_path)
    assert "./my_task: 0 errors, 0 warnings" in run_commands(found, tmp_path)


def test_exit_code_page_lists_every_code_and_kind():
    text = (DOCS / "reference" / "exit-codes.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| (\d+) \| `(\w+)` \|", text, re.MULTILINE))
    errors = [e for e in vars(rlcli.errors).values() if isinstance(e, type) and issubclass(e, rlcli.errors.RlcliError)]
    for error in errors:
        if error.kind not in ("error", "stopped"):
            assert rows[str(error.exit_code)] == error.kind
    assert set(rows) == {*map(str, range(1, 11)), "75", "130"}


def test_plugin_page_lists_every_check():
    text = (page_path("first-plugin.md")).read_text(encoding="utf-8")
    listed = [
        name for cell in re.findall(r"^\| (`.*?`) \|", text, re.MULTILINE) for name in re.findall(r"`(.+?)`", cell)
    ]
    assert set(CHECKS) <= set(listed)


def test_lint_page_lists_every_rule():
    text = (DOCS / "guides" / "check-and-lint.md").read_text(encoding="utf-8")
    assert re.findall(r"^\| `(.*?)` \|", text.partition("## Lint")[2], re.MULTILINE) == list(RULES)
