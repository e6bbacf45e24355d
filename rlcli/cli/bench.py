"""`rlcli bench TASK`: how fast it steps and trains here, and with which sizes and threads it trains soonest."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.console import console, is_terminal, plain
from rlcli.cli.options import Agent, ConfigFile, Debug, Json, NumEnvs, Overrides, Quiet, Verbose, flags, tell_notes
from rlcli.cli.tables import flow, screen

if TYPE_CHECKING:
    from rlcli.rl.bench import Findings, Stepped, Trained

_BUSY = 0.5
"""Processes a core that want to run before anything is measured: more is said."""


def command(
    task: Annotated[str, typer.Argument(help="A task's name, distribution:name, or a folder with a task.yaml.")],
    overrides: Overrides = None,
    agent: Agent = None,
    num_envs: NumEnvs = None,
    config: ConfigFile = None,
    save_preset: Annotated[
        str | None,
        typer.Option("--save-preset", metavar="FILE|NAME", help="Write what is recommended, for train --config."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="The preset may replace a file.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="A first impression: short, and once.")] = False,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Measure a task here, and recommend sizes and threads."""
    from rlcli.config.load import resolve
    from rlcli.machine import wait_calmly
    from rlcli.rl.trust import named_task

    wait_calmly()
    file = None if save_preset is None else _preset_file(save_preset, overwrite)
    source = named_task(task)

    def resolved(changes: Mapping[str, Any]) -> Any:
        given = {**flags(scene__num_envs=num_envs), **changes}
        return resolve(source, agent=agent, config_file=config, overrides=overrides or [], flags=given)

    wanted = resolved({})
    wanted.require_agent()
    tell_notes(wanted)

    from rlcli.rl.bench import QUICK, Bench, Pace
    from rlcli.rl.bench_preset import explanation, preset
    from rlcli.rl.files import write_atomic

    machine = _machine(wanted)
    if machine["load"] is not None and machine["load"] > _BUSY * machine["cores"]:
        console.warn(f"the machine is busy (load {machine['load']:.1f} on {machine['cores']} cores): figures will vary")
    stopped = False
    with _View(f"rlcli bench {source.name}") as view:
        bench = Bench(resolved, QUICK if quick else Pace(), view.tell, view.show)
        try:
            findings = bench.run()
        except KeyboardInterrupt:
            findings, stopped = bench.findings, True
    _show(findings, (bench.horizon_key or "horizon").upper())
    for line in explanation(findings):
        console.data(line)
    if findings.unsteady:
        console.warn("measurements differ from one repeat to the next: something else runs on this machine")
    changes = None if findings.recommended is None else bench.changes(findings.recommended.setting)
    if changes is not None and file is not None:
        write_atomic(file, preset(wanted, changes, findings, machine, agent is not None))
        console.info(f"rlcli train {task} --config {file}")
        console.data(str(file))
    console.document(
        "bench",
        task=source.name,
        agent=wanted.agent_name,
        state="stopped" if stopped else "finished",
        machine=machine,
        **findings.record(),
        recommended=changes,
        present=bench.changes(bench.present),
        why=explanation(findings),
        preset=str(file) if file is not None and changes is not None else None,
    )
    if stopped:
        from rlcli.errors import Stopped

        raise Stopped("stopped; what had been measured is shown, and no preset was written", exit_code=130)


def _preset_file(word: str, overwrite: bool) -> Path:
    """Where the preset goes: FILE, or NAME.yaml here.

    Raises:
        UsageError: if something is there that may not be replaced.
        MachineError: if there is no such folder, or it cannot be written.
    """
    from rlcli.errors import MachineError, UsageError

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


def _machine(resolved: Any) -> dict[str, Any]:
    import rlcli
    from rlcli.machine import available_cores, core_quota, memory
    from rlcli.rl.bench import load
    from rlcli.rl.environment import processor, versions

    return {
        "cpu": processor()["model"],
        "cores": available_cores(),
        "quota": core_quota(),
        "memory": memory(),
        "load": load(),
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
        _number(row.steps_per_s),
        _share(row.physics),
        _share(row.spread),
        _bytes(row.resident),
        f"left out: {row.left_out}" if row.left_out else "",
    ]


def _trained(row: Trained, shares: Sequence[str]) -> list[str]:
    setting = row.setting
    remark = f"left out: {row.left_out}" if row.left_out else "" if row.alike else "learns otherwise"
    return [
        f"{setting.num_envs:,}",
        "-" if setting.horizon is None else str(setting.horizon),
        "-" if setting.minibatches is None else str(setting.minibatches),
        str(setting.engine_threads),
        str(setting.torch_threads),
        "-" if row.seconds is None else f"{1e3 * row.seconds:.4g}",
        _number(row.steps_per_s),
        *(_share(row.shares.get(name)) for name in shares),
        _share(row.spread),
        _bytes(row.resident),
        remark,
    ]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:,.0f}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.0%}"


def _bytes(value: int | None) -> str:
    return "-" if value is None else f"{value / 2**20:,.0f} MB"


class _View:
    """What has been measured so far, on stderr: a block that grows on a terminal, lines elsewhere. A context."""

    def __init__(self, title: str) -> None:
        self._title, self._doing = title, ""
        self._lines: list[list[str]] = []
        self._live: Any = None

    def __enter__(self) -> _View:
        if is_terminal(sys.stderr) and not console.quiet:
            from rich.live import Live

            self._live = Live(console=screen(sys.stderr), refresh_per_second=4, transient=True)
            self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            with contextlib.suppress(OSError):  # the terminal may be gone
                self._live.__exit__(kind, error, trace)

    def tell(self, doing: str) -> None:
        """What is measured next."""
        self._doing = doing
        self._draw()

    def show(self, findings: Findings) -> None:
        """Take in one row more."""
        rows = [_progress(*_stepped(row)[:6]) for row in findings.stepped]
        for one in findings.trained:
            setting, ms = one.setting, "-" if one.seconds is None else f"{1e3 * one.seconds:.4g} ms"
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
