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
