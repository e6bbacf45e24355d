"""A signal ends a command even if it arrives while Python runs a destructor, which drops exceptions."""

import subprocess
import sys

import pytest

PROGRAM = """
import os, signal, time, weakref
from rlcli.machine import stop_signals

class Thing:
    pass

class Closer:
    def __del__(self):
        os.kill(os.getpid(), signal.{number})
        time.sleep(0.2)

def closed(_):
    os.kill(os.getpid(), signal.{number})
    time.sleep(0.2)

stop_signals.raise_on_signals()
try:
    {code}
    time.sleep(20)
    print("lost")
except KeyboardInterrupt:
    print(stop_signals.stopped_by_signal().message)
"""


@pytest.mark.parametrize("code", ["Closer()", "thing = Thing(); reference = weakref.ref(thing, closed); del thing"])
@pytest.mark.parametrize(
    ("number", "message"), [("SIGINT", "interrupted\n"), ("SIGTERM", "stopped by the signal SIGTERM\n")]
)
def test_signal_in_a_destructor_or_callback_ends_the_command(code, number, message):
    program = PROGRAM.format(code=code, number=number)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.stdout, done.stderr, done.returncode) == (message, "", 0)


def test_other_errors_of_destructors_are_printed():
    program = (
        "from rlcli.machine import stop_signals\nstop_signals.raise_on_signals()\n"
        "class Broken:\n    def __del__(self):\n        raise ValueError('no key')\nBroken()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert "ValueError: no key" in done.stderr


C_CODE = """
import ctypes, os, signal, sys
from rlcli.machine import stop_signals

run = ctypes.pythonapi.PyRun_String
run.restype, run.argtypes = ctypes.py_object, [ctypes.c_char_p, ctypes.c_int, ctypes.py_object, ctypes.py_object]
names = {"__builtins__": __builtins__, "os": os, "signal": signal}
stop_signals.raise_on_signals()
try:
    run(b"os.kill(os.getpid(), signal.SIGTERM)\\nwhile True: pass\\n", 257, names, names)
except KeyboardInterrupt:
    stop_signals.end_on_signals()
    sys.exit(75)
"""


def test_exit_code_is_kept_if_the_signal_arrives_in_python_code_of_a_c_library(tmp_path):
    (tmp_path / "program.py").write_text(C_CODE)
    done = subprocess.run(
        [sys.executable, "-m", "program"], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (75, "")
