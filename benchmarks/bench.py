"""Every table of the CPU in `docs/benchmarks.md`: `make bench`, or `python benchmarks/bench.py [TABLE...]`.

Each table runs in a process of its own, one after the other, and keeps its result in `results.json`; then the generated
parts of the pages are written from that. `--pages` only writes the pages; `--quick` tries everything out and keeps
nothing. Run it on a machine that does nothing else.
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
from tables import PAGES, filled, keep, results, stands, table

SCRIPTS = {
    "env_step": ["--repeats", "2", "--seconds", "0.05", "--num-envs", "64"],
    "train": ["--repeats", "2", "--num-envs", "64"],
}
"""Programs that print their result with `--json`; what a trial of them is given."""
MODULES = {
    "mjlab": "against_mjlab",
    "envpool": "against_envpool",
    "trainers": "against_trainers",
    "startup": "startup",
    "growth": "growth",
}
"""Tables that keep their own results (tables.py)."""
TABLES = [*SCRIPTS, *MODULES]


def env_step(result: dict[str, Any]) -> str:
    """The environment step of bare physics."""
    rows = [
        [row["task"], f"{row['num_envs']:,}", f"**{row['ratio']:.3f}**",
         f"{row['ratio_min']:.3f} .. {row['ratio_max']:.3f}", f"{row['env_steps_per_s']:,.0f}",
         f"{row['bare_steps_per_s']:,.0f}"]
        for row in result["rows"]
    ]  # fmt: skip
    heads = ["task", "environments", "of bare `Batch`", "min .. max", "environment steps/s", "bare steps/s"]
    return f"{stands(result)}\n\n{table(heads, rows)}"


def train(result: dict[str, Any]) -> str:
    """Training of bare physics."""
    rows = [
        [f"{row['num_envs']:,}", f"**{row['ratio']:.3f}**", f"{row['ratio_min']:.3f} .. {row['ratio_max']:.3f}",
         f"{row['stock_sb3_ratio']:.3f}", f"{row['train_steps_per_s']:,.0f}",
         " ".join(f"{name} {value:.0f}" for name, value in row["ms"].items())]
        for row in result["rows"]
    ]  # fmt: skip
    heads = ["environments", "of bare `Batch`", "min .. max", "stock SB3 on the same task", "training steps/s",
             "ms an iteration"]  # fmt: skip
    return f"{stands(result)}\n\n{table(heads, rows)}"


def readme(kept: dict[str, Any]) -> str:
    """The figures in the README's sentences."""
    steps = {(row["task"], row["num_envs"]): row["ratio"] for row in kept["env_step"]["rows"]}
    said = [f"The environment step runs at {steps['cartpole', 4096]:.3f} of the bare physics at 4,096 cartpoles"]
    if "ratio" in kept.get("mjlab", {}):
        said.append(f"takes 1/{kept['mjlab']['ratio']:.1f} of mjlab's time on a CPU at 1,024")
    means = kept.get("envpool", {}).get("means")
    if means:
        said.append(f"is {means['1024']:.2f} times as fast as EnvPool's over Gymnasium's eleven tasks")
    times = {
        row["name"]: row["times"]["ppo"]["ratio"] for row in kept.get("trainers", {}).get("rows", []) if row["times"]
    }
    if "dummy" in times:
        said.append(f"training is {times['dummy']:.1f} times as fast as SB3's on a plain Gymnasium cartpole")
    return f"{', '.join(said)}\n([figures](docs/benchmarks.md))."


def texts(kept: dict[str, Any]) -> dict[str, str]:
    """Name of a part -> its text, of what has been measured."""
    makers: dict[str, Callable[[dict[str, Any]], str]] = {"env_step": env_step, "train": train}
    makers |= {name: importlib.import_module(module).markdown for name, module in MODULES.items() if name in kept}
    found = {name: makers[name](kept[name]) for name in TABLES if name in kept}
    return {**found, **({"readme": readme(kept)} if "env_step" in kept else {})}


def write_pages() -> None:
    """Write the generated parts of the pages anew."""
    parts = texts(results())
    for page in PAGES:
        page.write_text(filled(page.read_text(), parts))


def run(name: str, quick: bool) -> bool:
    """Measure a table; whether that went well."""
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
