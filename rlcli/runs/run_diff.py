"""Compare two runs by their files: configuration, software and hardware, metrics, weights and policy.

`rlcli diff` and `rlcli reproduce` print the result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice, takewhile, zip_longest
from typing import TYPE_CHECKING, Any

from rlcli.config.layers import leaves
from rlcli.config.messages import dotted
from rlcli.runs.config_diff import Difference, Section, as_text, compare_values, run_values
from rlcli.runs.metric_rows import read_rows
from rlcli.runs.provenance import differences
from rlcli.runs.run import Run
from rlcli.safe_text import shorten

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli.runs.checkpoint_reader import Checkpoint

SECTIONS = ("configuration", "environment", "metrics", "weights", "policy")
"""Parts of two runs that are compared, in this order: a difference in one part may cause differences in later parts.
`environment` is the software and hardware."""
_CLOCK = "Perf/"
"""Prefix of metrics that measure time, which are never equal."""
_ROWS = 4096
"""Rows of a replay buffer that are read and compared at a time."""


def compare(left: Run, right: Run, *, sections: Iterable[str] = SECTIONS, until: int | None = None) -> list[Section]:
    """Compare two runs, part by part.

    All differences of the configuration and the environment are returned, but only the first one of each other part.

    Args:
        left: a run.
        right: another run.
        sections: the parts to compare, some of `SECTIONS`.
        until: last environment step of the metrics and checkpoints that are compared; None: compare all, so that a
            longer run differs.

    Raises:
        CheckpointError: if a required file cannot be read.
    """
    parts: dict[str, Callable[[], Section]] = {
        "configuration": lambda: compare_values(run_values(left), run_values(right)),
        "environment": lambda: _environments(left, right),
        "metrics": lambda: _metrics(left, right, until),
        "weights": lambda: _weights(left, right, until),
        "policy": lambda: _policies(left, right, until),
    }
    wanted = set(sections)
    return [parts[name]() for name in SECTIONS if name in wanted]


def first_difference(sections: Iterable[Section]) -> tuple[str, Difference] | None:
    """Return the first difference that is not cosmetic, with the name of its section; None if there is none."""
    found = ((section.name, each) for section in sections for each in section.differences)
    return next(((name, each) for name, each in found if each.category != "cosmetic"), None)


def last_iteration(run: Run) -> int:
    """Return the number of the last iteration in a run's metrics, counted from 1; 0 if the run has no metrics.

    Raises:
        CheckpointError: if metrics.jsonl has a corrupt line.
    """
    return max((row["iteration"] for row in read_rows(run.metrics, strict=True)), default=0)


def _environments(left: Run, right: Run) -> Section:
    rows = differences(left.record, right.record)
    resumed = [run.record.get("resumed") for run in (left, right)]
    if as_text(resumed[0]) != as_text(resumed[1]):
        rows.append(("resumed", resumed[0], resumed[1]))
    complete = all("sources" in run.record and "cpu" in run.record for run in (left, right))
    compared = "versions, sources, processor, threads" if complete else "the entries that both have recorded"
    return Section("environment", compared, [Difference(*row) for row in rows])


def _metrics(left: Run, right: Run, until: int | None) -> Section:
    count = 0
    for row, twin in zip_longest(_rows(left, until), _rows(right, until)):
        if row is None or twin is None:
            if until is not None:
                break
            longer = row or twin
            assert longer is not None
            sides = _presence("recorded", row is not None, twin is not None)
            difference = Difference(f"iteration {longer['iteration']}", *sides)
            return Section("metrics", f"{count} iterations", [difference])
        names = ("iteration", *sorted((row.keys() | twin.keys()) - {"iteration"}))
        found = _first_unequal(row, twin, [name for name in names if not name.startswith(_CLOCK)])
        if found is not None:
            difference = Difference(f"iteration {row['iteration']}: {found}", row.get(found), twin.get(found))
            return Section("metrics", f"{count} iterations", [difference])
        count += 1
    return Section("metrics", f"{count} iterations")


def _rows(run: Run, until: int | None) -> Iterator[dict[str, Any]]:
    """Return the rows of a run's metrics up to the environment step `until`; all rows if it is None."""
    rows = read_rows(run.metrics, strict=True)
    return rows if until is None else takewhile(lambda row: row["step"] <= until, rows)


def _weights(left: Run, right: Run, until: int | None) -> Section:
    steps = _common_steps(left, right, until)
    if not steps:
        return Section("weights", "no checkpoint at a step that both have")
    compared = f"checkpoints at {len(steps)} steps, to step {steps[-1]}"
    return Section("weights", compared, list(islice(_checkpoint_differences(left, right, steps), 1)))


def _checkpoint_differences(left: Run, right: Run, steps: Sequence[int]) -> Iterator[Difference]:
    """Yield the differences between the checkpoints of two runs at some environment steps, in this order."""
    for step in steps:
        one, other = (_open_checkpoint(run, step) for run in (left, right))
        for part in _parts(one, other):
            equal = _digest(one, f"{part}.safetensors") == _digest(other, f"{part}.safetensors")
            # the last pair is read even if its hashes are equal: this checks the files
            if not equal or step == steps[-1]:
                yield from _compare_part(one, other, part)
        yield from _compare_values(one, other)
        if step == steps[-1]:
            yield from _compare_logs(one, other)


def _parts(one: Checkpoint, other: Checkpoint) -> list[str]:
    """Return the names of the tensor files of two checkpoints without the suffix: policy, trainer, then the others."""
    names = {name for saved in (one, other) for name in saved.manifest["files"] if name.endswith(".safetensors")}
    order = ("policy.safetensors", "trainer.safetensors")
    ordered = sorted(names, key=lambda name: (order.index(name) if name in order else len(order), name))
    return [name.removesuffix(".safetensors") for name in ordered]


def _compare_part(one: Checkpoint, other: Checkpoint, part: str) -> Iterator[Difference]:
    file = f"{part}.safetensors"
    present = [file in saved.manifest["files"] for saved in (one, other)]
    if all(present):
        yield from _compare_tensors(one.tensors(part), other.tensors(part), f"step {one.step}: {part} ")
    else:
        yield Difference(f"step {one.step}: {file}", *_presence("there", *present))


def _compare_tensors(left: Mapping[str, Tensor], right: Mapping[str, Tensor], prefix: str) -> Iterator[Difference]:
    for name in sorted(left.keys() | right.keys()):
        where = f"{prefix}{shorten(name, 200)}"  # an untrusted file has names of any length
        if name in left and name in right:
            yield from _compare_elements(left[name], right[name], where)
        else:
            yield Difference(where, *_presence("there", name in left, name in right))


def _compare_elements(left: Tensor, right: Tensor, where: str) -> Iterator[Difference]:
    """Yield the difference of two tensors: their types and shapes, or the first element that is not equal bit by bit.

    Args:
        left: a tensor.
        right: the tensor to compare it with.
        where: name of the tensors in the result.
    """
    import torch

    kinds = [f"{str(value.dtype).removeprefix('torch.')} {list(value.shape)}" for value in (left, right)]
    if kinds[0] != kinds[1]:
        yield Difference(where, *kinds)
    elif left.numel():
        # one row of bytes for each element: NaN equals itself, 0.0 differs from -0.0
        bits = [each.contiguous().reshape(-1, 1).view(torch.uint8).reshape(left.numel(), -1) for each in (left, right)]
        differ = (bits[0] != bits[1]).any(dim=1)
        if bool(differ.any()):
            first = int(differ.int().argmax())
            index = [int(i) for i in torch.unravel_index(torch.tensor(first), left.shape)]
            one, other = (value.reshape(-1)[first].item() for value in (left, right))
            yield Difference(f"{where}{index if index else ''}", one, other)


def _compare_logs(one: Checkpoint, other: Checkpoint) -> Iterator[Difference]:
    """Yield the differences between the replay buffers of two checkpoints, however their rows are split into files."""
    if not one.shards() and not other.shards():
        return
    left, right = one.state().logs, other.state().logs
    for name in sorted(left.keys() | right.keys()):
        where = f"step {one.step}: {name}"
        rows = [None if name not in side else f"rows {side[name].first} to {side[name].stop}" for side in (left, right)]
        if rows[0] != rows[1]:
            yield Difference(where, *rows)
            continue
        for start in range(left[name].first, left[name].stop, _ROWS):
            stop = min(start + _ROWS, left[name].stop)
            columns, other_columns = left[name].read(start, stop), right[name].read(start, stop)
            yield from _compare_tensors(columns, other_columns, f"{where} from row {start}: ")


def _compare_values(one: Checkpoint, other: Checkpoint) -> Iterator[Difference]:
    left, right = (dict(leaves(saved.json("state.json"))) for saved in (one, other))
    path = _first_unequal(left, right, [*left, *right])
    if path is not None:
        yield Difference(f"step {one.step}: state.json {dotted(path)}", left.get(path), right.get(path))


def _first_unequal(left: Mapping[Any, Any], right: Mapping[Any, Any], keys: Iterable[Any]) -> Any:
    """Return the first of `keys` whose values differ between two mappings; None if all are equal."""
    return next((key for key in keys if as_text(left.get(key)) != as_text(right.get(key))), None)


def _presence(word: str, left: bool, right: bool) -> tuple[str | None, str | None]:
    """Return the left and the right value of a `Difference` for an entry that only one side has.

    Args:
        word: the value for a side that has the entry; the value for a side without the entry is None.
        left: whether the left side has the entry.
        right: whether the right side has the entry.
    """
    return word if left else None, word if right else None


def _policies(left: Run, right: Run, until: int | None) -> Section:
    steps = _common_steps(left, right, until)
    if not steps:
        return Section("policy", "no checkpoint at a step that both have")
    one, other = (_digest(_open_checkpoint(run, steps[-1]), "policy.safetensors") for run in (left, right))
    compared = f"sha256 of step {steps[-1]}"
    if one != other:
        return Section("policy", compared, [Difference(f"step {steps[-1]}: policy.safetensors sha256", one, other)])
    return Section("policy", f"{compared}: {str(one)[:12]}...")


def _common_steps(left: Run, right: Run, until: int | None) -> list[int]:
    from rlcli.runs.checkpoint_reader import steps

    common = set(steps(left.checkpoints)) & set(steps(right.checkpoints))
    return sorted(step for step in common if until is None or step <= until)


def _open_checkpoint(run: Run, step: int) -> Checkpoint:
    from rlcli.runs.checkpoint_reader import open_checkpoint

    return open_checkpoint(run.checkpoints / f"{step:012d}")


def _digest(saved: Checkpoint, name: str) -> str | None:
    entry = saved.manifest["files"].get(name)
    return str(entry["sha256"]) if isinstance(entry, dict) and "sha256" in entry else None
