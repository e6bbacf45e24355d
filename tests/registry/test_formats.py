"""Formats of other frameworks: installed, not installed, broken, and their module aliases."""

import json
import os
import shutil
import subprocess
import sys
import textwrap

import pytest
from support import plugin_grammar

from rlcli.errors import pip_install
from rlcli.registry import find_task, unreadable_distributions

END = "exit code:"
HIDDEN = ("rlcli-oige", "rlcli-isaaclab")
CORE = f"""
import importlib.metadata, sys
every = importlib.metadata.distributions
importlib.metadata.distributions = lambda **given: (d for d in every(**given) if d.metadata["Name"] not in {HIDDEN!r})
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {tuple(name.replace("-", "_") for name in HIDDEN)!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
import json
from rlcli.cli.app import main
for words in json.loads(sys.argv[1]):
    print("\\n{END}", main(words), flush=True)
"""
"""Program that runs commands of `rlcli` as if neither format plugin were installed."""

OIGE = "name: Arm\nphysics_engine: physx\nenv: {numEnvs: 4}\nsim: {dt: 0.01}\nmjcf: {Arm: arm.xml}\n"
IMPORTED = """
sim: {dt: 0.01}
decimation: 2
episode_length_s: 1.0
scene: {entities: {}}
oige: {name: Arm, env: {maxEffort: 2.0}}
"""
ISAACLAB = """
from rlcli.isaaclab import ManagerBasedRLEnvCfg

class ArmEnvCfg(ManagerBasedRLEnvCfg):
    pass
"""


def core(folder, *commands):
    """Run commands of `rlcli` in one process without the format plugins; return (exit code, stdout) of each."""
    words = json.dumps([list(map(str, command)) for command in commands])
    done = subprocess.run([sys.executable, "-c", CORE, words], cwd=folder, capture_output=True, text=True, timeout=120)
    found, out = [], []
    for line in done.stdout.splitlines():
        if line.startswith(END):
            found.append((int(line.removeprefix(END)), "\n".join(out)))
            out = []
        else:
            out.append(line)
    assert len(found) == len(commands), done.stderr
    return found


def write_tasks(folder):
    """Write tasks of each known format, in every layout."""
    files = {
        "own/Arm.yaml": OIGE,
        "package/cfg/task/Arm.yaml": OIGE,
        "imported/task.yaml": IMPORTED,
        "lab/arm_env_cfg.py": ISAACLAB,
    }
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


TARGETS = {
    "./own": "rlcli-oige",
    "./own/Arm.yaml": "rlcli-oige",
    "./package": "rlcli-oige",
    "./imported": "rlcli-oige",
    "./lab": "rlcli-isaaclab",
    "./lab/arm_env_cfg.py:ArmEnvCfg": "rlcli-isaaclab",
}
COMMANDS = [(command, target, "--json") for command in ("validate", "train") for target in TARGETS]


@pytest.fixture(scope="module")
def refused(tmp_path_factory):
    """Result of each of `COMMANDS`."""
    return dict(zip(COMMANDS, core(write_tasks(tmp_path_factory.mktemp("tasks")), *COMMANDS), strict=True))


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: "-".join(command[:2]))
def test_task_of_missing_format_gives_pip_command(refused, command):
    code, out = refused[command]
    error = json.loads(out)["error"]
    assert code == 7
    assert "is not installed" in error["message"]
    assert error["hint"] == pip_install(TARGETS[command[1]])


def test_missing_importer_gives_pip_command(tmp_path):
    importing = ("import", "isaaclab", "env.yaml", "--model", "robot=robot.xml", "--json")
    (code, out), (_, text) = core(tmp_path, importing, ("import", "--help"))
    assert code == 7
    assert pip_install("rlcli-isaaclab") in out
    assert "isaaclab" not in text


def test_other_tasks_work_without_format_plugins(tmp_path):
    wrong = tmp_path / "wrong"
    wrong.mkdir()
    checked, shown, refused = core(tmp_path, ("validate", "cartpole"), ("show", "cartpole"), ("validate", "./wrong"))
    assert [code for code, _ in (checked, shown, refused)] == [0, 0, 4]
    assert "format" not in shown[1]
    # runs of every task that were saved before have the key, empty
    (wrong / "task.yaml").write_text(shown[1] + "\noige: {}\n")
    shutil.copy(find_task("cartpole").root / "cartpole.xml", wrong)
    assert core(tmp_path, ("validate", "./wrong"))[0][0] == 0


def test_excluded_format_plugins_are_not_used(tmp_path):
    command = [sys.executable, "-m", "rlcli", "validate", "./own"]
    env = {**os.environ, "RLCLI_PLUGINS": "none"}
    done = subprocess.run(command, cwd=write_tasks(tmp_path), env=env, capture_output=True, text=True)
    assert done.returncode == 7, done.stderr


FORMAT = """
from pathlib import Path
from rlcli.formats import FormatSpec, Note, Translation

SPEC = FormatSpec(summary="tasks of Elsewhere", read="elsewhere:read", key="elsewhere", check="elsewhere:check",
                  aliases={{"another_world": "elsewhere"}}{more})
HANDS = 2


def read(document, source):
    if "seconds" not in document.data:
        return None
    from rlcli.config.layers import document_origins
    data = {{"episode_length_s": document.data["seconds"], "elsewhere": {{"hands": HANDS}}}}
    data |= {{key: value for key, value in document.data.items() if key != "seconds"}}
    return Translation(data, document_origins(document, source.label, "task"), [Note("", "seconds", "mapped")])


def check(block):
    if block.get("hands") != HANDS:
        yield ("hands",), "a robot here has two", None
"""
TASK = """
seconds: 1.0
sim: {dt: 0.01}
decimation: 2
scene: {num_envs: 2, entities: {robot: {model: "cartpole:cartpole.xml"}}}
"""
CODE = """
from another_world import HANDS
from rlcli.envs.direct import DirectTask


class Task(DirectTask):
    num_observations, num_actions = 1, 1
"""
POINTS = "[rlcli.formats]\nelsewhere = elsewhere:SPEC\n"


@pytest.fixture
def task(tmp_path):
    folder = tmp_path / "task"
    folder.mkdir()
    (folder / "task.yaml").write_text(TASK)
    (folder / "task.py").write_text(textwrap.dedent(CODE))
    return folder


def test_installed_format_is_read_checked_and_shown(plugins, cli, task):
    plugins("elsewhere", FORMAT.format(more=""), entry_points=POINTS)
    done = cli("validate", str(task))
    assert done.returncode == 0, done.stderr
    assert "mapped: seconds" in done.stderr
    shown = cli("show", str(task), "--json")
    assert json.loads(shown.stdout)["config"]["elsewhere"] == {"hands": 2}
    assert "foreign" not in json.loads(shown.stdout)["config"]
    wrong = cli("validate", str(task), "elsewhere.hands=3")
    assert wrong.returncode == 3, wrong.stderr
    assert "elsewhere.hands: a robot here has two" in wrong.stderr


def test_alias_resolves_only_during_task_import(plugins, cli, task):
    plugins("elsewhere", FORMAT.format(more=""), entry_points=POINTS)
    program = f"""
        from rlcli.registry import load_object
        try:
            import another_world
        except ModuleNotFoundError as error:
            print(error)
        task = load_object({str(task / "task.py")!r} + ":Task")
        import elsewhere, sys
        print("another_world" in sys.modules, task.__init__.__globals__ is not None, elsewhere.__spec__.name)
        print(sys.modules[task.__module__].HANDS)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True)
    assert done.stdout.splitlines() == ["No module named 'another_world'", "False True elsewhere", "2"], done.stderr


def test_format_with_newer_api_is_refused(plugins, cli, task):
    plugins("elsewhere", FORMAT.format(more=", api=99"), entry_points=POINTS)
    done = cli("validate", str(task))
    assert done.returncode == 4, done.stderr
    assert "needs plugin API 99; this rlcli has 1" in done.stderr


def test_broken_format_does_not_stop_own_tasks(plugins, cli, task):
    plugins("elsewhere", "raise RuntimeError('torn')", entry_points=POINTS)
    shown = cli("show", "cartpole")
    assert shown.returncode == 0, shown.stderr
    (task / "task.yaml").write_text(shown.stdout)
    (task / "task.py").unlink()
    shutil.copy(find_task("cartpole").root / "cartpole.xml", task)
    done = cli("validate", str(task))
    assert done.returncode == 0, done.stderr
    broken = "plugin elsewhere 1.0: entry point 'elsewhere' = elsewhere:SPEC cannot be imported: RuntimeError: torn"
    assert f"warning: {broken}" in done.stderr
    assert cli("import", "--help").returncode == 0


@pytest.mark.parametrize("words", [("validate", "cartpole", "scene.num_envs=8"), ("train", "cartpole", "rewards.x=1")])
def test_task_of_own_format_imports_no_other_format(plugins, command, words):
    plugins("elsewhere", "raise SystemExit(7)", entry_points=POINTS)
    done = command(*words)
    assert done.returncode == (0 if words[0] == "validate" else 3), done.stderr
    assert "elsewhere" not in done.stderr + str([name for name in sys.modules if name == "elsewhere"])


@pytest.mark.parametrize("body", ["return ['x']", "return Translation({}, lambda path: 5, [])", "yield 1, 2, 3"])
def test_wrong_result_of_a_format_names_its_plugin(body, plugins, cli, tmp_path):
    source = plugin_grammar.MODULE.format(
        body=body, spec="FormatSpec", fields={"summary": "x", "read": "odd:f", "find": "odd:f", "key": "odd"}
    )
    plugins("odd", source, entry_points="[rlcli.formats]\nodd = odd:SPEC\n")
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "task.yaml").write_text(plugin_grammar.TASK + "odd: {a: 1}\n")
    done = cli("validate", str(tmp_path / "task"))
    assert done.returncode == 4, done.stderr
    assert "error: plugin odd 1.0: " in done.stderr
    assert "expected a" in done.stderr


@pytest.mark.parametrize(
    ("group", "command"), [("tasks", ("validate", "many1")), ("formats", ("validate", "cartpole"))]
)
def test_ten_thousand_entry_points_are_refused(group, command, plugins, cli):
    points = "".join(f"many{number} = many:SPEC\n" for number in range(10_000))
    plugins("many", entry_points=f"[rlcli.{group}]\n{points}")
    done = cli(*command)
    assert done.returncode == (4 if group == "tasks" else 0), done.stderr
    (broken,) = unreadable_distributions()
    assert f"10000 entry points in rlcli.{group}; at most" in broken.reason
