"""Training against other libraries' PPO: `python benchmarks/against_trainers.py`.

Stable-Baselines3 runs the same cartpole, written as a plain Gymnasium environment, in a `DummyVecEnv` and in a
`SubprocVecEnv`, each with its fastest number of environments. RSL-RL and skrl run rlcli's own environment. The sizes
are the same everywhere: 16 steps, 5 epochs, 4 minibatches, two networks of 32-32 ELU. An iteration with more
environments has more samples, so steps per second are compared.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from typing import Any

import peers
from sides import CHECKOUT, HERE, Block, Failed, Side, alternate, opened, ratio, steps_for
from tables import main, measured_on, rate, spread, table

NAME = "trainers"
NUM_ENVS = 4096
SIZES = (8, 16, 32, 64, 128, 256, 512)
OURS = {"ppo": "rlcli, trainer `ppo`", "sb3-ppo": "rlcli, trainer `sb3`"}
PEERS = {"dummy": "SB3, `DummyVecEnv`", "subproc": "SB3, `SubprocVecEnv`", "rsl_rl": "RSL-RL", "skrl": "skrl"}
PLAIN = ("dummy", "subproc")
"""Sides that step plain Gymnasium environments; the others step rlcli's."""


def best_size(peer: Side, kind: str, seconds: float) -> tuple[int, dict[str, float]]:
    """Return the number of environments at which SB3 trains fastest, and all measured numbers.

    The search ends when two numbers in a row are slower than the best one by a fifth.
    """
    found: dict[int, float] = {}
    for num_envs in SIZES:
        peer("open_sb3", kind=kind, num_envs=num_envs)
        peer("train", steps=1)
        steps = steps_for(lambda n: peer("train", steps=n), seconds)
        found[num_envs] = 16 * num_envs * steps / peer("train", steps=steps)
        if len(found) > 2 and max(list(found.values())[-2:]) < 0.8 * max(found.values()):
            break
    best = max(found, key=found.__getitem__)
    return best, {str(size): value for size, value in found.items()}


def prepared(side: Side, open_it: Callable[[], Any], warm: int) -> Block:
    """Return a side whose trainer has made a few iterations."""
    open_it()
    side("train", steps=warm)
    return lambda n: side("train", steps=n)


def measure(quick: bool) -> dict[str, Any]:
    """Measure the steps per second of each side, and the ratio of ours to theirs."""
    repeats, seconds, warm = (2, 0.05, 1) if quick else (7, 1.0, 3)
    sizes = {name: 64 if quick else NUM_ENVS for name in (*OURS, "rsl_rl", "skrl")}
    scans: dict[str, dict[str, float]] = {}
    failed: dict[str, str] = {}
    try:
        script = [str(peers.python("rlcli")), str(HERE / "side_trainers.py")]
        theirs = {name: Side(f"{NAME}-{name}", script) for name in PEERS}
    except Failed as error:
        theirs, failed = {}, dict.fromkeys(PEERS, str(error))
    ours = {
        name: Side(f"{NAME}-{name}", [sys.executable, str(HERE / "side_rlcli.py")], environment=CHECKOUT)
        for name in OURS
    }
    with opened(*ours.values(), *theirs.values()):
        blocks: dict[str, Block] = {}
        for name, side in ours.items():
            making = lambda name=name, side=side: side("open_trainer", agent=name, num_envs=sizes[name])  # noqa: E731
            blocks[name] = prepared(side, making, warm)
        for name, side in theirs.items():
            try:
                if name in PLAIN:
                    sizes[name], scans[name] = (8, {}) if quick else best_size(side, name, seconds / 2)
                    arguments = {"method": "open_sb3", "kind": name, "num_envs": sizes[name]}
                else:
                    arguments = {"method": f"open_{name}", "num_envs": sizes[name]}
                making = lambda side=side, arguments=arguments: side(**arguments)  # noqa: E731
                blocks[name] = prepared(side, making, warm)
            except Failed as error:
                failed[name] = str(error)
        steps = {name: steps_for(block, seconds) for name, block in blocks.items()}
        found = alternate(blocks, steps, repeats)
        machine, versions = ours["ppo"]("machine"), theirs["dummy"]("version") if theirs else {}
        memory = {name: side("memory_mb")["most"] for name, side in ours.items()}
    samples = {name: [16 * sizes[name] / each for each in seconds] for name, seconds in found.items()}
    rows = [
        {
            "name": name,
            "num_envs": sizes[name],
            "steps_per_s": statistics.median(values),
            "times": {mine: ratio(samples[mine], values) for mine in OURS} if name in PEERS else {},
        }
        for name, values in samples.items()
    ]
    return {
        "machine": machine,
        "versions": versions,
        "rows": rows,
        "scans": scans,
        "failed": failed,
        "memory_mb": memory,
    }


def markdown(result: dict[str, Any]) -> str:
    """Return the table in Markdown."""
    names, versions = {**OURS, **PEERS}, result["versions"]
    rows = []
    for row in result["rows"]:
        cells = [f"**{times['ratio']:.1f}** ({spread(times)})" for times in row["times"].values()] or ["", ""]
        rows.append([names[row["name"]], f"{row['num_envs']:,}", rate(row["steps_per_s"]), *cells])
    rows += [[names[name], f"failed: {reason}", "", "", ""] for name, reason in result["failed"].items()]
    heads = ["", "environments", "training steps/s", "speed of `ppo` / this row", "speed of `sb3` / this row"]
    scans = [
        f"{names[kind]} at {', '.join(f'{size}: {rate(value)}' for size, value in scan.items())}"
        for kind, scan in result["scans"].items()
    ]
    peer = ", ".join(f"{name} {versions[name]}" for name in ("rsl-rl-lib", "skrl", "gymnasium") if name in versions)
    tried = f"\n\nTraining steps/s by number of environments: {'; '.join(scans)}." if scans else ""
    return f"{measured_on(result, *([peer] if peer else []))}\n\n{table(heads, rows)}{tried}"


if __name__ == "__main__":
    main(sys.modules[__name__])
