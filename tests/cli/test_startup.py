"""Imports of commands: they take most of the time until the first line of output."""

import subprocess
import sys

import pytest

COMPUTING = {"torch", "mujoco", "numpy", "stable_baselines3", "gymnasium", "pandas", "matplotlib", "optuna", "rich"}
READING = {"pydantic", "yaml", "rlcli.config.load"}
REST = {"torch._dynamo", "torch._inductor", "sympy", "pandas", "matplotlib", "scipy", "optuna", "sqlalchemy", "imageio"}
"""Modules that training does not need; torch's compiler alone takes as long to import as torch."""


def imported(words, wanted):
    """Run a command; return its exit code, the `wanted` modules that it imported, and its stderr."""
    program = (
        "import sys\nfrom rlcli.cli.app import main\n"
        f"code = main({words!r})\nprint(code, *sorted(set({sorted(wanted)!r}) & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    code, *found = done.stdout.splitlines()[-1].split()
    return int(code), found, done.stderr


@pytest.mark.parametrize(
    ("words", "unwanted"),
    [
        (["--help"], COMPUTING | READING),
        (["train", "--help"], COMPUTING | {"rlcli.config.load"}),
        (["list-tasks"], COMPUTING | {"rlcli.config.load"}),
        (["show", "cartpole"], COMPUTING),
        (["validate", "cartpole"], COMPUTING),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, list) else "",
)
def test_light_command_imports_nothing_heavy(words, unwanted):
    assert imported(words, unwanted)[:2] == (0, [])


def test_command_imports_no_other_command(tmp_path):
    assert imported(["runs", "--runs-dir", str(tmp_path)], {"rlcli.cli.commands.train", "rlcli.cli.commands.sweep"})[
        :2
    ] == (0, [])


@pytest.mark.slow
@pytest.mark.parametrize(("task", "agent"), [("cartpole", "sb3-ppo"), ("cartpole-direct", "ppo"), ("cartpole", "sac")])
def test_train_imports_no_compiler_or_plotting_library(task, agent, tmp_path):
    words = ["train", task, "--agent", agent, "--num-envs", "4", "--max-iterations", "1", "-q"]
    words += ["--device", "cpu", "--runs-dir", str(tmp_path)]
    code, found, error_output = imported(words, REST)
    assert (code, found) == (0, []), error_output
