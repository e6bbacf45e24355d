"""Translation of `obs_groups` of an RSL-RL runner, the observation groups that actor and critic read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlcli.errors import ConfigError, Problem, listing
from rlcli.formats import Note

_RANDOM = ("noise", "bias", "delay")
"""Keys of a term that `enable_corruption: false` of its group switches off."""


def fit_groups(
    sets: Mapping[str, Any], agent: dict[str, Any], observations: Mapping[str, Any], notes: list[Note]
) -> None:
    """Set the keys `critic_obs` and `task` of an agent, so that its networks read the groups of `obs_groups`.

    rlcli's actor reads only the group `policy`. If `obs_groups` gives the actor other groups, their terms are added to
    `policy`; without `policy` among them, its own terms are removed.

    Args:
        sets: `obs_groups`: `policy` (or `actor`) and `critic` -> names of groups.
        agent: settings of the agent.
        observations: the groups of the task.
        notes: list that receives how keys were translated.

    Raises:
        ConfigError: if the task does not have a group.
    """
    actor, critic = (_names(sets, observations, *keys) for keys in (("actor", "policy"), ("critic",)))
    if critic:
        agent["critic_obs"] = critic
    if not actor or actor == ["policy"]:
        return
    agent["task"] = {"observations": {"policy": _merged(actor, observations)}}
    if critic:
        agent["critic_obs"] = list(dict.fromkeys("policy" if name in actor else name for name in critic))
        if "policy" in agent["critic_obs"] and not set(actor) <= set(critic):
            notes.append(
                Note("", "agent.obs_groups.critic", "approximated", "the critic reads all groups of the actor")
            )


def _names(sets: Mapping[str, Any], observations: Mapping[str, Any], *keys: str) -> list[str]:
    """Return the group names under the first of the `keys` that `sets` has; an empty list if it has none of them."""
    key = next((key for key in keys if sets.get(key)), None)
    found = list(sets[key]) if key is not None else []
    # the group `actor` of a file is the group `policy` of rlcli
    names = ["policy" if name == "actor" and "actor" not in observations else str(name) for name in found]
    for name in names:
        if name not in observations:
            message = f"no observation group '{name}'"
            raise ConfigError(
                [Problem("configuration", f"obs_groups.{key}", message, f"groups: {listing(observations)}")]
            )
    return names


def _merged(groups: list[str], observations: Mapping[str, Any]) -> dict[str, Any]:
    """Return one observation group with the terms of several groups; each term keeps the settings of its group."""
    merged: dict[str, Any] = {"enable_corruption": True, "history": None}
    if "policy" not in groups:
        merged |= dict.fromkeys(_terms(observations["policy"]))
    taken: set[str] = set()
    for group in groups:
        settings = observations[group]
        for name, term in _terms(settings).items():
            entry = dict(term)
            if settings.get("history") is not None:
                entry["history"] = settings["history"]
            if not settings.get("enable_corruption", True):
                entry |= dict.fromkeys(key for key in _RANDOM if key in entry)
            unique = f"{group}_{name}" if name in taken or (group != "policy" and name in merged) else name
            taken.add(unique)
            merged[unique] = entry
    return merged


def _terms(group: Mapping[str, Any]) -> dict[str, Any]:
    return {name: term for name, term in group.items() if isinstance(term, Mapping) and "func" in term}
