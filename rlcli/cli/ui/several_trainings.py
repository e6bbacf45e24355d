"""Views and tables of several trainings: of a study (one run for each seed), and of a sweep.

`rlcli train --seeds` and `rlcli sweep` use this module.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rlcli.cli.ui.console import console
from rlcli.cli.ui.progress_view import LiveView
from rlcli.cli.ui.tables import cell, fill
from rlcli.errors import Stopped
from rlcli.registry.task_location import task_reference
from rlcli.reporting.curves import FEWEST_FOR_IQM
from rlcli.runs.overview import Overview, overview
from rlcli.tuning.compare_best_with_default import ARMS, Comparison, Training
from rlcli.tuning.sweep import PRESET, Sweep
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
        hint = f"rlcli train --resume {result.folder} continues the study"
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
        """Update the view if the last update was at least 1 s ago (without a terminal: 10 s)."""
        now = time.monotonic()
        if now - self._last < (1.0 if self._live is not None else _LINE_EVERY_S) or console.quiet:
            return
        self._last = now
        seeds = [_cells(overview(run)) for run in self._runs]
        if self._live is None:
            console.info("; ".join(map(" ".join, seeds)))
            return
        lines = [line for cells in seeds for line in fill(cells, self._live.console.width)]
        self.update([self._title, *lines], refresh=True)


def _cells(run: Overview) -> list[str]:
    cells = [f"seed {run.seed}", run.state]
    if run.iterations:
        cells.append(f"{run.iteration or 0}/{run.iterations}")
    return cells + [f"{name} {run.last[name]:.4g}" for name in METRICS if name in run.last]


def print_sweep(sweep: Sweep) -> None:
    """Print the trials of a sweep, and the command that trains with the best trial's settings; with --json, as JSON."""
    settings, best = sweep.settings, sweep.best()
    rows, documents = [], {}
    for trial in sweep.trials():
        document = documents[trial.number] = sweep.document(trial)
        value, params = document["value"], document["params"]
        cells = [_value(params.get(parameter.key)) for parameter in sweep.parameters]
        mark = "best" if best is not None and trial.number == best.number else ""
        rows.append([str(trial.number), document["state"], cell(value, ".6g"), *cells, mark])
    console.table(["TRIAL", "STATE", settings["objective"].upper(), *(p.key for p in sweep.parameters), ""], rows)
    file = sweep.folder / PRESET
    if best is not None:
        run = documents[best.number]["run"] or "on the machine that trained this trial"
        console.info(f"best: trial {best.number}; its run: {run}")
        console.info(f"to train with its settings: rlcli train {task_reference(settings['source'])} --config {file}")
    if (same := sweep.same_objective()) is not None:
        easy = settings["objective"].startswith("success") and same == 1.0
        reason = (
            "the budget may be too long: every trial reaches the highest value; choose a shorter one, such as"
            " --objective success@10s, or --objective return"
            if easy
            else "the budget may be too short, so that no trial is better than another"
        )
        console.warn(f"all trials have the same objective, {settings['objective']} = {same:.6g}: {reason}")
    console.document(
        "sweep",
        sweep=str(sweep.folder),
        task=settings["task"],
        objective=settings["objective"],
        direction=settings["direction"],
        ended=len(sweep.ended()),
        wanted=settings["trials"],
        best=None if best is None else documents[best.number],
        preset=str(file) if file.is_file() else None,
        trials=list(documents.values()),
    )


def print_comparison(comparison: Comparison) -> None:
    """Print the training times of `sweep compare`, as a table and as a JSON document.

    Raises:
        Stopped: after the table, if a signal stopped the comparison.
    """
    rows = [
        [str(seed), *(cell for arm in ARMS for cell in _times(comparison.training(seed, arm)))]
        for seed in comparison.seeds
    ]
    medians, ratios = comparison.medians(), comparison.ratios()
    if medians:
        cells = []
        for arm in ARMS:
            median = medians.get(arm, {})
            cells += [cell(median.get("seconds"), ".2f"), cell(median.get("steps"), ",.0f")]
        rows.append(["median", *cells])
    if ratios:
        rows.append(["ratio", "", "", *(cell(ratio, ".3g", " x") for ratio in ratios.values())])
    threshold = comparison.threshold
    console.info(f"{comparison.task}: training until {threshold.key} >= {threshold.value:g}")
    console.table(["SEED", "DEFAULT S", "STEPS", f"TRIAL {comparison.trial} S", "STEPS"], rows)
    if comparison.stop_code is not None:
        hint = "run the same command again to continue"
        raise Stopped("stopped on request", exit_code=comparison.stop_code, hint=hint)
    console.document("sweep", **comparison.document())


def _times(training: Training | None) -> list[str]:
    if training is None:
        return ["-", "-"]
    time = training.time()
    return [cell(time["seconds"], ".2f") if training.reached else training.state, cell(time["steps"], ",.0f")]


def _value(value: object) -> str:
    return cell(value, ".4g" if isinstance(value, float) else "")
