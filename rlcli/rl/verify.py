"""The loop closed: an exported file, read back from the disk, drives plain MuJoCo by what its metadata says.

The program that the user gets computes observations and controls from an MjData, and `mj_step` moves that; nothing of
the environment stands in between. The environment is the referee: it says where episodes begin, what is asked and what
disturbs, it sees the states that come of it, and its own terms reward and end them. So both sides live through the same
episodes, once as the run's evaluation and once in plain MuJoCo.

A robot with legs magnifies the last bit of a number until two lives of it have nothing in common. Where returns part
although every number agrees, the episodes are lived again side by side: in each step plain MuJoCo and the engine start
from one state, and where they arrive within rounding of each other they go on from one state. A step that does not
agree is not mended, so that an error shows in the return.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import CheckpointError, UsageError
from rlcli.rl.export import TOLERANCE
from rlcli.rl.export_bundle import open_model
from rlcli.rl.policy import Policy
from rlcli.rl.rng import seed_generators
from rlcli.rl.rollout import Evaluation, acting, evaluate
from rlcli.sim.batch import BatchEngine

CLOSE = 1e-4
"""Largest accepted difference of an observation or a control, relative to max(1, |value|)."""
ROUNDING = 1e-3
"""How far actions and states may be apart after one step for rounding to be the reason."""
RETURN = 0.02
"""Largest accepted difference of the mean return, relative to the evaluation's mean |return|."""


@dataclass(slots=True)
class Verdict:
    """What closing the loop has shown. Differences are relative to max(1, |value|)."""

    episodes: int
    steps: int
    action: float
    observation: float
    control: float
    evaluated: float
    """Mean return of the run's evaluation."""
    driven: float
    """Mean return in plain MuJoCo."""
    scale: float
    """Mean |return| of the evaluation."""
    beside: float | None = None
    """Mean return of episodes lived side by side; None: there was no need."""
    parted: int = 0
    """Steps in which the two sides did not agree."""
    by_metadata: list[str] = field(default_factory=list)
    """Terms that plain code computed from the metadata."""
    unlike: list[str] = field(default_factory=list)
    """Where the metadata says something else of the robot than the task."""
    by_task: list[str] = field(default_factory=list)
    """Terms that only the task's own code knows, which computed them from the plain states."""

    @property
    def difference(self) -> float:
        """Of the returns, relative; rounding set aside where it had to be."""
        return self._apart(self.driven if self.beside is None else self.beside)

    @property
    def unaided(self) -> float:
        """The same with what rounding comes to."""
        return self._apart(self.driven)

    def _apart(self, found: float) -> float:
        return abs(found - self.evaluated) / max(self.scale, 1e-9)

    def rows(self) -> list[tuple[str, float, float, bool]]:
        """(what, found, allowed, whether it holds)"""
        aside = "" if self.beside is None else ", rounding set aside"
        checks = (
            ("description: places unlike the task", float(len(self.unlike)), 0.0),
            ("action: the file against the policy", self.action, TOLERANCE),
            ("observation: formulas against the task", self.observation, CLOSE),
            ("control: formulas against the task", self.control, CLOSE),
            (f"return: plain MuJoCo against the evaluation{aside}", self.difference, RETURN),
        )
        return [(what, found, allowed, found <= allowed) for what, found, allowed in checks]

    @property
    def holds(self) -> bool:
        """Whether all of it holds; NaN never does."""
        return all(row[3] for row in self.rows())


def verify(
    env: VecEnv,
    policy: Policy,
    code: str,
    file: Path,
    model: Path,
    episodes: int,
    task_seed: int,
    unlike: Sequence[str] = (),
) -> Verdict:
    """Evaluate the policy in its environment, then let the file live the same episodes in plain MuJoCo.

    Args:
        env: as for an evaluation.
        policy: the run's.
        code: the program that was written beside the file.
        file: the exported policy.
        model: the model that was written beside it.
        episodes: how many.
        task_seed: of the random numbers that tasks draw by themselves.
        unlike: where the metadata says something else of the robot than the task.

    Raises:
        CheckpointError: if the metadata makes no sense to the program.
    """
    space: dict[str, Any] = {"__name__": "run_policy"}
    exec(compile(code, "run_policy.py", "exec"), space)  # what has just been written, not what lies there
    fresh = env.state_dict()
    seed_generators(task_seed)
    evaluated = evaluate(env, acting(env, policy), episodes)
    controller, own = space["Controller"](file), open_model(model)

    def drive(beside: bool) -> tuple[_Driver, Evaluation]:
        env.load_state_dict(fresh)  # a curriculum, too, is where it was
        seed_generators(task_seed)
        driver = _Driver(env, policy, controller, own, beside)
        env.instead_of_physics = driver.physics
        try:
            return driver, evaluate(env, driver.act, episodes)
        finally:
            env.instead_of_physics = None

    driver, driven = drive(beside=False)
    verdict = driver.verdict(evaluated, driven)
    verdict.unlike = list(unlike)
    if not verdict.holds and all(held for *_, held in verdict.rows()[:-1]):
        driver, driven = drive(beside=True)
        verdict.beside, verdict.parted = float(np.mean(driven.returns)), driver.parted
    return verdict


class _Driver:
    """One plain simulation and one controller for each environment."""

    def __init__(self, env: VecEnv, policy: Policy, controller: Any, model: mujoco.MjModel, beside: bool) -> None:
        if not isinstance(env.engine, BatchEngine):
            raise UsageError("--verify compares with the CPU engine, and the task asks for another: sim.engine")
        self._env, self._engine, self._beside = env, env.engine, beside
        self.parted = 0
        """Steps in which a plain simulation and the engine did not arrive at one state."""
        self._require_same_shape(model)
        n = env.num_envs
        self._expected: Callable[[Tensor], Tensor] = acting(env, policy)
        self._controllers = [copy.copy(controller) for _ in range(n)]
        self._models = [copy.deepcopy(model) if env.engine.expansions() else model for _ in range(n)]
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
        self._steps = 0
        self._worst = {"action": 0.0, "observation": 0.0, "control": 0.0}

    def act(self, obs: Tensor) -> Tensor:
        """The file's actions for what the formulas see in the plain simulations. obs: what the environment sees."""
        begun = (self._env.episode_length_buf == 0).tolist()
        for i, controller in enumerate(self._controllers):
            self._follow(i, begun[i])
            if begun[i]:
                controller.reset()
            inputs = self._inputs(i, obs)
            try:
                self._ctrl[i] = controller.act(self._datas[i], inputs)
            except (KeyError, IndexError, TypeError, ValueError) as error:
                raise _misfit(error) from error
        actions = torch.from_numpy(np.stack([controller.action for controller in self._controllers]))
        seen = torch.from_numpy(np.stack([controller.obs for controller in self._controllers])).float()
        self._note("observation", seen, obs)
        expected = self._expected(obs if self._beside else seen)
        self._note("action", actions, expected)
        if not self._beside:
            return actions
        agree = _apart(actions, expected).amax(dim=1) <= ROUNDING
        return torch.where(agree[:, None], expected, actions)

    def physics(self) -> None:
        """`decimation` times `mj_step`, in the place of the engine."""
        asked = self._engine.field("ctrl").numpy()
        allowed = np.clip(asked, *self._ends)  # what MuJoCo would cut off, the file has cut off already
        self._note("control", *(torch.from_numpy(values[:, self._closed]) for values in (self._ctrl, allowed)))
        calls = self._env.calls_per_step
        for _ in range(calls):
            if calls > 1:
                self._env.compute_efforts()
            for i, data in enumerate(self._datas):
                data.ctrl[:] = np.where(self._closed, self._ctrl[i], asked[i])
                mujoco.mj_step(self._models[i], data, self._decimation // calls)
                if self._plan["derived"] == "current":
                    mujoco.mj_step1(self._models[i], data)  # what the state as it is looks like
            if self._beside:
                self._engine.step(self._decimation // calls)
            else:
                self._hand_over(range(len(self._datas)))
        if self._beside:
            self._agree()
        self._rows = [self._engine.row(i) for i in range(len(self._datas))]
        self._steps += len(self._datas)

    def _hand_over(self, which: Iterable[int]) -> None:
        for i in which:
            self._engine.take(i, self._datas[i])

    def _agree(self) -> None:
        """Where both have arrived at one state but for rounding, it is the engine's."""
        parted = []
        for i, data in enumerate(self._datas):
            fields = (self._engine.field(name)[i] for name in ("qpos", "qvel"))
            pairs = zip((data.qpos, data.qvel), fields, strict=True)
            if all(bool((_apart(torch.from_numpy(own), theirs) <= ROUNDING).all()) for own, theirs in pairs):
                self._put(i, self._engine.row(i))
                if self._plan["derived"] == "current":
                    mujoco.mj_step1(self._models[i], data)
            else:
                parted.append(i)
        self._hand_over(parted)
        self.parted += len(parted)

    def verdict(self, evaluated: Evaluation, driven: Evaluation) -> Verdict:
        """What has come of it."""
        terms = [("observation", term) for term in self._plan["observations"]]
        terms += [("control", term) for term in self._plan["controls"]]
        names = {held: [f"{w} {t['name']}" for w, t in terms if t["closed"] is held] for held in (True, False)}
        returns = evaluated.returns
        return Verdict(
            len(driven.returns),
            self._steps,
            action=self._worst["action"],
            observation=self._worst["observation"],
            control=self._worst["control"],
            evaluated=float(np.mean(returns)),
            driven=float(np.mean(driven.returns)),
            scale=float(np.mean(np.abs(returns))),
            by_metadata=names[True],
            by_task=names[False],
        )

    def _follow(self, i: int, begun: bool) -> None:
        """Where a reset or an event has put the simulation, the plain one is put as well."""
        row, last, data = self._engine.row(i), self._rows[i], self._datas[i]
        if not begun and last is not None and np.array_equal(row, last):
            return
        for name, values in self._engine.own_model(i).items():
            owner, _, attribute = name.rpartition(".")
            target = getattr(getattr(self._models[i], owner) if owner else self._models[i], attribute)
            target[...] = np.reshape(values, np.shape(target))
        if begun:
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
        """What comes from outside: commands, and what only the task's code computes."""
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
            self._worst[what] = float(np.maximum(self._worst[what], float(_apart(found, expected).max())))  # NaN stays

    def _require_same_shape(self, model: mujoco.MjModel) -> None:
        own = self._engine.model
        for name in ("nq", "nv", "nu", "na", "nbody", "nsensordata"):
            if getattr(model, name) != getattr(own, name):
                raise CheckpointError(f"the written model has another {name} than the run's")


def _misfit(error: Exception) -> CheckpointError:
    return CheckpointError(f"the file's metadata does not fit the model: {type(error).__name__}: {error}")


def _apart(found: Tensor, expected: Tensor) -> Tensor:
    """Differences relative to max(1, |value|)."""
    return (found - expected).abs() / expected.abs().clamp(min=1.0)


def _ends(controller: Any, model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Between which controls make a difference: the range of controls, and what `command` is kept within. (nu,) each"""
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = (np.where(limited, end, far) for end, far in zip(model.actuator_ctrlrange.T, _FREE, strict=True))
    columns = [pair for term in controller.about["actions"] for pair in term["limits"] or [_FREE] * term["size"]]
    kept = np.array([[far if end is None else end for end, far in zip(pair, _FREE, strict=True)] for pair in columns])
    for control in controller.plan["controls"]:
        if control["closed"] and _reads_command(control["value"]):
            ends = [controller.value(control["value"], None, {"command": end}) for end in kept.astype(np.float32).T]
            low[control["ctrl"]] = np.maximum(low[control["ctrl"]], np.minimum(*ends))
            high[control["ctrl"]] = np.minimum(high[control["ctrl"]], np.maximum(*ends))
    return low, high


_FREE = (-np.inf, np.inf)


def _reads_command(formula: Any) -> bool:
    """Whether it is made of the command alone."""
    if isinstance(formula, list):
        return True
    if "op" in formula:
        return all(map(_reads_command, formula["of"]))
    return formula.get("given") == "command"
