"""No block of code of any page is there unread: each is run by a test, or says why it is not."""

import ast
import json
import os
import re
import shlex
import subprocess
import sys
from functools import cache

import pytest
import torch
import yaml
from support.consoles import commands
from support.fenced import REPOSITORY, Block, all_blocks, blocks, page_path, run_commands, shortened, write_files
from support.worlds import CRITTER, CRITTER_TASK, edited, write
from support.worlds import build as build_env

from rlcli.cli.app import COMMANDS, GROUPS, build, main
from rlcli.config.load import resolve
from rlcli.registry import find_task

DOCS = REPOSITORY / "docs"
GENERATED = ("commands.md", "task-schema.md", "agents.md", "terms", "python")
"""Pages that `docs/reference.py` writes; tests/docs/test_reference_pages.py checks their examples."""
PAGES = [
    page
    for page in sorted(DOCS.rglob("*.md"))
    if "_build" not in page.parts and not {*page.relative_to(DOCS).parts[1:]} & {*GENERATED}
]
PAGES += [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md"]
PAGES += sorted((REPOSITORY / "plugins").glob("*/README.md"))

HERE = "tests/docs/test_code_blocks.py"
OF_PAGES = "tests/packaging/test_pages.py"
OF_WHEELS = "tests/packaging/test_wheels.py"
RUN_BY = {
    "README.md": f"{OF_PAGES}::test_readme_example_task_works",
    "README.md: What rlcli offers": f"{HERE}::test_the_mistake_of_the_readme_is_answered_as_it_says",
    "external-environments.md": f"{OF_PAGES}::test_scripts_for_other_libraries_run",
    "check-and-lint.md": f"{HERE}::test_the_commands_of_a_page_run_as_written",
    "analyse-failures.md": f"{HERE}::test_the_commands_of_a_page_run_as_written",
    "import-policies.md": f"{HERE}::test_a_foreign_policy_is_brought_over_as_the_page_says",
    "gymnasium-and-sb3.md": "tests/docs/test_port_from_gymnasium.py::"
    "test_the_ported_task_trains_and_lives_the_life_of_the_gymnasium_class",
    "determinism.md": f"{OF_PAGES}::test_determinism_page_works",
    "evaluate.md": f"{OF_PAGES}::test_evaluation_page_works",
    "exit-codes.md": "tests/docs/test_exit_codes_page.py::test_what_one_sees_is_what_the_page_says",
    "export.md": f"{HERE}::test_an_exported_file_is_used_as_the_page_says",
    "isaac-lab.md": f"{OF_PAGES}::test_isaac_lab_examples_train",
    "omniisaacgymenvs.md": "plugins/rlcli-oige/tests/test_oige_page.py::"
    "test_example_validates_and_good_action_earns_more",
    "train-on-a-gpu.md: On a cluster": f"{HERE}::test_cluster_script_trains_and_resumes",
    "python-api.md": f"{HERE}::test_the_scripts_of_the_python_page_run_as_written",
    "put-a-policy-on-a-robot.md": "tests/docs/test_robot_page.py::test_control_loop_balances_the_pole",
    "play.md": f"{HERE}::test_the_commands_of_a_page_run_as_written",
    "plots-and-reports.md": f"{OF_PAGES}::test_plots_and_reports_page_works",
    "plots-and-reports.md: The card of a task": f"{OF_PAGES}::test_task_card_of_page_is_printed",
    "ppo.md": f"{HERE}::test_the_agent_of_the_page_is_valid",
    "quickstart.md": "tests/docs/test_quickstart.py::test_every_command_of_the_quickstart_prints_what_the_page_shows",
    "record-episodes.md": f"{HERE}::test_the_commands_of_a_page_run_as_written",
    "resume.md": f"{HERE}::test_the_commands_of_a_page_run_as_written",
    "security.md": f"{HERE}::test_the_commands_of_a_page_run_as_written",
    "seeds-and-sweeps.md": f"{HERE}::test_the_commands_of_a_page_run_as_written",
    "choose-a-trainer.md": f"{HERE}::test_the_commands_of_a_page_run_as_written",
    "monitor-training.md": f"{HERE}::test_the_commands_of_a_page_run_as_written",
    "direct-task.md": f"{OF_PAGES}::test_task_of_page_checks_trains_and_learns",
    "first-plugin.md": f"{OF_WHEELS}::test_plugins_of_page_are_installed_and_train",
    "first-task.md": f"{OF_PAGES}::test_task_of_page_checks_trains_and_learns",
    "training-does-not-learn.md": f"{HERE}::test_the_commands_of_a_page_run_as_written",
    "first-task.md: Scenes": f"{OF_PAGES}::test_scenes_of_page_build_and_run",
    "first-task.md: Events and randomisation": f"{HERE}::test_randomised_models_of_the_page_differ",
    **dict.fromkeys(
        (f"first-task.md: {part}" for part in ("Observations", "Commands", "Actions", "Actuators", "Curriculum")),
        f"{OF_PAGES}::test_sections_of_task_page_work_together",
    ),
    "write-a-trainer.md": f"{OF_WHEELS}::test_trainer_of_page_works",
    "rlcli-example-acrobot/README.md": f"{OF_WHEELS}::test_plugin_readme_commands_run",
    "rlcli-gymnasium/README.md": "tests/packaging/test_gymnasium_plugin.py::test_readme_commands_run",
    "rlcli-menagerie/README.md": f"{OF_WHEELS}::test_menagerie_readme_commands_run_with_stand_in",
    "rlcli-rl-games/README.md": f"{OF_WHEELS}::test_trainer_plugin_readme_works",
    "rlcli-rsl-rl/README.md": f"{OF_WHEELS}::test_trainer_plugin_readme_works",
}
"""Page, or page and heading -> the test that runs what stands there; a plugin's README has the plugin's name."""

NEED_A_RUN = {"analyse-failures.md": 12, "play.md": 2, "security.md": 2, "monitor-training.md": 2}
"""Pages that speak of a run that is there already -> its iterations."""
NEED_A_TASK = ("check-and-lint.md", "security.md")
LANGUAGES = {"record-episodes.md": ("sh", "python"), "check-and-lint.md": ("sh", "python")}
PLUGINS = {"choose-a-trainer.md": "rlcli_rsl_rl"}


def is_code(block):
    return not block.language.startswith("{")


def called(page):
    """`export.md`, or `rlcli-gymnasium/README.md` for a plugin's."""
    return f"{page.parent.name}/{page.name}" if page.parent.parent.name == "plugins" else page.name


@pytest.mark.parametrize("page", PAGES, ids=called)
def test_every_block_of_code_is_run_or_says_why_not(page):
    for block in filter(is_code, all_blocks(page)):
        if block.not_run is not None:
            assert len(block.not_run.split()) > 3, f"{page.name}: a reason is a sentence: {block.not_run}"
            continue
        place = RUN_BY.get(f"{called(page)}: {block.section}", RUN_BY.get(called(page)))
        assert place, f"{page.name}, {block.section}: nothing runs\n{block.text}\n(or <!-- not run: WHY --> above it)"


@pytest.mark.parametrize("place", sorted(set(RUN_BY.values())))
def test_what_is_said_to_run_a_page_is_a_test_that_names_it(place):
    file, _, name = place.partition("::")
    text = (REPOSITORY / file).read_text(encoding="utf-8")
    tests = {node.name: node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef)}
    assert name in tests
    outside = "" if file == HERE and "RUN_BY" in text else text
    for page in {key.partition(":")[0] for key, value in RUN_BY.items() if value == place}:
        said = [*tests[name].decorator_list, tests[name]]
        named = "".join(ast.unparse(part) for part in said) + outside
        assert page.removesuffix("/README.md") in named or "SHELL_PAGES" in named, f"{name} does not name {page}"


SHELL_PAGES = sorted(
    key for key, place in RUN_BY.items() if place.endswith("test_the_commands_of_a_page_run_as_written")
)


@pytest.mark.slow
@pytest.mark.parametrize("page", SHELL_PAGES)
def test_the_commands_of_a_page_run_as_written(page, tmp_path):
    if page in PLUGINS:
        pytest.importorskip(PLUGINS[page], reason="a plugin that this page is about is not installed")
    found, run = [shortened(block) for block in blocks(page_path(page))], None
    task = "cartpole"
    if page in NEED_A_TASK:
        task = "./my_task"
        write_files(blocks(DOCS / "tutorials" / "first-task.md"), tmp_path)
    if page in NEED_A_RUN:
        train = f"rlcli train {task} --max-iterations {NEED_A_RUN[page]} --logger none\n"
        run = run_commands([Block("sh", None, train)], tmp_path).strip()
    run_commands(found, tmp_path, languages=LANGUAGES.get(page, ("sh",)), run=run)


@pytest.mark.slow
def test_the_scripts_of_the_python_page_run_as_written(tmp_path):
    """python-api.md"""
    for block in blocks(DOCS / "guides" / "python-api.md"):
        (tmp_path / block.file).write_text(block.text)
        subprocess.run([sys.executable, block.file], cwd=tmp_path, check=True, capture_output=True, timeout=300)


@pytest.mark.slow
def test_an_exported_file_is_used_as_the_page_says(tmp_path):
    train = Block("sh", None, "rlcli train cartpole --max-iterations 2 --logger none agent.save_interval=1\n")
    run = run_commands([train], tmp_path).strip()
    commands, *scripts = [b for b in blocks(DOCS / "guides" / "export.md") if "pip install" not in b.text]
    output = run_commands([commands], tmp_path, run=run)
    exports = tmp_path / run / "exports"
    for name in ("policy.onnx", "policy.pt2", "policy.py", "policy"):
        assert (exports / name).exists()
        assert f"{run}/exports/{name}\n" in output, "what was written is printed"
    assert output.count("policy.onnx\n") == 3
    assert (tmp_path / "policy.onnx").is_file()
    for kind in ("policy.pt2", "policy.py"):
        (tmp_path / kind).write_bytes((tmp_path / run / "exports" / kind).read_bytes())
    beside = "import sys, numpy\nsys.path.insert(0, '')\n"  # as a script's own folder is
    now = Block("python", None, f"{beside}now = numpy.zeros(4, numpy.float32)\n")
    shown = Block("python", None, "print(action.shape, command.shape)\n")
    assert len(scripts) == 3
    for script in scripts:
        parts = [now, script] if "torch" in script.text else [now, script, shown]
        one = Block("python", None, "".join(part.text for part in parts))
        output = run_commands([one], tmp_path, languages=("python",))
        assert output == (
            "" if "torch" in script.text else "(1,) (1,)\n" if "now)" in script.text else "(1, 1) (1, 1)\n"
        )


@pytest.mark.slow
def test_a_foreign_policy_is_brought_over_as_the_page_says(tmp_path):
    script = """
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize
from rlcli.adapters.sb3 import make_sb3
env = VecNormalize(make_sb3("cartpole", num_envs=4))
model = PPO("MlpPolicy", env, n_steps=8, batch_size=32, device="cpu").learn(32)
model.save("model.zip"), env.save("vecnormalize.pkl")
"""
    train = Block("python", None, script)
    found = blocks(DOCS / "guides" / "import-policies.md")
    run_commands([train, *found], tmp_path, languages=("sh", "python"))
    with_statistics = "rlcli import sb3 model.zip --task cartpole --normalizer normalizer.safetensors\n"
    output = run_commands([Block("sh", None, with_statistics)], tmp_path)
    assert len(list((tmp_path / "runs" / "cartpole").glob("*"))) == 2
    assert (tmp_path / output.strip()).is_dir()


def test_the_agent_of_the_page_is_valid():
    (block,) = [b for b in blocks(DOCS / "reference" / "ppo.md") if b.language == "yaml"]
    (agent,) = yaml.safe_load(block.text)["agents"].values()
    chosen = resolve(
        find_task("cartpole"),
        agent="ppo",
        overrides=[f"agent.{k}={yaml.safe_dump(v, default_flow_style=True).splitlines()[0]}" for k, v in agent.items()],
    )
    assert chosen.agent.max_iterations == agent["max_iterations"]


def test_the_mistake_of_the_readme_is_answered_as_it_says(capsys):
    (block,) = [b for b in blocks(REPOSITORY / "README.md") if b.language == "console"]
    command, said = block.text.strip().split("\n")
    assert main(shlex.split(command.removeprefix("$ rlcli "))) == 3
    assert capsys.readouterr().err.strip() == said


def test_randomised_models_of_the_page_differ(tmp_path):
    """first-task.md"""
    (block,) = blocks(DOCS / "tutorials" / "first-task.md", "## Events and randomisation", "## Observations")
    part = yaml.safe_load(block.text.replace("foot_.*", "geom_.*"))
    env = build_env(write(tmp_path / "task", edited(CRITTER_TASK, **part), critter_xml=CRITTER), 3)
    env.reset()
    env.step(torch.zeros(3, 4))
    worlds = [env.world(i)[0] for i in range(3)]
    for field in ("body_mass", "geom_friction", "dof_damping"):
        assert len({getattr(model, field).tobytes() for model in worlds}) == 3, field
    env.close()


def options(command):
    """The names of the options of a command."""
    return {name for parameter in command.params for name in (*parameter.opts, *parameter.secondary_opts)}


@cache
def table():
    import typer

    command = typer.main.get_command(build())
    commands = {name: options(inner) for name, inner in command.commands.items()}
    for group in GROUPS:
        commands[group] = set().union(*map(options, command.commands[group].commands.values()))
    return commands


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_and_option_that_a_page_names_exists(page):
    text = page.read_text(encoding="utf-8")
    spans = re.findall(r"`(rlcli [^`]+)`", text)
    for block in all_blocks(page):
        if block.language == "console":  # some show a mistake, and the answer to it
            spans += [c.text for c in commands(block.text) if not c.printed.startswith("error:")]
        elif block.language == "sh":
            spans += [line for line in block.text.replace("\\\n", " ").split("\n") if "rlcli " in line]
    for span in spans:
        for said in re.findall(r"(?:^|\s)rlcli ([a-z][a-z-]*)([^;|&]*)", span):
            command, words = said[0], said[1].split(" #")[0]
            assert command in table(), f"{page.name}: {span}"
            for option in re.findall(r"(?<=\s)--?[a-z][\w-]*", words):
                known = table()[command] | {"-h", "--help", "--version"}
                assert option in known, f"{page.name}: {option} of {span}"


def test_the_command_table_of_this_file_is_the_command_line():
    assert set(table()) == {*COMMANDS, *GROUPS}


STUBS = {
    "scontrol": 'if [ "$1" = show ]; then echo here; else echo "$2" >> requeued; fi',
    "srun": '"$@"',
    "torchrun": 'while [ "$1" != rlcli ]; do echo "$1" >> launched; shift; done; shift; words=("${@/cuda/cpu}"); '
    'exec "$PY" -m rlcli "${words[@]}" --max-iterations "$UNTIL"',
}
"""What a cluster brings, on one machine without one: torchrun starts a single process on the CPU."""


@pytest.mark.slow
def test_cluster_script_trains_and_resumes(tmp_path):
    (script,) = [b for b in all_blocks(DOCS / "tutorials" / "train-on-a-gpu.md") if b.file == "train.sbatch"]
    (tmp_path / "train.sbatch").write_text(script.text)
    for name, text in STUBS.items():
        (tmp_path / name).write_text(f"#!/bin/bash\n{text}\n")
        (tmp_path / name).chmod(0o755)
    job = {"SLURM_JOB_ID": "7", "SLURM_NNODES": "2", "SLURM_GPUS_ON_NODE": "8", "SLURM_JOB_NODELIST": "here"}
    environment = {**os.environ, **job, "SCRATCH": str(tmp_path), "PY": sys.executable,
                   "PATH": f"{tmp_path}:{os.environ['PATH']}"}  # fmt: skip
    for until in ("2", "4"):
        command = ["bash", "train.sbatch", "cartpole"]
        subprocess.run(command, cwd=tmp_path, env={**environment, "UNTIL": until}, check=True, timeout=200)
        (run,) = (tmp_path / "runs" / "cartpole").glob("*-job-7")
        text = (run / "run.json").read_text()
        assert json.loads(text)["iteration"] == int(until)
        assert '"state": "finished"' in text  # the form that the script looks for
    assert not (tmp_path / "requeued").exists()
    launched = (tmp_path / "launched").read_text().split()
    assert launched[launched.index("--rdzv-endpoint") + 1] == "here:29500"


def test_the_script_for_a_cluster_can_be_read_and_its_commands_exist():
    """train-on-a-gpu.md"""
    (script,) = [b for b in all_blocks(DOCS / "tutorials" / "train-on-a-gpu.md") if b.file == "train.sbatch"]
    done = subprocess.run(["bash", "-n"], input=script.text, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    options = set(re.findall(r"(?<=[ (])--[a-z-]+", script.text.partition("-m rlcli train")[2])) | {
        "--resume",
        "--name",
    }
    assert options <= table()["train"]
