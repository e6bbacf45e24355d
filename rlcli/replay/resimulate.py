"""Replay trajectory files: simulate their steps again, and compare every state with the file, bit by bit.

The actions of a recording are applied to an environment of the task, which computes events, rewards and resets again.
The engine calls of crash dumps and failure files are simulated without the task's terms, in one physics simulation for
each recorded environment.
"""

import contextlib
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rlcli.config.load import Resolved
from rlcli.envs.make import make_env
from rlcli.envs.observers import StepObserver
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import UsageError
from rlcli.registry import TaskSource
from rlcli.replay.trajectory import STATE_FIELDS, DivergencePoint, Episode, Trajectory, World
from rlcli.runs.provenance import model_digest
from rlcli.sim.divergence_report import WARNING_FIELDS, Call, Divergence
from rlcli.sim.engine import open_cpu_engine

_PHYSICS_FIELDS = ("time", "qpos", "qvel", "act", "qacc_warmstart")
"""Fields of a state that only physics and events write; the others are also written before each engine call."""


@dataclass(frozen=True, slots=True)
class Difference:
    """The first value in which a replay differs from the recorded file: where it is, and both values."""

    env: int
    episode: int | None
    """Index of the episode in the recording, from 0; None for a crash dump or a failure file."""
    step: int
    """Index of the state in the episode, or of the engine call, from 0."""
    field: str
    """Name of the field of the state, such as `qpos`, or `reward`."""
    recorded: list[float]
    """Values of the field in the file."""
    replayed: list[float]
    """Values of the field in the replay."""


@dataclass(slots=True)
class Replay:
    """Result of a replay: what was simulated again, and the first difference from the file (None: all is equal)."""

    steps: int
    """Number of environment steps of a recording, or engine calls of another file, that were simulated again."""
    difference: Difference | None = None
    compared: int = 0
    """Number of engine calls after which the states were compared; 0 for a recording."""
    same_model: bool = True
    """Whether the model of the installed task equals the recorded model; not checked for a recording."""
    diverged_at: dict[int, DivergencePoint | None] = field(default_factory=dict)
    """Index of a recorded environment -> where its replay diverges; None: the replay does not diverge."""


# --- recordings ---


def choose_episodes(trajectory: Trajectory, episode: int | None, *, filmed: bool = False) -> list[int]:
    """Return the indices of the episodes to replay; the list is empty for a crash dump or a failure file.

    Args:
        trajectory: the file.
        episode: index of the only episode to replay; None: all.
        filmed: whether a video of the replay will be made, which is possible for recordings only.

    Raises:
        UsageError: if the file does not have the episode, or is of a kind without complete episodes.
    """
    count = len(trajectory.header.episodes)
    if trajectory.header.kind != "recording":
        if episode is not None or filmed:
            message = f"{trajectory.file} has no complete episodes: --episode and --video need a recording"
            raise UsageError(message, hint="to film a failure case: `rlcli autopsy RUN N --video FILE.mp4`")
        return []
    if episode is not None and episode >= count:
        raise UsageError(
            f"there is no episode {episode} in {trajectory.file}",
            hint=f"the file has {count} episodes, numbered from 0",
        )
    if not count:
        hint = "no episode was of the recorded kind; record all: rlcli eval TASK --record FILE --record-mode all"
        raise UsageError(f"{trajectory.file} has no episodes", hint=hint)
    return list(range(count)) if episode is None else [episode]


class StateReader(StepObserver):
    """Observer that copies the state of all environments in each step, after physics and before any reset."""

    def __init__(self, env: VecEnv) -> None:
        self._env = env
        self.state: dict[str, Tensor] = {}

    def after_physics(self) -> None:
        """Store a copy of the state as `state`: field name -> values (num_envs, n)."""
        self.state = read_state(self._env)


def read_state(env: VecEnv) -> dict[str, Tensor]:
    """Return copies of the state fields that a recording holds, by the name of the field. (num_envs, n) each"""
    return {name: env.engine.field(name).detach().cpu().clone() for name in STATE_FIELDS}


def replay_episodes(
    recording: Trajectory, env: VecEnv, episodes: Iterable[int], before_step: Callable[[int], None] = lambda step: None
) -> Replay:
    """Apply the actions of a recording again; compare the states and rewards of some episodes with the recorded ones.

    Args:
        recording: the recording.
        env: the environments, with the recorded configuration.
        episodes: indices of the episodes to compare, from 0.
        before_step: called before each environment step with its index in the recording, from 0.

    Returns:
        The result; it ends at the first difference.

    Raises:
        CheckpointError: if the recording does not fit the environment.
    """
    tensors, starting = recording.of_episodes(), defaultdict(list)
    for number in sorted(episodes):
        e = recording.header.episodes[number]
        starting[e.begin].append((number, e, tensors[number]))
    chosen = [e for several in starting.values() for _, e, _ in several]
    result = Replay(sum(e.length for e in chosen))
    try:
        env.load_state_dict(recording.part("start."))
    except (KeyError, RuntimeError, ValueError) as error:
        raise recording.mismatch_error(error) from None
    actions, after = recording.tensors["actions"], StateReader(env)
    with env.observers.added(after):
        current: list[tuple[int, Episode, dict[str, Tensor]]] = []
        for t in range(max((e.begin + e.length for e in chosen), default=0)):
            before_step(t)
            before = read_state(env)
            rewards = env.step(actions[t].to(env.device)).reward.cpu()
            current = [one for one in current if t < one[1].begin + one[1].length] + starting[t]
            for number, e, recorded in current:
                step = t - e.begin
                pairs = [(0, n, recorded[n][0], before[n][e.env]) for n in STATE_FIELDS if step == 0]
                pairs += [(step + 1, n, recorded[n][step + 1], after.state[n][e.env]) for n in STATE_FIELDS]
                pairs.append((step + 1, "reward", recorded["rewards"][step], rewards[e.env]))
                for index, name, old, new in pairs:
                    if not _same_bits(old.numpy(), new.numpy()):
                        values = old.reshape(-1).tolist(), new.reshape(-1).tolist()
                        result.difference = Difference(e.env, number, index, name, *values)
                        return result
    return result


def _same_bits(left: NDArray[np.generic], right: NDArray[np.generic]) -> bool:
    """Return whether two arrays are equal bit by bit: NaN equals itself, 0 differs from -0."""
    return left.shape == right.shape and left.tobytes() == right.tobytes()


# --- engine calls ---


class ReplayWorld:
    """Physics simulation of one environment without the task's terms, to simulate recorded engine calls again.

    Args:
        model: the model of all environments.
        resolved: the configuration, whose section `sim` is used.
        own_model: fields of the model that differ between environments, with this environment's values, by name.
        follows_constants: whether the constants that MuJoCo derives from a model (`mj_setConst`) are derived again from
            `own_model`.

    Raises:
        ValueError, RuntimeError: if the fields do not fit the model.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        resolved: Resolved,
        own_model: Mapping[str, Tensor],
        follows_constants: bool,
    ) -> None:
        config = resolved.task.sim.model_copy(update={"engine": "batch", "engine_threads": 1})
        engine = open_cpu_engine(model, 1, config)
        for name, values in own_model.items():
            engine.load_model_field(name, values.reshape(engine.expand(name).shape))
        if follows_constants:
            engine.set_constants()
        self.engine, self.layout = engine, engine.state_layout

    def simulate(self, call: Call) -> NDArray[np.float64]:
        """Simulate a recorded engine call from its recorded state, and return the integration state after it."""
        self.engine.set_state_row(0, call.state)
        self.engine.step(call.nstep)
        self.engine.diverged()
        return self.engine.state_row(0)

    def differing_field(self, recorded: NDArray[np.float64], now: NDArray[np.float64], *, final: bool) -> str | None:
        """Return the name of the first field in which two states differ in any bit; None if all compared fields agree.

        Args:
            recorded: the recorded state.
            now: the state of the replay.
            final: whether to compare all fields; false: only `_PHYSICS_FIELDS`.
        """
        for name, columns in self.layout.fields():
            if (final or name in _PHYSICS_FIELDS) and not _same_bits(recorded[columns], now[columns]):
                return name
        return None

    def find_divergence(self, calls: list[Call], first: int) -> DivergencePoint | None:
        """Simulate engine calls again, one physics step at a time, and find the first physics step that diverges.

        Args:
            calls: the recorded engine calls.
            first: index of the call to begin with.

        Returns:
            The physics step, or None if none diverges.
        """
        for number, call in enumerate(calls[first:], start=first):
            self.engine.set_state_row(0, call.state)
            for substep in range(call.nstep):
                before = self.engine.state_row(0)
                self.engine.step(1)
                if self.engine.diverged() is None:
                    continue
                found = self.engine.described_divergences[0]
                place, value = self._diverged_value(found, before)
                time = float(before[self.layout.columns("time")][0])
                return DivergencePoint(
                    call=number, substep=substep, time=time, cause=found.cause, place=place, value=value
                )
        return None

    def _diverged_value(self, found: Divergence, before: NDArray[np.float64]) -> tuple[str, str]:
        """Return `place` and `value` of a `DivergencePoint`: where a divergence shows, and the value there.

        Args:
            found: the divergence.
            before: the integration state before the physics step that diverged.
        """
        warned = WARNING_FIELDS.get(found.cause)
        if warned is None:
            name = found.cause.removesuffix(" not finite")
            values = self.engine.own_model_fields(0).get(name)
            if values is None and name in dict(self.layout.fields()):
                values = self.engine.state_row(0)[self.layout.columns(name)]
            if values is None:
                return found.detail, ""
            flat = np.asarray(values).flatten()
            index = int((~np.isfinite(flat)).argmax())
            return f"{name}[{index}]", repr(float(flat[index]))
        if warned == "qacc":
            self.engine.set_state_row(0, before)
            values = self.engine.world(0)[1].qacc
        else:
            values = before[self.layout.columns(warned)]
        return found.detail, f"{warned} {float(values[found.index])!r}" if 0 <= found.index < len(values) else ""


@dataclass(frozen=True, slots=True)
class StagedWorld:
    """The recorded engine calls of one environment, with a physics simulation that can simulate them again."""

    header: World
    """Cause of the recording, and facts about the calls."""
    world: ReplayWorld
    """The simulation, with the environment's own model fields."""
    calls: list[Call]
    """The calls, oldest first."""
    final: NDArray[np.float64]
    """The recorded integration state after the last call. (nstate,)"""


@dataclass(frozen=True, slots=True)
class Staged:
    """Content of a failure or crash file, with simulations of the installed task for its recorded environments."""

    resolved: Resolved
    """The recorded configuration, with the installed task's code and models."""
    model: mujoco.MjModel
    """The compiled model of the installed task."""
    same_model: bool
    """Whether the installed task's model equals the recorded model."""
    worlds: list[StagedWorld]
    """One simulation for each recorded environment."""


def stage(trajectory: Trajectory, named: TaskSource | None = None) -> Staged:
    """Build the task of a failure or crash file, and a physics simulation for each of the recorded environments.

    Args:
        trajectory: the file.
        named: the task on the command line; it replaces the recorded task if both are local files or folders, for
            example after the task's folder was moved. None: no task was named.

    Raises:
        TaskError: if the task is not installed any more.
        ConfigError: if the installed task does not accept the recorded configuration.
        CheckpointError: if the recorded states or model fields do not fit the installed task's model.
    """
    header, resolved = trajectory.header, trajectory.resolved(named)
    with contextlib.closing(make_env(resolved)) as env:
        model = env.engine.model
    worlds = []
    for number, described in enumerate(header.worlds):
        tensors = trajectory.part(f"world.{number}.")
        states, final = tensors["states"].numpy(), tensors["final"].numpy()
        try:
            own_model = trajectory.part(f"world.{number}.model.")
            world = ReplayWorld(model, resolved, own_model, header.follows_constants)
            width = len(world.engine.state_row(0))
            if states.shape[1] != width or len(final) != width:
                found = f"states of {states.shape[1]} numbers and a final state of {len(final)} numbers"
                raise ValueError(f"the file has {found}; a state of the model has {width}")
        except (ValueError, RuntimeError) as error:
            raise trajectory.mismatch_error(error) from None
        calls = [Call(state, nstep) for state, nstep in zip(states, described.nstep, strict=True)]
        worlds.append(StagedWorld(described, world, calls, final))
    return Staged(resolved, model, model_digest(model) == header.model, worlds)


def replay_calls(trajectory: Trajectory, named: TaskSource | None = None) -> Replay:
    """Simulate every engine call of a failure or crash file again, and compare the states with the recorded ones.

    A state that an event changed between two calls is not compared.

    Args:
        trajectory: the file.
        named: the task on the command line, as in `stage`.

    Returns:
        The result; it ends at the first difference.

    Raises:
        CheckpointError, ConfigError, TaskError: see `stage`.
    """
    staged = stage(trajectory, named)
    result = Replay(0, same_model=staged.same_model)
    diverged = trajectory.header.failure is None or trajectory.header.failure.kind == "diverged"
    for part in staged.worlds:
        env, world = part.header.env, part.world
        following = [call.state for call in part.calls[1:]] + [part.final]
        for index, (call, recorded) in enumerate(zip(part.calls, following, strict=True)):
            now, final = world.simulate(call), index == len(part.calls) - 1
            result.steps += 1
            if not final and not part.header.follows[index]:
                continue
            result.compared += 1
            name = world.differing_field(recorded, now, final=final)
            if name is not None:
                columns = world.layout.columns(name)
                values = recorded[columns].tolist(), now[columns].tolist()
                result.difference = Difference(env, None, index, name, *values)
                break
        if diverged or result.difference is not None:
            result.diverged_at[env] = world.find_divergence(part.calls, part.header.first)
        if result.difference is not None:
            break
    return result
