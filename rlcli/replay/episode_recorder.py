"""Recorder of whole episodes, for `rlcli eval --record` and `rlcli play --record`.

`rlcli replay` can simulate the recorded episodes again.
"""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from rlcli.envs.observers import StepObserver
from rlcli.envs.step_result import StepRecord
from rlcli.envs.vec_env import VecEnv
from rlcli.replay.resimulate import read_state
from rlcli.replay.trajectory import STATE_FIELDS, Episode, Header, write_trajectory


class EpisodeRecorder(StepObserver):
    """Observer that records the first complete episodes after it is added to the environments.

    Use it with `with env.observers.added(recorder):` from the beginning of an episode on.

    Args:
        env: the environments.
        episodes: number of episodes, divided evenly between the environments, as in an evaluation.
        env_id: index of the environment from which all episodes are taken; None: from all environments.
    """

    def __init__(self, env: VecEnv, episodes: int, *, env_id: int | None = None) -> None:
        self._env, count = env, env.num_envs
        self._quota = [episodes // count + (i < episodes % count) for i in range(count)]
        if env_id is not None:
            self._quota = [episodes * (i == env_id) for i in range(count)]
        self._start: dict[str, Tensor] = {}
        self._new = list(range(count))
        self._begin = [0] * count
        self._first: dict[tuple[int, int], dict[str, Tensor]] = {}
        """(environment, first step) -> state and model fields at the start of the episode."""
        self._after: list[dict[str, Tensor]] = []
        self._actions: list[Tensor] = []
        self._rewards: list[Tensor] = []
        self.episodes: list[Episode] = []
        """The recorded episodes, in the order in which they ended."""

    def before_step(self) -> None:
        """Copy the state and model fields at the beginning of new episodes."""
        if not self._start:
            self._start = self._env.state_dict()
        if not self._new:
            return
        engine = self._env.engine
        fields = read_state(self._env)
        fields |= {f"model.{name}": engine.expand(name).detach().cpu() for name in engine.expanded_fields()}
        for env in self._new:
            self._begin[env] = len(self._actions)
            self._first[env, len(self._actions)] = {name: values[env].clone() for name, values in fields.items()}
        self._new = []

    def after_physics(self) -> None:
        """Copy the state after the physics steps, before any reset."""
        self._after.append(read_state(self._env))

    def on_step(self, record: StepRecord) -> None:
        """Copy actions and rewards, and add the episodes that end in this step to `episodes`."""
        self._actions.append(record.action.detach().cpu().clone())
        self._rewards.append(record.reward.detach().cpu().clone())
        if record.episodes is None:
            return
        ended = record.episodes.ended()
        self._new = ended.ids.tolist()
        for row, env in enumerate(self._new):
            if self._quota[env] > 0:
                self._quota[env] -= 1
                self.episodes.append(Episode.of(self._env, ended, row, begin=self._begin[env]))

    def save(self, files: Mapping[str, Path]) -> list[Path]:
        """Write the recorded episodes to one file or several.

        Args:
            files: which episodes -> the file for these episodes; the keys are `all`, `succeeded` and `failed`.

        Returns:
            The files that were written.

        Raises:
            MachineError: if the disk reports an error.
        """
        for word, file in files.items():
            self._write(file, [e for e in self.episodes if word == "all" or e.succeeded == (word == "succeeded")])
        return list(files.values())

    def _write(self, file: Path, episodes: list[Episode]) -> None:
        last = max((e.begin + e.length for e in episodes), default=0)
        actions = torch.stack(self._actions[:last]) if last else torch.zeros(0, self._env.num_envs, 0)
        tensors = {"actions": actions} | {f"start.{name}": value for name, value in self._start.items()}
        for number, e in enumerate(episodes):
            prefix, steps = f"episode.{number}.", slice(e.begin, e.begin + e.length)
            first = self._first[e.env, e.begin]
            for name in STATE_FIELDS:
                states = [first[name], *(after[name][e.env] for after in self._after[steps])]
                tensors[prefix + name] = torch.stack(states)
            tensors |= {prefix + name: values for name, values in first.items() if name.startswith("model.")}
            tensors[f"{prefix}actions"] = actions[steps, e.env]
            tensors[f"{prefix}rewards"] = torch.stack(self._rewards[steps])[:, e.env]
        write_trajectory(file, Header.of(self._env).model_copy(update={"episodes": episodes}), tensors)
