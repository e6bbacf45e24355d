"""Tables of `docs/explanation/benchmarks.md`: results are stored in `results.json`, pages are written from them.

A table is a module with `NAME`, `measure(quick)`, which returns a JSON object, and `markdown(result)`. Run as a
program, the module measures, stores the result and writes it into the pages; `--quick` is a short trial that only
prints.
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
    """Return name of a table -> its last result."""
    return json.loads(RESULTS.read_text()) if RESULTS.exists() else {}


def keep(name: str, result: dict[str, Any]) -> None:
    """Replace the stored result of a table."""
    RESULTS.write_text(json.dumps({**results(), name: rounded(result)}, indent=1) + "\n")


def filled(text: str, texts: dict[str, str]) -> str:
    """Return a page with its generated parts replaced; parts that are not given stay.

    A part is between the comments `bench: NAME` and `end bench`, and gets their indentation.
    """

    def part(found: re.Match[str]) -> str:
        name = found["name"]
        if name not in texts:
            return found[0]
        lines = [f"<!-- bench: {name} -->", *texts[name].strip().splitlines(), "<!-- end bench -->"]
        return "\n".join(f"{found['indent']}{line}".rstrip() for line in lines)

    return _MARKED.sub(part, text)


def marked(text: str) -> list[str]:
    """Return the names of a page's generated parts."""
    return [found["name"] for found in _MARKED.finditer(text)]


def table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def measured_on(result: dict[str, Any], *more: str) -> str:
    """Return the line that names the machine of a table."""
    return ", ".join([result["machine"], *more])


def rounded(value: Any) -> Any:
    """Round numbers to five digits: more are noise."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    if isinstance(value, list):
        return [rounded(each) for each in value]
    return float(f"{value:.5g}") if isinstance(value, float) else value


def spread(row: dict[str, Any], name: str = "ratio") -> str:
    """Return the lowest and highest ratio as text."""
    return f"{row[f'{name}_min']:.2f} .. {row[f'{name}_max']:.2f}"


def geometric_mean(values: Sequence[float]) -> float:
    """Return the geometric mean of ratios."""
    return statistics.geometric_mean(values)


def rate(value: float) -> str:
    """Return a number of steps per second as text."""
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
