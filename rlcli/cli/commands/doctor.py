"""Command `rlcli doctor`: checks of the machine, the installation and the plugins.

The checks themselves are in `rlcli.doctor`; this module prints their results as a table.
"""

from dataclasses import asdict

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import ProbeTimeout, RunsDir
from rlcli.registry.probe import TIMEOUT_S


def command(
    timeout: ProbeTimeout = TIMEOUT_S,
    runs_dir: RunsDir = None,
) -> None:
    """Check the installation, the machine and all plugins, and print how to repair the faults.

    Examples:
        rlcli doctor
            Print a table of all checks, with hints.
        rlcli doctor --json
            Print the same as JSON, for a bug report.
    """
    from rlcli.doctor import run_checks
    from rlcli.runs.run_ref import default_runs_dir

    console.info(f"checking all plugins; each may take up to {timeout:g} s")
    checks = run_checks(runs_dir or default_runs_dir(), timeout)
    console.table(["CHECK", "STATE", "FOUND"], [[check.name, check.state, check.found] for check in checks])
    for check in checks:
        if check.hint:
            console.data(f"{check.state}: {check.name}: {check.hint}")
    broken, warnings = ([check.name for check in checks if check.state == state] for state in ("broken", "warning"))
    faults = [f"{word}: {', '.join(names)}" for word, names in (("broken", broken), ("warnings", warnings)) if names]
    console.data("; ".join(faults) or "all good")
    console.document("doctor", healthy=not broken, all_good=not faults, checks=[asdict(check) for check in checks])
    if broken:
        raise typer.Exit(9)
