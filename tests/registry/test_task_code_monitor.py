"""The thread that looks at the frames of the running code."""

import subprocess
import sys

from rlcli.registry import task_code_monitor

SCRIPT = """
import gc, random, sys, threading, time, types
from rlcli.registry.task_code_monitor import frames_of_thread

class Cycle:
    def __init__(self):
        self.me = self

functions = []
for count in range(1, 40):  # frames of different sizes, which hold objects that are no frames
    variables = "".join(f"    v{number} = {count}.0\\n" for number in range(count))
    names = {"functions": functions, "Cycle": Cycle}
    exec(f"def f(n):\\n{variables}    Cycle()\\n    return functions[n * 7 % 39](n - 1) if n else None\\n", names)
    functions.append(names["f"])

main, ended = threading.get_ident(), threading.Event()

def watch():
    while not ended.is_set():
        assert all(type(frame) is types.FrameType for frame in frames_of_thread(main))
    print("watched")

def pause(*_):  # like a finalizer that lets other threads run
    if threading.get_ident() != main:
        time.sleep(0.0002)

watcher = threading.Thread(target=watch)
gc.callbacks.append(pause)
gc.set_threshold(30)
sys.setswitchinterval(1e-4)
watcher.start()
end = time.monotonic() + 3
while time.monotonic() < end:
    random.choice(functions)(random.randrange(400))
ended.set()
watcher.join()
"""


def test_frames_of_a_running_thread_are_read_without_a_crash():
    """On Python 3.11, a garbage collection inside of `f_back` made it read freed memory."""
    done = subprocess.run([sys.executable, "-P", "-c", SCRIPT], capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout) == (0, "watched\n"), done.stderr[-2000:]


def test_packages_of_pip_install_target_are_no_code_of_a_task(tmp_path, monkeypatch):
    library, task = tmp_path / "target" / "library.py", tmp_path / "project" / "own_task.py"
    (library.parent / "library-1.0.dist-info").mkdir(parents=True)
    task.parent.mkdir()
    for folder in (library.parent, task.parent):
        monkeypatch.syspath_prepend(folder)
    for cached in (task_code_monitor._libraries, task_code_monitor.is_task_file):
        cached.cache_clear()
    try:
        assert not task_code_monitor.is_task_file(str(library), "library")
        assert task_code_monitor.is_task_file(str(task), "own_task")
    finally:
        task_code_monitor._libraries.cache_clear()
