"""Microseconds per call of every observation, reward, termination and success term: `python benchmarks/terms.py`.

The environments are those of the terms' tests, in their three states in turn. Quantities that are computed once per
step (rotations, velocities of bodies, float32 copies) count for each term that reads them: their cache is cleared
between calls.
"""

from __future__ import annotations

import argparse
import inspect
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from machine import describe

TESTS = Path(__file__).resolve().parent.parent / "tests"
sys.path[:0] = [str(TESTS), str(TESTS / "mdp")]
from support.mdp_table import OBSERVATIONS, REWARDS, SUCCESS, TERMINATIONS  # noqa: E402
from support.mdp_worlds import bound, hand_made, sensors  # noqa: E402

SECTIONS = {"observations": OBSERVATIONS, "rewards": REWARDS, "terminations": TERMINATIONS, "success": SUCCESS}


def forces(env: Any) -> dict[str, list[tuple[Any, dict[str, Any], None]]]:
    """Return the terms that a separate test measures."""
    from rlcli.mdp import observations, rewards

    return {
        "observations": [(observations.body_incoming_wrench, {"entity": "robot", "bodies": ".*"}, None)],
        "rewards": [(rewards.body_lin_acc_l2, {"entity": "robot", "bodies": ".*"}, None)],
    }


def microseconds(env: Any, call: Callable[[], Any], seconds: float) -> float:
    """Return the fastest of several blocks; caches are cleared between calls."""
    best, calls = float("inf"), 4
    end = time.perf_counter() + seconds
    with torch.inference_mode():
        call()
        while best == float("inf") or time.perf_counter() < end:
            begin = time.perf_counter()
            for _ in range(calls):
                env.sim.stamp += 1
                call()
            best = min(best, (time.perf_counter() - begin) / calls)
    return 1e6 * best


def measure(num_envs: int, seconds: float) -> dict[str, float]:
    """Return `section.term` -> microseconds, the slowest row of each term."""
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as folder:
        env = hand_made(Path(folder), num_envs=num_envs)
        made = sensors(num_envs)
        for section, rows in SECTIONS.items():
            for term, parameters, _ in [*rows, *forces(env).get(section, [])]:
                given = bound(env, parameters, made)
                if inspect.isclass(term):
                    call = term(env, **given)
                else:
                    call = lambda term=term, given=given: term(env, **given)  # noqa: E731
                name = f"{section}.{term.__name__}"
                found[name] = max(found.get(name, 0.0), microseconds(env, call, seconds))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num-envs", nargs="+", type=int, default=[64, 1024, 4096])
    parser.add_argument("--seconds", type=float, default=0.03, help="spent on each row of the table")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    columns = {n: measure(n, options.seconds) for n in options.num_envs}
    if options.json:
        print(json.dumps({"machine": describe(), "microseconds": columns}, indent=2))
        return
    print(describe())
    print(f"{'term':56}" + "".join(f"{n:>10}" for n in columns))
    for name in next(iter(columns.values())):
        print(f"{name:56}" + "".join(f"{column[name]:>10.1f}" for column in columns.values()))


if __name__ == "__main__":
    main()
