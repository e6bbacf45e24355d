"""Against mjlab on its CPU device: `python benchmarks/against_mjlab.py`.

It measures the environment step of the same cartpole (`gpu_mdp_check.py` compares rewards and observations) with 1,024
environments under random actions; the time from the start of each library's own `train` of its own cartpole to the end
of the first step and of the first update, with and without cached kernels; the time to list the tasks; and memory.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from typing import Any

import peers
from machine import cores
from sides import CACHE, CHECKOUT, HERE, Failed, Side, alternate, opened, ratio, steps_for, wall
from tables import main, measured_on, rate, spread, table

NAME = "mjlab"
NUM_ENVS = 1024
ENVS = str(NUM_ENVS)
OURS = ["rlcli.cli.app:main", "train", "cartpole", "--num-envs", ENVS, "--device", "cpu", "--quiet"]
THEIRS = ["mjlab.scripts.train:main", "Mjlab-Cartpole-Balance", "--env.scene.num-envs", ENVS, "--agent.logger",
          "tensorboard", "--gpu-ids", "None"]  # fmt: skip
FIRST = {
    "first step": ("rlcli.envs.vec_env:VecEnv.step", "mjlab.envs.manager_based_rl_env:ManagerBasedRlEnv.step"),
    "first update": ("rlcli.rl.sb3.trainer:Sb3Trainer.iterate", "rsl_rl.algorithms.ppo:PPO.update"),
}


def steps_of_both(repeats: int, seconds: float) -> dict[str, Any]:
    """Measure environment steps in turn, and the memory of both sides afterwards."""
    ours = Side("mjlab-rlcli", [sys.executable, str(HERE / "side_rlcli.py")], environment=CHECKOUT)
    theirs = Side("mjlab-mjlab", [str(peers.python("mjlab")), str(HERE / "side_mjlab.py")], environment=quietly())
    with opened(ours, theirs):
        ours("open_env", task="cartpole", num_envs=NUM_ENVS, threads=cores())
        theirs("open_env", num_envs=NUM_ENVS, threads=cores())
        blocks = {"ours": lambda n: ours("step", steps=n), "theirs": lambda n: theirs("step", steps=n)}
        blocks["theirs"](50)
        blocks["ours"](600)  # until episodes no longer end in the same step
        steps = {name: steps_for(block, seconds) for name, block in blocks.items()}
        found = alternate(blocks, steps, repeats)
        memory = {name: side("memory_mb")["most"] for name, side in (("ours", ours), ("theirs", theirs))}
        versions = theirs("version")
    rates = {name: NUM_ENVS / statistics.median(found[name]) for name in found}
    return {**ratio(found["theirs"], found["ours"]), "rates": rates, "memory_mb": memory, "versions": versions}


def quietly(**more: str) -> dict[str, str]:
    """Return variables for mjlab on a machine without a display or a GPU; compiled kernels are kept."""
    return {"MUJOCO_GL": "disabled", "CUDA_VISIBLE_DEVICES": "", "WARP_CACHE_PATH": str(CACHE / "warp"), **more}


def waits(repeats: int, cold: bool) -> dict[str, Any]:
    """Measure the seconds from the start of a process to a result that the user waits for, in turn."""
    here, there, found = peers.python("rlcli"), peers.python("mjlab"), {}
    program = str(HERE / "first_call.py")

    def first(library: int, milestone: str, folder: str, **environment: str) -> float:
        where = ["--runs-dir", folder] if library == 0 else ["--log-root", folder]
        python, command = (here, OURS) if library == 0 else (there, THEIRS)
        return wall([str(python), program, FIRST[milestone][library], *command, *where], quietly(**environment))

    with tempfile.TemporaryDirectory() as folder:
        for milestone in FIRST:
            for library in (0, 1):
                first(library, milestone, folder)  # files read once, kernels compiled
            rounds = [(first(0, milestone, folder), first(1, milestone, folder)) for _ in range(repeats)]
            found[milestone] = columns(rounds)
        if cold:
            rounds = []
            for _ in range(repeats):
                with tempfile.TemporaryDirectory() as empty:
                    rounds.append(
                        (first(0, "first step", folder), first(1, "first step", folder, WARP_CACHE_PATH=empty))
                    )
            found["first step, nothing compiled yet"] = columns(rounds)
    # mjlab's own `list-envs` exits with the number of its tasks
    lists = [[str(here.with_name("rlcli")), "list-tasks"], [str(there), "-m", "mjlab.scripts.list_envs"]]
    for command in lists:
        wall(command, quietly())
    found["list of tasks"] = columns([(wall(lists[0]), wall(lists[1], quietly())) for _ in range(repeats)])
    return found


def columns(rounds: list[tuple[float, float]]) -> dict[str, float]:
    """Return the medians of both sides, and of the ratio of mjlab's time to ours."""
    ours, theirs = zip(*rounds, strict=True)
    return {"ours": statistics.median(ours), "theirs": statistics.median(theirs), **ratio(theirs, ours)}


def measure(quick: bool) -> dict[str, Any]:
    """Measure steps, waiting times and memory."""
    try:
        return {**steps_of_both(2 if quick else 7, 0.2 if quick else 1.0), "waits": waits(1 if quick else 5, not quick)}
    except Failed as error:
        return {"failed": str(error)}


def markdown(result: dict[str, Any]) -> str:
    """Return the table in Markdown."""
    if "failed" in result:
        return f"{measured_on(result)}\n\nmjlab: {result['failed']}"
    versions = result["versions"]
    peer = f"mjlab {versions['mjlab']} (mujoco-warp {versions['mujoco-warp']}, rsl_rl {versions['rsl-rl-lib']})"
    rates, memory = result["rates"], result["memory_mb"]
    rows = [["environment steps/s, 1,024 cartpoles", rate(rates["ours"]), rate(rates["theirs"]),
             f"**{result['ratio']:.1f}** times as many ({spread(result)})"]]  # fmt: skip
    for what, row in result["waits"].items():
        name = what if what.startswith("list") else f"from start to {what}"
        times = (
            f"**1/{row['ratio']:.1f}** of its time" if row["ratio"] > 1 else f"**{1 / row['ratio']:.1f}** times as long"
        )
        rows.append([name, f"{row['ours']:.2f} s", f"{row['theirs']:.2f} s", f"{times} (1/{row['ratio_min']:.1f} ..)"])
    share = memory["ours"] / memory["theirs"]
    rows.append(
        ["memory at its most, stepping", f"{memory['ours']:.0f} MB", f"{memory['theirs']:.0f} MB", f"{share:.2f}"]
    )
    return f"{measured_on(result, peer)}\n\n{table(['', 'rlcli', 'mjlab on the CPU', ''], rows)}"


if __name__ == "__main__":
    main(sys.modules[__name__])
