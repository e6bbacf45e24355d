"""`rlcli bench TASK`: how fast it steps and trains here, and with which sizes and threads it trains soonest."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui.console import console, plain
from rlcli.cli.ui.options import Agent, ConfigFile, NumEnvs, Overrides, TaskName
from rlcli.cli.ui.progress_view import LiveView
from rlcli.cli.ui.tables import cell, flow
from rlcli.errors import MachineError, Stopped, UsageError
from rlcli.formats import log_notes

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.tuning.bench import Bench, Findings, Stepped, Trained

_BUSY = 0.5
"""Processes a core that want to run before anything is measured: more is said."""


def command(
    task: TaskName,
    overrides: Overrides = None,
    agent: Agent = None,
    num_envs: NumEnvs = None,
    config: ConfigFile = None,
    save_preset: Annotated[
        str | None, typer.Option(metavar="FILE|NAME", help="Write what is recommended, for train --config.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="The preset may replace a file.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="A first impression: short, and once.")] = False,
) -> None:
    """Measure a task here, and recommend sizes and threads."""
    from rlcli.config.layers import flags
    from rlcli.config.load import resolve
    from rlcli.machine import limit_openmp_spinning
    from rlcli.runs.trusted_tasks import named_task

    limit_openmp_spinning()
    file = None if save_preset is None else _preset_file(save_preset, overwrite)
    source = named_task(task)

    def resolved(changes: Mapping[str, Any]) -> Resolved:
        given = {**flags(scene__num_envs=num_envs), **changes}
        return resolve(source, agent=agent, config_file=config, overrides=overrides or [], flags=given)

    wanted = resolved({})
    wanted.require_agent()
    log_notes(wanted.notes)

    from rlcli.tuning.bench import QUICK, Bench, Pace

    machine = _machine(wanted)
    stopped = False
    with _View(f"rlcli bench {source.name}") as view:
        bench = Bench(resolved, QUICK if quick else Pace(), view.announce, view.show)
        try:
            bench.run()
        except KeyboardInterrupt:
            stopped = True
    _report(bench, wanted, machine, file, f"rlcli train {task}", names_agent=agent is not None, stopped=stopped)
    if stopped:
        raise Stopped("stopped; what had been measured is shown, and no preset was written", exit_code=130)


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
    """Print the measurements and the recommendation, and write the preset."""
    from rlcli.runs.atomic_io import write_atomic
    from rlcli.tuning.bench_recommendation import bench_preset, explanation

    findings = bench.findings
    _show(findings, (bench.horizon_key or "horizon").upper())
    for line in explanation(findings):
        console.data(line)
    if findings.unsteady:
        console.warn("measurements differ from one repeat to the next: something else runs on this machine")
    changes = None if findings.recommended is None else bench.changes(findings.recommended.setting)
    if changes is not None and file is not None:
        write_atomic(file, bench_preset(resolved, changes, findings, machine, names_agent))
        console.info(f"{command} --config {file}")
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


def _preset_file(word: str, overwrite: bool) -> Path:
    """Where the preset goes: FILE, or NAME.yaml here.

    Raises:
        UsageError: if something is there that may not be replaced.
        MachineError: if there is no such folder, or it cannot be written.
    """
    file = Path(word)
    if not word or file.name in ("", ".."):
        raise UsageError("--save-preset needs the name of a file", hint="--save-preset cartpole.yaml")
    if file.suffix not in (".yaml", ".yml"):
        file = file.with_name(f"{file.name}.yaml")
    folder = file.absolute().parent
    if file.is_dir():
        raise UsageError(f"--save-preset {file} is a folder", hint=f"give a file: {file / 'preset.yaml'}")
    if os.path.lexists(file) and not overwrite:
        raise UsageError(f"--save-preset: {file} exists", hint="another name, or --overwrite")
    if not folder.is_dir():
        raise MachineError(f"--save-preset: there is no folder {folder}")
    if not os.access(folder, os.W_OK):
        raise MachineError(f"--save-preset: {folder} cannot be written", hint="choose another folder")
    return file


def _machine(resolved: Resolved) -> dict[str, Any]:
    """Return the facts of the machine, and warn if it is busy."""
    import rlcli
    from rlcli.machine import available_cores, available_memory, core_quota, processor
    from rlcli.runs.provenance import versions
    from rlcli.tuning.bench import load

    cores, busy = available_cores(), load()
    if busy is not None and busy > _BUSY * cores:
        console.warn(f"the machine is busy (load {busy:.1f} on {cores} cores): figures will vary")
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
        columns = ["ENVS", "THREADS", "STEPS/S", "PHYSICS", "SPREAD", "MEMORY", ""]
        console.table(columns, [_stepped(row) for row in findings.stepped], "environment, random actions")
    if findings.trained:
        shares = list(dict.fromkeys(name for row in findings.trained for name in row.shares))
        columns = ["ENVS", horizon, "MINIBATCHES", "ENGINE", "TORCH", "MS", "STEPS/S", *map(str.upper, shares)]
        rows = [_trained(row, shares) for row in findings.trained]
        console.data("")
        console.table([*columns, "SPREAD", "MEMORY", ""], rows, "training, an iteration")
        console.data("")


def _stepped(row: Stepped) -> list[str]:
    return [
        f"{row.num_envs:,}",
        str(row.engine_threads),
        cell(row.steps_per_s, ",.0f"),
        cell(row.physics, ".0%"),
        cell(row.spread, ".0%"),
        _memory(row.resident),
        f"left out: {row.left_out}" if row.left_out else "",
    ]


def _trained(row: Trained, shares: Sequence[str]) -> list[str]:
    setting = row.setting
    remark = f"left out: {row.left_out}" if row.left_out else "" if row.alike else "learns otherwise"
    return [
        f"{setting.num_envs:,}",
        cell(setting.horizon),
        cell(setting.minibatches),
        str(setting.engine_threads),
        str(setting.torch_threads),
        cell(row.milliseconds, ".4g"),
        cell(row.steps_per_s, ",.0f"),
        *(cell(row.shares.get(name), ".0%") for name in shares),
        cell(row.spread, ".0%"),
        _memory(row.resident),
        remark,
    ]


def _memory(count: int | None) -> str:
    return "-" if count is None else f"{count / 2**20:,.0f} MB"


class _View(LiveView):
    """View of the measurements so far: a block that grows on a terminal, else lines."""

    def __init__(self, title: str) -> None:
        super().__init__(refresh_per_second=4, transient=True)
        self._title, self._doing = title, ""
        self._lines: list[list[str]] = []

    def announce(self, doing: str) -> None:
        """Show what is measured next."""
        self._doing = doing
        self._draw()

    def show(self, findings: Findings) -> None:
        """Show the rows so far."""
        rows = [_progress(*_stepped(row)[:6]) for row in findings.stepped]
        for one in findings.trained:
            setting, ms = one.setting, cell(one.milliseconds, ".4g", " ms")
            steps = [] if setting.horizon is None else [f"{setting.horizon} steps"]
            threads = f"threads {setting.engine_threads}, {setting.torch_threads}"
            rows.append([f"{setting.num_envs:,} envs", *steps, threads, ms])
        if self._live is None and len(rows) > len(self._lines):
            console.info("  ".join(rows[-1]))
        self._lines = rows
        self._draw()

    def _draw(self) -> None:
        if self._live is None:
            return
        from rich.text import Text

        width = self._live.console.width
        lines = [line for row in self._lines for line in flow(row, width)]
        room = max(4, self._live.console.height - 4)
        text = "\n".join([plain(self._title), *lines[-room:], *flow([f"... {self._doing}"], width)])
        self._live.update(Text(text))


def _progress(envs: str, threads: str, rate: str, physics: str, spread: str, memory: str) -> list[str]:
    if rate == "-":
        return [f"{envs} envs", "left out"]
    return [f"{envs} envs", f"threads {threads}", f"{rate} steps/s", f"physics {physics}", f"spread {spread}", memory]
