"""Torch's libraries are loaded beside other imports; whatever happens meanwhile, a command ends as it should."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import rlcli

ON_LINUX = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nothing is loaded ahead")


def ran(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env={**os.environ, **variables}, capture_output=True, text=True, timeout=120)


@ON_LINUX
def test_torch_finds_its_libraries_loaded():
    code = """
import threading
from rlcli.machine import load_torch_ahead
load_torch_ahead()
(thread,) = set(threading.enumerate()) - {threading.main_thread()}
thread.join()
assert "libtorch_cpu" in open("/proc/self/maps").read()
import torch
assert torch.nn.Linear(2, 3)(torch.ones(5, 2)).shape == (5, 3)
"""
    done = ran(code)
    assert (done.returncode, done.stderr) == (0, "")


def test_torch_is_imported_while_its_libraries_are_loaded():
    done = ran("from rlcli.machine import load_torch_ahead as f; f(); import torch; print(int(torch.ones(3).sum()))")
    assert (done.returncode, done.stdout.strip()) == (0, "3"), done.stderr


def test_nothing_is_loaded_ahead_of_what_is_there():
    code = "import threading as t, torch; n = t.active_count(); from rlcli.machine import *; load_torch_ahead()"
    done = ran(f"{code}; print(t.active_count() - n)")
    assert done.stdout.strip() == "0", done.stderr


@pytest.mark.parametrize("broken", ["nothing", "no libraries", "garbage", "raises"])
def test_a_torch_that_is_broken_is_no_matter_until_it_is_imported(tmp_path, broken):
    if broken != "nothing":
        (tmp_path / "torch" / "lib").mkdir(parents=True)
        (tmp_path / "torch" / "__init__.py").write_text("raise OSError('no')" if broken == "raises" else "")
    if broken == "garbage":
        (tmp_path / "torch" / "lib" / "libtorch.so").write_bytes(b"garbage" * 1000)
    hidden = "import sys; sys.path = [p for p in sys.path if 'site-packages' not in p]; " if broken == "nothing" else ""
    place = Path(rlcli.__file__).parents[1]
    done = ran(
        f"{hidden}from rlcli.machine import load_torch_ahead as f; f(); print('on')", PYTHONPATH=f"{tmp_path}:{place}"
    )
    assert (done.returncode, done.stdout.strip()) == (0, "on"), done.stderr


@ON_LINUX
def test_a_process_that_ends_meanwhile_waits_for_the_libraries():
    done = ran("from rlcli.machine import load_torch_ahead; load_torch_ahead(); raise SystemExit(5)")
    assert (done.returncode, done.stderr) == (5, "")


def test_a_refused_command_begins_nothing_and_a_program_of_the_users_own_neither(tmp_path):
    code = """
import threading
from rlcli.cli.app import main
assert main(["train", "nosuch"]) == 4
assert main(["train", "cartpole", "--resume", "nosuch"]) == 5
assert threading.active_count() == 1
"""
    done = ran(code)
    assert done.returncode == 0, done.stderr
