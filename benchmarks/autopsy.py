"""Cost of the failure recorder for a training: `python benchmarks/autopsy.py`.

Two trainings with the same seed, with and without the recorder, run iterations in turn. The figure is the ratio of
their environment steps per second, the median of blocks, by the clock and by processor time, which depends less on
other processes. After every block both write a checkpoint with the recorded episodes; this is part of the measured
time.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from machine import describe

from rlcli.config.load import resolve
from rlcli.config.schema import AutopsyConfig
from rlcli.envs.make import make_env
from rlcli.registry import find_task, load_object
from rlcli.replay.crash_dump import CrashDumper
from rlcli.replay.failure_recorder import open_failure_recorder
from rlcli.training.checkpoint_writer import CheckpointWriter, Keep


class Training:
    """Training that runs iterations on request."""

    def __init__(self, task: str, agent: str, num_envs: int, folder: Path, config: AutopsyConfig | None) -> None:
        resolved = resolve(find_task(task), agent=agent, flags={"scene.num_envs": num_envs, "agent.torch_threads": 1})
        assert resolved.trainer is not None
        self.env = make_env(resolved, seed=1)
        make = load_object(resolved.trainer.trainer)
        self.trainer = make(self.env, resolved.agent, seed=1, device="cpu", torch_threads=1)
        self.trainer.start()
        (folder / "checkpoints").mkdir(parents=True)
        CrashDumper(self.env, folder / "dumps")
        cases = open_failure_recorder(self.env, config, folder, None)
        self.saver = CheckpointWriter(folder / "checkpoints", Keep(2), {}, cases=cases)

    def block(self, iterations: int) -> tuple[float, float]:
        """Return environment steps per second, by the clock and by processor time."""
        steps, begin, used = self.trainer.env_steps, time.perf_counter(), time.process_time()
        for _ in range(iterations):
            self.trainer.iterate()
            if self.saver.cases is not None:
                self.saver.cases.commit(self.trainer.iteration, self.trainer.env_steps)
        self.saver.save(self.trainer.state(), self.trainer.iteration, self.trainer.env_steps)
        self.saver.wait()
        taken = self.trainer.env_steps - steps
        return taken / (time.perf_counter() - begin), taken / (time.process_time() - used)


def measure(task: str, agent: str, num_envs: int, blocks: int, iterations: int) -> dict[str, Any]:
    """Return one row of the table."""
    with tempfile.TemporaryDirectory() as place:
        on = Training(task, agent, num_envs, Path(place) / "on", AutopsyConfig())
        off = Training(task, agent, num_envs, Path(place) / "off", None)
        ratios, processor, rates = [], [], []
        for block in range(blocks + 1):
            pair = (on, off) if block % 2 else (off, on)
            rate = {id(training): training.block(iterations) for training in pair}
            if block:  # the first warms up
                ratios.append(rate[id(on)][0] / rate[id(off)][0])
                processor.append(rate[id(on)][1] / rate[id(off)][1])
                rates.append(rate[id(off)][0])
        cases = on.saver.cases
        assert cases is not None
        files = list((Path(place) / "on" / "autopsy").glob("*.safetensors"))
        return {
            "task": task,
            "num_envs": num_envs,
            "ratio": statistics.median(ratios),
            "ratio_min": min(ratios),
            "ratio_max": max(ratios),
            "processor_ratio": statistics.median(processor),
            "processor_ratio_min": min(processor),
            "processor_ratio_max": max(processor),
            "steps_per_s_off": statistics.median(rates),
            "seconds_kept": cases.seconds,
            "cases": len(files),
            "mib_on_disk": sum(file.stat().st_size for file in files) / 2**20,
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=["cartpole"])
    parser.add_argument("--agent", default="sb3-ppo")
    parser.add_argument("--num-envs", nargs="+", type=int, default=[4096])
    parser.add_argument("--blocks", type=int, default=9)
    parser.add_argument("--iterations", type=int, default=4, help="length of a block")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = [
        measure(task, options.agent, num_envs, options.blocks, options.iterations)
        for task in options.tasks
        for num_envs in options.num_envs
    ]
    if options.json:
        print(json.dumps({"machine": describe(), "rows": rows}, indent=2))
        return
    print(describe())
    for row in rows:
        print(
            f"{row['task']} x {row['num_envs']}: {row['ratio']:.4f} of the steps/s without"
            f" ({row['ratio_min']:.4f} .. {row['ratio_max']:.4f}; {row['steps_per_s_off']:,.0f} steps/s),"
            f" {row['processor_ratio']:.4f} by the processor's time"
            f" ({row['processor_ratio_min']:.4f} .. {row['processor_ratio_max']:.4f}),"
            f" {row['seconds_kept']:.2f} s kept, {row['cases']} cases, {row['mib_on_disk']:.1f} MiB"
        )


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
