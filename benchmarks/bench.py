"""All CPU tables of `docs/explanation/benchmarks.md`: `make bench`, or `python benchmarks/bench.py [TABLE...]`.

Each table runs in a separate process, one after the other, and stores its result in `results.json`. Then the generated
parts of the pages are written from these results. `--pages` only writes the pages; `--quick` is a short trial that
stores nothing. Run it on an idle machine.
"""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

from sides import HERE, child_environment
from tables import PAGES, filled, keep, measured_on, results, table

SCRIPTS = {
    "env_step": ["--repeats", "2", "--seconds", "0.05", "--num-envs", "64"],
    "train": ["--repeats", "2", "--num-envs", "64"],
}
"""Programs that print their result with `--json`, and their arguments for a quick trial."""
MODULES = {
    "mjlab": "against_mjlab",
    "envpool": "against_envpool",
    "trainers": "against_trainers",
    "startup": "startup",
    "growth": "growth",
}
"""Tables that store their own results (tables.py)."""
TABLES = [*SCRIPTS, *MODULES]


HEADS = {
    "num_envs": "environments",
    "ratio": "rlcli / bare `Batch`",
    "ratio_stage_none": "rlcli / `Batch` at stage NONE",
    "physics": "physics / environment step",
    "stock_sb3_ratio": "stock SB3 on the same task",
    "env_steps_per_s": "rlcli [environment steps/s]",
    "bare_steps_per_s": "bare `Batch` [environment steps/s]",
    "train_steps_per_s": "training steps/s",
    "ms": "parts of an iteration [ms]",
}
"""Keys of the programs' rows -> longer column titles in the page."""


def shown(key: str, row: dict[str, Any]) -> str:
    """Return a value of a row as text for the page."""
    value = row.get(key)
    if value is None:
        return ""
    if isinstance(value, dict):
        return " ".join(f"{name} {part:.0f}" for name, part in value.items())
    if isinstance(value, int):
        return f"{value:,}"
    if not isinstance(value, float):
        return str(value)
    if f"{key}_min" in row:
        return f"**{value:.3f}** ({row[f'{key}_min']:.3f} .. {row[f'{key}_max']:.3f})"
    return f"{value:.3f}" if value < 10 else f"{value:,.0f}"


def printed(result: dict[str, Any]) -> str:
    """Return the table of a program, with a column for each key."""
    keys = dict.fromkeys(key for row in result["rows"] for key in row if not key.endswith(("_min", "_max")))
    rows = [[shown(key, row) for key in keys] for row in result["rows"]]
    return f"{measured_on(result)}\n\n{table([HEADS.get(key, key) for key in keys], rows)}"


def readme(kept: dict[str, Any]) -> str:
    """Return the README's figure of the training speed."""
    rows = kept["trainers"]["rows"]
    times = next(row["times"]["ppo"]["ratio"] for row in rows if row["name"] == "dummy")
    return (
        f"- **{times:.1f} times** the training speed of Stable-Baselines3 on a plain Gymnasium cartpole, on the same"
        " two cores."
    )


def texts(kept: dict[str, Any]) -> dict[str, str]:
    """Return name of a part -> its text, for all stored results."""
    makers: dict[str, Callable[[dict[str, Any]], str]] = dict.fromkeys(SCRIPTS, printed)
    makers |= {name: importlib.import_module(module).markdown for name, module in MODULES.items() if name in kept}
    found = {name: makers[name](kept[name]) for name in TABLES if name in kept}
    return {**found, **({"readme": readme(kept)} if "trainers" in kept else {})}


def write_pages() -> None:
    """Write the generated parts of the pages."""
    parts = texts(results())
    for page in PAGES:
        page.write_text(filled(page.read_text(), parts))


def run(name: str, quick: bool) -> bool:
    """Measure a table; return whether that succeeded."""
    begin = time.perf_counter()
    print(f"== {name}", flush=True)
    script = name if name in SCRIPTS else MODULES[name]
    command = [sys.executable, str(HERE / f"{script}.py")]
    if name in MODULES:
        done = subprocess.run([*command, *(["--quick"] if quick else [])])
    else:
        trial = SCRIPTS[name] if quick else []
        done = subprocess.run([*command, "--json", *trial], stdout=subprocess.PIPE, text=True, env=child_environment())
        if done.returncode == 0 and not quick:
            keep(name, json.loads(done.stdout))
    print(f"== {name}: {time.perf_counter() - begin:.0f} s, exit {done.returncode}", flush=True)
    return done.returncode == 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", metavar="TABLE", help=f"of {', '.join(TABLES)}; default: all")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--pages", action="store_true")
    options = parser.parse_args()
    unknown = [name for name in options.tables if name not in TABLES]
    if unknown:
        parser.error(f"no table {', '.join(unknown)}; there are {', '.join(TABLES)}")
    went = [] if options.pages else [run(name, options.quick) for name in options.tables or TABLES]
    if not options.quick:
        write_pages()
    raise SystemExit(0 if all(went) else 1)


if __name__ == "__main__":
    main()
