"""Read failure cases, the recordings of failed and outlier episodes of a training, for `rlcli autopsy`.

Reading and listing failure cases executes no code. `stage_case` builds the task to compute contacts and images, and so
runs the task's code, which must be trusted (`rlcli.runs.trusted_tasks`).
"""

import logging
import re
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from rlcli.errors import CheckpointError
from rlcli.registry import TaskSource
from rlcli.replay.resimulate import Staged, stage
from rlcli.replay.trajectory import Episode, Failure, Trajectory, World, read_trajectory
from rlcli.runs.atomic_io import finite_json
from rlcli.runs.run import Run
from rlcli.runs.safe_io import read_errors, require_inside, require_plain_entries

_log = logging.getLogger(__name__)
FOLDER = "autopsy"
"""Name of the folder in a run that has the files of failure cases."""
FILE_NAME = re.compile(r"(\d{12,15})-env-(\d{6,12})-episode-(\d{6,15})\.safetensors")
"""Pattern of the name of a failure case's file: its groups are environment steps, environment and episode."""
_MAX_FILES = 10_000


@dataclass(frozen=True, slots=True)
class FailureCase:
    """Recording of the last steps of a failed or outlier episode of a training."""

    trajectory: Trajectory
    """Content of the file, with one episode and the engine calls of its environment."""

    @property
    def episode(self) -> Episode:
        """Length, return and end of the episode."""
        return self.trajectory.header.episodes[0]

    @property
    def failure(self) -> Failure:
        """Why the episode was recorded, and in which iteration."""
        failure = self.trajectory.header.failure
        assert failure is not None
        return failure

    @property
    def world(self) -> World:
        """The engine calls that simulated the recorded environment steps."""
        return self.trajectory.header.worlds[0]

    @property
    def ended_by(self) -> str:
        """What ended the episode: the names of the terminations, or the cause of the divergence, as one text."""
        return self.world.ended_by if self.failure.kind == "diverged" else ", ".join(self.episode.causes)

    @property
    def seconds(self) -> float:
        """Simulated time of the recorded steps [s]."""
        return self.episode.kept * self.trajectory.header.step_dt

    @property
    def times(self) -> NDArray[np.float64]:
        """Time since the start of the episode at the end of each recorded step [s]. (steps,)"""
        e = self.episode
        return np.arange(e.length - e.kept + 1, e.length + 1, dtype=np.float64) * self.trajectory.header.step_dt

    def values(self, name: str) -> NDArray[np.float32]:
        """Return the recorded observations, actions or reward_terms (steps, columns), or the rewards (steps,).

        `name` is one of these four names.
        """
        array: NDArray[np.float32] = self.trajectory.tensors[f"episode.0.{name}"].numpy()
        return array

    def columns(self, name: str) -> dict[str, NDArray[np.float32]]:
        """Return the recorded values (steps,) of each column of the observations, actions or reward terms, by name.

        `name` is `observations`, `actions` or `reward_terms`.
        """
        names = getattr(self.trajectory.header.columns, name)
        return dict(zip(names, self.values(name).T, strict=True))

    def record(self) -> dict[str, Any]:
        """Return why, when and where the episode was recorded, as JSON data for `rlcli autopsy --json`."""
        episode, failure = self.episode, self.failure
        facts = {
            "file": str(self.trajectory.file),
            "iteration": failure.iteration,
            "step": failure.step,
            "env": episode.env,
            "episode": episode.index,
            "length": episode.length,
            "return": episode.total_reward,
            "kept_for": failure.kind,
            "ended_by": episode.causes,
            "cause": self.ended_by if failure.kind == "diverged" else None,
            "truncated": episode.truncated,
            "usual_returns": None if failure.usual_returns is None else list(failure.usual_returns),
            "steps_kept": episode.kept,
            "seconds_kept": self.seconds,
        }
        finite: dict[str, Any] = finite_json(facts)
        return finite

    def series(self) -> dict[str, Any]:
        """Return the values of all recorded steps as JSON data: time, reward, reward_terms, observations, actions.

        Each value is a list over the steps; reward_terms, observations and actions have one list for each column.
        """
        values = {
            "time": self.times.tolist(),
            "reward": self.values("rewards").tolist(),
            **{
                name: {column: values.tolist() for column, values in self.columns(name).items()}
                for name in ("reward_terms", "observations", "actions")
            },
        }
        finite: dict[str, Any] = finite_json(values)
        return finite


def list_failure_cases(run: Run) -> list[FailureCase]:
    """Return the failure cases of a run, the oldest first; at most 10,000 files are read.

    A file that cannot be read, or is not a failure case, is skipped with a warning.

    Raises:
        CheckpointError: if the folder of failure cases is outside the run.
    """
    folder = run.folder / FOLDER
    if not folder.is_dir():
        return []
    with read_errors(folder):
        require_inside(run.folder, folder)
    require_plain_entries(folder, only_links=True)
    cases = []
    for file in sorted(file for file in folder.iterdir() if FILE_NAME.fullmatch(file.name))[:_MAX_FILES]:
        try:
            trajectory = read_trajectory(file)
        except CheckpointError as error:
            _log.warning("skipped: %s", error.message)
            continue
        if trajectory.header.failure is None:
            _log.warning("skipped: %s is not a failure case; move it out of the run's folder", file)
            continue
        cases.append(FailureCase(trajectory))
    return sorted(cases, key=lambda case: (case.failure.step, case.episode.env, case.episode.index))


def why_no_cases(run: Run) -> str:
    """Return one sentence for the user on why a run has no failure cases; call it only for such a run."""
    device = str(run.record.get("device", "cpu"))
    if device.startswith("cuda"):
        return (
            f"the run was trained on {device}, where steps cannot be replayed; rlcli eval --checkpoint RUN --record"
            " FILE --record-mode failed records failed episodes of its policy"
        )
    return "no episode was recorded before the last checkpoint; agent.autopsy sets how many are recorded"


@dataclass(frozen=True, slots=True)
class Contact:
    """Two geoms in contact, with the contact force."""

    geoms: tuple[str, str]
    """Names of the two geoms."""
    distance: float
    """Distance between the geoms [m]; negative if they penetrate each other."""
    force: float
    """Force along the contact normal [N]."""
    position: tuple[float, float, float]
    """Position of the contact, world frame [m]."""


@dataclass(frozen=True, slots=True)
class StagedCase:
    """A failure case together with a simulation of the installed task, to compute contacts and images."""

    staged: Staged
    states: list[NDArray[np.float64]]
    """Finite states at the beginning of each recorded step; without a divergence also the state after the last step."""

    def forward(self, number: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return MuJoCo's model, and its data for `states[number]` with all derived fields computed."""
        engine = self.staged.worlds[0].world.engine
        engine.set_state_row(0, self.states[number])
        return engine.world(0)

    def contacts(self) -> list[Contact]:
        """Return the contacts in the last recorded state, the largest force first."""
        model, data = self.forward(-1)
        found = []
        force = np.zeros(6)
        for index in range(data.ncon):
            contact = data.contact[index]
            mujoco.mj_contactForce(model, data, index, force)
            names = (_geom_name(model, int(contact.geom[0])), _geom_name(model, int(contact.geom[1])))
            x, y, z = contact.pos.tolist()
            found.append(Contact(names, float(contact.dist), float(force[0]), (x, y, z)))
        return sorted(found, key=lambda contact: -contact.force)


def stage_case(case: FailureCase, named: TaskSource | None = None) -> StagedCase:
    """Build the task of a failure case, to compute contacts and draw images.

    Args:
        case: the failure case.
        named: the task on the command line; it replaces the recorded task if both are local files or folders, for
            example after the task's folder was moved. None: no task was named.

    Raises:
        CheckpointError: if the case has no finite state, or does not fit the installed task.
        ConfigError, TaskError: see `rlcli.replay.resimulate.stage`.
    """
    torch.set_num_threads(1)
    staged = stage(case.trajectory, named)
    if not staged.same_model:
        _log.warning(
            "the model of the installed task differs from the model in training: contacts and images show the"
            " installed model"
        )
    first, calls = case.world.first, staged.worlds[0].calls
    calls_per_step = max(1, first // max(1, case.episode.kept - 1))
    states = [call.state for call in calls[first % calls_per_step : first + 1 : calls_per_step]]
    if case.failure.kind != "diverged":  # after a divergence MuJoCo resets the state to the default
        states.append(staged.worlds[0].final)
    finite = [state for state in states if np.isfinite(state).all()]
    if not finite:
        raise CheckpointError(f"{case.trajectory.file} has no finite state; choose another case")
    return StagedCase(staged, finite)


def _geom_name(model: mujoco.MjModel, index: int) -> str:
    """Return the name of a geom; of a geom without a name, its index and the name of its body as one text."""
    name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, index)
    if name:
        return str(name)
    body = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, int(model.geom_bodyid[index]))
    return f"geom {index} of {body or 'world'}"
