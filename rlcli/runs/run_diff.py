"""Where two runs first part: configuration, environment, metrics, weights. Their files are read, nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import takewhile, zip_longest
from typing import TYPE_CHECKING, Any

from rlcli.config.layers import leaves
from rlcli.config.messages import dotted
from rlcli.runs.config_diff import Difference, Section, Values, as_text, compare_values
from rlcli.runs.metric_rows import read_rows
from rlcli.runs.provenance import differences
from rlcli.runs.run import Run

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli.runs.checkpoint import Checkpoint

SECTIONS = ("configuration", "environment", "metrics", "weights", "policy")
"""In the order of cause and effect: what stands first explains what follows."""
_CLOCK = "Perf/"
"""Metrics of the clock, which are never equal."""
_ROWS = 4096
"""Of a replay buffer that are compared at a time."""


def compare(left: Run, right: Run, *, sections: Iterable[str] = SECTIONS, until: int | None = None) -> list[Section]:
    """Compare two runs. Of metrics and weights the first difference is told, of the others each.

    Args:
        left: a run.
        right: another.
        sections: which parts to compare.
        until: the environment step up to which metrics and checkpoints count; None: to the end of both, and a run
            that has more iterations differs.

    Raises:
        CheckpointError: if a file that is needed cannot be read.
    """
    parts: dict[str, Callable[[], Section]] = {
        "configuration": lambda: compare_values(Values.of_run(left), Values.of_run(right)),
        "environment": lambda: _environments(left, right),
        "metrics": lambda: _metrics(left, right, until),
        "weights": lambda: _weights(left, right, until),
        "policy": lambda: _policies(left, right, until),
    }
    wanted = set(sections)
    return [parts[name]() for name in SECTIONS if name in wanted]


def first_difference(sections: Iterable[Section]) -> tuple[str, Difference] | None:
    """The first difference that is not cosmetic, and its section."""
    found = ((section.name, each) for section in sections for each in section.differences)
    return next(((name, each) for name, each in found if each.category != "cosmetic"), None)


def reached(run: Run) -> int:
    """Return the last iteration that a run has metrics of."""
    return max((row["iteration"] for row in read_rows(run, strict=True)), default=0)


def _environments(left: Run, right: Run) -> Section:
    rows = differences(left.record, right.record)
    resumed, again = left.record.get("resumed"), right.record.get("resumed")
    if as_text(resumed) != as_text(again):
        rows.append(("resumed", resumed, again))
    whole = all("sources" in run.record and "cpu" in run.record for run in (left, right))
    words = "versions, sources, processor, threads" if whole else "what both have recorded"
    return Section("environment", words, [Difference(*row) for row in rows])


def _metrics(left: Run, right: Run, until: int | None) -> Section:
    count = 0
    for row, twin in zip_longest(_rows(left, until), _rows(right, until)):
        if row is None or twin is None:
            if until is not None:
                break
            ends = [None if side is None else "recorded" for side in (row, twin)]
            longer = row if row is not None else twin
            assert longer is not None
            difference = Difference(f"iteration {longer['iteration']}", *ends)
            return Section("metrics", f"{count} iterations", [difference])
        for name in ("iteration", *sorted((row.keys() | twin.keys()) - {"iteration"})):
            if not name.startswith(_CLOCK) and as_text(row.get(name)) != as_text(twin.get(name)):
                where = f"iteration {row['iteration']}: {name}"
                difference = Difference(where, row.get(name), twin.get(name))
                return Section("metrics", f"{count} iterations", [difference])
        count += 1
    return Section("metrics", f"{count} iterations")


def _rows(run: Run, until: int | None) -> Iterator[dict[str, Any]]:
    """The rows of a run's metrics up to an environment step."""
    rows = read_rows(run, strict=True)
    return rows if until is None else takewhile(lambda row: row["step"] <= until, rows)


def _weights(left: Run, right: Run, until: int | None) -> Section:
    steps = _common_steps(left, right, until)
    if not steps:
        return Section("weights", "no checkpoint at a step that both have")
    words = f"checkpoints at {len(steps)} steps, to step {steps[-1]}"
    for step in steps:
        one, other = (_open(run, step) for run in (left, right))
        for part in _parts(one, other):
            equal = _digest(one, f"{part}.safetensors") == _digest(other, f"{part}.safetensors")
            if equal and step != steps[-1]:
                continue  # the last pair is read whatever its manifests say: that checks the files
            found = _tensors(one, other, part)
            if found is not None:
                return Section("weights", words, [found])
        found = _values(one, other) or (_logs(one, other) if step == steps[-1] else None)
        if found is not None:
            return Section("weights", words, [found])
    return Section("weights", words)


def _parts(one: Checkpoint, other: Checkpoint) -> list[str]:
    """Tensor files of either: the policy first, then what trains it."""
    names = {name for saved in (one, other) for name in saved.manifest["files"] if name.endswith(".safetensors")}
    order = ("policy.safetensors", "trainer.safetensors")
    ordered = sorted(names, key=lambda name: (order.index(name) if name in order else len(order), name))
    return [name.removesuffix(".safetensors") for name in ordered]


def _tensors(one: Checkpoint, other: Checkpoint, part: str) -> Difference | None:
    file = f"{part}.safetensors"
    held = [file in saved.manifest["files"] for saved in (one, other)]
    if not all(held):
        return Difference(f"step {one.step}: {file}", *("there" if has else None for has in held))
    left, right = one.tensors(part), other.tensors(part)
    for name in sorted(left.keys() | right.keys()):
        where = f"step {one.step}: {part} {name}"
        if name not in left or name not in right:
            return Difference(where, *("there" if name in side else None for side in (left, right)))
        found = _elements(left[name], right[name], where)
        if found is not None:
            return found
    return None


def _elements(left: Tensor, right: Tensor, where: str) -> Difference | None:
    """The first element whose bits differ."""
    import torch

    kinds = [f"{str(value.dtype).removeprefix('torch.')} {list(value.shape)}" for value in (left, right)]
    if kinds[0] != kinds[1]:
        return Difference(where, *kinds)
    if not left.numel():
        return None
    bits = [value.contiguous().reshape(-1, 1).view(torch.uint8).reshape(left.numel(), -1) for value in (left, right)]
    differ = (bits[0] != bits[1]).any(dim=1)
    if not bool(differ.any()):
        return None
    place = int(differ.int().argmax())
    index = [int(i) for i in torch.unravel_index(torch.tensor(place), left.shape)]
    one, other = (value.reshape(-1)[place].item() for value in (left, right))
    return Difference(f"{where}{index if index else ''}", one, other)


def _logs(one: Checkpoint, other: Checkpoint) -> Difference | None:
    """The first element of a replay buffer that differs, wherever its rows are cut into files."""
    if not one.shards() and not other.shards():
        return None
    left, right = one.state().logs, other.state().logs
    for name in sorted(left.keys() | right.keys()):
        where = f"step {one.step}: {name}"
        held = [None if name not in side else f"rows {side[name].first} to {side[name].stop}" for side in (left, right)]
        if held[0] != held[1]:
            return Difference(where, *held)
        for start in range(left[name].first, left[name].stop, _ROWS):
            stop = min(start + _ROWS, left[name].stop)
            columns, twins = left[name].read(start, stop), right[name].read(start, stop)
            for column in sorted(columns.keys() | twins.keys()):
                found = _elements(columns[column], twins[column], f"{where} from row {start}: {column}")
                if found is not None:
                    return found
    return None


def _values(one: Checkpoint, other: Checkpoint) -> Difference | None:
    left, right = (dict(leaves(saved.json("state.json"))) for saved in (one, other))
    for path in dict.fromkeys([*left, *right]):
        if as_text(left.get(path)) != as_text(right.get(path)):
            return Difference(f"step {one.step}: state.json {dotted(path)}", left.get(path), right.get(path))
    return None


def _policies(left: Run, right: Run, until: int | None) -> Section:
    steps = _common_steps(left, right, until)
    if not steps:
        return Section("policy", "no checkpoint at a step that both have")
    one, other = (_digest(_open(run, steps[-1]), "policy.safetensors") for run in (left, right))
    words = f"sha256 of step {steps[-1]}"
    if one != other:
        return Section("policy", words, [Difference(f"step {steps[-1]}: policy.safetensors sha256", one, other)])
    return Section("policy", f"{words}: {str(one)[:12]}...")


def _common_steps(left: Run, right: Run, until: int | None) -> list[int]:
    from rlcli.runs.checkpoint import steps

    common = set(steps(left.checkpoints)) & set(steps(right.checkpoints))
    return sorted(step for step in common if until is None or step <= until)


def _open(run: Run, step: int) -> Checkpoint:
    from rlcli.runs.checkpoint import open_checkpoint

    return open_checkpoint(run.checkpoints / f"{step:012d}")


def _digest(saved: Checkpoint, name: str) -> str | None:
    entry = saved.manifest["files"].get(name)
    return str(entry["sha256"]) if isinstance(entry, dict) and "sha256" in entry else None
