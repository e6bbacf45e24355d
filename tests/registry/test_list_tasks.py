"""`list-tasks` and its cache: details of installed tasks without importing them in its own process."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from support.broken_plugins import MODEL, TASK

pytestmark = pytest.mark.processes
HEAVY = ["torch", "mujoco", "numpy", "stable_baselines3"]


def rows(done):
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    return {row["name"]: row for row in document["tasks"]}


def test_index_of_built_in_tasks_is_up_to_date():
    import rlcli_tasks

    file = Path(rlcli_tasks.__file__).with_name("index.json")
    command = [sys.executable, "-m", "rlcli.envs.describe_plugins", "--index", "rlcli"]
    fresh = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert json.loads(file.read_text()) == json.loads(fresh), f"run: {' '.join(command[1:])} > {file}"


def test_built_in_tasks_have_details(command):
    found = rows(command("list-tasks", "--json"))
    cartpole = found["cartpole"]
    assert cartpole["workflow"] == "managed"
    assert (cartpole["observation_size"], cartpole["action_size"], cartpole["agent"]) == (4, 1, "sb3-ppo")
    assert "pole" in cartpole["summary"]
    assert found["cartpole-direct"]["workflow"] == "direct"


def test_list_tasks_imports_no_plugin_and_no_heavy_module(plugins, cli):
    for number in range(3):
        plugins(f"plug{number}", "raise SystemExit('imported')\n")
    program = (
        "import sys; from rlcli.cli.app import main; code = main(['list-tasks']);"
        f"print(code, sorted(set(sys.modules) & {set(HEAVY)!r}), [m for m in sys.modules if m.startswith('plug')])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert lines[-1] == "0 [] []"
    assert sum("SystemExit: imported" in line for line in lines[:-1]) == 3
    assert "after a repair, load again: rlcli list-tasks --probe" in done.stderr


def cpu_time_of_children():
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


@pytest.mark.parametrize(("arguments", "bound_s"), [(["list-tasks"], 0.35), (["--help"], 0.25)])
def test_light_commands_are_fast_with_twenty_plugins(plugins, spec, cli, arguments, bound_s):
    index = {"workflow": "managed", "observation_size": 2, "action_size": 1}
    for number in range(20):
        plugins(f"plug{number}", spec, files={"index.json": json.dumps({f"plug{number}-task": index})})
    times = []
    for _ in range(3):
        start = cpu_time_of_children()
        assert cli(*arguments).returncode == 0
        times.append(cpu_time_of_children() - start)
    assert min(times) < 3 * bound_s


def test_pattern_filters_names_and_summaries(command):
    everything = rows(command("list-tasks", "--json"))
    wanted = [name for name, row in everything.items() if "direct" in f"{name} {row['summary']}".lower()]
    assert "cartpole-direct" in wanted
    assert "cartpole" not in wanted
    assert list(rows(command("list-tasks", "DIRECT", "--json"))) == wanted
    assert rows(command("list-tasks", "no such thing", "--json")) == {}


@pytest.mark.parametrize(
    ("pattern", "advice"),
    [
        ("cartpol-", "did you mean 'cartpole'"),
        ("Cart-pole", "did you mean 'cartpole'"),
        ("zzz", "rlcli list-tasks shows all"),
    ],
)
def test_pattern_without_match_gives_hint(command, pattern, advice):
    done = command("list-tasks", pattern)
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr.startswith(f"no task's name or summary contains '{pattern}'; {advice}")
    assert json.loads(command("list-tasks", pattern, "--json").stdout)["tasks"] == []


def test_shared_names_show_their_distribution(plugins, spec, command):
    plugins("a", spec, task="walk")
    plugins("b", spec, task="walk")
    done = command("list-tasks")
    assert "a:walk" in done.stdout
    assert "b:walk" in done.stdout


def test_unreadable_distribution_is_warning_and_json_row(plugins, command):
    plugins("bad", entry_points="[rlcli.tasks]\nnonsense\n")
    done = command("list-tasks", "--json")
    assert "bad-1.0.dist-info" in done.stderr
    assert json.loads(done.stdout)["broken"][0]["distribution"] == "bad-1.0.dist-info"
    assert "cartpole" in rows(done)


def test_probe_fills_cache_and_reports_broken_tasks(plugins, spec, cli, command):
    plugins("good", "print('hello')\n" + spec, files={"task.yaml": TASK.format(summary="Slide."), "model.xml": MODEL})
    plugins("exits", "import sys\nsys.exit(3)\n")
    plugins("crashes", "import os\nos._exit(7)\n")
    plugins("killed", "import os, signal\nos.kill(os.getpid(), signal.SIGKILL)\n")
    plugins("raises", "raise ValueError('out of cheese')\n")
    plugins("invalid", spec, files={"task.yaml": "decimation: -2\n"})
    found = rows(cli("list-tasks", "task", "--json"))
    good = found["good-task"]
    assert (good["summary"], good["workflow"], good["num_envs"]) == ("Slide.", "managed", 5)
    assert (good["observation_size"], good["action_size"], good["agent"], good["broken"]) == (2, 1, "ppo", None)
    assert "SystemExit: 3" in found["exits-task"]["broken"]
    assert found["crashes-task"]["broken"] == "ended the process (exit 7)"
    assert found["killed-task"]["broken"] == "crashed (SIGKILL)"
    assert "out of cheese" in found["raises-task"]["broken"]
    assert found["invalid-task"]["broken"].endswith("task.yaml:1:1: missing key 'sim' at the top level (and 6 more)")
    again = rows(command("list-tasks", "--json"))
    assert {name: again[name] for name in found} == found
    assert "broken: ended the process (exit 7)" in command("list-tasks").stdout
    again = rows(cli("list-tasks", "task", "--probe", "--json"))
    assert {name: again[name] for name in found} == found


def test_probe_stops_hanging_task(plugins, cli):
    plugins("hangs", "import time\ntime.sleep(600)\n")
    found = rows(cli("list-tasks", "hangs", "--probe", "--probe-timeout", "1.5", "--json"))
    assert found["hangs-task"]["broken"] == "did not load within 1.5 s"


def test_changed_or_reinstalled_plugin_invalidates_cache(plugins, spec, tmp_path):
    import os

    from rlcli.registry import catalog
    from rlcli.registry.probe import _key

    plugins("good", spec)
    entry = next(e for e in catalog()[0] if e.name == "good-task")
    before = _key(entry)
    assert _key(entry) == before
    for number, file in enumerate(("good-1.0.dist-info/RECORD", "good/__init__.py")):
        os.utime(tmp_path / "site" / file, ns=(2**62, 2**62 + number))
        assert _key(entry) != before
        before = _key(entry)


def test_status_shows_state_and_policy(plugins, spec, command):
    details = {"summary": "Fine.", "workflow": "direct", "observation_size": 3, "action_size": 1}
    index = json.dumps({"good-task": {**details, "policy": True}})
    plugins("good", spec, files={"index.json": index})
    plugins("plain", spec, files={"task.yaml": TASK.format(summary="x"), "model.xml": MODEL})
    done = command("list-tasks")
    head, *lines = done.stdout.splitlines()
    assert head.split()[2:8] == ["WORKFLOW", "OBS", "ACT", "ENVS", "AGENT", "STATUS"]
    shown = {line.split()[0]: line for line in lines}
    assert "  ok, policy  " in shown["good-task"]
    assert "  ok, policy  " in shown["cartpole"]
    assert "  ok  " in shown["plain-task"]
    found = rows(command("list-tasks", "--json"))
    assert [found[name]["status"] for name in ("good-task", "cartpole", "plain-task")] == ["ok, policy"] * 2 + ["ok"]
    assert (found["cartpole"]["policy"], found["ant-direct"]["policy"]) == (True, found["ant-direct"]["status"] != "ok")


def test_plugin_may_ship_details(plugins, spec, cli):
    index = json.dumps({"good-task": {"summary": "Shipped.", "workflow": "direct", "observation_size": 3}})
    plugins("good", spec, files={"index.json": index})
    row = rows(cli("list-tasks", "--json"))["good-task"]
    assert (row["summary"], row["observation_size"], row["action_size"]) == ("Shipped.", 3, None)


@pytest.mark.parametrize(
    "index",
    ["", "[]", "{", '{"good-task": 3}', '{"good-task": {"summary": ["x"]}}', '{"good-task": {"num_envs": "x"}}'],
)
def test_invalid_details_are_ignored(plugins, spec, command, index, tmp_path):
    plugins("good", spec, files={"index.json": index})
    (tmp_path / "cache" / "rlcli").mkdir(parents=True)
    (tmp_path / "cache" / "rlcli" / "tasks.json").write_text(index)
    done = command("list-tasks")
    assert done.returncode == 0
    assert "good-task" in done.stdout


def test_printing_plugin_keeps_json_valid(plugins, spec, cli):
    plugins(
        "loud",
        "print('hello')\nimport sys; sys.stdout.write('again')\n" + spec,
        files={"task.yaml": TASK.format(summary="x"), "model.xml": MODEL},
    )
    done = cli("show", "loud-task", "--json")
    assert json.loads(done.stdout)["config"]["summary"] == "x"
    assert "hello" in done.stderr


@pytest.mark.parametrize("source", ["import sys\nsys.exit(0)\n", "def f(:\n", "import no_such_module\n", "SPEC = 3\n"])
def test_broken_plugin_exits_with_4_without_traceback(plugins, cli, source):
    plugins("odd", source)
    done = cli("show", "odd-task", "--json")
    error = json.loads(done.stdout)["error"]
    assert (done.returncode, error["exit_code"], error["kind"]) == (4, 4, "task")
    assert "plugin odd 1.0: entry point 'odd-task' = odd:SPEC " in error["message"]
    assert "Traceback" not in done.stderr
    assert cli("show", "cartpole").returncode == 0


def test_broken_probe_result_wins_over_shipped_details(plugins, cli, command):
    plugins("bad", "raise ValueError('out of cheese')\n", files={"index.json": '{"bad-task": {"workflow": "direct"}}'})
    assert rows(command("list-tasks", "--json"))["bad-task"]["broken"] is None
    assert "out of cheese" in rows(cli("list-tasks", "bad", "--probe", "--json"))["bad-task"]["broken"]
    assert "out of cheese" in rows(command("list-tasks", "--json"))["bad-task"]["broken"]
