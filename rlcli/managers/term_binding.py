"""Binding of terms to the compiled model, when the environment is built.

To bind a term is to create it from its configuration: names of entities, joints and so on in its parameters are
replaced by objects and indices, and the result is a `BoundTerm`.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from rlcli.config.load import Resolved
from rlcli.config.schema import TermConfig
from rlcli.config.strict_yaml import Path
from rlcli.config.term_signatures import SELECTORS, Signature
from rlcli.errors import ConfigError, DivergedError, Problem, ShapeError, TaskError, did_you_mean, listing, short_error
from rlcli.managers.attribute_state import AttributeState
from rlcli.managers.curriculum_values import TunableValues
from rlcli.random import stream
from rlcli.registry import is_framework, load_module
from rlcli.scene.entity import Entity
from rlcli.scene.names import NameProblem
from rlcli.scene.sensors import Sensor
from rlcli.sim.engine import Engine
from rlcli.sim.env_selection import Selection

SENSORS = {"ContactSensor": "contact", "RaySensor": "rays", "CameraSensor": "camera"}
"""Type of a term's parameter (an alias in `rlcli.task`) -> kind of the sensors in `scene.sensors` that it accepts."""


@dataclass(frozen=True, slots=True)
class BoundTerm:
    """Configured term whose parameters are objects and indices instead of names.

    A manager gets the term's value by `call()`, and runs an event or a curriculum term by `call(selection)`.
    """

    name: str
    """Name of the term in the YAML."""
    path: Path
    """Path of the term in the configuration, such as `("rewards", "alive")`."""
    config: TermConfig
    resolved: Resolved
    """The configuration of the task."""
    call: Callable[..., Any]
    elements: dict[str, list[str]]
    """Parameter that selects elements (`joints`, `bodies`, ...) -> names of the selected elements."""
    stream: np.uint64
    """Index of the term's random stream."""
    memory: AttributeState | None = None
    """Object that saves the term's attributes in checkpoints, for a class in the task's code without `state_dict`.

    None for other terms, which have a `state_dict` or no state."""

    @property
    def instance(self) -> Any:
        """The term itself: an object if the term is a class, else the function with its parameters."""
        return self.call

    def error(self, message: str, *keys: str) -> ShapeError:
        """Return a ShapeError whose place is the term in the YAML; with `keys`, the setting below these keys."""
        return ShapeError([self.resolved.problem((*self.path, *keys), message)])

    def require_finite(self, values: Tensor, what: str) -> None:
        """Check that values of the term are finite; `what` is their name in the message. values (num_envs, ...)

        Raises:
            DivergedError: with the number of environments that have a value that is not finite, and the first of them.
        """
        bad = ~values.isfinite().flatten(1).all(dim=1) if values.dim() > 1 else ~values.isfinite()
        if bool(bad.any()):
            raise DivergedError(
                f"{what} ({self.config.func}) is not finite in {int(bad.sum())} of {len(bad)} environments, first in"
                f" environment {int(bad.nonzero()[0, 0])}; look for divisions by 0, roots and logarithms"
            )

    def state_dict(self) -> dict[str, Tensor]:
        """Return the tensors that the term keeps from step to step; empty for a term without state."""
        if hasattr(self.call, "state_dict"):
            state: dict[str, Tensor] = self.call.state_dict()
            return state
        return {} if self.memory is None else self.memory.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`."""
        if hasattr(self.call, "load_state_dict"):
            self.call.load_state_dict(state)
        elif self.memory is not None:
            self.memory.load_state_dict(state)


@dataclass(frozen=True, slots=True)
class EnvContext:
    """Parts of an environment that its managers use."""

    num_envs: int
    step_dt: float
    device: torch.device
    engine: Engine
    tunable: TunableValues
    select_all: Callable[[], Selection]
    """Return a selection of all environments, whose random numbers depend on the training step."""

    def zeros(self, *shape: int) -> Tensor:
        """Return a tensor of zeros with a row for each environment. (num_envs, *shape)"""
        return torch.zeros(self.num_envs, *shape, device=self.device)


class TermEnv(Protocol):
    """Interface of the environment for `Binder`; the terms receive the same object as their parameter `env`."""

    device: torch.device

    @property
    def entities(self) -> Mapping[str, Entity]:
        """Entities of the scene by name."""

    @property
    def sensors(self) -> Mapping[str, Sensor]:
        """Sensors of the scene by name."""


class Binder:
    """Resolver of the names in the terms of one environment; problems are collected, and raised all at once."""

    def __init__(self, env: TermEnv, resolved: Resolved) -> None:
        self.env = env
        self.resolved = resolved
        self.problems: list[Problem] = []
        self.tunable = TunableValues(resolved.task, env.device)
        self._commands: dict[str, BoundTerm] = {}
        self._open_addresses()

    def bind(self, section: str, path: Path, config: TermConfig) -> BoundTerm | None:
        """Return a term with its names resolved to objects and indices; None, with a problem, if a name is unknown."""
        signature = self.signature(section, config)
        params, elements = self._resolve(signature, path, config)
        if params is None:
            return None
        target = self.load(signature)
        try:
            call = target(self.env, **params) if signature.is_class else functools.partial(target, self.env, **params)
        except (NameProblem, ValueError) as problem:
            self.add_problem(path, str(problem), getattr(problem, "hint", None))
            return None
        except AttributeError:
            if not self.problems:
                raise
            return None  # a manager is absent because of a problem of its terms, which is reported with all others
        name = str(path[-1])
        own = signature.is_class and not hasattr(call, "state_dict") and not is_framework(type(call).__module__)
        memory = AttributeState(call) if own else None
        draws = stream(".".join(str(step) for step in path))
        return BoundTerm(name, path, config, self.resolved, call, elements, draws, memory)

    def signature(self, section: str, config: TermConfig) -> Signature:
        """Return the signature (parameters and their types) of the function or class of a configured term."""
        signature = self.resolved.vocabulary.find(section, config.func)
        assert signature is not None  # the validation of the configuration has already looked it up
        return signature

    def bind_all(self, section: str) -> list[BoundTerm]:
        """Return the bound terms of a section of the task, such as `rewards`, in order."""
        terms = self._bind_each(section, (section,), getattr(self.resolved.task, section))
        if section == "commands":
            self._commands = {term.name: term for term in terms}
        return terms

    def bind_group(self, group: str) -> list[BoundTerm]:
        """Return the bound terms of an observation group, in order."""
        return self._bind_each("observations", ("observations", group), self.resolved.task.observations[group].terms)

    def _bind_each(self, section: str, path: Path, configs: Mapping[str, TermConfig | None]) -> list[BoundTerm]:
        bound = [self.bind(section, (*path, name), config) for name, config in configs.items() if config is not None]
        return [term for term in bound if term is not None]

    def load(self, signature: Signature) -> Any:
        """Import a term and return its function or class.

        Raises:
            TaskError: if the import of the term's module fails.
        """
        if signature.target is not None:
            return signature.target
        source = self.resolved.source
        if signature.file in source.term_files:
            module = source.term_modules[source.term_files.index(signature.file)]
            try:
                return getattr(load_module(module), signature.attribute)
            except Exception as error:
                raise TaskError(f"{signature.file}: cannot be imported: {short_error(error)}") from error
        return getattr(importlib.import_module(signature.module), signature.attribute)

    def add_problem(self, path: Path, message: str, hint: str | None = None) -> None:
        """Collect a problem at a path of the configuration; `raise_problems` raises all of them."""
        self.problems.append(self.resolved.problem(path, message, hint))

    def raise_problems(self) -> None:
        """Raise all problems at once.

        Raises:
            ConfigError: if there are problems.
        """
        if self.problems:
            raise ConfigError(self.problems)

    def _resolve(
        self, signature: Signature, path: Path, config: TermConfig
    ) -> tuple[dict[str, Any] | None, dict[str, list[str]]]:
        params = config.params
        elements: dict[str, list[str]] = {}
        resolved = True
        for parameter in signature.parameters:
            if parameter.alias == "Entity":
                name = params[parameter.name]
                entity = self.env.entities.get(name)
                if entity is None:
                    near = did_you_mean(name, self.env.entities) or f"entities: {listing(self.env.entities)}"
                    self.add_problem((*path, parameter.name), f"no entity '{name}' in the scene", near)
                    return None, elements
                params[parameter.name] = entity
        for parameter in signature.parameters:
            name = parameter.name
            if parameter.alias == "Command" and params[name] is not None:
                params[name] = self._command(path, name, params[name])
                resolved = resolved and params[name] is not None
            elif parameter.alias == "Address":
                params[name] = self._opened.get((*path, name))
                resolved = resolved and params[name] is not None
            elif parameter.alias in SENSORS:
                if params[name] is not None:
                    params[name] = self._sensor(path, name, params[name], SENSORS[parameter.alias])
                    resolved = resolved and params[name] is not None
            else:
                params[name] = self.tunable.get((*path, name), params[name])
        for parameter in signature.parameters:
            if parameter.alias in SELECTORS and params[parameter.name] is not None:
                try:
                    index, names = params["entity"].select(parameter.alias, params[parameter.name])
                except NameProblem as problem:
                    self.add_problem((*path, parameter.name), str(problem), problem.hint)
                    resolved = False
                    continue
                params[parameter.name], elements[parameter.name] = index, names
        return (params if resolved else None), elements

    def _sensor(self, path: Path, parameter: str, name: str, kind: str) -> Sensor | None:
        configs = self.resolved.task.scene.sensors
        found = configs.get(name)
        if found is not None and found.kind == kind:
            return self.env.sensors.get(name)  # absent after an error of the scene, which is reported already
        names = [other for other, config in configs.items() if config.kind == kind]
        message = f"no sensor '{name}' of kind {kind} in scene.sensors"
        if found is not None:
            message = f"sensor '{name}' is of kind {found.kind}, the term needs one of kind {kind}"
        near = did_you_mean(name, names) or f"sensors of this kind: {listing(names) if names else 'none'}"
        self.add_problem((*path, parameter), message, near)
        return None

    def _open_addresses(self) -> None:
        """Make the tensors of the settings that the curriculum changes, before the terms that read them are bound."""
        self._opened: dict[Path, Tensor] = {}
        for name, config in self.resolved.task.curriculum.items():
            signature = self.resolved.vocabulary.find("curriculum", config.func) if config is not None else None
            for parameter in signature.parameters if signature is not None else ():
                if parameter.alias == "Address":
                    path = ("curriculum", name)
                    assert config is not None
                    try:
                        self._opened[*path, parameter.name] = self.tunable.make_changeable(
                            config.params[parameter.name]
                        )
                    except NameProblem as problem:
                        self.add_problem((*path, parameter.name), str(problem), problem.hint)

    def _command(self, path: Path, parameter: str, name: str) -> Any:
        if name in self._commands:
            return self._commands[name].instance
        names = [command for command, config in self.resolved.task.commands.items() if config is not None]
        if name not in names:  # else the problem of the command itself is reported already
            hint = f"commands: {listing(names)}" if names else "add the command to commands:"
            self.add_problem((*path, parameter), f"no command '{name}'", did_you_mean(name, names) or hint)
        return None


def resets(terms: Iterable[BoundTerm]) -> list[Callable[[Any], None]]:
    """Return the `reset` methods of the terms that have one; call them with the environments of new episodes."""
    return [term.instance.reset for term in terms if hasattr(term.instance, "reset")]


def first_value(term: BoundTerm) -> Any:
    """Call a term for the first time, when the environment is built.

    Raises:
        ShapeError: if the term raises a ValueError, with the message of the ValueError.
    """
    try:
        return term.call()
    except ValueError as error:
        raise term.error(str(error)) from None


_DTYPES = (torch.float32, torch.float64, torch.float16)
"""Types of real numbers that numpy has."""


class CheckedTerm:
    """Function that returns a term's value in each step and checks it: torch would broadcast a wrong shape silently.

    Args:
        term: the term.
        value: the first value of the term.
        shape: the shape that each value must have.
        is_mask: whether the values are booleans, such as the values of terminations.

    Raises:
        ShapeError: if the first value is wrong. A call raises a ShapeError for a later value that is wrong.
    """

    __slots__ = ("_call", "_dtype", "_is_mask", "_shape", "_term")

    def __init__(self, term: BoundTerm, value: object, shape: tuple[int, ...], *, is_mask: bool = False) -> None:
        self._term, self._call, self._shape, self._is_mask = term, term.call, shape, is_mask
        self._dtype = self._require(value).dtype

    def __call__(self) -> Tensor:
        """Return the value of the current step."""
        value = self._call()
        try:
            plain = value.dtype is self._dtype and not (value.requires_grad or value.is_neg() or value.is_meta)
            if plain and value.shape == self._shape and value.layout is torch.strided:
                return value  # type: ignore[no-any-return]
        except (AttributeError, RuntimeError):  # no tensor, or a nested one
            pass
        return self._require(value)

    def _require(self, value: object) -> Tensor:
        """Check a value; return it without a gradient, and as float32 if numpy lacks its type (such as bfloat16)."""
        found = None
        if not isinstance(value, Tensor):
            found = f"a value of type {type(value).__name__}"
        elif value.is_nested or value.is_meta or value.is_quantized or value.layout is not torch.strided:
            found = "a tensor that is not dense"
        elif value.shape != self._shape:
            found = f"a tensor of shape {tuple(value.shape)}"
        elif value.is_complex() or (self._is_mask and value.is_floating_point()):
            found = f"a tensor of type {value.dtype}"
        if found is None:
            assert isinstance(value, Tensor)
            value = value.detach().resolve_neg()
            if self._is_mask:
                return value.bool()
            return value.float() if value.is_floating_point() and value.dtype not in _DTYPES else value
        wanted = f"a tensor of shape {self._shape}{' of booleans' if self._is_mask else ''}"
        raise self._term.error(f"'{self._term.config.func}' returned {found}; return {wanted}")
