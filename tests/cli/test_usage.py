"""Command line: help, flags, usage errors, JSON documents of errors, and closed streams."""

import json
import os
import subprocess
import sys

import pytest

from rlcli.cli.app import COMMANDS

HEAVY = ["torch", "mujoco", "numpy", "stable_baselines3"]


def document(text):
    """Parse the single JSON document on stdout."""
    content = json.loads(text)
    assert content["schema"] == 1
    return content


@pytest.mark.parametrize("flag", ["-h", "--help"])
@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
def test_help_goes_to_stdout_with_exit_code_0(in_process, command, flag):
    code, out, err = in_process(*command, flag)
    assert (code, err) == (0, "")
    assert " ".join(["Usage: rlcli", *command]) in out


def test_help_imports_nothing_heavy():
    program = (
        "import sys; from rlcli.cli.app import main; main(['--help']);"
        f"print(sorted(set(sys.modules) & {set(HEAVY)!r}), [m for m in sys.modules if m.startswith('rlcli_tasks')])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.splitlines()[-1] == "[] []"


def test_version_is_printed(in_process):
    import rlcli

    assert in_process("--version") == (0, f"rlcli {rlcli.__version__}\n", "")


def test_missing_command_prints_help_on_stderr(in_process):
    code, out, err = in_process()
    assert (code, out) == (2, "")
    assert err.startswith("Usage: rlcli")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tran", "cartpole"], "Did you mean 'train'?"),
        (["show"], "Missing argument 'TASK'"),
        (["list-tasks", "--jso"], "--json"),
        (["list-tasks", "a", "b"], "unexpected extra argument"),
        (["train", "cartpole", "--seed", "x"], "'--seed': expected a whole number, found 'x'"),
        (["train", "cartpole", "--num-envs"], "requires an argument"),
        (["train"], "no task given"),
        (["train", "cartpole", "--device", "gpu"], "no device 'gpu'"),
        (["train", "cartpole", "--device", "cuda:"], "no device 'cuda:'"),
        (["train", "cartpole", "--device", "cuda:one"], "no device 'cuda:one'"),
        (["play", "cartpole", "--policy", "traned"], "did you mean 'trained'"),
    ],
)
def test_usage_errors_exit_with_2(in_process, arguments, message):
    code, out, err = in_process(*arguments)
    assert (code, out) == (2, "")
    assert message in err
    assert "Traceback" not in err
    code, out, _ = in_process(*arguments, "--json")
    if arguments[-1] != "--num-envs":  # it takes the next word as its value
        error = document(out)["error"]
        assert (code, error["kind"], error["exit_code"]) == (2, "usage", 2)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--rewards.alive.weight", "2"],
        ["--rewards.alive.weight=2"],
        ["--agent.n_steps=2", "rewards.alive.weight=2"],
        ["--scene.num_envs", "2"],
    ],
)
def test_override_with_dashes_has_hint(in_process, arguments):
    code, _, err = in_process("train", "cartpole", *arguments)
    assert code == 2
    key = arguments[0].removeprefix("--").partition("=")[0]
    assert f"overrides have no dashes: {key}=2" in err


@pytest.mark.parametrize(
    ("option", "setting"),
    [("--lr", "agent.learning_rate"), ("--learning-rate", "agent.learning_rate"), ("--decimation", "decimation")],
)
def test_setting_as_option_has_hint_with_full_key(in_process, option, setting):
    code, _, err = in_process("train", "cartpole", option, "2")
    assert code == 2
    assert f"overrides have no dashes: {setting}=2" in err
    assert f"{setting}=2" in in_process("train", "cartpole", f"{option}=2")[2]


def test_underscores_are_accepted_for_hyphens(in_process):
    code, out, _ = in_process("show", "cartpole", "--num_envs", "3", "--json")
    assert code == 0
    assert document(out)["config"]["scene"]["num_envs"] == 3
    assert in_process("list_tasks")[0] == 0


@pytest.mark.parametrize(
    ("arguments", "code", "kind"),
    [
        (["show", "nope"], 4, "task"),
        (["validate", "nope"], 4, "task"),
        (["validate", "nope.yaml"], 4, "task"),
        (["train", "nope"], 4, "task"),
        (["train", "./nope"], 4, "task"),
        (["train", "sim.dt=1"], 4, "task"),
        (["show", "cartpole", "x=1"], 3, "config"),
        (["show", "cartpole", "x"], 2, "usage"),
        (["show", "cartpole", "--agent", "x"], 3, "config"),
        (["show", "cartpole", "--config", "nope.yaml"], 3, "config"),
        (["validate", "cartpole", "decimation=0"], 3, "config"),
        (["train", "cartpole", "decimation=0"], 3, "config"),
        (["train", "cartpole", "--num-envs", "0"], 3, "config"),
        (["train", "cartpole", "agent.trainer=rsl-rl"], 7, "dependency"),
    ],
)
def test_error_prints_one_document_with_exit_code(in_process, here, monkeypatch, arguments, code, kind):
    monkeypatch.setenv("RLCLI_PLUGINS", "rlcli")  # hides trainers of other distributions
    found, out, err = in_process(*arguments, "--json")
    error = document(out)["error"]
    assert (found, error["exit_code"], error["kind"]) == (code, code, kind)
    assert set(error) == {"kind", "exit_code", "message", "hint", "problems"}
    assert error["message"].splitlines()[0] in err
    assert all(set(problem) == {"where", "path", "message", "hint"} for problem in error["problems"])
    assert bool(error["problems"]) == (kind == "config")
    found, out, err = in_process(*arguments)
    assert (found, out) == (code, "")
    assert "Traceback" not in err
    assert list(here.iterdir()) == []  # no partial files


def test_debug_prints_traceback(in_process):
    code, _, err = in_process("show", "nope", "--debug")
    assert code == 4
    assert "Traceback" in err


def test_missing_trainer_names_pip_command(in_process, monkeypatch):
    monkeypatch.setenv("RLCLI_PLUGINS", "rlcli")
    code, _, err = in_process("train", "cartpole", "agent.trainer=rl-games")
    assert code == 7
    assert "trainer 'rl-games' is not installed" in err
    assert "rlcli-rl-games" in err


@pytest.mark.parametrize(
    "arguments",
    [["list-tasks"], ["show", "cartpole"], ["list-tasks", "--json"], ["show", "nope", "--json"], ["--help"]],
)
def test_closed_pipe_is_not_an_error(rlcli, arguments):
    read, write = os.pipe()
    os.close(read)
    with os.fdopen(write, "w") as stdout:
        done = rlcli(*arguments, stdout=stdout)
    assert "Traceback" not in done.stderr
    assert "Broken" not in done.stderr
    if arguments[:2] == ["show", "nope"]:
        assert done.returncode == 4


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is always full")
@pytest.mark.parametrize("arguments", [["list-tasks"], ["show", "cartpole", "--json"]])
def test_full_disk_is_one_message(rlcli, arguments):
    with open("/dev/full", "w") as stdout:
        done = rlcli(*arguments, stdout=stdout)
    assert done.returncode == 10
    assert "error: cannot write the output: No space left on device\n" in done.stderr


@pytest.mark.parametrize("arguments", [["terms", "--json"], ["--help"]])
def test_closed_stdout_is_one_message(here, arguments):
    done = subprocess.run(
        [sys.executable, "-m", "rlcli", *arguments], cwd=here, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: os.close(1),
    )  # fmt: skip
    assert (done.returncode, done.stderr.splitlines()[0]) == (10, "error: the standard output is closed")


@pytest.mark.parametrize("arguments", [["--help"], *([name] for name in COMMANDS), ["validate", "/"]])
def test_deleted_current_folder_is_one_message(in_process, here, arguments):
    here.rmdir()
    code, out, err = in_process(*arguments)
    assert (code, out) == (10, "")
    assert err.startswith("error: the current folder cannot be used: No such file or directory\nhint: ")


FORGED = "x\nerror: forged\r\x1b[2J\t\u2028\u202e\ud800"


@pytest.mark.parametrize("method", ["data", "info", "detail", "warn", "table", "title", "heat_map", "error"])
def test_text_of_a_file_cannot_add_lines(capfd, method):
    from rlcli.cli.ui.console import Console
    from rlcli.errors import CheckpointError, ConfigError, Problem
    from rlcli.reporting.heat_map import Axis, HeatMap

    console = Console(verbose=True)
    {
        "data": lambda: console.data(FORGED, FORGED),
        "info": lambda: console.info(FORGED),
        "detail": lambda: console.detail(FORGED),
        "warn": lambda: console.warn(FORGED),
        "table": lambda: console.table([FORGED], [[FORGED]]),
        "title": lambda: console.table(["a"], [["b"]], FORGED),
        "heat_map": lambda: console.heat_map(
            FORGED, FORGED, HeatMap(FORGED, Axis("a", (FORGED,)), Axis("b", (FORGED,)), [[0.5]], 0.0, 1.0)
        ),
        "error": lambda: (
            console.error(CheckpointError(FORGED, hint=FORGED)),
            console.error(ConfigError([Problem(FORGED, FORGED, FORGED, FORGED)])),
        ),
    }[method]()
    out, err = capfd.readouterr()
    assert all(character == "\n" or character.isprintable() for character in out + err)
    assert not [line for line in (out + err).splitlines() if line.startswith("error: forged")]


def test_unencodable_text_is_escaped(rlcli, small):
    done = rlcli("show", small(("a small task", "größer →")), PYTHONIOENCODING="ascii")
    assert done.returncode == 0
    assert r"gr\xf6\xdfer \u2192" in done.stdout


FAILING = """
from rlcli.config.schema import EntityConfig, ObservationConfig, RewardConfig, SceneConfig, SimConfig, TaskConfig
from rlcli.config.schema import ActionConfig, TerminationConfig
from rlcli.task import Entity


def uprightness(env, *, entity: Entity = "robot"):
    return entity.data.joint_poss[:, 0]


TASK = TaskConfig(
    sim=SimConfig(dt=0.01), decimation=1, episode_length_s=1.0,
    scene=SceneConfig(num_envs=2, entities={"robot": EntityConfig(model="cartpole:cartpole.xml")}),
    actions={"push": ActionConfig(func="joint_effort", joints=["slider_to_cart"])},
    observations={"policy": {"pos": ObservationConfig(func="joint_pos")}},
    rewards={"upright": RewardConfig(func=uprightness, weight=1.0)},
    terminations={"time_out": TerminationConfig(func="time_out", time_out=True)},
)
"""


@pytest.mark.parametrize("flags", [[], ["--debug"]])
def test_exception_in_task_code_names_file_and_line(in_process, tmp_path, flags):
    (tmp_path / "task.py").write_text(FAILING, encoding="utf-8")
    code, _, err = in_process("validate", "--deep", str(tmp_path), *flags)
    line = FAILING.split("\n").index("    return entity.data.joint_poss[:, 0]") + 1
    assert code == 4
    assert f"task.py:{line}: uprightness: AttributeError: 'EntityData' object has no attribute 'joint_poss'" in err
    assert "a bug in rlcli" not in err
    assert ("Traceback" in err) is bool(flags)


def test_exception_in_rlcli_is_reported_as_bug(here):
    program = (
        "import sys; from rlcli.cli.app import main; from rlcli.cli.commands import validate;"
        "validate.task_source = None; sys.exit(main(['validate', '--deep', 'cartpole']))"
    )
    # a process of its own: here the files of the tests would count as code of a task, which changes modules
    done = subprocess.run([sys.executable, "-c", program], cwd=here, capture_output=True, text=True)
    assert done.returncode == 1
    assert "this is a bug in rlcli: TypeError" in done.stderr
    assert "Traceback" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--task", "cartpole"], "rlcli train cartpole"),
        (["play", "--load_run", "x"], "--checkpoint RUN"),
        (["train", "cartpole", "env.scene.num_envs=8"], "remove 'env.'"),
        (["train", "cartpole", "sim.device=cpu"], "the device is an option: --device cpu"),
        (
            ["train", "cartpole", "events.reset_cart.params.position=[0,1]"],
            "write the parameters of a term beside its 'func'",
        ),
    ],
)
def test_options_of_other_programs_have_hints(in_process, arguments, message):
    code, _, err = in_process(*arguments)
    assert code in (2, 3)
    assert message in err
