"""Small in-process trainings with every kind of state: `train` starts, resumes, and stops on request."""

import random
import signal
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
import yaml

from rlcli.config.load import resolve
from rlcli.config.schema import AutopsyConfig
from rlcli.envs.make import make_env
from rlcli.envs.observers import StepObserver
from rlcli.errors import Stopped
from rlcli.random import derive
from rlcli.registry import find_task, load_object
from rlcli.replay.failure_recorder import open_failure_recorder
from rlcli.runs.checkpoint_reader import open_checkpoint, steps
from rlcli.runs.metric_rows import read_rows
from rlcli.runs.run import Run
from rlcli.training import loop
from rlcli.training.checkpoint_writer import CheckpointWriter, KeepRule, drop_after
from rlcli.training.loggers import JsonLines
from rlcli.training.periodic_eval import PeriodicEval
from rlcli.training.signals import StopRequest
from support.worlds import CRITTER_TASK, critter, dump

ITERATIONS = 10
_OFF = "train_freq: 3, gradient_steps: 2, learning_starts: 20, batch_size: 8, buffer_size: 28"
AGENTS = {
    "ppo": "trainer: ppo, algorithm: ppo, num_steps: 4, num_minibatches: 2, num_epochs: 2, schedule: adaptive,"
    " desired_kl: 0.01, actor: {hidden: [8]}, critic: {hidden: [8]}, normalize_value: true",
    "sb3-ppo": "trainer: sb3, algorithm: ppo, n_steps: 4, n_epochs: 2, num_minibatches: 2, policy: {hidden: [8]}",
    "a2c": "trainer: sb3, algorithm: a2c, n_steps: 4, policy: {hidden: [8]}",
    "sac": f"trainer: sb3, algorithm: sac, {_OFF}, policy: {{hidden: [8]}}",
    "td3": f"trainer: sb3, algorithm: td3, {_OFF}, policy: {{hidden: [8]}}",
}
_MOTORS = {
    "front": {"kind": "dc_motor", "joints": ["hip_f."], "stiffness": 25.0, "damping": 0.5, "effort_limit": 8.0,
              "saturation_effort": 10.0, "velocity_limit": 20.0},
    "back": {"kind": "pd", "joints": ["hip_b."], "stiffness": 25.0, "damping": 0.5, "effort_limit": 8.0,
             "delay": [0, 2]},
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    task: str
    agent: str
    normalize: bool
    more: str = ""
    """More settings of the agent."""


def everything() -> str:
    """Return the critter's YAML with noise, bias, history, delay, command, curriculum, model fields and motors."""
    task = yaml.safe_load(CRITTER_TASK)
    robot = {k: v for k, v in task["scene"]["entities"]["robot"].items() if k != "joints"}
    uniform = {"kind": "uniform", "low": -0.05, "high": 0.05}
    policy = {
        "gravity": {"func": "projected_gravity", "noise": uniform},
        "rates": {"func": "base_ang_vel", "scale": 0.25, "bias": {"kind": "gaussian", "std": 0.02},
                  "delay": {"steps": [0, 2]}},
        "angles": {"func": "joint_pos_rel", "history": 3, "noise": {"kind": "gaussian", "std": 0.01}},
        "speeds": {"func": "joint_vel_rel", "modifiers": [{"kind": "digital_filter", "b": [0.5, 0.5]}]},
        "last": {"func": "last_action"},
        "asked": {"func": "generated_commands", "command": "walk"},
    }  # fmt: skip
    walk = {"func": "uniform_velocity", "resampling_time_s": [0.05, 0.2], "lin_vel_x": [-0.5, 1.0],
            "ang_vel_z": [-1.0, 1.0], "rel_standing": 0.1}  # fmt: skip
    events = {
        "mass": {"func": "randomize_body_mass", "mode": "reset", "range": [0.5, 1.5]},
        "friction": {"func": "randomize_geom_friction", "mode": "reset", "range": [0.5, 1.5], "min_steps_between": 5},
        "gravity": {"func": "randomize_gravity", "mode": "interval", "range": [-1, 1],
                    "interval_range_s": [0.04, 0.2]},
        "pose": {"func": "randomize_default_joint_pos", "mode": "reset", "range": [-0.1, 0.1]},
        "hit": {"func": "apply_body_impulse", "mode": "interval", "interval_range_s": [0.04, 0.2],
                "bodies": "torso", "force": [-5.0, 5.0], "duration_s": [0.02, 0.1]},
    }  # fmt: skip
    task["events"] |= events
    task["commands"] = {"walk": walk}
    task["rewards"]["speed"] = {"func": "track_lin_vel_xy_exp", "weight": 1.0, "command": "walk", "std": 0.5}
    task["curriculum"] = {
        "smooth": {"func": "interpolate", "address": "rewards.rate.weight", "begin": 5, "end": 25, "to": -0.1},
        "faster": {"func": "stages", "address": "commands.walk.lin_vel_x", "steps": [12, 20],
                   "values": [[-1.0, 1.5], [-1.0, 2.0]]},
    }  # fmt: skip
    task["episode_length_s"] = 0.2
    task["scene"]["entities"]["robot"] = {**robot, "actuators": _MOTORS}
    task["observations"]["policy"] = policy
    return dump(task)


@cache
def resolved_of(case: Case, place: Path) -> Any:
    folder = place / f"{case.task}-{case.agent}-{case.normalize}-{abs(hash(case.more))}"
    folder.mkdir(parents=True, exist_ok=True)
    agent = {**yaml.safe_load(f"{{{AGENTS[case.agent]}}}"), **yaml.safe_load(f"{{{case.more}}}")}
    agent |= {"normalize_observations": case.normalize, "max_iterations": ITERATIONS}
    config = {"scene": {"num_envs": 4}, "sim": {"engine_threads": 1}, "agents": {"x": agent}}
    if case.task != "everything":
        config["episode_length_s"] = 0.15
    (folder / "agent.yaml").write_text(yaml.dump(config))
    task = str(critter(folder, everything())) if case.task == "everything" else case.task
    return resolve(find_task(task), agent="x", config_file=folder / "agent.yaml")


def train(
    run: Path,
    case: Case,
    place: Path,
    *,
    after: int | None = None,
    within: tuple[int, int] | None = None,
    resume: int | None = None,
    threads: int = 1,
    keep: KeepRule | None = None,
    save_interval: int | None = 1,
    eval_interval: int | None = None,
    autopsy: AutopsyConfig | None = None,
) -> Run:
    """Train as `rlcli train` does, or resume.

    Args:
        run: its folder.
        case: what is trained.
        place: for the task's files.
        after: stop after so many iterations.
        within: stop in the middle: (iteration, environment step of it).
        resume: environment steps of the checkpoint to go on from; -1: the newest.
        threads: of the engine.
        keep: which checkpoints stay.
        save_interval: iterations between checkpoints.
        eval_interval: iterations between evaluations.
        autopsy: which ends of episodes are kept; None: none.
    """
    resolved, record = resolved_of(case, place), Run(run, {})
    new = resume is None
    if new:
        record.checkpoints.mkdir(parents=True)
        record.update(best=None)
    if threads != 1:
        sim = resolved.task.sim.model_copy(update={"engine_threads": threads})
        resolved = replace(resolved, task=resolved.task.model_copy(update={"sim": sim}))
    # a resumed trainer is created with other seeds: its state must come from the checkpoint
    seed = 5 if new else random.Random(str(run)).randrange(1000, 2000)
    torch.manual_seed(seed)
    env = make_env(resolved, seed=derive(seed, "environments"))
    trainer = load_object(resolved.trainer.trainer)(env, resolved.agent, seed=seed, device="cpu", torch_threads=1)
    saved = None
    if new:
        trainer.start()
    else:
        step = steps(record.checkpoints)[-1] if resume == -1 else resume
        saved = open_checkpoint(record.checkpoints / f"{step:012d}")
        trainer.load(saved.state())
        drop_after(record.checkpoints, saved.step)
    cases = open_failure_recorder(env, autopsy, run, None if saved is None else saved.step)
    saver = CheckpointWriter(
        record.checkpoints, keep or KeepRule(None), {"case": str(case)}, resumed=saved, cases=cases
    )
    log = JsonLines(record.metrics, resume_after=None if new else trainer.iteration)
    trials = None
    if eval_interval is not None:
        history = [*read_rows(record.metrics)]
        trials = PeriodicEval(lambda: make_env(resolved, seed=77), 3, eval_interval, history)
        saver.best = trials.best
    stop = StopRequest(can_interrupt=True)
    env.observers.add(_Stopper(stop, trainer, within))

    def show(progress: Any) -> None:
        if progress.iteration == after:
            stop.signal = signal.SIGTERM

    budget = loop.Budget(resolved.agent.max_iterations, None)
    training = loop.TrainLoop(
        trainer, record, saver, [log], save_interval=save_interval, periodic_eval=trials, show=show, stop=stop
    )
    try:
        training.train(budget)
    except Stopped:
        assert after is not None or within is not None
    else:
        assert within is None, "the step was never reached"
    finally:
        assert cases is None or cases.on_step in env.observers.on_step
        log.close()
        env.close()
    return record


class _Stopper(StepObserver):
    """Requests a stop in one step of one iteration."""

    def __init__(self, stop: StopRequest, trainer: Any, within: tuple[int, int] | None) -> None:
        self.stop, self.trainer, self.within = stop, trainer, within
        self.taken, self.iteration = 0, -1

    def before_step(self) -> None:
        if self.iteration != self.trainer.iteration:
            self.taken, self.iteration = 0, self.trainer.iteration
        if self.within == (self.iteration, self.taken):
            self.stop.signal = signal.SIGTERM
        self.taken += 1
        self.stop.check()
