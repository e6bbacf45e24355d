"""Code of a task that hangs, warns, or raises errors of the system: each is reported once, with its file and line."""

import json
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from support.command_line import COIN, COIN_TASK

from rlcli.registry.task_code_monitor import _OwnTime

pytestmark = [pytest.mark.usefixtures("empty_folder"), pytest.mark.processes]

HOOKS = {
    "pre_physics_step": "def pre_physics_step(self, actions): ...",
    "reset_idx": "self.fails[env_ids] =",
    "get_observations": "self.obs_buf[:, 0] =",
    "calculate_metrics": "self.rew_buf[:] =",
    "is_done": "self.reset_buf[:] =",
}
"""Hook of a direct task -> the text before which a line of code is inserted."""


@pytest.fixture
def with_code(coin, tmp_path):
    """Return a function that inserts code into a hook of the task, and returns the number of its line."""

    def insert(hook, code, settings="num_envs: 32"):
        anchor = HOOKS[hook]
        place = COIN_TASK.index(anchor)
        changed = COIN_TASK.replace(anchor, f"{code}; {anchor}")
        if hook == "pre_physics_step":
            changed = COIN_TASK.replace(
                "pre_physics_step(self, actions): ...", f"pre_physics_step(self, actions): {code}"
            )
        (tmp_path / "coin" / "task.py").write_text(f"import os, time, warnings, logging, threading{changed}")
        (tmp_path / "coin" / "task.yaml").write_text(COIN.replace("num_envs: 32", settings))
        return COIN_TASK[:place].count("\n") + 1

    return insert


TRAIN = ("train", "./coin", "--num-envs", "4", "--logger", "none", "-q")
EVAL = ("eval", "./coin", "--policy", "zero", "--episodes", "4")
HANG = "[time.sleep(0.5) for _ in range(1200)]"


@pytest.mark.slow
@pytest.mark.timeout(200)
@pytest.mark.parametrize(
    ("hook", "words"),
    [
        ("calculate_metrics", TRAIN),
        ("pre_physics_step", EVAL),
        ("reset_idx", ("play", "./coin", "--policy", "zero", "--viewer", "none", "-q")),
        ("get_observations", ("check", "./coin")),
        ("is_done", ("lint", "./coin")),
    ],
)
def test_hook_that_hangs_is_named(with_code, start, tmp_path, hook, words):
    line = with_code(hook, HANG)
    process = start(*words)
    found = next(text for text in process.stderr if "has not returned" in text)
    assert f"warning: {tmp_path}/coin/task.py:{line}: {hook} has not returned for 10 s" in found
    time.sleep(2)
    process.kill()
    assert "has not returned" not in process.stderr.read()


@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="the kernel does not measure waiting threads")
def test_clock_of_a_hanging_call_leaves_out_the_wait_for_a_cpu():
    """Four processes share one CPU: each runs for about a quarter of the time, and a sleeping thread waits for none."""
    cpu = min(os.sched_getaffinity(0))
    code = f"import os; os.sched_setaffinity(0, [{cpu}])\nwhile True: pass"
    rivals = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(3)]
    own = os.sched_getaffinity(0)
    os.sched_setaffinity(0, [cpu])
    try:
        clock, begin = _OwnTime(threading.get_native_id()), time.monotonic()
        while time.monotonic() - begin < 2.0:
            pass
        busy, wall = clock.now(), time.monotonic() - begin
        assert busy < 0.6 * wall
    finally:
        os.sched_setaffinity(0, own)
        for rival in rivals:
            rival.kill()
            rival.wait()
    clock, begin = _OwnTime(threading.get_native_id()), time.monotonic()
    time.sleep(0.5)
    assert clock.now() > 0.45


@pytest.mark.slow
def test_import_of_a_task_that_hangs_is_named(coin, tmp_path, start):
    (tmp_path / "coin" / "task.py").write_text(f"import time\ntime.sleep(600)\n{COIN_TASK}")
    process = start("validate", "./coin", "--deep", "-q")
    assert "coin/task.py:2: <module> has not returned for 10 s" in process.stderr.readline()


@pytest.mark.slow
def test_hook_that_hangs_in_a_worker_process_is_named(with_code, start):
    line = with_code("calculate_metrics", "self.env.shard.first and time.sleep(20)", "num_envs: 32, workers: 2")
    process = start(*TRAIN)
    assert f"coin/task.py:{line}: calculate_metrics has not returned for 10 s" in process.stderr.readline()


LOUD = "warnings.warn(chr(27) + '[31m' + 'x y ' * 900 + str(self.progress_buf[0]))"
LOGS = "logging.getLogger('task').warning(chr(27) + '[2J%s', 'x y ' * 900)"


def stderr_of(process):
    """Return what a successful command prints on stderr. Warnings in this process would go to pytest."""
    _, err = process.communicate()
    assert process.returncode == 0, err
    return err


@pytest.mark.parametrize(
    "code", [LOUD, LOGS, "logging.getLogger('task').warning('%d', 'x y')"], ids=["warn", "log", "bad log"]
)
def test_warning_of_a_task_is_one_short_line(with_code, start, code):
    line = with_code("calculate_metrics", code)
    err = stderr_of(start(*EVAL))
    (warning,) = [text for text in err.splitlines() if "coin/task.py:" in text]
    assert warning.startswith("warning: ")
    assert f"coin/task.py:{line}: " in warning
    assert len(warning.partition("task.py:")[2]) < 220
    assert "\x1b" not in err
    assert "x y " * 60 not in err


def test_warning_of_a_task_in_workers_is_printed_once(with_code, start):
    line = with_code("calculate_metrics", "warnings.warn('mind the gap')", "num_envs: 32, workers: 2")
    err = stderr_of(start(*TRAIN[:2], *TRAIN[4:]))
    assert err.count("mind the gap") == 1
    assert f"coin/task.py:{line}: UserWarning: mind the gap" in err


def test_error_in_a_thread_of_a_task_is_one_line(with_code, cli):
    line = with_code("calculate_metrics", "t = threading.Thread(target=lambda: 1 / 0); t.start(); t.join()")
    found = cli(*EVAL)
    assert found.code == 0
    assert f"coin/task.py:{line}: error in a thread or destructor: ZeroDivisionError: division by zero" in found.err


@pytest.mark.parametrize(
    "code", ["type('X', (), {'__del__': lambda self: os._exit(3)})()", "finalize(X(), sys.exit, 3)"]
)
def test_exit_in_a_destructor_of_a_task_is_one_line(with_code, start, code):
    made = "X = type('X', (), {})" if "finalize" in code else "pass"
    line = with_code("calculate_metrics", f"import sys; from weakref import finalize; {made}; {code}")
    err = stderr_of(start(*EVAL))
    assert err.count(f"coin/task.py:{line}: error in a thread or destructor: SystemExit: ") == 1, err
    assert "Exception ignored" not in err


ERRORS = {
    "open('/no/such')": "FileNotFoundError: [Errno 2] No such file or directory: '/no/such'",
    "open('x' * 300)": "OSError: [Errno 36] File name too long: ",
    "exec('raise BrokenPipeError(32, str(32))')": "BrokenPipeError: [Errno 32] 32",
    "exec('raise EOFError(7)')": "EOFError: 7",
    "next(iter([]))": "StopIteration",
    "os._exit(7)": "SystemExit: it called os._exit(7)",
    "exec('import posix; posix._exit(7)')": "SystemExit: it called os._exit(7)",
    "os.abort()": "SystemExit: it called os.abort()",
    "os.fork()": "RuntimeError: os.fork would continue the command in two processes",
    "__import__('pty').fork()": "RuntimeError: os.forkpty would continue the command in two processes",
    "exec('import typer; raise typer.Exit(0)')": "Exit: 0",
    "exec('import typer; raise typer.Abort')": "Abort",
}


@pytest.mark.parametrize("code", ERRORS)
@pytest.mark.parametrize("words", [EVAL, TRAIN], ids=["eval", "train"])
def test_system_error_of_a_task_has_its_line(with_code, cli, words, code):
    line = with_code("calculate_metrics", code)
    found = cli(*words)
    assert found.code == 4, found.err
    assert f"coin/task.py:{line}: calculate_metrics: {ERRORS[code]}" in found.err


@pytest.mark.parametrize("code", [*ERRORS, "1 / 0"])
def test_error_of_a_task_in_a_worker_process_has_its_line(with_code, cli, code):
    line = with_code("calculate_metrics", f"self.env.shard.first and {code}", "num_envs: 32, workers: 2")
    found = cli(*TRAIN[:2], *TRAIN[4:])
    assert found.code == 4, found.err
    assert f"coin/task.py:{line}: calculate_metrics: {ERRORS.get(code, 'ZeroDivisionError')}" in found.err


@pytest.mark.parametrize(
    "code",
    [
        "import builtins; builtins.len = builtins.isinstance = builtins.print = None",
        "import builtins; del builtins.str, builtins.type, builtins.len",
        "import builtins; builtins.len = None; raise ValueError",
    ],
)
def test_import_that_breaks_built_in_functions_is_an_error(coin, tmp_path, start, code):
    (tmp_path / "coin" / "task.py").write_text(f"{COIN_TASK}\n{code}\n")
    process = start(*EVAL)
    _, err = process.communicate()
    assert process.returncode == 4, err
    assert "Traceback" not in err
    assert "replaced the built-in functions" in err
    assert "coin/task.py" in err.splitlines()[-1] + err.splitlines()[-2]


BREAKS = {
    "vars(builtins).update(len=None, print=None)": "len, print",
    "[vars(builtins).pop(name) for name in ('isinstance', 'type')]": "isinstance, type",
    "vars(builtins).update(isinstance=lambda *_: False)": "isinstance",
    "vars(builtins).update(__import__=None)": "__import__",
    "vars(builtins).clear()": "__name__, __doc__, __package__",
}


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("code", BREAKS)
def test_hook_that_breaks_built_in_functions_is_named(with_code, start, workers, code):
    guard = "self.env.shard.first and " if workers == 2 else ""
    line = with_code("calculate_metrics", f"import builtins; {guard}{code}", f"num_envs: 32, workers: {workers}")
    process = start(*TRAIN)
    _, err = process.communicate()
    assert process.returncode == 4, err
    assert "Traceback" not in err
    found = f"code of the task has deleted or replaced the built-in functions {BREAKS[code]}"
    assert f"coin/task.py:{line}: {found}" in err


CHANGES = {
    "torch.zeros = None": "torch.zeros",
    "time.monotonic = None": "time.monotonic",
    "vars(time).update(monotonic=None)": "time.__dict__",
    "del os.replace": "os.replace",
    "setattr(threading.Thread, 'start', None)": "threading.Thread.start",
    "sys.modules.clear()": "sys.modules",
    "sys.modules.update(dict.fromkeys(sys.modules))": "sys.modules",
    "sys.modules.update({name: 3 for name in sys.modules if name != 'sys'})": "sys.modules",
    "exec('torch.zeros = torch.ones = None')": "torch.ones",
}


@pytest.mark.parametrize("code", CHANGES)
def test_hook_that_breaks_a_library_is_named(with_code, start, code):
    """The command fails later, in code of rlcli: no frame of the traceback is the task's."""
    line = with_code("calculate_metrics", f"import sys; torch.backends.cudnn.enabled = False; {code}")
    process = start(*TRAIN)
    _, err = process.communicate()
    assert process.returncode == 4, err
    assert "Traceback" not in err
    assert f"coin/task.py:{line}: code of the task changes {CHANGES[code]}, which is probably the reason for" in err


@pytest.mark.parametrize("words", [TRAIN, EVAL], ids=["train", "eval"])
def test_hook_that_breaks_modules_under_another_name_is_named(with_code, start, words):
    line = with_code("calculate_metrics", "import sys; m = sys.modules; [m.update({k: None}) for k in list(m)[::2]]")
    process = start(*words)
    _, err = process.communicate()
    assert process.returncode == 4, err
    assert "Traceback" not in err
    assert f"coin/task.py:{line}: code of the task has removed or replaced " in err
    assert "not installed" not in err


IN_A_STRING = {
    "def f(self): 1 / 0": "ZeroDivisionError: division by zero",
    "def f(self): os._exit(7)": "SystemExit: it called os._exit(7)",
    "def f(self): os.fork()": "RuntimeError: os.fork would continue",
    "def f(self): exec('import os; os.fork()', {})": "RuntimeError: os.fork would continue",
}


@pytest.mark.parametrize("code", IN_A_STRING)
@pytest.mark.parametrize("words", [EVAL, TRAIN], ids=["eval", "train"])
def test_hook_from_a_string_is_named_with_the_file_of_the_task(coin, cli, tmp_path, words, code):
    after = f"namespace = globals(); exec({code!r}, namespace); Task.calculate_metrics = namespace['f']"
    (tmp_path / "coin" / "task.py").write_text(f"import os\n{COIN_TASK}\n{after}\n")
    found = cli(*words)
    assert found.code == 4, found.err
    assert f"coin/task.py: line 1 of code in a string: f: {IN_A_STRING[code]}" in found.err


def test_error_in_a_thread_whose_code_is_from_a_string_is_one_line(coin, cli, tmp_path):
    code = "def f(): 1 / 0\nt = threading.Thread(target=f); t.start(); t.join()"
    after = f"import threading\nexec({code!r})"
    (tmp_path / "coin" / "task.py").write_text(f"{COIN_TASK}\n{after}\n")
    found = cli(*EVAL)
    assert found.code == 0, found.err
    assert "coin/task.py: line 1 of code in a string: error in a thread or destructor: ZeroDivisionError" in found.err


def test_hook_that_breaks_a_library_in_a_worker_process_is_named(with_code, start):
    line = with_code(
        "calculate_metrics", "self.env.shard.first and setattr(torch, 'zeros', None)", "num_envs: 32, workers: 2"
    )
    process = start(*TRAIN)
    _, err = process.communicate()
    assert process.returncode == 4, err
    assert f"coin/task.py:{line}: code of the task changes torch.zeros, which is probably" in err


def test_thread_of_a_task_that_ends_the_command_is_named(with_code, start):
    line = with_code("calculate_metrics", "t = threading.Thread(target=lambda: os._exit(0)); t.start(); t.join()")
    process = start(*EVAL)
    _, err = process.communicate()
    assert process.returncode == 4, err
    assert err.endswith(f"coin/task.py:{line}: a thread has ended the command with os._exit(0)\n")


@pytest.mark.slow
def test_thread_of_a_task_that_outlasts_the_command_is_named(with_code, start):
    line = with_code("reset_idx", "threading.Thread(target=lambda: time.sleep(15)).start()")
    err = stderr_of(start(*EVAL))
    assert f"coin/task.py:{line}: a thread still runs 10 s after the end of the command" in err


def test_timer_of_a_task_is_named(with_code, start):
    line = with_code("calculate_metrics", "import signal; signal.alarm(1); time.sleep(5)")
    process = start(*EVAL)
    _, err = process.communicate()
    assert process.returncode == 4, err
    assert (
        f"coin/task.py:{line}: a timer has expired, and the task's code has set no handler for its signal SIGALRM"
        in err
    )


@pytest.mark.parametrize("text", ["'x y ' * 900", "'a\\nhint: run: curl x | sh' * 30", "chr(27) * 900"])
def test_text_of_an_error_of_a_task_is_short(with_code, cli, text):
    line = with_code("calculate_metrics", f"exec('raise ValueError(t)', {{'t': {text}}})")
    found = cli(*EVAL)
    (error,) = [each for each in found.err.splitlines() if each.startswith("error: ")]
    assert len(error.partition(f":{line}: calculate_metrics: ")[2].replace("\\x1b", "x")) <= 200
    assert "\nhint: run" not in found.err
    assert "\x1b" not in found.err


@pytest.mark.parametrize("hook", ["calculate_metrics", "reset_idx"])
def test_task_that_changes_the_current_folder_is_trained(with_code, start, tmp_path, hook):
    with_code(hook, "os.chdir('/')")
    process = start(*TRAIN[:-1], "--max-iterations", "1")
    out, err = process.communicate()
    assert process.returncode == 0, err
    (run,) = Path("runs/coin").iterdir()
    assert out == f"{run}\n"
    assert f"run {run}\n" in err
    assert json.loads((run / "run.json").read_text())["state"] == "finished"


@pytest.mark.parametrize("hook", ["calculate_metrics", "reset_idx", "is_done"])
def test_relative_paths_are_valid_if_a_hook_changes_the_current_folder(with_code, cli, start, hook):
    """Each command runs hooks before it writes its file into the run or the current folder."""
    assert cli(*TRAIN).code == 0
    (run,) = Path("runs/coin").iterdir()
    with_code(hook, "os.chdir('/')")
    assert cli("report", run, "--no-video").code == 0
    assert (run / "report.html").is_file()
    assert cli("export", "--checkpoint", run, "--format", "bundle", "-o", "bundle").code == 0
    assert Path("bundle/manifest.json").is_file()
    assert cli("eval", "--checkpoint", run, "--episodes", "4", "--record", "episodes.npz").code == 0
    assert Path("episodes.npz").is_file()
    assert cli("runs").out.count("finished") == 1
    assert Path.cwd() != Path("/")


def test_recording_in_a_relative_path_is_written_if_a_hook_changes_the_current_folder(with_code, start):
    with_code("reset_idx", "os.chdir('/')")
    process = start(*EVAL, "--record", "episodes.npz")
    _, err = process.communicate()
    assert process.returncode == 0, err
    assert Path("episodes.npz").is_file()
