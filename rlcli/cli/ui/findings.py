"""Results of `check` and `lint`: a table, the findings, and how many there are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from rlcli.cli.ui.console import console

if TYPE_CHECKING:
    from rlcli.testing import Finding, Remark

    AnyFinding = Finding | Remark
    Results = Sequence[tuple[str, Sequence[AnyFinding] | None]]
    """What was checked, and what was found; None: it did not run."""


def show_findings(
    task: str, title: str, results: Results, findings: Sequence[AnyFinding], notes: Mapping[str, str] | None = None
) -> None:
    """Print a table of results, the notes, the findings and their number.

    Args:
        task: the task.
        title: head of the first column.
        results: what was checked, and what was found.
        findings: all findings.
        notes: remarks about what was checked, by its name.
    """
    console.table([title, "RESULT"], [[name, result_of(found)] for name, found in results])
    for name, text in (notes or {}).items():
        console.data(f"note: {name}: {text}")
    for finding in findings:
        console.data(str(finding))
    errors = count_errors(findings)
    warnings = len(findings) - errors
    console.data(f"{task}: {_count(errors, 'error')}, {_count(warnings, 'warning')}")


def result_of(found: Sequence[AnyFinding] | None) -> str:
    """Return the result of one check as a word."""
    if found is None:
        return "not run"
    if count_errors(found):
        return "error"
    return "warning" if found else "ok"


def count_errors(findings: Iterable[AnyFinding]) -> int:
    """Return how many findings are errors."""
    return sum(finding.severity == "error" for finding in findings)


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"
