"""Print the lines that no test runs; fail below the minimum: `python tests/coverage_gate.py FILE.json`."""

import json
import sys
from pathlib import Path

LINES, BRANCHES = 95.0, 90.0
"""Minimum coverage of `rlcli/` in percent; pyproject.toml lists what is excluded, and why."""


def main(file: str) -> int:
    report = json.loads(Path(file).read_text())
    totals = report["totals"]
    lines = 100.0 * totals["covered_lines"] / totals["num_statements"]
    branches = 100.0 * totals["covered_branches"] / totals["num_branches"]
    gaps = {
        name: part["summary"]["missing_lines"] + part["summary"]["missing_branches"]
        for name, part in report["files"].items()
    }
    for name in sorted(gaps, key=gaps.__getitem__, reverse=True)[:15]:
        print(f"{gaps[name]:5d} lines and branches not reached in {name}")
    print(f"lines {lines:.1f} % (at least {LINES:g}), branches {branches:.1f} % (at least {BRANCHES:g})")
    return 0 if lines >= LINES and branches >= BRANCHES else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
