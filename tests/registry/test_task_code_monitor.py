"""The thread that looks at the frames of the running code."""

import subprocess
import sys

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
