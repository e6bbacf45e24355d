"""Command `rlcli bench`: measurement of a task's speed on this machine.

The command recommends numbers of environments, threads and worker processes; --save-preset writes them to a file.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui.console import console, plain
from rlcli.cli.ui.options import Agent, ConfigFile, NumEnvs, Overrides, TaskName
from rlcli.cli.ui.progress_view import LiveView
from rlcli.cli.ui.tables import cell, fill
from rlcli.errors import MachineError, Stopped, UsageError
from rlcli.formats import log_notes

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.tuning.bench import Bench, Findings, Stepped, Trained
    from rlcli.tuning.step_profile import Cost

_PROFILED = 5.0
"""Duration of the measurement of `bench --profile` [s]."""
_MAX_LOAD = 0.5
"""System load [running processes per core] above which the command warns that other programs disturb it."""


def command(
    task: TaskName,
    overrides: Overrides = None,
    agent: Agent = None,
    num_envs: NumEnvs = None,
    config: ConfigFile = None,
    save_preset: Annotated[str | None, typer.Option(metavar="FILE|NAME")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite")] = False,
    quick: Annotated[bool, typer.Option("--quick")] = False,
    profile: Annotated[bool, typer.Option("--profile")] = False,
) -> None:
    """Measure the speed of a task on this machine, and recommend numbers of environments, threads and workers.

    Options:
        save_preset: Write the recommended settings to FILE.yaml, or to NAME.yaml here, for train --config.
        overwrite: Allow --save-preset to replace a file.
        quick: Measure for a shorter time; the figures are less exact.
        profile: Show the time of each stage and term of an environment step; recommend nothing.

    Examples:
        rlcli bench cartpole --save-preset fast.yaml
            Write the recommended settings, for: rlcli train --config fast.yaml
        rlcli bench quadruped-flat --profile --num-envs 1024
            See which terms take the time of a step.
    """
    from rlcli.config.layers import flags
    from rlcli.config.load import resolve
    from rlcli.machine.processes import limit_openmp_spinning
    from rlcli.runs.trusted_tasks import named_task

    limit_openmp_spinning()
    file = None if save_preset is None else _preset_file(save_preset, overwrite)
    source = named_task(task)

    def resolved(changes: Mapping[str, Any]) -> Resolved:
        settings = {**flags(scene__num_envs=num_envs), **changes}
        return resolve(source, agent=agent, config_file=config, overrides=overrides or [], flags=settings)

    present = resolved({})
    if profile:
        return _profile(present, file, _PROFILED / 5 if quick else _PROFILED)
    present.require_agent()
    log_notes(present.notes)

    from rlcli.tuning.bench import QUICK, Bench, Pace

    machine = _machine(present)
    stopped = False
    with _View(f"rlcli bench {source.name}") as view:
        bench = Bench(resolved, QUICK if quick else Pace(), view.announce, view.show)
        try:
            bench.run()
        except KeyboardInterrupt:
            stopped = True
    _report(bench, present, machine, file, f"rlcli train {task}", names_agent=agent is not None, stopped=stopped)


def _profile(resolved: Resolved, preset: Path | None, seconds: float) -> None:
    """Print the table of `--profile`: the time that each part of an environment step takes."""
    if preset is not None:
        raise UsageError(
            "--profile recommends no settings that --save-preset could write",
            hint="leave out --profile or --save-preset",
        )
    import torch

    from rlcli.tuning.step_profile import profile_step

    machine = _machine(resolved)
    torch.set_num_threads(1)  # the tensors are small: waking threads would take longer than the work
    costs = profile_step(resolved, seconds)
    rows = [[cost.section if cost.term is None else f"  {cost.term}", *_cost_cells(cost)] for cost in costs]
    console.table(["PART OF THE STEP", "MS", "SHARE"], rows, f"environment step, {resolved.task.scene.num_envs:,} envs")
    document = [dataclasses.asdict(cost) for cost in costs]
    console.document("bench", task=resolved.source.name, machine=machine, profile=document)


def _cost_cells(cost: Cost) -> list[str]:
    return [cell(cost.milliseconds, ".3f"), cell(cost.share, ".1%")]


def _report(
    bench: Bench,
    resolved: Resolved,
    machine: dict[str, Any],
    file: Path | None,
    command: str,
    *,
    names_agent: bool,
    stopped: bool,
) -> None:
    """Print the measurements and the recommendation, and write the preset (a YAML file for `train --config`).

    Raises:
        Stopped: if the user stopped the measurements.
    """
    from rlcli.runs.atomic_io import write_atomic
    from rlcli.tuning.recommended_preset import bench_preset, explanation

    findings = bench.findings
    _show(findings, (bench.horizon_key or "horizon").upper())
    for line in explanation(findings):
        console.data(line)
    if findings.unsteady:
        console.warn("repeated measurements differ by more than 15 %: end other programs and measure again")
    changes = None if findings.recommended is None else bench.changes(findings.recommended.setting)
    if changes is not None and file is not None:
        write_atomic(file, bench_preset(resolved, changes, findings, machine, names_agent))
        console.info(f"preset written; next: {command} --config {file}")
        console.data(str(file))
    console.document(
        "bench",
        task=resolved.source.name,
        agent=resolved.agent_name,
        state="stopped" if stopped else "finished",
        machine=machine,
        **findings.record(),
        recommended=changes,
        present=bench.changes(bench.present),
        why=explanation(findings),
        preset=file if changes is not None else None,
    )
    if stopped:
        raise Stopped("stopped; the measurements until now are shown, and no preset was written", exit_code=130)


def _preset_file(name: str, overwrite: bool) -> Path:
    """Return the path of the YAML file that --save-preset writes: FILE, or NAME.yaml in the current folder.

    Raises:
        UsageError: if the file exists and may not be replaced.
        MachineError: if the folder does not exist or cannot be written.
    """
    from rlcli.runs.atomic_io import require_regular, require_writable

    file = Path(name)
    if not name or file.name in ("", ".."):
        raise UsageError("--save-preset needs the name of a file", hint="for example: --save-preset cartpole.yaml")
    if file.suffix not in (".yaml", ".yml"):
        file = file.with_name(f"{file.name}.yaml")
    folder = file.absolute().parent
    require_regular(file)
    if os.path.lexists(file) and not overwrite:
        raise UsageError(f"--save-preset: {file} exists", hint="choose another name, or add --overwrite")
    if not folder.is_dir():
        raise MachineError(f"--save-preset: there is no folder {folder}; create this folder, or choose another one")
    require_writable(file)
    return file


def _machine(resolved: Resolved) -> dict[str, Any]:
    """Return the machine's processor, cores, memory, load and versions, as JSON data; warn if the machine is busy."""
    import rlcli
    from rlcli.machine.control_groups import core_quota
    from rlcli.machine.cores import available_cores
    from rlcli.machine.memory import available_memory
    from rlcli.machine.processor import processor
    from rlcli.runs.provenance import versions
    from rlcli.tuning.bench import system_load

    cores, busy = available_cores(), system_load()
    if busy is not None and busy > _MAX_LOAD * cores:
        console.warn(f"the machine is busy (load {busy:.1f} on {cores} cores): end other programs")
    return {
        "cpu": processor()["model"],
        "cores": cores,
        "quota": core_quota(),
        "memory": available_memory(),
        "load": busy,
        "versions": {"rlcli": rlcli.__version__, **{name: v for name, v in versions(resolved).items() if v}},
    }


def _show(findings: Findings, horizon: str) -> None:
    if findings.stepped:
        columns = ["ENVS", "THREADS", "WORKERS", "STEPS/S", "PHYSICS", "SPREAD", "MEMORY", ""]
        console.table(columns, [_step_cells(row) for row in findings.stepped], "environment, random actions")
    if findings.trained:
        shares = list(dict.fromkeys(name for row in findings.trained for name in row.shares))
        columns = ["ENVS", horizon, "MINIBATCHES", "ENGINE", "TORCH", "WORKERS", "MS", "STEPS/S"]
        rows = [_training_cells(row, shares) for row in findings.trained]
        console.data("")
        console.table([*columns, *map(str.upper, shares), "SPREAD", "MEMORY", ""], rows, "training, one iteration")
        console.data("")


def _step_cells(row: Stepped) -> list[str]:
    return [
        f"{row.num_envs:,}",
        str(row.engine_threads),
        str(row.workers),
        cell(row.steps_per_s, ",.0f"),
        cell(row.physics, ".0%"),
        *_last_cells(row, ""),
    ]


def _training_cells(row: Trained, shares: Sequence[str]) -> list[str]:
    setting = row.setting
    sizes = [cell(setting.num_envs, ","), cell(setting.horizon), cell(setting.minibatches)]
    threads = [str(setting.engine_threads), str(setting.torch_threads), str(setting.workers)]
    times = [cell(row.milliseconds, ".4g"), cell(row.steps_per_s, ",.0f")]
    times += [cell(row.shares.get(name), ".0%") for name in shares]
    return [*sizes, *threads, *times, *_last_cells(row, "" if row.alike else "learns differently")]


def _last_cells(row: Stepped | Trained, remark: str) -> list[str]:
    memory = "-" if row.resident is None else f"{row.resident / 2**20:,.0f} MB"
    return [cell(row.spread, ".0%"), memory, f"left out: {row.left_out}" if row.left_out else remark]


class _View(LiveView):
    """Progress display of `rlcli bench`: a block that is redrawn on a terminal, else one line for each measurement."""

    def __init__(self, title: str) -> None:
        super().__init__(refresh_per_second=4, transient=True)
        self._title, self._current = title, ""
        self._rows: list[list[str]] = []

    def announce(self, current: str) -> None:
        """Show a text that describes the measurement that starts now. Without a terminal, show nothing."""
        self._current = current
        self._draw()

    def show(self, findings: Findings) -> None:
        """Show the finished measurements. Without a terminal, print only the last one, if it is new."""
        rows = [_step_parts(row) for row in findings.stepped]
        for row in findings.trained:
            setting, ms = row.setting, cell(row.milliseconds, ".4g", " ms")
            steps = [] if setting.horizon is None else [f"{setting.horizon} steps"]
            threads = f"engine threads {setting.engine_threads}, torch threads {setting.torch_threads}"
            rows.append([f"{setting.num_envs:,} envs", *steps, f"{threads}, workers {setting.workers}", ms])
        if self._live is None and len(rows) > len(self._rows):
            console.info("  ".join(rows[-1]))
        self._rows = rows
        self._draw()

    def _draw(self) -> None:
        if self._live is not None:
            width, max_lines = self._live.console.width, max(4, self._live.console.height - 4)
            lines = [line for row in self._rows for line in fill(row, width)]
            self.update([plain(self._title), *lines[-max_lines:], *fill([f"... {self._current}"], width)])


def _step_parts(row: Stepped) -> list[str]:
    envs, threads, workers, rate, physics, spread, memory, _ = _step_cells(row)
    if row.steps_per_s is None:
        return [f"{envs} envs", "left out"]
    sizes = [f"{envs} envs", f"threads {threads}", f"workers {workers}"]
    return [*sizes, f"{rate} steps/s", f"physics {physics}", f"spread {spread}", memory]
