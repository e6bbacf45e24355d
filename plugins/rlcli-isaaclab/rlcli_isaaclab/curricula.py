"""Curriculum terms that change the setting at an address in the configuration.

A task of Isaac Lab that imports a name from `isaaclab.envs.mdp` gets the object of this name from here.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from rlcli_isaaclab.managers import ManagerTermBase

_SECTION = re.compile(r"^(\w+?)s?(?:_manager\.cfg)?\.")


class modify_env_param(ManagerTermBase):  # noqa: N801  (Isaac Lab's name)
    """Curriculum term that changes a setting: its new value is `modify_fn(env, env_ids, value, **modify_params)`."""

    NO_CHANGE: ClassVar[object] = object()
    """Value that `modify_fn` returns to leave the setting unchanged."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        self._setting: ChangedSetting = cfg.setting
        self._value = torch.tensor(self._setting.start, dtype=torch.float64)

    def __call__(self, env: Any, env_ids: Any, modify_fn: Any, modify_params: Any = None, **opened: Tensor) -> None:
        """Change the setting, at the resets of the environments `env_ids`.

        Args:
            env: environment, with Isaac Lab's interface.
            env_ids: indices of the environments that reset.
            modify_fn: function that returns the new value, or NO_CHANGE.
            modify_params: further arguments of `modify_fn`; None: none.
            opened: tensors of rlcli's settings that depend on this setting; they are changed in place.
        """
        value = _in_form_of(self._setting.start, self._value.tolist())
        new = modify_fn(env, env_ids, value, **(modify_params or {}))
        if new is self.NO_CHANGE:
            return
        self._value = torch.tensor(new, dtype=torch.float64)
        if self._setting.addresses:
            for (key, _), number in zip(self._setting.addresses, self._setting.translate(new), strict=True):
                opened[key].copy_(torch.as_tensor(number, dtype=torch.float32))
        else:
            self._setting.write(env, new)


class modify_term_cfg(modify_env_param):  # noqa: N801  (Isaac Lab's name)
    """`modify_env_param` with an address that starts with a section: `events.NAME.params.KEY`."""


class ChangedSetting:
    """A setting of one of Isaac Lab's terms, and the settings of rlcli that depend on it.

    Args:
        data: settings of all sections, as nested dicts.
        address: Isaac Lab's address of the setting, such as `event_manager.cfg.NAME.params.KEY`.
        read: function that translates a term: (section, path of the term in the section, settings of the term) ->
            (path, settings) of each term of rlcli that replaces it.

    Raises:
        KeyError: if no setting has the address, or its value is neither a number nor a list of numbers.
    """

    def __init__(
        self, data: Mapping[str, Any], address: str, read: Callable[[str, list[str], Mapping[str, Any]], Any]
    ) -> None:
        match = _SECTION.match(address)
        if match is None or f"{match[1]}s" not in data:
            raise KeyError(address)
        self.section = f"{match[1]}s"
        parts = re.sub(r"\[(\d+)\]", r".\1", address[match.end() :]).split(".")
        depth = 2 if self.section == "observations" else 1
        self.term, self.path = parts[:depth], parts[depth:]
        settings: Any = data[self.section]
        for part in self.term:
            settings = settings[part]
        self._settings, self._read = settings, read
        self.start = _get(settings, self.path)
        if not _is_numeric(self.start):
            raise KeyError(address)
        self.is_own = False
        """Whether the term runs the task's own code, which receives Isaac Lab's value instead of a translated one."""
        changed = set(self._numbers(_with_numbers_changed(self.start)).items()) - set(self._numbers(self.start).items())
        names = sorted(name for name, _ in changed)
        self.addresses = [(f"address_{index}", name) for index, name in enumerate(names)]
        """Pairs: a parameter of the curriculum term, and the address of a setting of rlcli, such as
        `rewards.alive.weight`, that changes with the value."""

    def translate(self, value: Any) -> list[Any]:
        """Return the values of rlcli's settings for a value of Isaac Lab's setting, in the order of `addresses`."""
        found = self._numbers(value)
        return [found[name] for _, name in self.addresses]

    def write(self, env: Any, value: Any) -> None:
        """Write a value into the settings of the term, for a term that runs the user's own code."""
        bound = env.managed._bound.get(self.section, [])
        if self.section == "observations":
            bound = env.managed._observations[self.term[0]]
        call = next(term.call for term in bound if term.name == self.term[-1])
        if self.path[0] == "params":
            _set(call.params, self.path[1:], value)
        else:
            _set(call.term.cfg, self.path, value)

    def _numbers(self, value: Any) -> dict[str, Any]:
        """Translate the term with a value of the setting; return the numbers in rlcli's terms, by address."""
        settings = copy.deepcopy(self._settings)
        _set(settings, self.path, value)
        found: dict[str, Any] = {}
        for path, config in self._read(self.section, self.term, settings):
            self.is_own = not isinstance(config["func"], str)
            if self.is_own and self.path[0] not in ("weight", "noise", "scale", "clip"):
                continue  # the user's own term gets the value itself
            found.update(_flat(config, path))
        return found


def _flat(value: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from _flat(item, f"{path}.{name}")
    elif _is_numeric(value):
        yield path, _as_tuple(value)


def _as_tuple(value: Any) -> Any:
    return tuple(map(_as_tuple, value)) if isinstance(value, list | tuple) else value


def _is_numeric(value: Any) -> bool:
    """Return whether a value is a number, or a list of numbers."""
    if isinstance(value, list | tuple):
        return bool(value) and all(map(_is_numeric, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def _with_numbers_changed(value: Any) -> Any:
    """Return a setting with 1 added to each of its numbers.

    The class translates the term with the original and with this value: settings of rlcli that then differ depend on
    the setting.
    """
    if isinstance(value, list | tuple):
        return type(value)(_with_numbers_changed(item) for item in value)
    return value + 1.0


def _in_form_of(form: Any, value: Any) -> Any:
    """Return a value with the types of `form`: lists or tuples, integers or floats."""
    if isinstance(form, list | tuple):
        return type(form)(_in_form_of(a, b) for a, b in zip(form, value, strict=True))
    return value if isinstance(form, float) or value != int(value) else type(form)(value)


def _get(value: Any, path: list[str]) -> Any:
    for part in path:
        value = value[int(part)] if isinstance(value, list | tuple) else _member(value, part)
    return value


def _member(value: Any, name: str) -> Any:
    return value[name] if isinstance(value, Mapping) else getattr(value, name)


def _set(target: Any, path: list[str], value: Any) -> None:
    """Set the value at a path in nested objects, dicts and lists; a tuple on the path is replaced by a changed copy."""
    name = path[0]
    if len(path) > 1:
        inner = target[int(name)] if isinstance(target, list) else _member(target, name)
        if isinstance(inner, tuple):
            inner = list(inner)
            _set(inner, path[1:], value)
            value = tuple(inner)
        else:
            _set(inner, path[1:], value)
            return
    if isinstance(target, list):
        target[int(name)] = value
    elif isinstance(target, dict):
        target[name] = value
    else:
        setattr(target, name, value)
