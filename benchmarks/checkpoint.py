"""Cost of a checkpoint: `python benchmarks/checkpoint.py`.

Training waits for the copy in memory; another thread writes the files. The task is the humanoid of `humanoid.py`, its
agent is PPO with networks of 512, 256 and 128.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path

import torch
from humanoid import TASK, humanoid
from machine import describe

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task, load_object
from rlcli.runs.checkpoint_reader import open_checkpoint
from rlcli.training.checkpoint_writer import CheckpointWriter, Keep

AGENT = """
agents:
  ppo:
    {trainer: ppo, algorithm: ppo, num_steps: 2, num_epochs: 1, max_iterations: 1000, normalize_observations: true,
     actor: {hidden: [512, 256, 128]}, critic: {hidden: [512, 256, 128]}}
"""


def make_trainer(folder: Path, num_envs: int) -> object:
    """Return the trainer after one iteration, so that its optimiser has moments."""
    (folder / "humanoid.xml").write_text(humanoid())
    (folder / "task.yaml").write_text(TASK.read_text() + AGENT)
    resolved = resolve(find_task(str(folder)), agent="ppo", overrides=[f"scene.num_envs={num_envs}"])
    env = make_env(resolved, seed=1)
    trainer = load_object(resolved.trainer.trainer)(env, resolved.agent, seed=1, device="cpu", torch_threads=1)
    trainer.start()
    trainer.iterate()
    return trainer


def measure(trainer: object, checkpoints: Path, repeats: int) -> dict[str, float]:
    """Return medians of the copy, the whole wait in `save`, writing, loading [ms], and the size [MB]."""
    rows = []
    saver = CheckpointWriter(checkpoints, Keep(2), {})
    for number in range(repeats):
        begin = time.perf_counter()
        state = trainer.state()
        copied = time.perf_counter()
        saver.save(state, number, 1000 + number)
        handed_over = time.perf_counter()
        saver.wait()
        written = time.perf_counter()
        folder = checkpoints / f"{1000 + number:012d}"
        open_checkpoint(folder).state()
        read = time.perf_counter()
        size = sum(file.stat().st_size for file in folder.iterdir())
        rows.append((copied - begin, handed_over - begin, written - handed_over, read - written, size / 1e9))
    names = ("copy_ms", "training_waits_ms", "written_ms", "read_ms", "megabytes")
    columns = zip(*rows, strict=True)
    return {name: 1e3 * statistics.median(column) for name, column in zip(names, columns, strict=True)}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num-envs", type=int, default=4096)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        checkpoints = Path(folder) / "checkpoints"
        checkpoints.mkdir()
        figures = measure(make_trainer(Path(folder), options.num_envs), checkpoints, options.repeats)
    if options.json:
        print(json.dumps({"machine": describe(), "num_envs": options.num_envs, **figures}, indent=1))
        return
    print(describe())
    print(
        f"{options.num_envs} environments, {figures['megabytes']:.0f} MB: training waits"
        f" {figures['training_waits_ms']:.0f} ms (the copy {figures['copy_ms']:.0f} ms), written in"
        f" {figures['written_ms']:.0f} ms beside it, read in {figures['read_ms']:.0f} ms"
    )


if __name__ == "__main__":
    main()
