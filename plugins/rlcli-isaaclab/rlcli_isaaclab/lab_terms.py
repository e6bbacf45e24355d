"""Terms of Isaac Lab that are written here in its form, because no built-in term of rlcli has their parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor


@dataclass(frozen=True, slots=True)
class LabTerm:
    """A term in Isaac Lab's form."""

    function: Any
    needed: Callable[[Mapping[str, Any]], bool]
    """Whether these parameters need the function; otherwise the built-in term of the same name is used."""


def last_action_of_term(env: Any, action_name: str) -> Tensor:
    """Last raw action of one action term. (num_envs, k)"""
    return env.action_manager.get_term(action_name).raw_actions


LAB_TERMS: dict[str, LabTerm] = {
    "last_action": LabTerm(last_action_of_term, lambda params: params.get("action_name") is not None),
}
"""Isaac Lab's name -> term."""
