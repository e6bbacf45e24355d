"""A broken plugin affects only its own row; everything else works as without it."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from support.broken_plugins import BROKEN, FILES

from rlcli.registry import catalog
from rlcli.registry.probe import probe
from rlcli.registry.task_code_monitor import exit_refused

pytestmark = pytest.mark.processes
BUILT_IN = {"cartpole", "cartpole-direct", "ant-direct"}
TRAIN = ("train", "good-task", "--num-envs", "2", "--max-iterations", "1", "--logger", "none")


def document(done):
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return json.loads(done.stdout)


def row_of(listed, name):
    """Return the row of a broken plugin in the output of `list-tasks --json`."""
    (row,) = [row for row in listed["tasks"] if row["distribution"] == name]
    return row


def check_listed(listed, names):
    assert {*BUILT_IN, "good-task"} <= {
        row["name"] for row in listed["tasks"] if row["distribution"] in ("rlcli", "good")
    }
    unreadable = {row["distribution"].replace("_", "-") for row in listed["broken"]}
    assert unreadable == {f"{name}-1.0.dist-info" for name in names if BROKEN[name].unreadable}
    for name in names:
        if not (BROKEN[name].unreadable or BROKEN[name].foreign):
            assert row_of(listed, name)["name"] == BROKEN[name].options.get("task", f"{name}-task")


def test_broken_plugins_are_at_least_24():
    assert len(BROKEN) >= 24


@pytest.mark.parametrize("name", BROKEN)
def test_list_tasks_works_beside_broken_plugin(broken_plugins, command, name):
    broken_plugins(name)
    check_listed(document(command("list-tasks", "--json", "--probe-timeout", "5")), [name])
    listed = command("list-tasks")
    assert (listed.returncode, "Traceback" in listed.stderr) == (0, False)
    assert "good-task" in listed.stdout
    assert BROKEN[name].foreign or name.replace("-", "_") in (listed.stdout + listed.stderr).replace("-", "_")


@pytest.mark.slow
@pytest.mark.parametrize("name", BROKEN)
def test_train_works_beside_broken_plugin(broken_plugins, cli, name):
    broken_plugins(name)
    trained = document(cli(*TRAIN, "--json"))
    assert (trained["state"], trained["iteration"]) == ("finished", 1)


@pytest.mark.slow
def test_all_broken_plugins_together(broken_plugins, cli, capsys):
    broken_plugins(*BROKEN)
    start = time.perf_counter()
    done = cli("list-tasks", "--probe-timeout", "5")
    took = time.perf_counter() - start
    with capsys.disabled():
        print(f"list-tasks with {len(BROKEN)} broken plugins: {took:.2f} s")
    assert "good-task" in done.stdout
    check_listed(document(cli("list-tasks", "--json")), BROKEN)
    assert document(cli(*TRAIN, "--json"))["state"] == "finished"
    trained = cli(*TRAIN)
    assert trained.returncode == 0, trained.stderr
    bare = cli("list-tasks", "--json", RLCLI_PLUGINS="none")
    assert {row["distribution"] for row in json.loads(bare.stdout)["tasks"]} == {"rlcli"}


@pytest.mark.slow
def test_probe_reports_reason_of_each_broken_plugin(broken_plugins, cli):
    broken_plugins(*BROKEN)
    listed = document(cli("list-tasks", "--probe", "--probe-timeout", "20", "--json"))
    check_listed(listed, BROKEN)
    for name, case in BROKEN.items():
        if case.said is not None:
            assert case.said in row_of(listed, name)["broken"], name
        elif not (case.unreadable or case.foreign):
            assert (row_of(listed, name)["broken"], row_of(listed, name)["observation_size"]) == (None, 2), name
    assert {row["broken"] for row in listed["tasks"] if row["distribution"] in ("rlcli", "good")} == {None}
    again = document(cli("list-tasks", "--json"))
    assert again == listed


@pytest.mark.parametrize("name", ["exits-with-0", "raises", "newer-api", "unknown-field", "api-is-text"])
def test_use_of_broken_plugin_fails_with_reason(broken_plugins, cli, name):
    broken_plugins(name)
    done = cli("show", f"{name}-task", "--json")
    error = json.loads(done.stdout)["error"]
    assert (done.returncode, error["kind"]) == (4, "task")
    assert BROKEN[name].said in error["message"]
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("name", ["prints", "prints-from-c"])
def test_output_of_plugin_is_not_in_json(broken_plugins, cli, name):
    broken_plugins(name)
    done = cli("show", f"{name}-task", "--json")
    assert document(done)["config"]["summary"] == "Slide."
    assert "hubbub" in done.stderr


def test_output_of_running_task_is_not_in_json(plugins, cli):
    terms = "def one(env):\n    import torch\n    print('hubbub')\n    return torch.ones(env.num_envs)\n"
    from support.broken_plugins import FILES, IMPORT

    task = FILES["task.yaml"].replace("func: is_alive", "func: one")
    source = IMPORT + "SPEC = TaskSpec(__name__, 'x', terms=('noisy.terms',))\n"
    plugins("noisy", source, files={**FILES, "task.yaml": task, "terms.py": terms})
    done = cli("eval", "noisy-task", "--policy", "zero", "--episodes", "2", "--num-envs", "2", "--json")
    assert document(done)["command"] == "eval"
    assert "hubbub" in done.stderr


def test_terms_that_task_spec_does_not_name_are_found_beside_the_yaml(plugins, cli):
    from support.broken_plugins import FILES, SPEC

    task = FILES["task.yaml"].replace("func: is_alive", "func: home_sweet_home")
    terms = "def home_sweet_home(env): ...\n"
    plugins("forgetful", SPEC, files={**FILES, "task.yaml": task, "terms.py": terms})
    done = cli("validate", "forgetful-task")
    assert done.returncode == 3
    assert "terms.py is beside the YAML, but TaskSpec.terms does not name it" in done.stderr


def test_built_in_task_wins_over_plugin_of_same_name(broken_plugins, cli):
    broken_plugins("takes-a-built-in-name")
    assert "on a cart" in cli("show", "cartpole").stdout
    listed = cli("list-tasks")
    assert "takes-a-built-in-name:cartpole" in listed.stdout
    assert not [line for line in listed.stdout.splitlines() if line.startswith("rlcli:")]
    ambiguous = {row["name"]: row["ambiguous"] for row in document(cli("list-tasks", "--json"))["tasks"]}
    assert not ambiguous["cartpole"]


def test_excluded_plugin_is_named_in_error(broken_plugins, cli):
    broken_plugins()
    done = cli("show", "good-task", RLCLI_PLUGINS="none")
    assert done.returncode == 4
    assert "RLCLI_PLUGINS=none excludes its plugin" in done.stderr
    assert cli("show", "good-task", RLCLI_PLUGINS="GOOD").returncode == 0
    assert "RLCLI_PLUGINS names 'nmae'" in cli("list-tasks", RLCLI_PLUGINS="good,nmae").stderr


def test_plugin_needing_newer_rlcli_gives_version(plugins, cli):
    metadata = "Metadata-Version: 2.1\nName: early\nVersion: 1.0\nRequires-Dist: rlcli>=99.1\n"
    plugins("early", "from rlcli.task import Wings\n", metadata=metadata)
    done = cli("show", "early-task")
    assert done.returncode == 4
    assert "the plugin needs rlcli 99.1, but" in done.stderr


@pytest.mark.parametrize("command", ["doctor", "list-tasks"])
def test_ctrl_c_kills_probe_processes(broken_plugins, tmp_path, command):
    """Ctrl-C does not wait for a plugin that hangs, and kills its process."""
    broken_plugins("hangs")
    here = tmp_path / "here"
    here.mkdir()
    arguments = ["list-tasks", "hangs", "--probe"] if command == "list-tasks" else ["doctor"]
    process = subprocess.Popen(
        [sys.executable, "-m", "rlcli", *arguments, "--probe-timeout", "500"],
        cwd=here,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TMPDIR": str(here)},
    )
    deadline = time.monotonic() + 60
    while not list(here.glob("rlcli-probe-*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, "Traceback" in err) == (130, False)
    assert not list(here.glob("rlcli-probe-*"))


def test_ctrl_c_during_probe_start_kills_processes(broken_plugins, monkeypatch):
    """The first process runs before the last thread starts, so Ctrl-C may come between the two."""
    broken_plugins("hangs")
    submit = ThreadPoolExecutor.submit

    def interrupted(*arguments, **options):
        submit(*arguments, **options)
        raise KeyboardInterrupt

    monkeypatch.setattr(ThreadPoolExecutor, "submit", interrupted)
    before = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        probe([entry for entry in catalog()[0] if entry.name == "hangs-task"], timeout_s=60.0)
    assert time.monotonic() - before < 30.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flags", "named"),
    [
        ([], "rlcli validate: plugin slow:slow-task (slow:SPEC), 0:10 so far"),
        (["-q"], "warning: plugin slow 1.0: "),
    ],
)
def test_plugin_that_hangs_is_named(plugins, flags, named):
    plugins("slow", "import time\ntime.sleep(600)\n")
    command = [sys.executable, "-m", "rlcli", "validate", "slow-task", *flags]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        lines = [process.stderr.readline() for _ in range(1 if flags else 2)]
        process.kill()
    assert any(line.startswith(named) for line in lines), lines
    if flags:
        assert (
            "slow/__init__.py:2: <module> has not returned for 10 s; if the call does not end, exclude the" in lines[0]
        )


@pytest.mark.slow
def test_probe_of_many_hanging_plugins_takes_little_more_than_one(plugins):
    points = "[rlcli.tasks]\n" + "".join(f"{name} = {{0}}:{name}\n" for name in "abcd")
    for number in range(6):
        plugins(f"slow{number}", "import time\ntime.sleep(600)\n", entry_points=points.format(f"slow{number}"))
    before = time.monotonic()
    entries = [entry for entry in catalog()[0] if entry.distribution.startswith("slow")]
    rows = probe(entries, timeout_s=5.0)
    assert time.monotonic() - before < 40
    reasons = [rows[entry.qualified].broken for entry in entries if entry.distribution == "slow0"]
    assert reasons == ["did not load within 5 s"] * 2 + ["not loaded, because 2 others did not load within 5 s"] * 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("torch.set_default_dtype(torch.float64)", "default dtype from torch.float32 to torch.float64"),
        ("torch.set_default_dtype(torch.float16)", "default dtype from torch.float32 to torch.float16"),
        ("torch.set_default_device('meta')", "default device from cpu to meta"),
        ("torch.set_grad_enabled(False)", "gradient mode from True to False"),
    ],
)
def test_plugin_that_changes_settings_of_torch_changes_no_training(plugins, command, change, message):
    from support.broken_plugins import FILES, SPEC

    plugins("sets", f"import torch\n{change}\n{SPEC}", files=FILES)
    done = command("train", "sets-task", "--num-envs", "2", "--max-iterations", "1", "--logger", "none", "--json")
    assert f"imported code has changed torch's {message}; rlcli has restored the earlier value" in done.stderr
    assert document(done)["state"] == "finished"
    assert (torch.get_default_dtype(), str(torch.get_default_device())) == (torch.float32, "cpu")
    assert torch.is_grad_enabled()


ENDS = {
    "os._exit(0)": "SystemExit: it called os._exit(0)",
    "__import__('sys').exit(0)": "SystemExit: 0",
    "1 / 0": "ZeroDivisionError: division by zero",
}
FORMAT = "import os\nfrom rlcli.formats import FormatSpec\nSPEC = FormatSpec('x', {part})\ndef f(*_):\n    {ends}\n"
PARTS = {
    "import": "import os\n{ends}\n",
    "find": FORMAT.replace("{part}", "find='bad:f'"),
    "read": FORMAT.replace("{part}", "read='bad:f'"),
    "check": FORMAT.replace("{part}", "key='mine', check='bad:f'").replace("{ends}", "yield {ends}"),
}
DIRECT = "from rlcli.envs.direct import DirectTask\nclass Task(DirectTask):\n    num_observations = num_actions = 1\n"
COMMANDS = [("validate", "./task"), ("train", "./task", "--max-iterations", "1", "--logger", "none", "-q")]


@pytest.mark.parametrize("ends", list(ENDS))
@pytest.mark.parametrize("part", list(PARTS))
def test_format_plugin_that_ends_the_process_is_named(plugins, command, tmp_path, part, ends):
    """Neither a command nor its exit code is lost, wherever the plugin ends the process."""
    plugins("bad", PARTS[part].format(ends=ends), entry_points="[rlcli.formats]\nbad = bad:SPEC\n")
    folder = tmp_path / "here" / "task"
    folder.mkdir(parents=True)
    for name, text in FILES.items():
        (folder / name).write_text(text)
    if part in ("read", "check"):
        (folder / "task.yaml").write_text(FILES["task.yaml"] + "mine: {a: 1}\n")
    if part == "check":
        (folder / "task.py").write_text(DIRECT)
    for words in COMMANDS:
        done = command(*words)
        sys.modules.pop("bad", None)
        line = next(line for line in done.stderr.splitlines() if ": plugin bad 1.0: " in line)
        assert ENDS[ends] in line
        assert "__init__.py:" in line
        # a task that does not need the format is read
        assert done.returncode == (0 if part in ("import", "find") else 4), done.stderr
        assert "Traceback" not in done.stderr
    assert command("list-tasks").returncode == 0


def test_children_and_threads_may_end_while_a_command_runs():
    with exit_refused():
        child = multiprocessing.get_context("fork").Process(target=os._exit, args=(7,))
        child.start()
        child.join()
        assert child.exitcode == 7
        with pytest.raises(SystemExit, match=r"it called os\._exit\(3\)"):
            os._exit(3)
