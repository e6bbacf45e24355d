"""Playback of a policy in real time, with the controls of a viewer: the class `Playback`, which all viewers use.

A viewer may run in a thread of its own: it submits requests (`submit`) and reads a snapshot of the state (`view`). The
thread of the simulation executes the requests between two steps (`advance`), so that nothing changes within a step.
"""

import logging
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import CheckpointError, UsageError
from rlcli.managers.command import CommandManager
from rlcli.rl.action_functions import Act
from rlcli.viewer.checkpoints import RunCheckpoints
from rlcli.viewer.playback_statistics import PlaybackStatistics
from rlcli.viewer.protocol import View

_log = logging.getLogger(__name__)
SPEEDS = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
"""Speeds of a playback, as multiples of real time."""
_LAG = 0.25
"""Largest delay behind real time that a call of `advance` makes up for [s]."""
_FRAME_S = 1.0 / 60.0
"""Time between two images [s]."""
_REFRESH_S = 1.0
"""Time between two reads of the list of checkpoints [s]."""


@dataclass(slots=True)
class Playback:
    """Playback of a policy in real time, for a viewer.

    The methods `view`, `submit` and `requests` may be called in any thread, the others only in the simulation's thread.

    Args:
        env: the environments; reset when the playback is made, unless `initial_obs` is given.
        act: the policy, a function: observations (num_envs, d) -> actions (num_envs, a).
        checkpoint_source: checkpoints of the run, to which the user can switch; None: no checkpoints.
        checkpoint: the checkpoint of the first policy, by its number of environment steps; None: no checkpoint.
        shown: index of the shown environment.
        speed: speed as a multiple of real time, one of `SPEEDS`.
    """

    env: VecEnv
    act: Act
    checkpoint_source: RunCheckpoints | None = None
    checkpoint: int | None = None
    shown: int = 0
    speed: float = 1.0
    follow: bool = False
    """Whether to switch to each new checkpoint when it appears."""
    max_advance_s: float = 0.1
    """Time after which `advance` returns to the viewer, even if steps are still due [s]."""
    longest_s: float | None = None
    """Time after which the viewer closes, by the clock [s]; None: no limit."""
    initial_obs: Tensor | None = None
    """Current observations of environments whose episodes continue; None: the environments are reset. (num_envs, d)"""
    steps: int = 0
    """Number of steps made so far; each steps all environments."""
    message: str = ""
    """Last message for the user, such as that a checkpoint was loaded."""
    _knob: int = 0
    _requests: deque[Callable[[], None]] = field(default_factory=deque)
    _obs: Tensor = field(init=False)
    _due: float = 0.0
    _single: int = 0
    _push: np.ndarray | None = None
    _reward: Tensor = field(init=False)
    _checkpoints: tuple[int, ...] = ()
    statistics: PlaybackStatistics = field(init=False)
    _view: View = field(init=False)
    _commands: CommandManager | None = None

    def __post_init__(self) -> None:
        self._commands = _commands(self.env)
        self._obs = self.env.reset(seed=self.env.seed)["policy"] if self.initial_obs is None else self.initial_obs
        self._reward = torch.zeros(self.env.num_envs)
        self.statistics = PlaybackStatistics(self.env)
        self.refresh_checkpoints()
        self._publish()

    # --- from any thread ---

    @property
    def view(self) -> View:
        """Snapshot of the playback for the viewer, after the last `advance`."""
        return self._view

    def submit(self, request: Callable[[], None]) -> None:
        """Queue a call of a method of this object, such as `reset`; the call is made between two steps."""
        self._requests.append(request)

    def requests(self) -> dict[str, Callable[[], None]]:
        """Return the requests that a viewer's keys and buttons submit: name -> function for `submit`."""
        view = self._view
        return {
            "pause": partial(self.pause, not view.paused),
            "step": self.single_step,
            "reset": self.reset,
            "slower": partial(self.change_speed, -1),
            "faster": partial(self.change_speed, 1),
            "next environment": partial(self.show, view.shown + 1),
            "previous environment": partial(self.show, view.shown - 1),
            "newer checkpoint": partial(self.switch_relative, 1),
            "older checkpoint": partial(self.switch_relative, -1),
            "previous command": partial(self.select_command, -1),
            "next command": partial(self.select_command, 1),
            "raise command": partial(self.adjust_command, 1),
            "lower command": partial(self.adjust_command, -1),
        }

    # --- in the simulation's thread ---

    def advance(self, elapsed: float) -> int:
        """Execute the requests, then make the environment steps that are due; return the number of steps made.

        If the machine is too slow, the playback is slower than real time; it does not catch up a delay of over 0.25 s.

        Args:
            elapsed: real time since the last call [s].
        """
        while self._requests:  # only this thread removes requests
            self._requests.popleft()()
        count, self._single = self._single, 0
        if not count and self.env.is_playing():
            self._due += min(elapsed, _LAG) * self.speed / self.env.step_dt
            count = int(self._due)
            self._due -= count
        end = time.perf_counter() + self.max_advance_s
        done = 0
        while done < count and (done == 0 or time.perf_counter() < end):
            self._step()
            done += 1
        self._publish()
        return done

    def pause(self, paused: bool = True) -> None:
        """Pause or resume the playback; `env.is_playing()` is false during a pause."""
        self.env.pause(paused)
        self._due = 0.0

    def single_step(self) -> None:
        """Pause, and make one step of the environments in the next `advance`."""
        self.pause()
        self._single += 1

    def set_speed(self, speed: float) -> None:
        """Set the speed to the value of `SPEEDS` that is nearest to `speed` on a logarithmic scale."""
        self.speed = min(SPEEDS, key=lambda available: abs(np.log(available / max(speed, 1e-9))))

    def change_speed(self, change: int = 1) -> None:
        """Change the speed to the next faster (`change` is 1) or next slower (-1) value of `SPEEDS`."""
        position = SPEEDS.index(self.speed) + change
        self.speed = SPEEDS[max(0, min(position, len(SPEEDS) - 1))]

    def reset(self) -> None:
        """Start a new episode in every environment."""
        self._obs = self.env.reset()["policy"]
        self.statistics.clear_returns()
        self._reward = torch.zeros(self.env.num_envs)
        self._due = 0.0

    def show(self, shown: int) -> None:
        """Show the environment with the index `shown`, modulo the number of environments: -1 is the last one."""
        self.shown = shown % self.env.num_envs
        self.statistics.clear_curves()
        self._push = None

    def hold(self, name: str, value: float | None) -> None:
        """Hold a command (such as `vx`) at a value in all environments; None: the task samples the command again.

        Raises:
            UsageError: for an unknown name, or a value that is not finite.
        """
        hold_command(self.env, name, value)

    def select_command(self, change: int) -> None:
        """Select the next (`change` is 1) or previous (-1) command, which `adjust_command` then changes."""
        if self._commands is not None and (knobs := self._commands.knobs()):
            self._knob = (self._knob + change) % len(knobs)

    def adjust_command(self, change: int) -> None:
        """Change the selected command by `change` tenths of its range, and hold the command at the new value.

        If the new value is outside the range, the task samples the command again.
        """
        if self._commands is None or not (knobs := self._commands.knobs()):
            return
        knob = knobs[self._knob]
        start = min(max(0.0, knob.low), knob.high)
        value = self._commands.held.get(knob.name, start) + change * (knob.high - knob.low) / 10.0
        inside = knob.low - 1e-6 <= value <= knob.high + 1e-6
        self.hold(knob.name, round(value, 6) if inside else None)

    def refresh_checkpoints(self) -> None:
        """Read the list of the run's checkpoints again; if `follow` and the list has changed, switch to the newest."""
        if self.checkpoint_source is None:
            return
        before, self._checkpoints = self._checkpoints, tuple(self.checkpoint_source.steps())
        if self.follow and self._checkpoints != before:
            self._switch_to_newest()

    def set_follow(self, follow: bool) -> None:
        """Set whether to switch to each new checkpoint when it appears; if so, switch to the newest checkpoint now."""
        self.follow = follow
        self.refresh_checkpoints()
        if follow:
            self._switch_to_newest()

    def _switch_to_newest(self) -> None:
        if self._checkpoints and self._checkpoints[-1] != self.checkpoint:
            self.switch(self._checkpoints[-1])

    def switch(self, step: int) -> None:
        """Continue the running episodes with the policy of another checkpoint.

        If the checkpoint cannot be loaded, the policy stays and `message` says why.

        Args:
            step: number of environment steps of the checkpoint.
        """
        assert self.checkpoint_source is not None
        try:
            self.act = self.checkpoint_source.load(step)
        except CheckpointError as error:
            self._report(f"step {step} cannot be played, the current policy continues: {error.message}")
            self._checkpoints = tuple(self.checkpoint_source.steps())
            return
        self.checkpoint = step
        self._report(f"now playing step {step}")

    def switch_relative(self, change: int) -> None:
        """Switch to the next newer (`change` is 1) or next older (-1) checkpoint, if there is one."""
        self.refresh_checkpoints()
        if not self._checkpoints:
            return
        newer = [step for step in self._checkpoints if step > (self.checkpoint or 0)]
        older = [step for step in self._checkpoints if step < (self.checkpoint or 0)]
        chosen = newer[:1] if change > 0 else older[-1:]
        if chosen:
            self.switch(chosen[0])

    def push(self, forces: np.ndarray | None) -> None:
        """Apply forces and torques to the bodies of the shown environment in each step, until the next call.

        Args:
            forces: force and torque on each body, world frame; None or values that are not finite: nothing is applied.
                (nbody, 6) [N, N m]
        """
        usable = forces is not None and forces.shape == (self.env.engine.model.nbody, 6) and np.isfinite(forces).all()
        self._push = forces.copy() if forces is not None and usable and forces.any() else None

    def _step(self) -> None:
        """Make a step of all environments with the policy's actions, also during a pause."""
        playing = self.env.is_playing()
        self.env.pause(False)
        try:
            with torch.no_grad():
                action = self.act(self._obs)
                if self._push is None:
                    result = self.env.step(action)
                else:
                    result = self._step_under_force(action, self._push)
        finally:
            self.env.pause(not playing)
        self._obs, self._reward = result.obs["policy"], result.reward
        self.statistics.add(result, self.shown)
        self.steps += 1

    def _step_under_force(self, action: Tensor, push: np.ndarray) -> Any:
        """Make a step with the forces that the user applies to bodies in the viewer; remove the forces after the step.

        Forces that the step itself has set, for example in a reset, stay.

        Args:
            action: actions of all environments. (num_envs, a)
            push: force and torque on each body of the shown environment, world frame. (nbody, 6) [N, N m]
        """
        row = self.env.engine.field("xfrc_applied")[self.shown]
        before = row.clone()
        pushed = before + torch.from_numpy(push).to(row)
        row.copy_(pushed)
        result = self.env.step(action)
        row.copy_(torch.where(row == pushed, before, row))  # forces that a reset has written stay
        return result

    def _report(self, message: str) -> None:
        """Show a message to the user in the viewer, and log the message."""
        self.message = " ".join(message.split())
        _log.info(message)

    def _publish(self) -> None:
        """Set `view` to a snapshot of the present state."""
        shown, statistics = self.shown, self.statistics
        knobs = () if self._commands is None else tuple(self._commands.knobs())
        self._view = View(
            paused=not self.env.is_playing(),
            speed=self.speed,
            shown=shown,
            num_envs=self.env.num_envs,
            episode_s=float(self.env.episode_length_buf[shown]) * self.env.step_dt,
            reward=float(self._reward[shown]),
            conditions=self.env.success_conditions(shown),
            episode_return=float(statistics.returns[shown]),
            episodes=int(statistics.ended[shown]),
            succeeded=int(statistics.succeeded[shown]),
            last_episode=statistics.last_episode(shown),
            curves=statistics.curves(),
            checkpoint=self.checkpoint,
            checkpoints=self._checkpoints,
            follow=self.follow,
            knobs=knobs,
            commands=tuple(self._commands.value(knob, shown) for knob in knobs) if self._commands else (),
            held={} if self._commands is None else dict(self._commands.held),
            knob=self._knob,
            message=self.message,
        )


def run_in_real_time(playback: Playback, is_open: Callable[[], bool], draw: Callable[[], None]) -> None:
    """Call `Playback.advance` and `draw` up to 60 times a second, until the viewer is closed or `longest_s` is over.

    Args:
        playback: environments and policy.
        is_open: returns whether the viewer is still open.
        draw: renders the present state. This function runs in the simulation's thread between two calls of `advance`,
            so it may read `playback.env`. Another thread of a viewer may read only `playback.view`.
    """
    before, refreshed = time.perf_counter(), 0.0
    end = math.inf if playback.longest_s is None else before + playback.longest_s
    while is_open() and before < end:
        now = time.perf_counter()
        if now - refreshed > _REFRESH_S:
            playback.refresh_checkpoints()
            refreshed = now
        playback.advance(now - before)
        before = now
        draw()
        time.sleep(max(0.0, _FRAME_S - (time.perf_counter() - now)))


def hold_command(env: VecEnv, name: str, value: float | None) -> None:
    """Hold a command (such as `vx`) at a value in all environments; None: the task samples the command again.

    Raises:
        UsageError: for an unknown name, or a value that is not finite.
    """
    manager = _commands(env)
    if manager is None:
        raise UsageError(f"the task has no command '{name}'", hint="leave out --command: the task has no commands")
    manager.hold(name, value)


def _commands(env: VecEnv) -> CommandManager | None:
    """Return the command manager; None for a direct task."""
    return getattr(env, "command_manager", None)
