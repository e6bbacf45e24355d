"""Torch's libraries are loaded beside other imports; whatever happens meanwhile, a command ends as it should."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nothing is loaded ahead")


def ran(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "GOMP_SPINCOUNT"}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env={**environment, **variables}, capture_output=True, text=True, timeout=120)


@ON_LINUX
def test_torch_finds_its_libraries_loaded():
    code = """
import os, threading, time
from rlcli.machine import load_torch_ahead, torch_is_loading
load_torch_ahead()
assert torch_is_loading()
while torch_is_loading():
    time.sleep(0.01)
assert "libtorch_cpu" in open("/proc/self/maps").read()
import torch
assert torch.nn.Linear(2, 3)(torch.ones(5, 2)).shape == (5, 3)
print(os.environ["GOMP_SPINCOUNT"])
"""
    done = ran(code)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "1000"


def test_what_the_user_says_of_waiting_threads_stays():
    code = "import os; from rlcli.machine import load_torch_ahead as f; f(); print(os.environ['GOMP_SPINCOUNT'])"
    assert ran(code, GOMP_SPINCOUNT="7").stdout.strip() == "7"


def test_torch_is_imported_while_its_libraries_are_loaded():
    code = "from rlcli.machine import load_torch_ahead as f; f(); import torch; print(int(torch.ones(3).sum()))"
    done = ran(code)
    assert (done.returncode, done.stdout.strip()) == (0, "3"), done.stderr


def test_nothing_is_loaded_ahead_of_what_is_there():
    code = "import torch; from rlcli.machine import *; load_torch_ahead(); print(torch_is_loading())"
    assert ran(code).stdout.strip() == "False"


@pytest.mark.parametrize("repeat", range(3))
@pytest.mark.parametrize("command", ["train", "eval"])
def test_a_command_that_is_refused_meanwhile_ends_as_it_should(command, repeat):
    done = ran(f"import sys; sys.argv[1:] = ['{command}', 'nosuch']; import rlcli.cli.app as a; sys.exit(a.main())")
    assert (done.returncode, done.stdout) == (4, "")
    assert done.stderr.startswith("error: no task 'nosuch'\nhint: ")


@ON_LINUX
def test_a_process_that_ends_otherwise_waits_for_the_libraries():
    done = ran("from rlcli.machine import load_torch_ahead; load_torch_ahead(); raise SystemExit(5)")
    assert (done.returncode, done.stderr) == (5, "")
