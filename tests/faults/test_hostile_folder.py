"""A current folder with modules of well-known names, and limits of memory: no command imports them or crashes."""

import ast
import os
import random
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.child_processes import PATIENCE, SMALL
from support.fault_sizes import FIRST_SEED, chosen

import rlcli

MODULES = ("json", "numpy", "torch", "rlcli", "rlcli_tasks", "mujoco", "yaml", "typing", "multiprocessing", "optuna",
    "ctypes", "types", "glfw", "textwrap", "sitecustomize", "usercustomize")  # fmt: skip
TRAIN = ("train", "cartpole", *SMALL, "--max-iterations", "1", "--logger", "none")
MIB = 1 << 20


def command(folder, *words, limit=None):
    """Run the command `rlcli` in a folder, as the installed script does."""

    def restrict():
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_AS, (limit, limit))

    script = "import sys; from rlcli.cli.app import main; sys.exit(main())"
    return subprocess.run(
        [sys.executable, "-P", "-c", script, *words],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        preexec_fn=restrict,
        env={**os.environ, "XDG_CACHE_HOME": str(folder / "cache"), "OMP_NUM_THREADS": "1"},
    )


def hostile(folder):
    for name in MODULES:
        (folder / f"{name}.py").write_text(
            f"open({str(folder / 'executed')!r}, 'a').write({name!r})\nraise SystemExit(77)\n"
        )
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("doctor", "--probe-timeout", "300"),
        ("list-tasks", "--probe"),
        (*TRAIN, "--seeds", "2"),
        (*TRAIN, "scene.workers=2"),
        ("sweep", "cartpole", *SMALL, "--param", "agent.learning_rate=1e-3,2e-3", "--trials", "1", "--episodes", "2",
         "--max-iterations", "1"),
        ("validate", "--deep", "./task"),
    ],
)  # fmt: skip
def test_command_imports_nothing_from_the_current_folder(words, tmp_path):
    task = tmp_path / "task"
    task.mkdir()
    (task / "model.xml").write_text(
        '<mujoco><worldbody><body><joint name="slide" type="slide"/><geom size="1"/></body>'
        '<replicate count="6000"><site size="1"/></replicate></worldbody></mujoco>'
    )
    (task / "task.yaml").write_text(
        "summary: Many sites.\ndecimation: 1\nepisode_length_s: 1\nsim: {dt: 0.01}\n"
        "scene: {num_envs: 1, entities: {robot: {model: model.xml}}}\n"
        "actions: {effort: {func: joint_effort, joints: [slide]}}\nobservations: {policy: {pos: {func: joint_pos}}}\n"
        "rewards: {alive: {func: is_alive, weight: 1.0}}\n"
    )
    done = command(hostile(tmp_path), *words)
    assert not (tmp_path / "executed").exists(), (tmp_path / "executed").read_text()
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


def test_every_child_process_is_started_by_one_function():
    """A list that starts with `sys.executable` would search the current folder for modules."""
    for file in Path(rlcli.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.List) and any("sys.executable" in ast.unparse(item) for item in node.elts):
                assert file.name == "processes.py", f"{file}:{node.lineno}: use rlcli.machine.processes.python_command"


@pytest.mark.skipif(sys.platform != "linux", reason="limits of address space")
@pytest.mark.parametrize("mib", [300, 600, 1000])
def test_command_with_too_little_memory_names_it(mib, tmp_path):
    done = command(tmp_path, *TRAIN, limit=mib * MIB)
    assert done.returncode == 10, done.stderr
    assert done.stderr.startswith(f"error: the process is limited to {mib} MiB of memory")
    assert command(tmp_path, "validate", "cartpole", limit=mib * MIB).returncode == 0


EVAL = ("eval", "cartpole", "scene.num_envs=4", "--policy", "zero", "--episodes", "4")
HEAVY = {
    "train": TRAIN,
    "train many": (*TRAIN, "scene.num_envs=100000", "agent.n_steps=2", "agent.n_epochs=1"),
    "seeds": (*TRAIN, "--seeds", "2"),
    "workers": (*TRAIN, "scene.workers=2"),
    "resume": ("train", "--resume", "latest", "--max-iterations", "2", "-q"),
    "validate": ("validate", "cartpole", "--deep"),
    "check": ("check", "cartpole"),
    "lint": ("lint", "cartpole"),
    "eval": EVAL,
    "play": ("play", "cartpole", "--policy", "zero", "--video", "x.mp4"),
    "stress": ("stress", "cartpole", "--policy", "zero", "--episodes", "2", "--sweep", "body_mass=1,2"),
    "export": ("export", "cartpole", "--output", "p.onnx"),
    "export torch": ("export", "cartpole", "--format", "torch", "--output", "p.pt2"),
    "report": ("report", "latest", "--no-eval"),
    "reproduce": ("reproduce", "latest"),
    "probe": ("list-tasks", "cartpole", "--probe"),
    "doctor": ("doctor",),
}
LIMITS = random.Random(32 + FIRST_SEED).choices(range(1024, 2600), k=3)


@pytest.fixture(scope="module")
def one_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    assert command(folder, *TRAIN).returncode == 0
    return folder


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits of address space")
@pytest.mark.parametrize(
    ("name", "mib"),
    chosen([(name, mib) for name in HEAVY for mib in (512, *LIMITS)], 6),
)
def test_command_with_little_memory_works_or_names_it(name, mib, one_run, tmp_path):
    shutil.copytree(one_run, tmp_path, dirs_exist_ok=True)
    done = command(tmp_path, *HEAVY[name], limit=mib * MIB)
    assert done.returncode in ((0, 8, 9, 10) if name == "doctor" else (0, 8, 10)), done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    assert not done.returncode or "memory" in done.stdout + done.stderr
    assert len(re.findall("^error: ", done.stderr, re.MULTILINE)) <= 1
