"""Files and lines on two ways through the code: `python benchmarks/reading_paths.py action` and `config`.

`action`: a rollout of `ppo` in the task, from `Collector.collect` through `VecEnv.step` with resets, and back.
`config`: `rlcli train` from the command line to the built environment; only functions that get or return a part of the
configuration count.

A line is to be read if it belongs to a function of rlcli that runs on the way, to the head of its class (all but its
methods), or to the head of its module (docstring, imports, constants). `lines` are those of the whole file.
"""

from __future__ import annotations

import argparse
import ast
import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import rlcli
import rlcli.cli.app
from rlcli.config.load import Resolved, resolve
from rlcli.config.schema.base import StrictModel
from rlcli.runs.trusted_tasks import named_task
from rlcli.training import setup

PACKAGE = Path(rlcli.__file__).parent
FUNCTION = 3
"""Flags of the code of a function; the body of a module or class, which runs at import, has others."""
PARTS = {"Resolved", "Layers", "TaskSource", "Document", "Signature", "Vocabulary", "TaskCheck", "TrainingRequest"}
PARTS |= {"Job", "Loader", "_Reader"}
"""Classes, besides the models of the schema, whose objects are or contain a part of the configuration."""


class Recorder:
    """Recorder of the functions of rlcli that run; `wanted` says for a call or return whether it counts."""

    def __init__(self, wanted: Callable[[FrameType, str, Any], bool]) -> None:
        self.lines: dict[str, set[int]] = defaultdict(set)
        self._wanted = wanted

    def __call__(self, frame: FrameType, event: str, result: Any) -> None:
        """Record a call or return; Python calls this method as the profile function."""
        code = frame.f_code
        is_own = code.co_flags & FUNCTION == FUNCTION and code.co_filename.startswith(f"{PACKAGE}/")
        if is_own and event in ("call", "return") and self._wanted(frame, event, result):
            self.lines[code.co_filename].add(code.co_firstlineno)

    def report(self) -> None:
        """Print one row for each file, and the totals."""
        rows = []
        for file, lines in sorted(self.lines.items()):
            text = Path(file).read_text(encoding="utf-8")
            tree = ast.parse(text)
            if read := _read_in(tree, lines):
                rows.append((file, len(text.splitlines()), len(read | _head(tree))))
        for file, whole, count in rows:
            print(f"{Path(file).relative_to(PACKAGE)!s:45} {whole:5} lines {count:5} to read")
        print(f"{len(rows)} files, {sum(row[1] for row in rows)} lines, {sum(row[2] for row in rows)} to read")


def _first(node: Any) -> int:
    return min([node.lineno, *(each.lineno for each in node.decorator_list)])


def _head(node: Any) -> set[int]:
    """Return the lines of a module or class without its functions and classes."""
    defined = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    parts = [each for each in node.body if not isinstance(each, defined)]
    return {line for each in parts for line in range(each.lineno, each.end_lineno + 1)}


def _read_in(node: Any, lines: set[int]) -> set[int]:
    """Return the lines to read in the functions and classes of a module or class."""
    read: set[int] = set()
    for each in node.body:
        if isinstance(each, ast.ClassDef) and (inside := _read_in(each, lines)):
            read |= inside | _head(each) | {*range(_first(each), each.lineno + 1)}
        elif isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef):
            own = {*range(_first(each), (each.end_lineno or 0) + 1)}
            read |= own if own & lines else set()
    return read


def _is_config(value: Any) -> bool:
    if isinstance(value, StrictModel | Resolved) or type(value).__name__ in PARTS:
        return True
    if isinstance(value, type):
        return issubclass(value, StrictModel)
    own = getattr(value, "__dict__", {}) if type(value).__module__.startswith("rlcli") else {}
    return not {"resolved", "config", "_resolved", "_config"}.isdisjoint(own)


def _handles_config(frame: FrameType, event: str, result: Any) -> bool:
    if event == "return":
        return _is_config(result)
    code = frame.f_code
    names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
    return any(_is_config(frame.f_locals.get(name)) for name in names)


def action(task: str) -> None:
    """Report the way of an action."""
    overrides = ["scene.num_envs=64", "scene.workers=1", "episode_length_s=0.5"]
    resolved = resolve(named_task(task), overrides=overrides, agent="ppo")
    trainer: Any = setup.make_trainer(resolved, 3, "cpu", 1)[0]
    trainer.start()
    trainer.iterate()
    recorder = Recorder(lambda frame, event, result: True)
    sys.setprofile(recorder)
    trainer.collector.collect()
    sys.setprofile(None)
    recorder.report()


def config(task: str) -> None:
    """Report the way of a configuration; the training stops when its environment is built."""
    recorder, make = Recorder(_handles_config), setup.make_training_env

    def stop_after(*arguments: Any, **settings: Any) -> Any:
        make(*arguments, **settings)
        sys.setprofile(None)
        recorder.report()
        raise KeyboardInterrupt

    setup.make_training_env = stop_after
    sys.setprofile(recorder)
    rlcli.cli.app.main(
        ["train", task, "--agent", "ppo", "--num-envs", "16", "scene.workers=1", "--logger", "none", "-q"]
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", choices=["action", "config"])
    parser.add_argument("task", nargs="?", default="cartpole")
    given = parser.parse_args()
    {"action": action, "config": config}[given.path](given.task)
