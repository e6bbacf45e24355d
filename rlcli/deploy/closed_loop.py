"""Closed-loop check of an exported file: read back from the disk, it drives plain MuJoCo by its metadata alone.

The program that the user gets computes observations and controls from an MjData, and `mj_step` moves that; nothing of
the environment stands in between. The environment is the reference: it resets, draws commands and disturbances, reads
the resulting states, and its own terms compute rewards and terminations. Both sides run the same episodes, once as the
run's evaluation and once in plain MuJoCo.

In a legged robot rounding errors grow until two simulations of one episode have nothing in common. Where returns differ
although every number agrees, the episodes are run again and re-synchronised: in each step plain MuJoCo and the engine
start from one state, and where they arrive within rounding of each other they go on from one state. A step in which
they disagree is not corrected, so that an error shows in the return.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.config.load import resolve
from rlcli.deploy.env_description import describe
from rlcli.deploy.export import TOLERANCE
from rlcli.deploy.onboard_program import PROGRAM, open_model, program, write_model, write_program
from rlcli.envs.direct import DirectEnv
from rlcli.envs.make import make_env
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import CheckpointError, UsageError
from rlcli.evaluation.evaluate import Evaluation, evaluate
from rlcli.random import derive
from rlcli.rl.acting import trained_policy
from rlcli.rl.policy import Policy
from rlcli.rl.rng import seed_generators
from rlcli.runs.checkpoint_manifest import deployment_differences
from rlcli.runs.restore import require_fit

if TYPE_CHECKING:
    from rlcli.registry import TaskSource
    from rlcli.runs.checkpoint import Checkpoint
    from rlcli.runs.policy_ref import Choice

_log = logging.getLogger(__name__)

CLOSE = 1e-4
"""Largest accepted difference of an observation or a control, relative to max(1, |value|)."""
ROUNDING = 1e-3
"""Largest difference of actions and states after one step that rounding may explain."""
RETURN = 0.02
"""Largest accepted difference of the mean return, relative to the evaluation's mean |return|."""
_SEED = 42


@dataclass(slots=True)
class ReferenceEnv:
    """The run's environment, as an evaluation has it, and what plain code must know of it."""

    env: VecEnv
    deployment: dict[str, Any]


@dataclass(slots=True)
class Verdict:
    """Result of the closed-loop check. Differences are relative to max(1, |value|)."""

    model: Path
    program: Path
    differing: list[str]
    """Places where the metadata describes another robot than the task."""
    episodes: int
    steps: int
    differences: dict[str, float]
    """action, observation, control -> largest difference."""
    evaluation_return: float
    """Mean return of the run's evaluation."""
    plain_return: float
    """Mean return in plain MuJoCo."""
    scale: float
    """Mean |return| of the evaluation."""
    by_metadata: list[str]
    """Terms that plain code computed from the metadata."""
    by_task: list[str]
    """Terms that only the task's own code can compute; it did so from the plain states."""
    synchronized_return: float | None = None
    """Mean return of re-synchronised episodes; None: there was no need for them."""
    disagreeing_steps: int = 0
    """Steps in which the two sides did not arrive at one state."""

    @property
    def return_difference(self) -> float:
        """Relative difference of the mean returns in plain MuJoCo and in the evaluation."""
        return self._relative(self.plain_return)

    def rows(self) -> list[tuple[str, float, float, bool]]:
        """Return the checks: (what, found, allowed, whether it holds) each."""
        synchronized = self.synchronized_return
        returns = self.return_difference if synchronized is None else self._relative(synchronized)
        aside = "" if synchronized is None else ", rounding set aside"
        checks = (
            ("description: places unlike the task", float(len(self.differing)), 0.0),
            ("action: the file against the policy", self.differences["action"], TOLERANCE),
            ("observation: formulas against the task", self.differences["observation"], CLOSE),
            ("control: formulas against the task", self.differences["control"], CLOSE),
            (f"return: plain MuJoCo against the evaluation{aside}", returns, RETURN),
        )
        return [(what, found, allowed, found <= allowed) for what, found, allowed in checks]

    @property
    def holds(self) -> bool:
        """Whether every check holds; NaN never does."""
        return all(row[3] for row in self.rows())

    def record(self) -> dict[str, Any]:
        """Return the result as JSON."""
        synchronized = None
        if self.synchronized_return is not None:
            synchronized = {"return": self.synchronized_return, "parted": self.disagreeing_steps}
        return {
            "passed": self.holds,
            "episodes": self.episodes,
            "steps": self.steps,
            "model": str(self.model),
            "program": str(self.program),
            "return": self.plain_return,
            "evaluation_return": self.evaluation_return,
            "side_by_side": synchronized,
            "checks": [dict(zip(("check", "found", "allowed", "passed"), row, strict=True)) for row in self.rows()],
            "unlike": self.differing,
            "closed_by_metadata": self.by_metadata,
            "closed_by_task": self.by_task,
        }

    def _relative(self, found: float) -> float:
        return abs(found - self.evaluation_return) / max(self.scale, 1e-9)


def open_reference(choice: Choice, checkpoint: Checkpoint, named: TaskSource | None) -> ReferenceEnv:
    """Build the environment that a policy is for, without what corrupts observations: no file can know that.

    Args:
        choice: the policy.
        checkpoint: its checkpoint.
        named: the task that the command line names, if it does.
    """
    configure = partial(resolve, choice.source(named), agent=choice.agent, play=True)
    resolved = configure()
    corrupted = [name for name, group in resolved.task.observations.items() if group.enable_corruption]
    if corrupted:
        clean = [f"observations.{name}.enable_corruption=false" for name in corrupted]
        resolved = configure(overrides=clean)
    torch.set_num_threads(1)
    seed_generators(derive(_SEED, "task"))
    env = make_env(resolved, seed=derive(_SEED, "evaluation"))
    require_fit(checkpoint, env.layout)
    return ReferenceEnv(env, describe(env))


def verify(reference: ReferenceEnv, checkpoint: Checkpoint, file: Path, format_: str, episodes: int) -> Verdict:
    """Evaluate the policy in its environment, then run the same episodes with the file in plain MuJoCo.

    The model and the program that runs the file are written beside it.

    Args:
        reference: the run's environment.
        checkpoint: the policy's checkpoint.
        file: the exported policy.
        format_: its format.
        episodes: how many to run.

    Raises:
        CheckpointError: if the metadata makes no sense to the program.
        MachineError: if the disk refuses.
    """
    env = reference.env
    model = write_model(env.spec, env.engine.model, file.parent)
    code = program(file, model, format_)
    place = file.parent / PROGRAM
    if not write_program(file.parent, code):
        _log.warning(f"{place} is not what would be written, and stays as it is: remove it for a new one")
    _log.info(f"{file.name} drives plain MuJoCo with {model.name} for {episodes} episodes")
    differing = deployment_differences(checkpoint, env.layout.record(), reference.deployment, _may_randomize(env))
    space: dict[str, Any] = {"__name__": "run_policy"}
    exec(compile(code, "run_policy.py", "exec"), space)  # what has just been written, not what lies there
    controller, policy = space["Controller"](file), checkpoint.policy()
    initial = env.state_dict()
    seed_generators(derive(_SEED, "task"))
    evaluated = evaluate(env, trained_policy(env, policy), episodes)

    def drive(synchronize: bool) -> tuple[_Driver, Evaluation]:
        env.load_state_dict(initial)  # a curriculum, too, is where it was
        seed_generators(derive(_SEED, "task"))
        driver = _Driver(env, policy, controller, open_model(model), synchronize)
        env.physics_override = driver.physics
        try:
            return driver, evaluate(env, driver.act, episodes)
        finally:
            env.physics_override = None

    driver, driven = drive(synchronize=False)
    verdict = Verdict(
        model,
        place,
        differing,
        len(driven.returns),
        driver.steps,
        driver.differences,
        evaluation_return=float(np.mean(evaluated.returns)),
        plain_return=float(np.mean(driven.returns)),
        scale=float(np.mean(np.abs(evaluated.returns))),
        by_metadata=driver.terms(closed=True),
        by_task=driver.terms(closed=False),
    )
    if not verdict.holds and all(holds for *_, holds in verdict.rows()[:-1]):
        driver, driven = drive(synchronize=True)
        verdict.synchronized_return = float(np.mean(driven.returns))
        verdict.disagreeing_steps = driver.disagreeing_steps
    return verdict


def _may_randomize(env: VecEnv) -> bool:
    """Whether a task may draw gains or the initial state at random: some event does more than reset."""
    events = [event for event in env.config.events.values() if event is not None]
    return isinstance(env, DirectEnv) or not all(event.func.startswith("reset_") for event in events)


class _Driver:
    """One plain simulation and one controller for each environment."""

    def __init__(self, env: VecEnv, policy: Policy, controller: Any, model: mujoco.MjModel, synchronize: bool) -> None:
        engine = env.engine.replayable
        if engine is None:
            raise UsageError("--verify compares with the CPU engine, and the task asks for another: sim.engine")
        self._env, self._engine, self._synchronize = env, engine, synchronize
        self.steps = 0
        self.disagreeing_steps = 0
        """Steps in which a plain simulation and the engine did not arrive at one state."""
        self.differences = {"action": 0.0, "observation": 0.0, "control": 0.0}
        """Largest difference of each."""
        self._require_same_shape(model)
        n = env.num_envs
        self._expected: Callable[[Tensor], Tensor] = trained_policy(env, policy)
        self._controllers = [copy.copy(controller) for _ in range(n)]
        self._models = [copy.deepcopy(model) if env.engine.expanded_fields() else model for _ in range(n)]
        self._datas = [mujoco.MjData(own) for own in self._models]
        self._rows: list[np.ndarray | None] = [None] * n
        self._ctrl = np.zeros((n, model.nu))
        self._plan = controller.about["deployment"]
        closed = [c for control in self._plan["controls"] if control["closed"] for c in control["ctrl"]]
        self._closed = np.zeros(model.nu, dtype=bool)
        try:
            self._closed[closed] = True
            self._ends = _ends(controller, model)
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise _misfit(error) from error
        self._open_terms = [term for term in self._plan["observations"] if not term["closed"]]
        self._decimation = controller.about["decimation"]

    def act(self, obs: Tensor) -> Tensor:
        """Return the file's actions for the plain simulations; `obs` are the observations of the environment."""
        is_first = (self._env.episode_length_buf == 0).tolist()
        for i, controller in enumerate(self._controllers):
            self._copy_state(i, is_first[i])
            if is_first[i]:
                controller.reset()
            inputs = self._inputs(i, obs)
            try:
                self._ctrl[i] = controller.act(self._datas[i], inputs)
            except (KeyError, IndexError, TypeError, ValueError) as error:
                raise _misfit(error) from error
        actions = torch.from_numpy(np.stack([controller.action for controller in self._controllers]))
        computed = torch.from_numpy(np.stack([controller.obs for controller in self._controllers])).float()
        self._note("observation", computed, obs)
        expected = self._expected(obs if self._synchronize else computed)
        self._note("action", actions, expected)
        if not self._synchronize:
            return actions
        agree = _difference(actions, expected).amax(dim=1) <= ROUNDING
        return torch.where(agree[:, None], expected, actions)

    def physics(self) -> None:
        """`decimation` times `mj_step`, in the place of the engine."""
        ctrl = self._engine.field("ctrl").numpy()
        allowed = np.clip(ctrl, *self._ends)  # what MuJoCo would cut off, the file has cut off already
        self._note("control", *(torch.from_numpy(values[:, self._closed]) for values in (self._ctrl, allowed)))
        calls = self._env.calls_per_step
        for _ in range(calls):
            if calls > 1:
                self._env.compute_efforts()
            for i, data in enumerate(self._datas):
                data.ctrl[:] = np.where(self._closed, self._ctrl[i], ctrl[i])
                mujoco.mj_step(self._models[i], data, self._decimation // calls)
                if self._plan["derived"] == "current":
                    mujoco.mj_step1(self._models[i], data)  # what the state as it is looks like
            if self._synchronize:
                self._engine.step(self._decimation // calls)
            else:
                self._write_to_engine(range(len(self._datas)))
        if self._synchronize:
            self._synchronize_states()
        self._rows = [self._engine.state_row(i) for i in range(len(self._datas))]
        self.steps += len(self._datas)

    def _write_to_engine(self, env_ids: Iterable[int]) -> None:
        for i in env_ids:
            self._engine.copy_data(i, self._datas[i])

    def _synchronize_states(self) -> None:
        """Where both sides arrived at one state but for rounding, go on from that of the engine."""
        disagreeing = []
        for i, data in enumerate(self._datas):
            fields = (self._engine.field(name)[i] for name in ("qpos", "qvel"))
            pairs = zip((data.qpos, data.qvel), fields, strict=True)
            if all(bool((_difference(torch.from_numpy(own), theirs) <= ROUNDING).all()) for own, theirs in pairs):
                self._put(i, self._engine.state_row(i))
                if self._plan["derived"] == "current":
                    mujoco.mj_step1(self._models[i], data)
            else:
                disagreeing.append(i)
        self._write_to_engine(disagreeing)
        self.disagreeing_steps += len(disagreeing)

    def terms(self, *, closed: bool) -> list[str]:
        """Return the terms that plain code computes from the metadata, or those that it cannot."""
        kinds = {"observation": self._plan["observations"], "control": self._plan["controls"]}
        return [f"{kind} {t['name']}" for kind, terms in kinds.items() for t in terms if t["closed"] is closed]

    def _copy_state(self, i: int, is_first: bool) -> None:
        """Copy the engine's state into the plain simulation if a reset or an event has changed it."""
        row, last, data = self._engine.state_row(i), self._rows[i], self._datas[i]
        if not is_first and last is not None and np.array_equal(row, last):
            return
        for name, values in self._engine.own_model_fields(i).items():
            owner, _, attribute = name.rpartition(".")
            target = getattr(getattr(self._models[i], owner) if owner else self._models[i], attribute)
            target[...] = np.reshape(values, np.shape(target))
        if is_first:
            mujoco.mj_resetData(self._models[i], data)
        self._put(i, row)
        if self._plan["forces_after_reset"]:
            mujoco.mj_forward(self._models[i], data)
            self._put(i, row)  # a forward pass leaves a warm start behind
        else:
            mujoco.mj_step1(self._models[i], data)
        self._rows[i] = row

    def _put(self, i: int, row: np.ndarray) -> None:
        mujoco.mj_setState(self._models[i], self._datas[i], row, int(mujoco.mjtState.mjSTATE_INTEGRATION))

    def _inputs(self, i: int, obs: Tensor) -> dict[str, np.ndarray]:
        """The inputs that plain code cannot compute: commands, and the terms that only the task's code knows."""
        commands = getattr(self._env, "command_manager", None)
        inputs = {
            f"command/{term.name}": term.instance.command[i].numpy()
            for term in (commands.terms if commands is not None else [])
        }
        for term in self._open_terms:
            begin, end = term["columns"]
            inputs[term["value"]["given"]] = obs[i, end - (end - begin) // term["history"] : end].numpy()
        return inputs

    def _note(self, what: str, found: Tensor, expected: Tensor) -> None:
        if found.numel():
            largest = float(_difference(found, expected).max())
            self.differences[what] = float(np.maximum(self.differences[what], largest))  # NaN stays

    def _require_same_shape(self, model: mujoco.MjModel) -> None:
        own = self._engine.model
        for name in ("nq", "nv", "nu", "na", "nbody", "nsensordata"):
            if getattr(model, name) != getattr(own, name):
                raise CheckpointError(f"the written model has another {name} than the run's")


def _misfit(error: Exception) -> CheckpointError:
    return CheckpointError(f"the file's metadata does not fit the model: {type(error).__name__}: {error}")


def _difference(found: Tensor, expected: Tensor) -> Tensor:
    """Difference relative to max(1, |value|)."""
    return (found - expected).abs() / expected.abs().clamp(min=1.0)


def _ends(controller: Any, model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest effective controls: the range of controls, and the limits of `command`. (nu,) each"""
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = (np.where(limited, end, far) for end, far in zip(model.actuator_ctrlrange.T, _FREE, strict=True))
    columns = [pair for term in controller.about["actions"] for pair in term["limits"] or [_FREE] * term["size"]]
    limits = np.array([[far if end is None else end for end, far in zip(pair, _FREE, strict=True)] for pair in columns])
    for control in controller.plan["controls"]:
        if control["closed"] and _reads_command(control["value"]):
            ends = [controller.value(control["value"], None, {"command": end}) for end in limits.astype(np.float32).T]
            low[control["ctrl"]] = np.maximum(low[control["ctrl"]], np.minimum(*ends))
            high[control["ctrl"]] = np.minimum(high[control["ctrl"]], np.maximum(*ends))
    return low, high


_FREE = (-np.inf, np.inf)


def _reads_command(formula: Any) -> bool:
    """Whether a formula reads the command alone."""
    if isinstance(formula, list):
        return True
    if "op" in formula:
        return all(map(_reads_command, formula["of"]))
    return bool(formula.get("given") == "command")
