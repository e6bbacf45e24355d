"""Environment steps against EnvPool's, on Gymnasium's eleven MuJoCo v5 tasks: `python benchmarks/against_envpool.py`.

Both sides have the same models (compared field by field), frame skip, threads, range of random actions and automatic
resets. They start together and run blocks with the same number of steps in turn, so that their episodes have the same
age. EnvPool contains MuJoCo 3.6; a bare loop of `mj_step` on both versions shows how much of a ratio is due to MuJoCo.
EnvPool's calls that only reset an environment are not counted as steps. The limit of a ratio is its value if everything
except the engine's call took no time.
"""

from __future__ import annotations

import statistics
import sys
from typing import Any

import peers
from machine import cores
from sides import HERE, Failed, Side, alternate, opened, ratio, steps_for
from tables import geometric_mean, main, measured_on, rate, spread, table

NAME = "envpool"
MUJOCO_OF_ENVPOOL = "3.6.0"
TASKS = {
    "gym-ant": "Ant-v5",
    "gym-half-cheetah": "HalfCheetah-v5",
    "gym-hopper": "Hopper-v5",
    "gym-humanoid": "Humanoid-v5",
    "gym-humanoid-standup": "HumanoidStandup-v5",
    "gym-inverted-double-pendulum": "InvertedDoublePendulum-v5",
    "gym-inverted-pendulum": "InvertedPendulum-v5",
    "gym-pusher": "Pusher-v5",
    "gym-reacher": "Reacher-v5",
    "gym-swimmer": "Swimmer-v5",
    "gym-walker2d": "Walker2d-v5",
}


FORCES = {"gym-ant", "gym-humanoid", "gym-humanoid-standup"}
"""Tasks that observe `cfrc_ext`, which `mujoco.batch` does not compute."""


def side(name: str, environment: str) -> Side:
    """Return a program of this folder in one of the virtual environments."""
    return Side(f"{NAME}-{name}-{environment}", [str(peers.python(environment)), str(HERE / f"side_{name}.py")])


def one(task: str, num_envs: int, ours: Side, theirs: Side, repeats: int, seconds: float) -> dict[str, Any]:
    """Return a task with `num_envs` environments."""
    here = ours("open_env", task=task, num_envs=num_envs, threads=cores())
    there = theirs("open_env", task=TASKS[task], num_envs=num_envs, threads=cores())
    for key in ("physics_steps", "max_episode_length"):
        if here[key] != there[key]:
            raise Failed(f"{key} is {here[key]} here, {there[key]} there")
    differences = ours("differs", path=there["model"])
    if differences:
        raise Failed(f"the models differ in {', '.join(differences)}")
    blocks = {"ours": lambda n: ours("step", steps=n), "theirs": lambda n: theirs("step", steps=n)}
    warm = alternate(blocks, dict.fromkeys(blocks, 32), 2)
    steps = max(4, round(seconds / warm["ours"][-1]))
    found = alternate(blocks, dict.fromkeys(blocks, steps), repeats)
    compared = ratio(found["theirs"], found["ours"])
    return {
        **compared,
        "limit": compared["ratio"] / ours("physics"),
        "ours": num_envs / statistics.median(found["ours"]),
        "envpool": num_envs / statistics.median(found["theirs"]),
        "steps": steps,
        "model": there["model"],
        "physics_steps": there["physics_steps"],
    }


def mujocos_part(
    model: str, physics_steps: int, new: Side, old: Side, repeats: int, seconds: float
) -> dict[str, float]:
    """Return the speed of this release's MuJoCo relative to EnvPool's for a model, on one thread."""
    for each in (new, old):
        each("open_model", path=model, physics_steps=physics_steps)
    blocks = {"new": lambda n: new("step", steps=n), "old": lambda n: old("step", steps=n)}
    steps = dict.fromkeys(blocks, steps_for(blocks["new"], seconds))
    blocks["old"](steps["old"])
    found = alternate(blocks, steps, repeats)
    return ratio(found["old"], found["new"])


def row_of(task: str, repeats: int, seconds: float) -> dict[str, Any]:
    """Measure a task in separate processes, so that a failure affects no other task."""
    row: dict[str, Any] = {"task": task}
    try:
        sides = side("rlcli", "rlcli"), side("envpool", "envpool"), side("mujoco", "rlcli"), side("mujoco", "envpool")
        with opened(*sides) as (ours, theirs, new, old):
            for num_envs in (64, 1024):
                row[str(num_envs)] = one(task, num_envs, ours, theirs, repeats, seconds)
            setting = {key: row["64"][key] for key in ("model", "physics_steps")}
            row["mujoco"] = mujocos_part(**setting, new=new, old=old, repeats=repeats, seconds=seconds / 2)
            row["versions"] = [theirs("version")["envpool"], old("version")["mujoco"]]
    except Failed as error:
        row["failed"] = str(error)
    for column in ("64", "1024"):
        row.get(column, {}).pop("model", None)
    print(row, file=sys.stderr, flush=True)
    return row


def measure(quick: bool) -> dict[str, Any]:
    """Measure all tasks, one row each."""
    repeats, seconds = (2, 0.05) if quick else (7, 0.4)
    try:
        peers.add("envpool", f"mujoco=={MUJOCO_OF_ENVPOOL}")
    except Failed as error:
        return {"failed": str(error)}
    rows = [row_of(task, repeats, seconds) for task in (["gym-hopper", "gym-ant"] if quick else TASKS)]
    whole = [row for row in rows if "failed" not in row]
    if not whole:
        return {"failed": rows[0]["failed"]}
    versions = "EnvPool {} with MuJoCo {}".format(*whole[0]["versions"])
    means = {key: geometric_mean([row[key]["ratio"] for row in whole]) for key in ("64", "1024", "mujoco")}
    limits = {key: geometric_mean([row[key]["limit"] for row in whole]) for key in ("64", "1024")}
    return {"envpool": versions, "rows": rows, "means": means, "limits": limits}


def markdown(result: dict[str, Any]) -> str:
    """Return the table in Markdown."""
    if "failed" in result:
        return f"{measured_on(result)}\n\nEnvPool: {result['failed']}"
    heads = ["task"]
    for num_envs in (64, 1024):
        heads += [f"ratio at {num_envs:,} environments", "min .. max", "limit", "rlcli [steps/s]", "EnvPool [steps/s]"]
    rows = []
    for row in result["rows"]:
        name = f"`{row['task']}`" + (" *" if row["task"] in FORCES else "")
        if "failed" in row:
            rows.append([name, f"failed: {row['failed']}", *[""] * 10])
            continue
        cells = [name]
        for column in (row["64"], row["1024"]):
            cells += [f"**{column['ratio']:.2f}**", spread(column), f"{column['limit']:.2f}"]
            cells += [rate(column["ours"]), rate(column["envpool"])]
        rows.append([*cells, f"{row['mujoco']['ratio']:.2f}"])
    last = ["geometric mean"]
    for key in ("64", "1024"):
        last += [f"**{result['means'][key]:.2f}**", "", f"{result['limits'][key]:.2f}", "", ""]
    rows.append([*last, f"{result['means']['mujoco']:.2f}"])
    return f"{measured_on(result, result['envpool'])}\n\n{table([*heads, 'ratio of MuJoCo'], rows)}"


if __name__ == "__main__":
    main(sys.modules[__name__])
