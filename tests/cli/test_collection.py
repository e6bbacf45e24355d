"""Garbage collection: rare while a command starts, with the usual thresholds once it runs."""

import gc
import subprocess
import sys

from rlcli.cli.app import main

PROBE = """
import gc, sys
from rlcli.machine import garbage_collection
usual = gc.get_threshold()
as_usual, seen = garbage_collection.restore_garbage_collection, []
def record_thresholds():
    seen.append(gc.get_threshold())
    as_usual()
    seen.append(gc.get_threshold())
garbage_collection.restore_garbage_collection = record_thresholds
from rlcli.cli.app import main
code = main()
assert code == 0, code
assert len(seen) == 2, seen
assert seen[0][0] > 50 * usual[0], seen
assert seen[1] == usual, seen
print("as usual again")
"""


def run_probe(*words, folder):
    done = subprocess.run([sys.executable, "-c", PROBE, *words], capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_train_and_eval_restore_gc_thresholds(tmp_path):
    small = ["--num-envs", "8", "--quiet"]
    assert "as usual again" in run_probe(
        "train", "cartpole", "--max-iterations", "1", *small, "--runs-dir", "runs", folder=tmp_path
    )
    assert "as usual again" in run_probe("eval", "cartpole", "--episodes", "8", *small, folder=tmp_path)


def test_main_called_from_python_keeps_gc_thresholds():
    before = gc.get_threshold()
    assert main(["show", "cartpole"]) == 0
    assert gc.get_threshold() == before
