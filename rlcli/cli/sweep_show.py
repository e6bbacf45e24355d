"""`rlcli sweep show`: how far a sweep is, as a table, a document and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.cli.console import console

if TYPE_CHECKING:
    from rlcli.rl.search import Search

PICTURE = "sweep.svg"


def find(words: Sequence[str], runs: Path, storage: str | None) -> Search:
    """The sweep of a folder or a name; without one the newest.

    Raises:
        CheckpointError: if there is none.
        UsageError: if several are named, or several have that name.
    """
    from rlcli.errors import CheckpointError, UsageError, listing
    from rlcli.rl.run import STUDY
    from rlcli.rl.search import read_search

    if len(words) > 1:
        raise UsageError("one sweep at a time", hint="its folder or its name")
    known = sorted(file.parent for file in runs.glob(f"*/sweep-*/{STUDY}"))
    if not words:
        places = sorted(known, key=lambda folder: (folder / STUDY).stat().st_mtime)[-1:]
    elif (Path(words[0]) / STUDY).is_file():
        places = [Path(words[0])]
    else:
        places = [folder for folder in known if folder.name in (words[0], f"sweep-{words[0]}")]
    if len(places) > 1:
        raise UsageError(f"several tasks have a sweep '{words[0]}'", hint=f"name one: {listing(map(str, places))}")
    if not places:
        have = f"sweeps: {listing(map(str, known))}" if known else "rlcli sweep TASK --param ... makes one"
        raise CheckpointError(f"no sweep{f' {words[0]!r}' if words else ''} in {runs}", hint=have)
    return read_search(places[0], storage)


def draw(search: Search) -> None:
    """What the trials reached, over each parameter, as a picture in the sweep's folder.

    Raises:
        UsageError: if no trial has ended yet.
        DependencyError: without matplotlib.
    """
    from rlcli.errors import UsageError
    from rlcli.rl.figures import check_drawing, scatter
    from rlcli.rl.study import write_summary

    check_drawing()
    done = [trial for trial in search.trials() if trial.state.name == "COMPLETE"]
    if not done:
        raise UsageError("there is nothing to draw: no trial has ended yet")
    drawn = [("trial", [trial.number for trial in done], False)]
    drawn += [(p.key, [search.values(trial)[p.key] for trial in done], p.log) for p in search.parameters]
    values = [trial.value for trial in done]
    picture = scatter(drawn, values, search.settings["objective"], title=search.folder.name)
    console.data(str(write_summary(search.folder, PICTURE, picture)))


def report(search: Search) -> None:
    """The trials and the best one, as a table and as a document."""
    from rlcli.rl.search import PRESET

    settings, best = search.settings, search.best()
    rows, listed = [], {}
    for trial in search.trials():
        values = search.values(trial)
        folder = search.place(trial.number)
        value = trial.value if trial.state.name == "COMPLETE" else None
        listed[trial.number] = {
            "trial": trial.number,
            "state": trial.state.name.lower(),
            "value": value,
            "params": values,
            "run": str(folder) if folder.is_dir() else None,
            "seconds": trial.user_attrs.get("seconds"),
            "step": trial.user_attrs.get("step"),
            "why": trial.user_attrs.get("why"),
        }
        shown = "-" if value is None else f"{value:.6g}"
        mark = "best" if best is not None and trial.number == best.number else ""
        cells = [_cell(values.get(parameter.key)) for parameter in search.parameters]
        rows.append([str(trial.number), trial.state.name.lower(), shown, *cells, mark])
    console.table(["TRIAL", "STATE", settings["objective"].upper(), *(p.key for p in search.parameters), ""], rows)
    file = search.folder / PRESET
    if best is not None:
        found = listed[best.number]["run"] or "on the machine that trained it"
        console.info(f"best: trial {best.number}; its run: {found}; rlcli train {settings['task']} --config {file}")
    console.document(
        "sweep",
        sweep=str(search.folder),
        task=settings["task"],
        objective=settings["objective"],
        direction=settings["direction"],
        ended=len(search.ended()),
        wanted=settings["trials"],
        best=None if best is None else listed[best.number],
        preset=str(file) if file.is_file() else None,
        trials=list(listed.values()),
    )


def _cell(value: Any) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
