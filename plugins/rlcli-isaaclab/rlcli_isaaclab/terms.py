"""Terms written for Isaac Lab, `(env, target, asset_cfg)`, as terms of rlcli: bound once, called without arguments."""

from __future__ import annotations

import functools
import inspect
import typing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from rlcli.config.schema import Names, Number, StrictModel
from rlcli.config.term_signatures import SECTIONS, Parameter, Signature, SignatureError
from rlcli.sim.selection import Selection
from rlcli_isaaclab.managers import ManagerTermBaseCfg, SceneEntityCfg

_RESERVED = {name for model in SECTIONS.values() for name in model.model_fields} | {"params"}
_PLAIN: dict[Any, Any] = {float: Number, int: int, bool: bool, str: str}


class EntityModel(StrictModel):
    """A `SceneEntityCfg` as it is written to a file."""

    name: str
    """Name of an entity or sensor."""
    joint_names: Names | None = None
    """Names or regexes of joints; null: all."""
    body_names: Names | None = None
    """Names or regexes of bodies; null: all."""
    preserve_order: bool = False
    """The order written instead of the model's."""


class OwnTerm:
    """A function or class of the user's, in one section of the configuration."""

    def __init__(self, function: Any, section: str, entities: frozenset[str], extra: tuple[str, ...]) -> None:
        self.function, self.section = function, section
        self.is_class = isinstance(function, type)
        self.__name__, self.__module__ = function.__name__, function.__module__
        self.target = functools.partial(_bind, self)
        call = function.__call__ if self.is_class else function
        given = list(inspect.signature(call).parameters.values())
        self._skip = (1 if self.is_class else 0) + (2 if section == "events" or section == "curriculum" else 1)
        if len(given) < self._skip and not any(p.kind is p.VAR_POSITIONAL for p in given):
            wanted = "(env, env_ids, ...)" if self._skip - self.is_class == 2 else "(env, ...)"
            raise SignatureError(f"a term of {section} takes {wanted}")
        hints = _hints(call)
        named = [p for p in given[self._skip :] if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
        self.parameters = [self._parameter(p, hints.get(p.name), entities) for p in named]
        if any(p.kind is p.VAR_KEYWORD for p in given):
            known = {p.name for p in named}
            self.parameters += [
                Parameter(key_of(name), EntityModel if name in entities else Any, None, True, None)
                for name in extra
                if name not in known
            ]
        self.original = {key_of(p.name): p.name for p in named} | {key_of(name): name for name in extra}

    def __deepcopy__(self, memo: Any) -> OwnTerm:
        return self

    def __call__(self, *args: Any, **params: Any) -> Any:
        """What the function gives."""
        return self.function(*args, **params)

    def __rlcli_term__(self, name: str) -> Signature:
        """The signature of the term under a name."""
        code = getattr(self.function, "__code__", None)
        file = Path(inspect.getsourcefile(self.function) or "?")
        summary = (inspect.getdoc(self.function) or "").split("\n")[0]
        line = code.co_firstlineno if code else 1
        return Signature(name, self.__name__, True, file, line, summary, tuple(self.parameters), target=self.target)

    def _parameter(self, p: inspect.Parameter, hint: Any, entities: frozenset[str]) -> Parameter:
        entity = hint is SceneEntityCfg or p.name in entities or isinstance(p.default, SceneEntityCfg)
        kind = EntityModel if entity else _PLAIN.get(hint, Any)
        required = p.default is inspect.Parameter.empty
        default = None if required else p.default
        if isinstance(default, SceneEntityCfg):
            default = EntityModel.model_validate(entity_data(vars(default)))
        elif kind in _PLAIN.values() and default is None and not required:
            kind = kind | None
        return Parameter(key_of(p.name), kind, default, required, None)


class OwnCommand:
    """A class of the user's that draws a command, `Name(cfg, env)`, as the command term of one name."""

    def __init__(self, function: Any, name: str, settings: tuple[str, ...]) -> None:
        self.function, self.name = function, name
        self.__name__, self.__module__ = function.__name__, function.__module__
        self.target = functools.partial(_bind_command, self)
        self.original = {key_of(key): key for key in settings}

    def __deepcopy__(self, memo: Any) -> OwnCommand:
        return self

    def __call__(self, *args: Any) -> Any:
        """The class's object."""
        return self.function(*args)

    def __rlcli_term__(self, name: str) -> Signature:
        """The signature of the term under a name: the settings of its configuration."""
        file = Path(inspect.getsourcefile(self.function) or "?")
        summary = (inspect.getdoc(self.function) or "").split("\n")[0]
        parameters = tuple(Parameter(key, Any, None, True, None) for key in self.original)
        return Signature(name, self.__name__, True, file, 1, summary, parameters, target=self.target)


def key_of(name: str) -> str:
    """The key of a parameter: its name, unless all terms of some section have a key of that name."""
    return f"{name}_" if name in _RESERVED else name


@functools.cache
def own_term(function: Any, section: str, entities: frozenset[str], extra: tuple[str, ...]) -> OwnTerm:
    """The term that a function is; the same one each time."""
    return OwnTerm(function, section, entities, extra)


def entity_data(given: Any) -> dict[str, Any]:
    """What a `SceneEntityCfg` says, without what it leaves open.

    Raises:
        ValueError: for elements that MuJoCo's entities do not have.
    """
    for key in ("fixed_tendon_names", "object_collection_names"):
        if given.get(key) is not None:
            raise ValueError(f"{key} has no counterpart in MuJoCo")
    data = {"name": given["name"]}
    for key in ("joint_names", "body_names"):
        if given.get(key) is not None:
            value = given[key]
            data[key] = value if isinstance(value, str) else list(value)
    if given.get("preserve_order"):
        data["preserve_order"] = True
    return data


class _Bound:
    """A function in its environment."""

    def __init__(self, function: Any, section: str, env: Any, params: dict[str, Any]) -> None:
        self.term, self._section, self._env, self._params = function, section, env, params

    def __call__(self, selection: Selection | None = None) -> Any:
        if selection is not None:
            value = self.term(self._env, selection.env_ids(), **self._params)
            return (
                next(iter(value.values()), None) if isinstance(value, dict) else value
            )  # of several to log, the first
        value = self.term(self._env, **self._params)
        return value.bool() if self._section == "terminations" and value.dtype != torch.bool else value


class _BoundClass(_Bound):
    """An object in its environment; its tensors are saved with a checkpoint."""

    def reset(self, selection: Selection) -> None:
        """Episodes begin."""
        if hasattr(self.term, "reset"):
            self.term.reset(selection.env_ids())

    def state_dict(self) -> dict[str, Tensor]:
        """The object's tensors."""
        return _tensors_of(self.term)

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back what `state_dict` gave."""
        _take_back(self.term, state)


class _BoundCommand:
    """A command of the user's in its environment."""

    def __init__(self, term: Any) -> None:
        self.term = term
        self.command = term.command.clone().float()
        self._begun = False

    def resample(self, selection: Selection) -> None:
        """Draw new commands."""
        env_ids = selection.env_ids()
        self.term._resample_command(env_ids)
        self.term.command_counter[env_ids] += 1
        self.command.copy_(self.term.command)
        self._begun = True

    def update(self) -> None:
        """Once a step."""
        self.term._update_command()
        self.command.copy_(self.term.command)

    def metrics(self) -> dict[str, Tensor]:
        """What the command measures of itself. (num_envs,) each"""
        if self._begun:
            self.term._update_metrics()
        return dict(self.term.metrics)

    def reset(self, selection: Selection) -> None:
        """Episodes begin."""
        self.term.reset(selection.env_ids())

    def state_dict(self) -> dict[str, Tensor]:
        """The object's tensors."""
        return _tensors_of(self.term)

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back what `state_dict` gave."""
        _take_back(self.term, state)
        self._begun = True


def _bind_command(term: OwnCommand, env: Any, **params: Any) -> _BoundCommand:
    from rlcli_isaaclab.runtime import facade_of

    settings = {term.original[key]: _settings(value) for key, value in params.items()}
    times = list(env.config.commands[term.name].resampling_time_s)
    cfg = SimpleNamespace(class_type=term.function, debug_vis=False, resampling_time_range=times, **settings)
    return _BoundCommand(term.function(cfg, facade_of(env)))


def _settings(value: Any) -> Any:
    """Nested mappings whose keys are names as objects with members; any other as it is."""
    if isinstance(value, dict) and all(str(key).isidentifier() for key in value):
        return SimpleNamespace(**{key: _settings(item) for key, item in value.items()})
    return value


def _tensors_of(term: Any) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in vars(term).items() if isinstance(value, Tensor)}


def _take_back(term: Any, state: dict[str, Tensor]) -> None:
    for name, value in state.items():
        setattr(term, name, value.clone())


def _bind(term: OwnTerm, env: Any, **params: Any) -> _Bound:
    from rlcli_isaaclab.runtime import facade_of

    facade = facade_of(env)
    if term.section == "curriculum":
        facade.open_weights()  # it may change them, and what reads them is made after this
    values: dict[str, Any] = {}
    for key, value in params.items():
        if isinstance(value, EntityModel):
            value = SceneEntityCfg(**value.model_dump())
            facade.scene.resolve(value)
        values[term.original[key]] = value
    if not term.is_class:
        return _Bound(term.function, term.section, facade, values)
    made = term.function(ManagerTermBaseCfg(func=term.function, params=values), facade)
    return _BoundClass(made, term.section, facade, values)


def _hints(call: Any) -> dict[str, Any]:
    try:
        return typing.get_type_hints(call)
    except Exception:  # a name that is imported for type checkers only
        words = {"float": float, "int": int, "bool": bool, "str": str, "SceneEntityCfg": SceneEntityCfg}
        return {n: words.get(a) if isinstance(a, str) else a for n, a in getattr(call, "__annotations__", {}).items()}
