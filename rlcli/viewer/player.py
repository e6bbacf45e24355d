"""A policy in an environment, in real time, under the hands of whoever watches it.

One object for every viewer. The viewer's thread asks (`ask`) and looks (`view`); the thread of the simulation does what
was asked between two steps (`advance`), so that nothing is ever changed within one.
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import CheckpointError, UsageError
from rlcli.managers.command import CommandManager, Knob
from rlcli.rl.rollout import Act

SPEEDS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Multiples of real time."""
_LAG = 0.25
"""How far the simulation may fall behind before it stops to catch up [s]."""


class Shelf(Protocol):
    """The checkpoints that may be played."""

    def steps(self) -> list[int]:
        """Steps of those that are there now, ascending."""
        ...

    def load(self, step: int) -> Act:
        """The policy of one.

        Raises:
            CheckpointError: if it is not there any more, damaged, or of another task.
        """
        ...


@dataclass(frozen=True, slots=True)
class View:
    """What a viewer shows of the player; it does not change any more."""

    paused: bool
    speed: float
    shown: int
    num_envs: int
    episode_s: float
    """How long the episode shown has lasted [s]."""
    reward: float
    """Of the last step in the environment shown."""
    episodes: int
    """Ended since the start, of the environment shown."""
    checkpoint: int | None
    """Step of the policy; None: it is of no checkpoint."""
    checkpoints: tuple[int, ...]
    follow: bool
    knobs: tuple[Knob, ...]
    held: Mapping[str, float]
    knob: int
    """Which of the knobs a key turns."""
    message: str


@dataclass(slots=True)
class Player:
    """See the module.

    Args:
        env: the environment; its episodes begin when the player is made, unless they have `begun`.
        act: the policy.
        shelf: other policies, if there are.
        checkpoint: the step of the first policy.
        tell: hears what happens, as the view's `message` shows it.
    """

    env: VecEnv
    act: Act
    shelf: Shelf | None = None
    checkpoint: int | None = None
    tell: Callable[[str], None] = lambda _: None
    shown: int = 0
    speed: float = 1.0
    follow: bool = False
    """Play each new checkpoint as it appears."""
    patience: float = 0.1
    """How long steps may go on before a viewer is asked again what it wants [s]."""
    begun: Tensor | None = None
    """Observations of an environment that goes on from where it stands; None: its episodes begin now."""
    steps: int = 0
    message: str = ""
    _knob: int = 0
    _asked: queue.SimpleQueue[Callable[[], None]] = field(default_factory=queue.SimpleQueue)
    _obs: Tensor = field(init=False)
    _due: float = 0.0
    _single: int = 0
    _push: np.ndarray | None = None
    _reward: Tensor = field(init=False)
    _have: tuple[int, ...] = ()
    ended: Tensor = field(init=False)
    """Episodes that have ended. (num_envs,)"""
    _view: View = field(init=False)
    _commands: CommandManager | None = None

    def __post_init__(self) -> None:
        self._commands = _commands(self.env)
        self._obs = self.env.reset(seed=self.env.seed)["policy"] if self.begun is None else self.begun
        self._reward = torch.zeros(self.env.num_envs)
        self.ended = torch.zeros(self.env.num_envs, dtype=torch.int64)
        self.reread()
        self._publish()

    # --- from any thread ---

    @property
    def view(self) -> View:
        """What is to be shown now."""
        return self._view

    def ask(self, request: Callable[[], None]) -> None:
        """Have one of the methods below called between two steps."""
        self._asked.put(request)

    # --- in the simulation's thread ---

    def advance(self, elapsed: float) -> int:
        """Do what was asked, then as many steps as are due after `elapsed` seconds; how many those were.

        A machine that is too slow falls behind real time; it does not try to catch up.
        """
        while True:
            try:
                request = self._asked.get_nowait()
            except queue.Empty:
                break
            request()
        count, self._single = self._single, 0
        if not count and self.env.is_playing():
            self._due += min(elapsed, _LAG) * self.speed / self.env.step_dt
            count = int(self._due)
            self._due -= count
        end = time.perf_counter() + self.patience
        done = 0
        while done < count and (done == 0 or time.perf_counter() < end):
            self._step()
            done += 1
        self._publish()
        return done

    def pause(self, paused: bool = True) -> None:
        """Pause: no step runs, and the environment says so. Or go on."""
        self.env.pause(paused)
        self._due = 0.0

    def single_step(self) -> None:
        """Pause, and make one step of the environment."""
        self.pause()
        self._single += 1

    def set_speed(self, speed: float) -> None:
        """The nearest of `SPEEDS`."""
        self.speed = min(SPEEDS, key=lambda known: abs(np.log(known / max(speed, 1e-9))))

    def faster(self, places: int = 1) -> None:
        """Up or down in `SPEEDS`."""
        position = SPEEDS.index(self.speed) + places
        self.speed = SPEEDS[max(0, min(position, len(SPEEDS) - 1))]

    def reset(self) -> None:
        """A new episode in every environment."""
        self._obs = self.env.reset()["policy"]
        self._reward = torch.zeros(self.env.num_envs)
        self._due = 0.0

    def show(self, shown: int) -> None:
        """Show another environment; numbers wrap around."""
        self.shown = shown % self.env.num_envs
        self._push = None

    def hold(self, name: str, value: float | None) -> None:
        """Ask this of the policy, whatever the task would ask; None: what the task asks."""
        hold_command(self.env, name, value)

    def choose_knob(self, places: int) -> None:
        """Which command `turn_knob` changes: the next one, or the one before."""
        if self._commands is not None and (knobs := self._commands.knobs()):
            self._knob = (self._knob + places) % len(knobs)

    def turn_knob(self, places: int) -> None:
        """Hold the chosen command, some tenths of its range higher or lower; beyond the range it is let go."""
        if self._commands is None or not (knobs := self._commands.knobs()):
            return
        knob = knobs[self._knob]
        start = min(max(0.0, knob.low), knob.high)
        value = self._commands.held.get(knob.name, start) + places * (knob.high - knob.low) / 10.0
        inside = knob.low - 1e-6 <= value <= knob.high + 1e-6
        self.hold(knob.name, round(value, 6) if inside else None)

    def reread(self) -> None:
        """Read the list of checkpoints again; with `follow`, play the newest."""
        if self.shelf is None:
            return
        before, self._have = self._have, tuple(self.shelf.steps())
        if self.follow and self._have and self._have != before and self._have[-1] != self.checkpoint:
            self.switch(self._have[-1])

    def set_follow(self, follow: bool) -> None:
        """Whether each new checkpoint is played as it appears; the newest at once."""
        self.follow = follow
        self.reread()
        if follow and self._have and self._have[-1] != self.checkpoint:
            self.switch(self._have[-1])

    def switch(self, step: int) -> None:
        """Play another checkpoint in the running episodes; if it cannot be played, say so and change nothing."""
        assert self.shelf is not None
        try:
            self.act = self.shelf.load(step)
        except CheckpointError as error:
            self._say(f"step {step} cannot be played, step {self.checkpoint} goes on: {error.message}")
            self._have = tuple(self.shelf.steps())
            return
        self.checkpoint = step
        self._say(f"now playing step {step}")

    def neighbour(self, places: int) -> None:
        """Play the next newer or older checkpoint."""
        self.reread()
        if not self._have:
            return
        newer = [step for step in self._have if step > (self.checkpoint or 0)]
        older = [step for step in self._have if step < (self.checkpoint or 0)]
        chosen = newer[:1] if places > 0 else older[-1:]
        if chosen:
            self.switch(chosen[0])

    def push(self, forces: np.ndarray | None) -> None:
        """Forces and torques on the bodies of the environment shown, until the next call. (nbody, 6) [N, N m]"""
        usable = forces is not None and forces.shape == (self.env.engine.model.nbody, 6) and np.isfinite(forces).all()
        self._push = forces.copy() if forces is not None and usable and forces.any() else None

    def _step(self) -> None:
        playing = self.env.is_playing()
        self.env.pause(False)
        try:
            with torch.no_grad():
                action = self.act(self._obs)
                if self._push is None:
                    result = self.env.step(action)
                else:
                    result = self._pushed(action, self._push)
        finally:
            self.env.pause(not playing)
        self._obs, self._reward = result.obs["policy"], result.reward
        self.ended += result.terminated | result.truncated
        self.steps += 1

    def _pushed(self, action: Tensor, push: np.ndarray) -> Any:
        """A step under a force; where the step itself wrote another one, as a reset does, that stays."""
        row = self.env.engine.field("xfrc_applied")[self.shown]
        before = row.clone()
        under = before + torch.from_numpy(push).to(row)
        row.copy_(under)
        result = self.env.step(action)
        row.copy_(torch.where(row == under, before, row))
        return result

    def _say(self, message: str) -> None:
        self.message = " ".join(message.split())
        self.tell(message)

    def _publish(self) -> None:
        shown = self.shown
        self._view = View(
            paused=not self.env.is_playing(),
            speed=self.speed,
            shown=shown,
            num_envs=self.env.num_envs,
            episode_s=float(self.env.episode_length_buf[shown]) * self.env.step_dt,
            reward=float(self._reward[shown]),
            episodes=int(self.ended[shown]),
            checkpoint=self.checkpoint,
            checkpoints=self._have,
            follow=self.follow,
            knobs=() if self._commands is None else tuple(self._commands.knobs()),
            held={} if self._commands is None else dict(self._commands.held),
            knob=self._knob,
            message=self.message,
        )


def hold_command(env: VecEnv, name: str, value: float | None) -> None:
    """Ask a value of the policy; see `CommandManager.hold`.

    Raises:
        UsageError: for a name that there is not.
    """
    manager = _commands(env)
    if manager is None:
        raise UsageError(f"no command '{name}'", hint="the task has no commands")
    manager.hold(name, value)


def _commands(env: VecEnv) -> CommandManager | None:
    """Only manager-based tasks have command terms."""
    return getattr(env, "command_manager", None)
