"""Modifiers and noise of observations that a task defines itself. They act before rlcli clips and scales a term."""

from __future__ import annotations

import copy
import dataclasses
import functools
import importlib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rlcli.config.term_signatures import Signature, builtin_terms
from rlcli.sim.env_selection import Selection
from rlcli_isaaclab.settings import Key, Node
from rlcli_isaaclab.utils.buffers import call_without_effects, set_tensors, tensors_of


def is_own(function: Any) -> bool:
    """Return whether a modifier or a noise is a function or class of the task, and not one of this package."""
    return callable(function) and not str(getattr(function, "__module__", "")).startswith("rlcli_isaaclab")


def take_own_processing(node: Node) -> tuple[int, bool]:
    """Return (number of modifiers, whether noise) that `ProcessedTerm` must apply; remove these keys from `node`.

    Noise acts after the modifiers. So if the noise is the task's own, `ProcessedTerm` applies all modifiers too.
    """
    found, modifiers = node.data.get("noise"), node.data.get("modifiers") or []
    noise: dict[str, Any] = found if isinstance(found, dict) else {}
    kind = noise.get("class_type")
    has_noise = is_own(kind if kind is not None else noise.get("func"))
    if kind is not None and not has_noise:
        parts = (noise.get("noise_cfg"), noise.get("bias_noise_cfg"))
        has_noise = any(is_own(part.get("func")) for part in parts if isinstance(part, dict))
    own = [number for number, item in enumerate(modifiers, 1) if is_own(item.get("func"))]
    count = len(modifiers) if has_noise else max(own, default=0)
    changes: dict[str, Any] = {"modifiers": list(modifiers)[count:]} if count else {}
    if has_noise:
        changes["noise"] = None
    for key in changes:
        node.report.entries[(*node.key, key)] = ("mapped", "")
    node.data = {**node.data, **changes}
    return count, has_noise


def call_once_per_step(managed: Any, holders: list[Any], function: Callable[[], Tensor]) -> Tensor:
    """Call an observation function and return its value; an additional call in a step does not change any state.

    Additional calls compute the last observation of an episode, or the observation of a restored checkpoint. After such
    a call the state of the objects `holders` is restored.
    """
    manager = getattr(managed, "observation_manager", None)
    return call_without_effects(holders, function) if getattr(manager, "repeats_calls", False) else function()


class ProcessedTerm:
    """Observation term that applies the task's own modifiers and noise to the value of another term.

    Args:
        inner: the term that computes the value: the name of a built-in one, or a `UserTerm`.
        key: path of the term in Isaac Lab's configuration.
        count: number of modifiers to apply, from the first one.
        has_noise: whether to apply the noise.
        context: the task's configuration.
    """

    def __init__(self, inner: Any, key: Key, count: int, has_noise: bool, context: Any) -> None:
        self.inner, self.key, self.count, self.has_noise, self.context = inner, key, count, has_noise, context
        self.__name__ = inner if isinstance(inner, str) else inner.__name__
        self.__module__ = getattr(inner, "__module__", __name__)

    def __deepcopy__(self, memo: Any) -> ProcessedTerm:
        return self

    def __call__(self, *args: Any) -> Any:
        """Raise a TypeError: only a term that is bound to an environment can be called."""
        raise TypeError(f"the observation {self.__name__} cannot be called before it is bound to an environment")

    def __rlcli_term__(self, name: str) -> Signature:
        """Return the signature of the inner term; `name` is the term's key in the task."""
        if isinstance(self.inner, str):
            signature = builtin_terms("observations")[self.inner]
            target = getattr(importlib.import_module(signature.module), signature.attribute)
        else:
            signature = self.inner.__rlcli_term__(name)
            target = signature.target
        make = target if signature.is_class else functools.partial(functools.partial, target)
        bind = functools.partial(_BoundProcessed, self, make)
        bind.reads_body_forces = getattr(target, "reads_body_forces", False)  # type: ignore[attr-defined]
        return dataclasses.replace(signature, is_class=True, target=bind)


class _BoundProcessed:
    """A `ProcessedTerm` in one environment."""

    def __init__(self, term: ProcessedTerm, make: Any, env: Any, **params: Any) -> None:
        self._inner, self._managed = make(env, **params), env
        cfg = term.context.cfg
        for part in term.key:
            cfg = getattr(cfg, part)
        self._cfg = copy.deepcopy(cfg)
        self._modifiers = (self._cfg.modifiers or [])[: term.count]
        group = term.key[1]
        self._noise = self._cfg.noise if term.has_noise and env.config.observations[group].enable_corruption else None
        self._objects: dict[str, Any] = {}
        """Modifiers and noise with a state, by name; created for the shape of the first value."""
        self._shape: tuple[int, ...] | None = None

    def __call__(self) -> Tensor:
        return call_once_per_step(self._managed, list(self._objects.values()), self._compute)

    def _compute(self) -> Tensor:
        value: Tensor = self._inner().clone()
        is_first = self._shape is None
        if is_first:
            self._create(tuple(value.shape))
        for number, modifier in enumerate(self._modifiers):
            value = self._objects.get(f"modifier_{number}", modifier.func)(value, **modifier.params)
        if "noise" in self._objects:
            value = self._objects["noise"](value)
        elif self._noise is not None:
            value = self._noise.func(value, self._noise)
        if is_first:  # rlcli calls a term before the first reset, to find its shape
            self._reset(torch.arange(self._managed.num_envs, device=self._managed.device))
        return value

    def _create(self, shape: tuple[int, ...]) -> None:
        self._shape, device = shape, self._managed.device
        for number, modifier in enumerate(self._modifiers):
            if isinstance(modifier.func, type):
                self._objects[f"modifier_{number}"] = modifier.func(modifier, shape, str(device))
        class_type = getattr(self._noise, "class_type", None)
        if isinstance(class_type, type):
            self._objects["noise"] = class_type(self._noise, num_envs=self._managed.num_envs, device=str(device))

    def _reset(self, env_ids: Any) -> None:
        for item in self._objects.values():
            if hasattr(item, "reset"):
                item.reset(env_ids)

    def reset(self, selection: Selection) -> None:
        """Reset the inner term, the modifiers and the noise in the environments whose episode starts."""
        if hasattr(self._inner, "reset"):
            self._inner.reset(selection)
        self._reset(selection.env_ids())

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the tensors of the inner term, the modifiers and the noise, by name."""
        state = {f"term.{k}": v for k, v in self._inner.state_dict().items()} if hasattr(self._inner, "reset") else {}
        for name, item in self._objects.items():
            state |= {f"{name}.{path}": value.clone() for path, value in tensors_of(item).items()}
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors returned by `state_dict`."""
        parts: dict[str, dict[str, Tensor]] = {}
        for path, value in state.items():
            name, _, rest = path.partition(".")
            parts.setdefault(name, {})[rest] = value
        for name, tensors in parts.items():
            if name == "term":
                self._inner.load_state_dict(tensors)
            else:
                set_tensors(self._objects[name], tensors)
