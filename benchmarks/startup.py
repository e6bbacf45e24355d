"""Duration of commands from the start of their process: `python benchmarks/startup.py`.

Medians of runs in turn: `rlcli --help` beside a typer program with one empty command, listing tasks beside mjlab's
`list-envs`, the help of rl_zoo3's `train`, and `rlcli train cartpole` until its first update beside rl_zoo3's.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

import peers
from against_mjlab import quietly
from sides import HERE, Failed, wall
from tables import main, measured_on, table

NAME = "startup"
EMPTY = "import typer\napp = typer.Typer()\n\n@app.command()\ndef main() -> None: ...\n\napp()\n"
FIRST = str(HERE / "first_call.py")
ZOO = ["rl_zoo3.train:train", "--algo", "ppo", "--env", "CartPole-v1", "--device", "cpu"]
LABELS = {
    "empty": "a typer program without anything, `--help`",
    "help": "`rlcli --help`",
    "list": "`rlcli list-tasks`",
    "mjlab-list": "mjlab's `list-envs`",
    "zoo-help": "`python -m rl_zoo3.train --help`",
    "step": "`rlcli train cartpole` to the first step",
    "update": "`rlcli train cartpole` to the first update",
    "zoo-update": "rl_zoo3's PPO on CartPole-v1 to the first update",
}


def commands(folder: Path) -> dict[str, tuple[str, list[str]]]:
    """Return name -> (virtual environment, command)."""
    (folder / "empty.py").write_text(EMPTY)
    train = ["rlcli.cli.app:main", "train", "cartpole", "--device", "cpu", "--quiet", "--runs-dir", str(folder)]
    return {
        "empty": ("rlcli", ["python", str(folder / "empty.py"), "--help"]),
        "help": ("rlcli", ["rlcli", "--help"]),
        "list": ("rlcli", ["rlcli", "list-tasks"]),
        "mjlab-list": ("mjlab", ["python", "-m", "mjlab.scripts.list_envs"]),  # `list-envs` exits with their number
        "zoo-help": ("rl-zoo3", ["python", "-m", "rl_zoo3.train", "--help"]),
        "step": ("rlcli", ["python", FIRST, "rlcli.envs.vec_env:VecEnv.step", *train]),
        "update": ("rlcli", ["python", FIRST, "rlcli.rl.sb3.trainer:Sb3Trainer.iterate", *train]),
        "zoo-update": ("rl-zoo3", ["python", FIRST, "stable_baselines3.ppo.ppo:PPO.train", *ZOO, "-f", str(folder)]),
    }


def measure(quick: bool) -> dict[str, Any]:
    """Measure the seconds of each command."""
    repeats = 1 if quick else 9
    with tempfile.TemporaryDirectory() as folder:
        runs, failed = {}, {}
        for name, (environment, command) in commands(Path(folder)).items():
            try:
                program = peers.python(environment).with_name(command[0])
                runs[name] = [str(program), *command[1:]]
                wall(runs[name], quietly())  # files read once
            except Failed as error:
                runs.pop(name, None)
                failed[name] = str(error)
        rounds = [{name: wall(command, quietly()) for name, command in runs.items()} for _ in range(repeats)]
    seconds = {name: statistics.median(each[name] for each in rounds) for name in runs}
    over = statistics.median(each["help"] - each["empty"] for each in rounds)
    result = {"seconds": seconds, "help_over_empty_s": over, "failed": failed}
    if "mjlab-list" in runs:
        result["mjlab_list_ratio"] = statistics.median(each["mjlab-list"] / each["list"] for each in rounds)
    return result


def markdown(result: dict[str, Any]) -> str:
    """Return the table in Markdown."""
    rows = [[LABELS[name], f"{seconds:.2f} s"] for name, seconds in result["seconds"].items()]
    rows += [[LABELS[name], f"failed: {reason}"] for name, reason in result["failed"].items()]
    sentences = [f"`rlcli --help` takes **{result['help_over_empty_s']:.2f} s** longer than the empty program"]
    if "mjlab_list_ratio" in result:
        sentences.append(f"listing tasks takes 1/**{result['mjlab_list_ratio']:.0f}** of mjlab's time")
    return f"{measured_on(result)}\n\n{table(['', 'from start to end'], rows)}\n\n{'; '.join(sentences)}."


if __name__ == "__main__":
    main(sys.modules[__name__])
