"""Detection of diverged simulations and of numbers that are not finite in the environment loop, and the recovery.

A diverged environment returns to its last finite state, and its episode ends there as terminated. An environment that
an event or a reset has put out of bounds is quarantined: it returns to a good state at once, and its episode ends with
the next step. On a GPU each check would force a host sync: the engine checks on the device, and `check` reads the
results.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rlcli.errors import DivergedError
from rlcli.sim.divergence_report import MAX_DESCRIBED, STATE_LIMIT, Divergence, StateLayout
from rlcli.sim.env_selection import Selection
from rlcli.sim.state_cache import is_finite

if TYPE_CHECKING:
    from rlcli.envs.vec_env import VecEnv


class DivergenceGuard:
    """Checks of an environment loop for divergence and for values that are not finite; recovery from divergence."""

    def __init__(self, env: VecEnv) -> None:
        self._env = env
        self.quarantined = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
        """Environments whose episode ends with the next step. (num_envs,) bool"""
        self._any_quarantined = False
        self._quarantine_causes: Counter[str] = Counter()
        self._logged_causes: Counter[str] = Counter()

    @property
    def causes(self) -> Counter[str]:
        """Number of diverged environments since the start, by cause."""
        return self._quarantine_causes + Counter(self._env.engine.divergence_causes)

    def metrics(self) -> dict[str, float]:
        """Return the metrics `Sim/diverged/CAUSE`: numbers of environments that diverged since the last call."""
        causes = self.causes
        new, self._logged_causes = causes - self._logged_causes, causes
        return {f"Sim/diverged/{cause.replace(' ', '_')}": float(count) for cause, count in new.items()}

    def load_quarantined(self, quarantined: Tensor | None) -> None:
        """Restore the mask of quarantined environments; None: no environment is quarantined."""
        self.quarantined.zero_() if quarantined is None else self.quarantined.copy_(quarantined)
        self._any_quarantined = bool(self.quarantined.any())

    def check(self) -> None:
        """Raise the error that a GPU has recorded in the steps since the last call; on a CPU the step itself raises it.

        Raises:
            DivergedError: for an action, observation or reward that was not finite, or for more contacts or constraints
                than the GPU engine has room for.
        """
        engine = self._env.engine
        not_finite = engine.report_nonfinite()
        if engine.asynchronous and self._env.observers.on_divergence and engine.described_divergences:
            self._env.observers.run_on_divergence(engine.described_divergences, pending=False)
        for what in not_finite:
            raise DivergedError(
                f"{what} is not finite shortly before step {self._env.common_step}; lower"
                " sim.dt, or look for divisions by 0"
            )

    def after_physics(self) -> Tensor | None:
        """Read the state after physics, and return diverged environments to their last finite state.

        Returns:
            Environments that diverged in this step or were quarantined before it, (num_envs,) bool; None: none.
        """
        engine, sim = self._env.engine, self._env.sim
        if engine.asynchronous:
            diverged = engine.diverged()
            sim.refresh()
            return diverged
        sim.refresh()
        diverged = engine.diverged(sim.is_finite())
        if diverged is not None:
            self._env.observers.run_on_divergence(engine.described_divergences, pending=False)
        if self._any_quarantined:
            diverged = self.quarantined.clone() if diverged is None else diverged | self.quarantined
            self.quarantined.zero_()
            self._any_quarantined = False
        selection = None if diverged is None else self._env._select(diverged)
        if selection is not None:
            self._restore_diverged(selection)
            sim.refresh()
        sim.save_good_state()
        return diverged

    def quarantine_out_of_bounds(self) -> None:
        """Quarantine the environments that an event or a reset has put out of bounds.

        These environments return to the state before the event, or to the default state if their episode has just
        begun; the next step ends their episode. On a GPU the next step finds these environments: a check here would
        force a host sync.
        """
        env = self._env
        if env.engine.asynchronous:
            return
        bad = env.sim.out_of_bounds(STATE_LIMIT)
        if bad is not None:
            self._quarantine(bad)
        env.sim.save_good_state()

    def require_finite(self, values: Tensor, what: str, columns: Sequence[str] = ()) -> None:
        """Check that values of all environments are finite; on a GPU `check` raises later.

        Args:
            values: (num_envs,) or (num_envs, n)
            what: name of the values for the message, such as `the reward`.
            columns: names of the n columns.

        Raises:
            DivergedError: with the number of environments, and the first column with a value that is not finite.
        """
        env = self._env
        if env.engine.asynchronous:
            env.engine.check_finite(values, what)
            return
        if is_finite(values):
            return
        env._raise_for_term(what)
        bad = ~values.isfinite()
        rows = bad.any(dim=1) if bad.dim() > 1 else bad
        first = int(rows.nonzero()[0, 0])
        column = int(bad[first].nonzero()[0, 0]) if bad.dim() > 1 else 0
        name = f" in column {columns[column]}" if column < len(columns) else ""
        shard, among = env.shard, f"{len(rows)} environments"
        if shard.count != shard.total and len(rows) == shard.count:
            among = f"the environments {shard.first} to {shard.rows.stop - 1}"
            first += shard.first
        raise DivergedError(
            f"{what} is not finite in {int(rows.sum())} of {among}, first in environment {first}{name}"
            f" (step {env.common_step}); lower sim.dt, or look for divisions by 0"
        )

    def _restore_diverged(self, selection: Selection) -> None:
        """Return diverged environments to their last finite state; MuJoCo's own reset would change their rewards."""
        engine = self._env.engine
        engine.reset(selection)
        self._env.sim.restore_rows(selection)
        try:
            engine.forward(selection)
        except DivergedError:  # the last finite state fails, too: use the default state
            engine.reset(selection)
            engine.forward(selection)

    def _quarantine(self, bad: Tensor) -> None:
        env = self._env
        found = [self._describe(number) for number in bad.nonzero().flatten().tolist()]
        self._quarantine_causes.update(divergence.cause for divergence in found)
        self._env.observers.run_on_divergence(found[:MAX_DESCRIBED], pending=True)
        just_reset = bad & (env.episode_length_buf == 0)
        for rows, restore in ((bad & ~just_reset, True), (just_reset, False)):
            selection = env._select(rows)
            if selection is None:
                continue
            env.engine.reset(selection)
            if restore:
                env.sim.restore_rows(selection)
            env.engine.forward(selection)
            env.sim.refresh_rows(selection)
            for sensor in env.sensors.values():
                sensor.on_moved(selection)
        self.quarantined |= bad
        self._any_quarantined = True

    def _describe(self, number: int) -> Divergence:
        """Return the first value that an event or a reset has put out of bounds in environment `number`."""
        env = self._env
        columns, field = env.sim.qpos[number], "qpos"
        if bool((columns.abs() <= STATE_LIMIT).all()):
            columns, field = env.sim.qvel[number], "qvel"
        index = int((~(columns.abs() <= STATE_LIMIT)).nonzero()[0, 0])
        element = StateLayout(env.engine.model, {}).element_at(field, index)
        writer = "a reset" if int(env.episode_length_buf[number]) == 0 else "an event"
        what = "out of bounds" if bool(columns.isfinite().all()) else "not finite"
        return Divergence(number, f"{field} {what}", f"{element} = {float(columns[index]):g}, written by {writer}")
