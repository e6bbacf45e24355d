"""Table of the differences of two runs or configurations, for `rlcli diff` and `rlcli reproduce`.

The differences are grouped by kind: physics, MDP, agent, cosmetic.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from rlcli.cli.ui.console import console
from rlcli.safe_text import printable, shorten

if TYPE_CHECKING:
    from rlcli.runs.config_diff import Difference, Section

_MAX_ROWS = 10
"""Number of rows that one kind of difference, such as physics or MDP, has at most; with -v there is no limit."""
_WIDTH = 40
"""Largest length of a cell [characters]."""


def report_differences(command: str, sections: Sequence[Section], left: str, right: str, **entries: Any) -> bool:
    """Print the differences between two runs or configurations (the left and the right side).

    Args:
        command: name of the command in the JSON document: diff or reproduce.
        sections: the parts that were compared (configuration, metrics, weights ...), each with its differences.
        left: name of the left side.
        right: name of the right side.
        entries: further entries of the JSON document.

    Returns:
        Whether the sides are equal, except for cosmetic differences.
    """
    from rlcli.runs.atomic_io import finite_json
    from rlcli.runs.config_diff import CATEGORIES
    from rlcli.runs.run_diff import first_difference

    first = first_difference(sections)
    counts = Counter(each.category for section in sections for each in section.differences)
    console.table(["", "WHERE", "A", "B"], [row for section in sections for row in _rows(section)])
    if kinds := [f"{name} {counts[name]}" for name in CATEGORIES if counts[name]]:
        console.data(f"differences: {', '.join(kinds)}")
    if first is None:
        console.data("no difference, except cosmetic ones" if counts else "no difference")
    else:
        section, found = first
        sides = " | ".join(_sides(found))
        console.data(f"first difference: {section} {found.where}: {sides}")

    def document(difference: Difference) -> dict[str, Any]:
        facts: dict[str, Any] = finite_json(asdict(difference))
        return facts

    console.document(
        command,
        equal=first is None,
        categories={name: counts[name] for name in CATEGORIES},
        first=None if first is None else {"section": first[0], **document(first[1])},
        left=left,
        right=right,
        **entries,
        sections=[
            {"name": s.name, "compared": s.compared, "differences": [document(d) for d in s.differences]}
            for s in sections
        ],
    )
    return first is None


def _rows(section: Section) -> list[list[str]]:
    if not section.differences:
        return [[section.name, f"equal: {section.compared}", "", ""]]
    rows = []
    counts: Counter[str] = Counter()
    for each in section.differences:
        kind = each.category or section.name
        counts[kind] += 1
        if counts[kind] <= _MAX_ROWS or console.verbose:
            rows.append([kind, each.where, *_sides(each)])
    for kind, count in counts.items():
        if count > _MAX_ROWS and not console.verbose:
            rows.append([kind, f"and {count - _MAX_ROWS} more (-v shows them)", "", ""])
    return rows


def _sides(difference: Difference) -> list[str]:
    """Return the values on the left and on the right side, each with the file and line that set it."""
    sides = ((difference.left, difference.left_from), (difference.right, difference.right_from))
    return [f"{cell(value)} ({origin})" if origin else cell(value) for value, origin in sides]


def cell(value: object) -> str:
    """Format a value as a cell of the table; `-` for None."""
    return "-" if value is None else shorten(printable(value if isinstance(value, str) else repr(value)), _WIDTH)
