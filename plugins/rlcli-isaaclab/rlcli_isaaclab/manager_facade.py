"""Adapters that give rlcli's managers Isaac Lab's interface, for terms of the user.

For example, a term may call `env.command_manager.get_command("pose")`.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType, SimpleNamespace
from typing import Any

from torch import Tensor

from rlcli.errors import did_you_mean, listing
from rlcli.scene.names import NameProblem
from rlcli_isaaclab.missing_names import absence, user_place


class ManagerFacade:
    """Base class of the adapters: a manager of rlcli with the attributes of Isaac Lab's managers."""

    def __init__(self, manager: Any) -> None:
        self._manager = manager

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._manager, name)

    @property
    def active_terms(self) -> list[str]:
        """Names of the terms, in order."""
        return [term.name for term in self._manager.terms]

    @property
    def cfg(self) -> Any:
        """Settings of the terms by name: `func` is the function or the user's object, `params` has the parameters."""
        return SimpleNamespace(
            **{
                term.name: SimpleNamespace(
                    func=getattr(term.call, "term", term.call), params=getattr(term.call, "params", {})
                )
                for term in self._manager.terms
            }
        )


class ActionManagerFacade(ManagerFacade):
    """Action manager with Isaac Lab's attributes."""

    @property
    def total_action_dim(self) -> int:
        """Number of columns of the policy's action, of all action terms together."""
        return self._manager.size

    def get_term(self, name: str) -> Any:
        """Return an action term; its `processed_actions` are the commands to the joints."""
        return ActionTermFacade(_find_term(self._manager.terms, name, "action"), self._manager)


_ACTION_NAMES = {"_joint_ids": "joints", "_joint_names": "elements", "action_dim": "size"}
"""Attribute of Isaac Lab's joint actions -> attribute of rlcli's."""


class ActionTermFacade:
    """An action term with Isaac Lab's attributes."""

    def __init__(self, term: Any, manager: Any) -> None:
        self._term, self._manager = term, manager

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        holders = (self._term, getattr(self._term, "term", None))  # the second one is the user's object
        for holder in holders:
            found = getattr(holder, _ACTION_NAMES.get(name, name), None)
            found = getattr(holder, name, None) if found is None else found
            if found is not None:
                return found
        known = sorted({n for holder in holders for n in dir(holder) if not n.startswith("_")} | set(_ACTION_NAMES))
        hint = did_you_mean(name, known) or f"its attributes: {listing(known, 40)}"
        raise AttributeError(f"{user_place()}an action of rlcli has no '{name}'; {hint}")

    @property
    def raw_actions(self) -> Tensor:
        """The policy's actions for this term. (num_envs, k)"""
        start = 0
        for bound in self._manager.terms:
            if bound.instance is self._term:
                return self._manager.action[:, start : start + bound.instance.size]
            start += bound.instance.size
        raise LookupError("the action term does not belong to this environment")


class ObservationManagerFacade(ManagerFacade):
    """Observation manager with Isaac Lab's attributes."""

    @property
    def active_terms(self) -> Any:
        """Names of the terms of each group, in order."""
        return {name: [p.term.name for p in group.pipelines] for name, group in self._manager.groups.items()}


class TerminationManagerFacade(ManagerFacade):
    """Termination manager with Isaac Lab's attributes."""

    @property
    def dones(self) -> Tensor:
        """Where the episode ended in this step, by a termination or by time-out. (num_envs,) bool"""
        return self._manager.terminated | self._manager.time_outs

    def get_term(self, name: str) -> Tensor:
        """Return where the termination `name` ended the episode in this step. (num_envs,) bool"""
        fired = self._manager.fired
        if name not in fired:
            raise NameProblem(f"no termination '{name}'; terminations: {listing(fired)}")
        return fired[name]


class CommandManagerFacade(ManagerFacade):
    """Command manager with Isaac Lab's attributes."""

    def get_command(self, name: str) -> Tensor:
        """Return the current command of the term `name`. (num_envs, k)"""
        return _find_term(self._manager.terms, name, "command").command

    def get_term(self, name: str) -> Any:
        """Return a command term; for the user's own command, the user's object."""
        term = _find_term(self._manager.terms, name, "command")
        return term.term if hasattr(term, "term") else BuiltinCommand(term)


class BuiltinCommand:
    """Command term of rlcli in place of Isaac Lab's `CommandTerm`, for example a velocity command.

    Reading an attribute that rlcli's term does not have raises a TaskError with a hint.
    """

    def __init__(self, term: Any) -> None:
        self._term = term

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if not hasattr(self._term, name):
            hint = "call `env.command_manager.get_term(...)` in the file of a term, where rlcli looks for the call"
            raise absence(f"attribute '{name}' of the built-in command", hint=hint)
        return getattr(self._term, name)


class RewardManagerFacade(ManagerFacade):
    """Reward manager with Isaac Lab's attributes."""

    def __init__(self, manager: Any, tunable: Any) -> None:
        super().__init__(manager)
        self._tunable = tunable

    def get_term_cfg(self, name: str) -> Any:
        """Return the settings of the reward `name`. A weight that is assigned to them takes effect in the next step."""
        found = {term.name: term for term in self._manager.terms}
        if name not in found:
            raise NameProblem(f"no reward '{name}'", did_you_mean(name, found) or f"rewards: {listing(found)}")
        return RewardSettings(found[name].config, self._tunable, (*found[name].path, "weight"))

    @property
    def _episode_sums(self) -> dict[str, Tensor]:
        """Sums of the weighted terms over the running episodes. (num_envs,) each"""
        return {term.name: row for term, row in zip(self._manager.terms, self._manager._sums, strict=True)}

    def set_term_cfg(self, name: str, cfg: Any) -> None:
        """Set the weight of the reward `name` to `cfg.weight`; other settings are not changed."""
        self.get_term_cfg(name).weight = cfg.weight


class RewardSettings:
    """Settings of a reward term. Only the weight can be changed, and only by a curriculum term."""

    def __init__(self, config: Any, tunable: Any, path: tuple[Any, ...]) -> None:
        self._config, self._tunable, self._path = config, tunable, path
        self.params: Mapping[str, Any] = MappingProxyType(config.params)

    @property
    def weight(self) -> float:
        """Weight of the reward term, which a curriculum may change."""
        weight = self._tunable.get(self._path)
        return self._config.weight if weight is None else float(weight)

    @weight.setter
    def weight(self, value: float) -> None:
        weight = self._tunable.get(self._path)
        if weight is None:
            raise AttributeError("the weight of a reward can change only in a curriculum term; write one")
        weight.fill_(value)


def _find_term(terms: Any, name: str, kind: str) -> Any:
    found = {term.name: term.instance for term in terms}
    if name not in found:
        raise NameProblem(f"no {kind} '{name}'; {kind}s: {listing(found)}")
    return found[name]
