"""View of a study of several seeds: its progress during training, and the table at the end."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rlcli.cli.ui.console import console
from rlcli.cli.ui.progress_view import LiveView
from rlcli.cli.ui.tables import flow
from rlcli.errors import Stopped
from rlcli.reporting.curves import FEWEST_FOR_IQM
from rlcli.runs.overview import Overview, overview
from rlcli.tuning.train_seeds import METRICS, StudyResult

_LINE_EVERY_S = 10.0


def print_study(result: StudyResult) -> None:
    """Print the table and the JSON document of a study.

    Raises:
        Stopped: after the table, if a signal stopped the study.
    """
    if result.together is not None:
        _print_table(result.runs, result.together)
    if result.stop_code is not None:
        hint = f"rlcli train --resume {result.folder} continues it"
        raise Stopped("stopped on request", exit_code=result.stop_code, hint=hint)
    console.data(str(result.folder))
    console.document(
        "train",
        study=str(result.folder),
        task=result.task,
        state="failed" if result.exit_code else "finished",
        runs=result.runs,
        curves=None if result.curves is None else str(result.curves),
        picture=None if result.picture is None else str(result.picture),
        together=result.together or {},
    )


def _print_table(runs: Sequence[dict[str, Any]], together: dict[str, Any]) -> None:
    rows = []
    for run in runs:
        numbers = [f"{run[name]:.4g}" if name in run else "-" for name in METRICS]
        rows.append([str(run["seed"]), run["state"], f"{run['step'] or 0:,}", *numbers])
    count = sum(any(name in run for name in METRICS) for run in runs)
    middle = "IQM" if count >= FEWEST_FOR_IQM else "mean"
    for title, keys in ((middle, ("iqm",)), ("95 %", ("low", "high"))):
        cells = [_interval([together.get(name, {}).get(key) for key in keys]) for name in METRICS]
        rows.append([title, "", "", *cells])
    console.table(["SEED", "STATE", "STEPS", "RETURN", "SUCCESS"], rows)


def _interval(values: Sequence[float | None]) -> str:
    known = [f"{value:.4g}" for value in values if value is not None]
    return " .. ".join(known) if len(known) == len(values) else "-"


class SeedsView(LiveView):
    """View of the progress of each seed: a live table on a terminal, else a line every few seconds."""

    def __init__(self, title: str, runs: Sequence[Path]) -> None:
        super().__init__(auto_refresh=False, transient=True)
        self._title, self._runs = title, runs
        self._last = time.monotonic()

    def poll(self) -> None:
        """Update the view if the last update is old enough."""
        now = time.monotonic()
        if now - self._last < (1.0 if self._live is not None else _LINE_EVERY_S) or console.quiet:
            return
        self._last = now
        seeds = [_cells(overview(run)) for run in self._runs]
        if self._live is None:
            console.info("; ".join(map(" ".join, seeds)))
            return
        lines = [line for cells in seeds for line in flow(cells, self._live.console.width)]
        self.update([self._title, *lines], refresh=True)


def _cells(run: Overview) -> list[str]:
    cells = [f"seed {run.seed}", run.state]
    if run.iterations:
        cells.append(f"{run.iteration or 0}/{run.iterations}")
    return cells + [f"{name} {run.last[name]:.4g}" for name in METRICS if name in run.last]
