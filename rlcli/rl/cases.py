"""The ends of episodes that training kept, as a reader sees them; nothing of a run is executed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from rlcli.errors import CheckpointError
from rlcli.registry import TaskSource
from rlcli.rl.autopsy import FOLDER, NAME
from rlcli.rl.dump import Dump, Ending, Staged, read_dump, stage
from rlcli.rl.reading import refuse_links
from rlcli.rl.run import Run, require_inside
from rlcli.sim.batch import BatchEngine
from rlcli.sim.guard import Call

_MOST = 10_000
"""Files of a folder that are looked at."""


@dataclass(frozen=True, slots=True)
class Case:
    """One of them."""

    dump: Dump
    ending: Ending

    @property
    def env(self) -> int:
        """Environment of the training."""
        return self.dump.document.lives[0].env

    @property
    def ended_by(self) -> str:
        """Terminations, or the cause of a divergence with its place."""
        life = self.dump.document.lives[0]
        if self.ending.kind == "diverged":
            return f"{life.cause}{f' ({life.detail})' if life.detail else ''}"
        return ", ".join(self.ending.causes)

    @property
    def reward(self) -> NDArray[np.float32]:
        """Of each step. (steps,)"""
        return self._array("reward")

    @property
    def reward_terms(self) -> NDArray[np.float32]:
        """What each term paid. (steps, terms)"""
        return self._array("reward_terms")

    @property
    def observations(self) -> NDArray[np.float32]:
        """What the policy saw. (steps, columns)"""
        return self._array("obs")

    @property
    def actions(self) -> NDArray[np.float32]:
        """What it did. (steps, columns)"""
        return self._array("action")

    @property
    def steps(self) -> int:
        """How many steps were kept, the last ones of the episode."""
        return len(self.reward)

    @property
    def times(self) -> NDArray[np.float64]:
        """Time in the episode at the end of each step [s]. (steps,)"""
        numbers = np.arange(self.ending.length - self.steps, self.ending.length, dtype=np.float64) + 1.0
        return numbers * self.ending.step_dt

    def record(self) -> dict[str, Any]:
        """Its facts, as plain JSON."""
        ending = self.ending
        return {
            "file": str(self.dump.file),
            "iteration": ending.iteration,
            "step": ending.step,
            "env": self.env,
            "episode": ending.episode,
            "length": ending.length,
            "return": ending.total_reward,
            "kept_for": ending.kind,
            "ended_by": ending.causes,
            "cause": self.ended_by if ending.kind == "diverged" else None,
            "truncated": ending.truncated,
            "usual_returns": None if ending.usual is None else list(ending.usual),
            "steps_kept": self.steps,
            "seconds_kept": self.steps * ending.step_dt,
        }

    def _array(self, name: str) -> Any:
        return self.dump.tensors[f"0.{name}"].numpy()


@dataclass(frozen=True, slots=True)
class Contact:
    """Two geoms that touch."""

    geoms: tuple[str, str]
    distance: float
    """Negative where they penetrate [m]."""
    force: float
    """Along the normal [N]."""
    position: tuple[float, float, float]
    """[m]"""


def list_cases(run: Run, tell: Callable[[str], None]) -> list[Case]:
    """The cases of a run, the oldest first.

    Args:
        run: the run.
        tell: hears of files that are passed over, and why.

    Raises:
        CheckpointError: if their folder is not a folder of the run.
    """
    folder = run.folder / FOLDER
    if not folder.is_dir():
        return []
    try:
        require_inside(run.folder, folder)
    except OSError as error:
        raise CheckpointError(f"{folder} cannot be read: {error.strerror}") from None
    refuse_links(folder)
    cases = []
    for file in sorted(file for file in folder.iterdir() if NAME.fullmatch(file.name))[:_MOST]:
        try:
            dump = read_dump(file)
        except CheckpointError as error:
            tell(f"passed over: {error.message}")
            continue
        if dump.document.ending is None:
            tell(f"passed over: {file} is the dump of a divergence, and of no kept episode")
            continue
        cases.append(Case(dump, dump.document.ending))
    return sorted(cases, key=lambda case: (case.ending.step, case.env, case.ending.episode))


@dataclass(frozen=True, slots=True)
class Scene:
    """A case in a world of the installed task."""

    staged: Staged
    world: BatchEngine
    calls: list[Call]
    states: list[NDArray[np.float64]]
    """The states between its steps: what the first began with, and what each gave, as far as they are finite."""

    def show(self, number: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """One of the states, forwarded."""
        self.world.put(0, self.states[number])
        return self.world.world(0)

    def contacts(self) -> list[Contact]:
        """What touches in the last state, the strongest first."""
        model, data = self.show(-1)
        found = []
        force = np.zeros(6)
        for index in range(data.ncon):
            contact = data.contact[index]
            mujoco.mj_contactForce(model, data, index, force)
            names = (_geom(model, int(contact.geom[0])), _geom(model, int(contact.geom[1])))
            x, y, z = contact.pos.tolist()
            found.append(Contact(names, float(contact.dist), float(force[0]), (x, y, z)))
        return sorted(found, key=lambda contact: -contact.force)


def restage(case: Case, named: TaskSource | None = None) -> Scene:
    """Build a case's task, for its contacts and pictures.

    Raises:
        CheckpointError, ConfigError, TaskError: see `rlcli.rl.dump.stage`.
    """
    staged = stage(case.dump, named)
    life, world, calls, after = staged.worlds[0]
    per_step = max(1, (life.first // (case.steps - 1)) if case.steps > 1 else 1)
    begins = list(range(life.first, -1, -per_step))[::-1]
    states = [calls[index].state for index in begins]
    if case.ending.kind != "diverged":  # MuJoCo has put a world that diverged into its default state
        states.append(after)
    finite = [state for state in states if np.isfinite(state).all()]
    if not finite:
        raise CheckpointError(f"{case.dump.file} has no state that is finite")
    return Scene(staged, world, calls, finite)


def _geom(model: mujoco.MjModel, index: int) -> str:
    """A geom's name, or its number and its body's name."""
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, index)
    if name:
        return str(name)
    body = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.geom_bodyid[index]))
    return f"geom {index} of {body or 'world'}"
