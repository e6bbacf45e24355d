"""Completion of command lines: in bash and by the protocols of the shells, without heavy imports."""

import os
import shlex
import shutil
import subprocess
import sys

import pytest

from rlcli.viewer.protocol import VIEWERS

HEAVY = ("torch", "mujoco", "numpy", "stable_baselines3", "gymnasium")
PROGRAM = f"""
import atexit, sys
atexit.register(lambda: print([m for m in {HEAVY} if m in sys.modules], file=sys.stderr))
from rlcli.cli.app import main
sys.exit(main())
"""


def test_variable_of_a_shell_without_its_words_is_ignored(in_process, monkeypatch):
    monkeypatch.setenv("_RLCLI_COMPLETE", "complete_bash")
    code, out, err = in_process("list-tasks", "--json")
    assert code == 0, err
    assert '"cartpole"' in out


def completion_environment(words, shell):
    """Return the environment variables that a shell sets to complete the last word."""
    line = ["rlcli", *words]
    variables = {"_RLCLI_COMPLETE": f"complete_{shell}"}
    if shell == "bash":
        return variables | {"COMP_WORDS": "\n".join(line), "COMP_CWORD": str(len(words))}
    line_so_far = f"{shlex.join(line[:-1])} {words[-1]}"
    return variables | {"_TYPER_COMPLETE_ARGS": line_so_far, "_TYPER_COMPLETE_FISH_ACTION": "get-args"}


@pytest.fixture
def offered(in_process, monkeypatch, tmp_path, capfd):
    """Return a function that returns the completions of the last of some words."""

    def complete(*words, shell="bash"):
        with monkeypatch.context() as patched:
            patched.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
            for name, value in completion_environment(words, shell).items():
                patched.setenv(name, value)
            with pytest.raises(SystemExit, match=r"^0$"):  # completion exits the process
                in_process()
        out, err = capfd.readouterr()
        assert err == ""
        return [line for line in out.splitlines() if line]

    return complete


@pytest.fixture
def a_run(here):
    """Return a function that makes a run folder with a checkpoint, as `find_run` needs it."""

    def make(name, task="cartpole", runs="runs"):
        folder = here / runs / task / name
        (folder / "checkpoints" / f"{64:012d}").mkdir(parents=True)
        (folder / "run.json").write_text("{}")
        return folder

    return make


def test_completion_of_commands_options_and_tasks(offered):
    assert offered("tra") == ["train"]
    assert offered("train", "cartpole-") == ["cartpole-camera", "cartpole-direct"]
    assert "--max-iterations" in offered("train", "cartpole", "--max")


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (("play", "--viewer", ""), ["auto", *VIEWERS, "none"]),
        (("play", "cartpole", "--policy", "z"), ["zero"]),
        (("train", "cartpole", "--logger", "t"), ["tensorboard", "trackio"]),
        (("train", "--device", "c"), ["cpu", "cuda"]),
        (("export", "--format", "o"), ["onnx"]),
        (("diff", "--only", "w"), ["weights"]),
        (("import", "s"), ["sb3"]),
    ],
)
def test_completion_of_choices(offered, words, expected):
    assert offered(*words) == expected


def test_completion_of_agents_uses_task_on_command_line(offered, small):
    agents = "  small: {trainer: sb3, algorithm: ppo, max_iterations: 1}\n"
    task = small((agents, agents + "  smart: {trainer: sb3, algorithm: sac, max_iterations: 1}\n"))
    assert offered("train", task, "--agent", "") == ["small", "smart"]
    assert offered("train", task, "--agent", "sma") == ["small", "smart"]
    assert len(offered("train", "cartpole", "--agent", "")) >= 2
    assert offered("train", "no-such-task", "--agent", "") == []


def test_completion_of_runs_is_newest_first_from_runs_dir(offered, a_run, monkeypatch):
    for age, name in ((200, "older"), (100, "newer")):
        folder = a_run(name)
        os.utime(folder, (1e9 - age, 1e9 - age))
    a_run("elsewhere", runs="mine")
    assert offered("watch", "") == ["latest", "newer", "older"]
    assert offered("play", "--checkpoint", "ne") == ["newer"]
    assert "shipped" in offered("play", "--checkpoint", "")
    assert offered("watch", "--runs-dir", "mine", "e") == ["elsewhere"]
    monkeypatch.setenv("RLCLI_RUNS_DIR", "mine")
    assert offered("watch", "e") == ["elsewhere"]
    assert offered("diff", "cartpole-c") == ["cartpole-camera"]
    assert offered("watch", "runs/") == [], "the shell completes paths"


@pytest.mark.parametrize("words", [("train", "cartpole-"), ("train", "cartpole", "--agent", ""), ("watch", "")])
def test_completion_imports_nothing_heavy(here, words):
    command = [sys.executable, "-c", PROGRAM]
    env = os.environ | completion_environment(words, "bash")
    done = subprocess.run(command, env=env, capture_output=True, text=True, cwd=here, timeout=120)
    assert done.stdout
    assert done.stderr.strip() == "[]"


def test_completion_in_zsh_and_fish_has_task_summaries(offered):
    (line,) = offered("train", "cartpole-d", shell="fish")
    name, summary = line.split("\t")
    assert name == "cartpole-direct"
    assert "direct" in summary
    assert '"cartpole-direct":"' in "\n".join(offered("train", "cartpole-d", shell="zsh"))


def test_completion_works_with_broken_settings_and_tasks(offered, small, tmp_path, monkeypatch):
    (tmp_path / "mine.yaml").write_text("[")
    monkeypatch.setenv("RLCLI_SETTINGS", str(tmp_path / "mine.yaml"))
    assert offered("tra") == ["train"]
    task = small(("agents:", "agents: ["))
    assert offered("train", task, "--agent", "") == []


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash on this machine")
def test_bash_completion_function_works(here, tmp_path):
    program = tmp_path / "bin" / "rlcli"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m rlcli "$@"\n')
    program.chmod(0o755)
    script = """
eval "$(_RLCLI_COMPLETE=source_bash rlcli)"
complete -p rlcli
COMP_WORDS=(rlcli train cartpole-); COMP_CWORD=2; _rlcli_completion rlcli cartpole- train; echo "${COMPREPLY[@]}"
COMP_WORDS=(rlcli play --viewer n); COMP_CWORD=3; _rlcli_completion rlcli n --viewer; echo "${COMPREPLY[@]}"
COMP_WORDS=(rlcli train ./no); COMP_CWORD=2; _rlcli_completion rlcli ./no train; echo "${#COMPREPLY[@]}"
"""
    env = {**os.environ, "PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "--norc", "-c", script], capture_output=True, text=True, cwd=here, env=env, timeout=120
    )
    assert done.stderr == ""
    assert done.stdout.splitlines() == [
        "complete -o default -F _rlcli_completion rlcli",
        "cartpole-camera cartpole-direct",
        " ".join(name for name in (*VIEWERS, "none") if name.startswith("n")),
        "0",
    ]
