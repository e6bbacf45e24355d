"""Output of `rlcli check` and `rlcli lint`: a table of results, the findings, the JSON document, the exit code."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import typer

from rlcli.cli.ui.console import console

if TYPE_CHECKING:
    from rlcli.testing import Finding, Remark

    AnyFinding = Finding | Remark


def report_findings(
    command: str,
    task: str,
    kind: str,
    results: Sequence[tuple[str, Sequence[AnyFinding] | None]],
    records: Sequence[dict[str, Any]],
    *,
    notes: Mapping[str, str] | None = None,
    fail_on_warnings: bool = False,
) -> None:
    """Print the results of checks or rules; exit with code 9 if the task does not pass.

    Args:
        command: `check` or `lint`.
        task: the task as the user typed it.
        kind: `check` or `rule`.
        results: names of the checks or rules with their findings; None instead of findings: the check did not run.
        records: all findings as JSON data, for the output of --json.
        notes: name of a check -> a remark that is not a problem.
        fail_on_warnings: whether a task with warnings fails.
    """
    findings = [finding for _, found in results for finding in found or ()]
    console.table([kind.upper(), "RESULT"], [[name, _result_of(found)] for name, found in results])
    for name, text in (notes or {}).items():
        console.data(f"note: {name}: {text}")
    for finding in findings:
        console.data(str(finding))
    errors = sum(finding.severity == "error" for finding in findings)
    warnings = len(findings) - errors
    console.data(f"{task}: {_count(errors, 'error')}, {_count(warnings, 'warning')}")
    passed = not findings if fail_on_warnings else not errors
    entries: list[dict[str, Any]] = [{"name": name, "result": _result_of(found)} for name, found in results]
    if notes is not None:
        entries = [{**entry, "note": notes.get(entry["name"])} for entry in entries]
    console.document(command, task=task, passed=passed, **{f"{kind}s": entries}, findings=records)
    if not passed:
        raise typer.Exit(9)


def _result_of(found: Sequence[AnyFinding] | None) -> str:
    if found is None:
        return "not run"
    if any(finding.severity == "error" for finding in found):
        return "error"
    return "warning" if found else "ok"


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"
