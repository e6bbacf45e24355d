"""Run folders written by hand, as training leaves them, without training."""

import functools
import json

from rlcli.config.dump import explicit_values, to_data, to_yaml
from rlcli.config.load import resolve
from rlcli.registry import find_task
from rlcli.runs.run import create_run


def write_run(runs, task="cartpole", *, seed=1, overrides=(), rows=(), agent=None, config=None, **record):
    """Write a finished run without checkpoints; `rows` are (iteration, step, metrics)."""
    source, resolved, text = _resolved(str(task), agent, tuple(overrides))
    entries = {
        "seed": seed,
        "task": {**source.record(), "file": source.config.name},
        "agent": resolved.agent_name,
        "device": "cpu",
        "given": explicit_values(resolved),
        "rlcli": "0.1.0",
        "versions": {"mujoco": "4.0.0"},
        "command": ["rlcli", "train", source.name, "--seed", str(seed)],
        **record,
    }
    run = create_run(runs, source.name, None, text if config is None else config, entries)
    run.unlock()
    run.update(state="finished")
    write_metrics(run, rows)
    return run


@functools.cache
def _resolved(task, agent, overrides):
    source = find_task(task)
    resolved = resolve(source, agent=agent, overrides=overrides)
    return source, resolved, to_yaml(to_data(resolved))


def write_metrics(run, rows):
    lines = [json.dumps({"iteration": i, "step": step, **metrics}) for i, step, metrics in rows]
    run.metrics.write_text("".join(f"{line}\n" for line in lines))


def learning(count=10, steps=100, scale=1.0, **more):
    """Return metrics whose return rises by `scale` per iteration, with success, length, two rewards and two causes."""
    return [
        (
            i,
            i * steps,
            {
                "Train/mean_reward": scale * i,
                "Train/success_rate": i / count,
                "Train/mean_episode_length": 10.0 * i,
                "Episode_Reward/alive": 1.0,
                "Episode_Reward/effort": -0.1 * i,
                "Episode_Termination/time_out": i / count,
                "Episode_Termination/fell": 1 - i / count,
                "Loss/value": 1.0 / i,
                "Perf/collection_time": 0.5,
                "Perf/learning_time": 1.5,
                **more,
            },
        )
        for i in range(1, count + 1)
    ]
