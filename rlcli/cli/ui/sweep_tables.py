"""Tables and JSON documents of `sweep show` and `sweep compare`."""

from __future__ import annotations

from rlcli.cli.ui.console import console
from rlcli.cli.ui.tables import cell
from rlcli.errors import Stopped
from rlcli.tuning.sweep import PRESET, Sweep
from rlcli.tuning.sweep_compare import ARMS, Comparison, Training


def print_sweep(sweep: Sweep) -> None:
    """Print the trials and the best one, as a table and as a JSON document."""
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
        run = documents[best.number]["run"] or "on the machine that trained it"
        console.info(f"best: trial {best.number}; its run: {run}")
        console.info(f"to train with its settings: rlcli train {settings['task']} --config {file}")
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
    """Print the times of all trainings, as a table and as a JSON document.

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
