"""Check of an exported policy in plain MuJoCo, without the environment (`export --verify`).

The generated program `run_policy.py` computes observations and controls from an MjData, and `mj_step` advances the
MjData. No code of the environment takes part in that loop. The environment is the reference: it resets, samples
commands and disturbances, reads the resulting states, and computes rewards and terminations. The same episodes run
twice: once as an evaluation in the environment, once in plain MuJoCo.

With a legged robot, rounding errors grow until two simulations of one episode have nothing in common. If every
observation and action agrees but the returns differ, the episodes are run again and re-synchronised: plain MuJoCo and
the engine start each step from the same state. If both arrive at the same state within rounding, the engine's state is
copied to plain MuJoCo. A step in which the two states disagree is not corrected, so that an error changes the return.
"""

import copy
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.config.load import resolve
from rlcli.deploy.actuator_formulas import has_nominal_gains
from rlcli.deploy.closed_loop_result import ClosedLoopResult
from rlcli.deploy.env_description import describe
from rlcli.deploy.export import Exported, relative_difference
from rlcli.deploy.run_policy_files import PROGRAM, generate_program, open_model, write_model, write_program
from rlcli.envs.direct import DirectEnv
from rlcli.envs.make import make_env
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import CheckpointError, UsageError
from rlcli.evaluation.evaluate import Evaluation, evaluate
from rlcli.progress import track
from rlcli.random import derive
from rlcli.registry import TaskSource
from rlcli.rl.action_functions import trained_policy
from rlcli.rl.policy import Policy
from rlcli.rl.rng import seed_generators
from rlcli.runs.checkpoint_fit import require_fit
from rlcli.runs.checkpoint_reader import Checkpoint
from rlcli.runs.layout_and_deployment import deployment_differences
from rlcli.runs.policy_ref import Choice

_log = logging.getLogger(__name__)

ROUNDING = 1e-3
"""Largest difference of actions, and of states after one step, that counts as a rounding error."""
_SEED = 42
_PHASES = ("evaluation", "plain MuJoCo", "plain MuJoCo, re-synchronised (only if the returns differ)")
_FREE = (-np.inf, np.inf)
_BAD_METADATA = (KeyError, IndexError, TypeError, ValueError)
"""Exceptions that the generated program raises if the metadata does not fit the model."""


@dataclass(slots=True)
class ReferenceEnv:
    """The environment of a run, built as for an evaluation, with which an exported policy is compared."""

    env: VecEnv
    deployment: dict[str, Any]
    """Description of the environment for programs without rlcli."""


def open_reference(choice: Choice, checkpoint: Checkpoint, named: TaskSource | None, episodes: int) -> ReferenceEnv:
    """Build the environment that a policy was trained for, without observation noise, bias and delays.

    If the run has more parallel environments than `episodes`, their number is reduced to `episodes`, but not below two.

    Args:
        choice: the policy that the user has chosen.
        checkpoint: the checkpoint of the policy.
        named: the task that the user has named; None: the task of the run.
        episodes: number of episodes that will run.
    """
    configure = partial(resolve, choice.source(named), agent=choice.agent, play=True)
    resolved = configure()
    groups = resolved.task.observations.items()
    # noise and bias of observations are random, so an exported file cannot reproduce them
    clean = [f"observations.{name}.enable_corruption=false" for name, group in groups if group.enable_corruption]
    clean += [f"actions.{name}.delay=null" for name, term in resolved.task.actions.items() if term and term.delay]
    # at least two: with one, values that are random in each environment would look like constants of the task
    clean.append(f"scene.num_envs={min(resolved.task.scene.num_envs, max(2, episodes))}")
    resolved = configure(overrides=clean)
    torch.set_num_threads(1)
    seed_generators(derive(_SEED, "task"))
    env = make_env(resolved, seed=derive(_SEED, "evaluation"))
    require_fit(checkpoint, env.layout)
    return ReferenceEnv(env, describe(env))


def verify(
    reference: ReferenceEnv, checkpoint: Checkpoint, exported: Exported, format_: str, episodes: int
) -> ClosedLoopResult:
    """Evaluate a policy in its environment, then run the same episodes with the exported file in plain MuJoCo.

    The MuJoCo model, and the program that runs the policy on it, are written to the folder of the file.

    Args:
        reference: the environment for which the policy was trained.
        checkpoint: the policy's checkpoint.
        exported: the exported file.
        format_: format of the file.
        episodes: number of episodes.

    Raises:
        CheckpointError: if the metadata does not fit the model.
        MachineError: if a file cannot be written.
    """
    env, file = reference.env, exported.file
    model = write_model(env.spec, env.engine.model, file.parent)
    code = generate_program(file, model, format_, exported.metadata)
    program = file.parent / PROGRAM
    if not write_program(file.parent, code):
        _log.warning(f"{program} differs from the generated program and is not replaced; delete it to get a new one")
    _log.info(f"keep {file.name}, {model.name} and {PROGRAM} in one folder: the program reads the other two files")
    _log.info(f"checking {file.name}: it controls {model.name} in MuJoCo without rlcli for {episodes} episodes")
    differing = deployment_differences(checkpoint, env.layout.record(), reference.deployment, _may_randomize(env))
    space: dict[str, Any] = {"__name__": "run_policy"}
    # the code generated here, not the run_policy.py on disk, which the user may have changed
    exec(compile(code, "run_policy.py", "exec"), space)
    controller, policy = space["Controller"](file), checkpoint.policy()
    initial = env.state_dict()
    seed_generators(derive(_SEED, "task"))

    def run_plain(synchronize: bool) -> tuple[_PlainMujocoRunner, Evaluation]:
        work.advance()
        env.load_state_dict(initial)  # also restores the curriculum
        seed_generators(derive(_SEED, "task"))
        runner = _PlainMujocoRunner(env, policy, controller, open_model(model), synchronize)
        env.physics_override = runner.physics
        try:
            return runner, evaluate(env, runner.act, episodes)
        finally:
            env.physics_override = None

    with track("verification", phases=_PHASES) as work:
        evaluated = evaluate(env, trained_policy(env, policy), episodes)
        runner, plain = run_plain(synchronize=False)
        result = ClosedLoopResult(
            model,
            program,
            differing,
            len(plain.returns),
            runner.steps,
            runner.differences,
            evaluation_return=float(np.mean(evaluated.returns)),
            plain_return=float(np.mean(plain.returns)),
            scale=float(np.mean(np.abs(evaluated.returns))),
            by_metadata=runner.terms(closed=True),
            by_task=runner.terms(closed=False),
        )
        only_return_failed = not result.holds and all(passed for *_, passed in result.rows()[:-1])
        if only_return_failed:
            runner, plain = run_plain(synchronize=True)
            result.synchronized_return = float(np.mean(plain.returns))
            result.disagreeing_steps = runner.disagreeing_steps
    return result


def _may_randomize(env: VecEnv) -> bool:
    """Return whether gains or start states may be random: in a direct task, or with events other than `reset_...`."""
    events = [event for event in env.config.events.values() if event is not None]
    return isinstance(env, DirectEnv) or not all(event.func.startswith("reset_") for event in events)


_FORCES = ("xfrc_applied", "qfrc_applied")
"""Fields in which a task's code applies forces to bodies and to joints."""


class _PlainMujocoRunner:
    """Runner of an exported policy in plain MuJoCo: an MjModel, an MjData and a controller for each environment."""

    def __init__(self, env: VecEnv, policy: Policy, controller: Any, model: mujoco.MjModel, synchronize: bool) -> None:
        engine = env.engine.replayable
        if engine is None:
            raise UsageError("--verify needs the CPU engine: set sim.engine to auto or batch")
        self._env, self._engine, self._synchronize = env, engine, synchronize
        self.steps = 0
        self.disagreeing_steps = 0
        """Steps after which the states of plain MuJoCo and of the engine differed by more than rounding."""
        self.differences = {"action": 0.0, "observation": 0.0, "control": 0.0}
        """Largest relative difference of the actions, observations and controls so far."""
        self._require_same_sizes(model)
        n = env.num_envs
        self._policy_action: Callable[[Tensor], Tensor] = trained_policy(env, policy)
        self._controllers = [copy.copy(controller) for _ in range(n)]
        self._models = [copy.deepcopy(model) if env.engine.expanded_fields() else model for _ in range(n)]
        self._datas = [mujoco.MjData(own) for own in self._models]
        self._rows: list[np.ndarray | None] = [None] * n
        self._ctrl = np.zeros((n, model.nu))
        self._plan = controller.metadata["deployment"]
        closed = [c for control in self._plan["controls"] if control["closed"] for c in control["ctrl"]]
        self._closed = np.zeros(model.nu, dtype=bool)
        """Controls that a formula in the policy's metadata computes, by index of the control."""
        self._actuator_models = [(m, env.actuators[m["name"]]) for m in self._plan["actuator_models"] if m["closed"]]
        """Actuator models with a formula in the metadata: (record in the metadata, model of the environment) each."""
        self._random_gains: set[str] = set()
        """Names of the actuator models that had other gains than the formula in some environment."""
        try:
            self._closed[closed] = True
            for actuator_model in self._plan["actuator_models"]:
                self._closed[actuator_model["ctrl"]] = False  # `_compute_actuator_models` checks these
            self._bounds = _control_bounds(controller, model)
        except _BAD_METADATA as error:
            raise _metadata_error(error) from error
        self._open_terms = [term for term in self._plan["observations"] if not term["closed"]]
        self._decimation = controller.metadata["decimation"]
        self._forces: set[str] = set()
        """Names of the MjData fields of forces that the task's own code has set in its steps."""

    def act(self, obs: Tensor) -> Tensor:
        """Return the actions of the exported policy for the states of plain MuJoCo. (num_envs, a)

        The evaluation calls this function as its policy. `obs` are the environment's observations, with which the
        observations of the generated program are compared. (num_envs, d)
        """
        is_first = (self._env.episode_length_buf == 0).tolist()
        for i, controller in enumerate(self._controllers):
            self._copy_state(i, is_first[i])
            if is_first[i]:
                controller.reset()
            inputs = self._inputs(i, obs)
            try:
                self._ctrl[i] = controller.act(self._datas[i], inputs)
            except _BAD_METADATA as error:
                raise _metadata_error(error) from error
        actions = torch.from_numpy(np.stack([controller.action for controller in self._controllers]))
        computed = torch.from_numpy(np.stack([controller.obs for controller in self._controllers])).float()
        self._record_difference("observation", computed, obs)
        expected = self._policy_action(obs if self._synchronize else computed)
        self._record_difference("action", actions, expected)
        if not self._synchronize:
            return actions
        agree = relative_difference(actions, expected).amax(dim=1) <= ROUNDING
        return torch.where(agree[:, None], expected, actions)

    def physics(self) -> None:
        """Simulate one environment step of every environment in plain MuJoCo, instead of the engine."""
        ctrl = self._engine.field("ctrl").numpy()
        allowed = np.clip(ctrl, *self._bounds)  # the program clips its controls; MuJoCo clips those of the engine later
        pairs = (torch.from_numpy(values[:, self._closed]) for values in (self._ctrl, allowed))
        self._record_difference("control", *pairs)
        calls = self._env.calls_per_step
        for call in range(calls):
            if self._env.actuators:
                self._env.compute_efforts()
            forces = {name: self._engine.field(name).numpy() for name in _FORCES}
            commanded = np.where(self._closed, self._ctrl, ctrl)
            self._compute_actuator_models(commanded, ctrl, compare=call == 0 or not self._synchronize)
            for i, data in enumerate(self._datas):
                data.ctrl[:] = commanded[i]
                for name, values in forces.items():
                    applied = getattr(data, name)
                    if not np.array_equal(applied, values[i]):  # the force was set by the step, not by an event
                        self._forces.add(name)
                        applied[...] = values[i]
                mujoco.mj_step(self._models[i], data, self._decimation // calls)
                self._update_derived(i)
            if self._synchronize:
                self._engine.step(self._decimation // calls)
            else:
                self._write_to_engine(range(len(self._datas)))
        if self._synchronize:
            self._synchronize_states()
        self._rows = [self._engine.state_row(i) for i in range(len(self._datas))]
        self.steps += len(self._datas)

    def _compute_actuator_models(self, commanded: np.ndarray, ctrl: np.ndarray, *, compare: bool) -> None:
        """Write the controls of the actuator models that have a formula to `commanded`, for the next physics step.

        An environment whose gains differ from the gains in the formula keeps the controls of the environment's engine.

        Args:
            commanded: controls for plain MuJoCo; changed in place. (num_envs, nu)
            ctrl: controls that the environment computed. (num_envs, nu)
            compare: whether to record the differences between `commanded` and `ctrl`; only if both sides have the same
                state.
        """
        for i, controller in enumerate(self._controllers if self._actuator_models else ()):
            computed = controller.controls(self._datas[i])
            for described, model in self._actuator_models:
                at = described["ctrl"]
                if not has_nominal_gains(model, i):
                    self._random_gains.add(described["name"])
                    continue
                allowed = np.clip(ctrl[i], *self._bounds)[at]
                if compare:
                    self._record_difference("control", torch.from_numpy(computed[at]), torch.from_numpy(allowed))
                commanded[i, at] = computed[at]

    def _update_derived(self, i: int) -> None:
        # mj_step leaves positions and sensors of the state before it; mj_step1 computes those of the new state
        if self._plan["derived"] == "current":
            mujoco.mj_step1(self._models[i], self._datas[i])

    def _write_to_engine(self, env_ids: Iterable[int]) -> None:
        for i in env_ids:
            self._engine.copy_data(i, self._datas[i])

    def _synchronize_states(self) -> None:
        """Set plain MuJoCo and the engine to the same state after a step of both.

        If the states agree within rounding, both get the engine's state; else both get the state of plain MuJoCo.
        """
        disagreeing = []
        for i, data in enumerate(self._datas):
            fields = (self._engine.field(name)[i] for name in ("qpos", "qvel"))
            pairs = zip((data.qpos, data.qvel), fields, strict=True)
            differences = [relative_difference(torch.from_numpy(plain), engine) for plain, engine in pairs]
            if all(bool((difference <= ROUNDING).all()) for difference in differences):
                self._set_state(i, self._engine.state_row(i))
                self._update_derived(i)
            else:
                disagreeing.append(i)
        self._write_to_engine(disagreeing)
        self.disagreeing_steps += len(disagreeing)

    def terms(self, *, closed: bool) -> list[str]:
        """Return names of terms, such as `observation joint_pos`.

        Args:
            closed: true: the terms that the generated program computes; false: the terms that only the task's code
                computes.
        """
        models = [
            {**m, "closed": m["closed"] and m["name"] not in self._random_gains} for m in self._plan["actuator_models"]
        ]
        kinds = {"observation": self._plan["observations"], "control": self._plan["controls"], "actuator": models}
        named = [f"{kind} {t['name']}" for kind, terms in kinds.items() for t in terms if t["closed"] is closed]
        return named if closed else [*named, *(f"force data.{name}" for name in sorted(self._forces))]

    def _copy_state(self, i: int, is_first: bool) -> None:
        """Copy the state of environment `i` to its plain simulation if a reset or an event has changed it."""
        row, last, data = self._engine.state_row(i), self._rows[i], self._datas[i]
        if not is_first and last is not None and np.array_equal(row, last):
            return
        for name, values in self._engine.own_model_fields(i).items():
            owner, _, attribute = name.rpartition(".")
            target = getattr(getattr(self._models[i], owner) if owner else self._models[i], attribute)
            target[...] = np.reshape(values, np.shape(target))
        if is_first:
            mujoco.mj_resetData(self._models[i], data)
        self._set_state(i, row)
        if self._plan["forces_after_reset"]:
            mujoco.mj_forward(self._models[i], data)
            self._set_state(i, row)  # mj_forward has overwritten the warm start, which is part of the state
        else:
            mujoco.mj_step1(self._models[i], data)
        self._rows[i] = row

    def _set_state(self, i: int, row: np.ndarray) -> None:
        mujoco.mj_setState(self._models[i], self._datas[i], row, int(mujoco.mjtState.mjSTATE_INTEGRATION))

    def _inputs(self, i: int, obs: Tensor) -> dict[str, np.ndarray]:
        """Return the inputs of the program for environment `i`, by name: commands, observations without a formula."""
        commands = getattr(self._env, "command_manager", None)
        inputs = {
            f"command/{term.name}": term.instance.command[i].numpy()
            for term in (commands.terms if commands is not None else [])
        }
        for term in self._open_terms:
            begin, end = term["columns"]
            newest = end - (end - begin) // term["history"]
            inputs[term["value"]["given"]] = obs[i, newest:end].numpy()
        return inputs

    def _record_difference(self, name: str, found: Tensor, expected: Tensor) -> None:
        if found.numel():
            largest = float(relative_difference(found, expected).max())
            self.differences[name] = float(np.maximum(self.differences[name], largest))  # np.maximum keeps NaN

    def _require_same_sizes(self, model: mujoco.MjModel) -> None:
        own = self._engine.model
        for name in ("nq", "nv", "nu", "na", "nbody", "nsensordata"):
            written, wanted = getattr(model, name), getattr(own, name)
            if written != wanted:
                raise CheckpointError(
                    f"the exported model does not fit the run: {name} is {written} in the file and {wanted} in the run;"
                    " export the policy again"
                )


def _metadata_error(error: Exception) -> CheckpointError:
    return CheckpointError(
        f"the metadata in the exported file does not fit the model; export again: {type(error).__name__}: {error}"
    )


def _control_bounds(controller: Any, model: mujoco.MjModel) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and the largest value that each control can have, (nu,) each.

    The limits follow from MuJoCo's control ranges and from the limits of the policy's output `command`.
    """
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = (np.where(limited, end, far) for end, far in zip(model.actuator_ctrlrange.T, _FREE, strict=True))
    columns = [pair for term in controller.metadata["actions"] for pair in term["limits"] or [_FREE] * term["size"]]
    limits = np.array([[far if end is None else end for end, far in zip(pair, _FREE, strict=True)] for pair in columns])
    for control in controller.plan["controls"]:
        if control["closed"] and _reads_only_command(control["value"]):
            ends = [controller.value(control["value"], None, {"command": end}) for end in limits.astype(np.float32).T]
            low[control["ctrl"]] = np.maximum(low[control["ctrl"]], np.minimum(*ends))
            high[control["ctrl"]] = np.minimum(high[control["ctrl"]], np.maximum(*ends))
    return low, high


def _reads_only_command(formula: Any) -> bool:
    """Return whether a formula of the metadata depends only on the policy's output `command`."""
    if isinstance(formula, list):
        return True
    if "op" in formula:
        return all(map(_reads_only_command, formula["of"]))
    return bool(formula.get("given") == "command")
