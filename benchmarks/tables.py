"""The tables of `docs/explanation/benchmarks.md`: what was measured is kept in `results.json`, and the pages are written from that.

A table is a module with `NAME`, `measure(quick)`, which gives a JSON object, and `markdown(result)`. Run as a program
it measures, keeps the result and writes it into the pages; `--quick` only tries it out and prints.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from machine import describe

ROOT = Path(__file__).resolve().parent.parent
RESULTS = Path(__file__).with_name("results.json")
PAGES = [ROOT / "docs" / "explanation" / "benchmarks.md", ROOT / "README.md"]
_MARKED = re.compile(
    r"^(?P<indent> *)<!-- bench: (?P<name>[\w-]+) -->\n(?P<text>.*?)^ *<!-- end bench -->", re.DOTALL | re.MULTILINE
)


def results() -> dict[str, Any]:
    """Name of a table -> what was measured last."""
    return json.loads(RESULTS.read_text()) if RESULTS.exists() else {}


def keep(name: str, result: dict[str, Any]) -> None:
    """Replace what was measured last."""
    RESULTS.write_text(json.dumps({**results(), name: rounded(result)}, indent=1) + "\n")


def filled(text: str, texts: dict[str, str]) -> str:
    """A page with its generated parts written anew; those not given stay.

    A part stands between the comments `bench: NAME` and `end bench`, and is indented as they are.
    """

    def part(found: re.Match[str]) -> str:
        name = found["name"]
        if name not in texts:
            return found[0]
        lines = [f"<!-- bench: {name} -->", *texts[name].strip().splitlines(), "<!-- end bench -->"]
        return "\n".join(f"{found['indent']}{line}".rstrip() for line in lines)

    return _MARKED.sub(part, text)


def marked(text: str) -> list[str]:
    """The names of a page's generated parts."""
    return [found["name"] for found in _MARKED.finditer(text)]


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def stands(result: dict[str, Any], *more: str) -> str:
    """The line that says what a table was measured on."""
    return ", ".join([result["machine"], *more])


def rounded(value: Any) -> Any:
    """Numbers to five digits: more are noise."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def spread(row: dict[str, Any], name: str = "ratio") -> str:
    """Lowest and highest of a ratio."""
    return f"{row[f'{name}_min']:.2f} .. {row[f'{name}_max']:.2f}"


def geometric_mean(values: Sequence[float]) -> float:
    """Of ratios."""
    return statistics.geometric_mean(values)


def rate(value: float) -> str:
    """A number of steps a second."""
    return f"{value / 1e6:.3g} M" if value >= 1e6 else f"{value:,.0f}"


def main(module: ModuleType, options: Callable[[argparse.ArgumentParser], None] | None = None) -> None:
    """Run one table."""
    parser = argparse.ArgumentParser(description=module.__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a smoke test: few repeats, nothing is kept")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    given = parser.parse_args()
    result = {"machine": describe(), **module.measure(given.quick)}
    if not given.quick:
        keep(module.NAME, result)
        import bench

        bench.write_pages()
    print(json.dumps(rounded(result), indent=1) if given.json else module.markdown(rounded(result)))
    sys.stdout.flush()
