"""Adapters that run terms written for Isaac Lab as terms of rlcli.

Such a term is a function, for example `def reward(env, target, asset_cfg)`, or a class of which the environment makes
an object and calls it with the same arguments.
"""

from __future__ import annotations

import copy
import functools
import inspect
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor

from rlcli.config.schema import Names, Number, StrictModel
from rlcli.config.term_signatures import SECTIONS, Parameter, Signature, SignatureError
from rlcli.sim.env_selection import Selection
from rlcli_isaaclab.bound_objects import BoundCommand, BoundObject
from rlcli_isaaclab.config_class import is_missing
from rlcli_isaaclab.direct_env import building
from rlcli_isaaclab.managers import ManagerTermBaseCfg, SceneEntityCfg
from rlcli_isaaclab.own_processing import call_once_per_step
from rlcli_isaaclab.substeps import Substeps
from rlcli_isaaclab.term_values import resolved, set_members, to_namespace, type_hints
from rlcli_isaaclab.user_files import (
    adapt_to_device,
    code_of,
    file_text,
    place_of_code,
    source_text,
    term_reads_body_forces,
    unset_simple,
)

_RESERVED = {name for model in SECTIONS.values() for name in model.model_fields} | {"params"}
_PLAIN: dict[Any, Any] = {float: Number, int: int | Number, bool: bool, str: str}
"""Annotation of a parameter -> type by which rlcli checks it. Isaac Lab checks no types, so `int` also accepts 0.5."""


_Nothing = Annotated[list[str], Field(max_length=0)]


class EntityModel(StrictModel):
    """Schema of a `SceneEntityCfg` in a YAML task: a parameter of the user's term that selects joints and bodies."""

    name: str
    """Name of an entity or sensor."""
    joint_names: Names | _Nothing | None = None
    """Names or regexes of joints; null: all; []: none."""
    body_names: Names | _Nothing | None = None
    """Names or regexes of bodies; null: all; []: none."""
    preserve_order: bool = False
    """Whether to keep the written order instead of the model's."""


@dataclass(slots=True)
class TermContext:
    """Parts of Isaac Lab's configuration that rlcli does not use, but which the user's terms may read."""

    cfg: Any = None
    """The user's configuration object, which terms read as `env.cfg`; None: they read rlcli's configuration."""
    frames: dict[str, Any] = field(default_factory=dict)
    """Name -> settings of a frame transformer, or None for a light."""


class UserTerm:
    """Term of rlcli that runs a function or class of the user, written for Isaac Lab.

    Args:
        function: the user's function or class.
        section: section of the configuration, such as `rewards`.
        entities: names of the parameters that are a `SceneEntityCfg`.
        extra: names of all parameters that the configuration sets; those not declared go to `**kwargs`.
        objects: values of parameters that a YAML file cannot hold, such as functions.
        context: parts of the configuration that the function may read from the environment.
    """

    def __init__(
        self,
        function: Any,
        section: str,
        entities: frozenset[str],
        extra: tuple[str, ...],
        objects: Mapping[str, Any] | None = None,
        context: TermContext | None = None,
    ) -> None:
        self.context = context or TermContext()
        self.function, self.section, self.objects = function, section, dict(objects or {})
        self.is_class = isinstance(function, type)
        self.__name__ = getattr(function, "__name__", code_of(function).__name__)
        self.__module__ = code_of(function).__module__
        self.target = functools.partial(_bind_term, self)
        if section == "events" and "set_coms(" in file_text(function):
            self.target.prepare = unset_simple  # type: ignore[attr-defined]
        self.target.reads_body_forces = term_reads_body_forces(function)  # type: ignore[attr-defined]
        call = function.__call__ if self.is_class else function
        declared = list(inspect.signature(call).parameters.values())
        takes_env_ids = section in ("events", "curriculum")
        self._skip = (1 if self.is_class else 0) + (2 if takes_env_ids else 1)  # self, env, env_ids
        if len(declared) < self._skip and not any(p.kind is p.VAR_POSITIONAL for p in declared):
            expected = "(env, env_ids, ...)" if takes_env_ids else "(env, ...)"
            raise SignatureError(f"a term of {section} must take {expected}")
        hints = type_hints(call)
        named = [p for p in declared[self._skip :] if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
        named = [p for p in named if p.name not in self.objects]
        self.parameters = [self._parameter(p, hints.get(p.name), entities) for p in named]
        if any(p.kind is p.VAR_KEYWORD for p in declared):
            known = {p.name for p in named}
            self.parameters += [
                Parameter(key_of(name), EntityModel if name in entities else Any, None, True, None)
                for name in extra
                if name not in known
            ]
        self.original = {key_of(p.name): p.name for p in named} | {key_of(name): name for name in extra}

    def __deepcopy__(self, memo: Any) -> UserTerm:
        return self

    def __call__(self, *args: Any, **params: Any) -> Any:
        """Call the user's function, or create an object of the user's class."""
        return self.function(*args, **params)

    def __rlcli_term__(self, name: str) -> Signature:
        """Return the signature of the term; `name` is the term's key in the task."""
        file, line = place_of_code(self.function)
        summary = (inspect.getdoc(self.function) or "").split("\n")[0]
        return Signature(name, self.__name__, True, file, line, summary, tuple(self.parameters), target=self.target)

    def _parameter(self, p: inspect.Parameter, hint: Any, entities: frozenset[str]) -> Parameter:
        entity = hint is SceneEntityCfg or p.name in entities or isinstance(p.default, SceneEntityCfg)
        kind = EntityModel if entity else _PLAIN.get(hint, Any)
        unset = isinstance(p.default, SceneEntityCfg) and any(map(is_missing, vars(p.default).values()))
        required = p.default is inspect.Parameter.empty or unset
        default = None if required else p.default
        if isinstance(default, SceneEntityCfg):
            data = entity_data(vars(default)).items()  # in Isaac Lab a default with empty names selects all
            default = EntityModel.model_validate({key: value for key, value in data if value != []})
        elif kind in _PLAIN.values() and default is None and not required:
            kind = kind | None
        return Parameter(key_of(p.name), kind, default, required, None)


class UserObject:
    """Term of rlcli that runs a class of the user for an action or a command, created as `Name(cfg, env)`.

    Args:
        function: the user's class.
        section: `actions` or `commands`.
        name: name of the term.
        settings: names of the settings that a YAML file can hold; they are the parameters of the term.
        context: the user's configuration, which has the other settings.
    """

    def __init__(self, function: Any, section: str, name: str, settings: tuple[str, ...], context: TermContext) -> None:
        self.function, self.section, self.name, self.context = function, section, name, context
        self.__name__, self.__module__ = function.__name__, function.__module__
        self.target = functools.partial(_bind_object, self)
        self.original = {key_of(key): key for key in settings}

    def __deepcopy__(self, memo: Any) -> UserObject:
        return self

    def __call__(self, *args: Any) -> Any:
        """Create an object of the user's class."""
        return self.function(*args)

    def __rlcli_term__(self, name: str) -> Signature:
        """Return the signature of the term, whose key is `name`; its parameters are the keys of its configuration."""
        file = Path(inspect.getsourcefile(self.function) or "?")
        summary = (inspect.getdoc(self.function) or "").split("\n")[0]
        parameters = tuple(Parameter(key, Any, None, True, None) for key in self.original)
        return Signature(name, self.__name__, True, file, 1, summary, parameters, target=self.target)

    def settings(self, params: Mapping[str, Any]) -> Any:
        """Return the object `cfg` for the user's class: the user's configuration with the values in `params`."""
        values = {self.original[key]: value for key, value in params.items()}
        cfg = copy.deepcopy(getattr(getattr(self.context.cfg, self.section, None), self.name, None))
        if cfg is None:
            return SimpleNamespace(class_type=self.function, **{k: to_namespace(v) for k, v in values.items()})
        set_members(cfg, values)
        return cfg


class SettingTerm:
    """Curriculum term that changes a setting during training with a function of the user.

    Args:
        function: class of the term, `modify_env_param` or a subclass.
        setting: the setting that changes, a `ChangedSetting`.
        params: parameters that a YAML file cannot hold, such as the user's function.
        context: the user's configuration.
    """

    def __init__(self, function: Any, setting: Any, params: dict[str, Any], context: TermContext) -> None:
        self.function, self.setting, self.params, self.context = function, setting, params, context
        self.__name__, self.__module__ = function.__name__, function.__module__
        self.target = functools.partial(_bind_setting, self)

    def __deepcopy__(self, memo: Any) -> SettingTerm:
        return self

    def __call__(self, *args: Any) -> Any:
        """Create an object of the user's class."""
        return self.function(*args)

    def __rlcli_term__(self, name: str) -> Signature:
        """Return the signature of the term, whose key is `name`; its parameters are the addresses that it changes."""
        file = Path(inspect.getsourcefile(self.function) or "?")
        addresses = tuple(Parameter(key, str, None, True, "Address") for key, _ in self.setting.addresses)
        return Signature(name, self.__name__, True, file, 1, "Changes a setting.", addresses, target=self.target)


def key_of(name: str) -> str:
    """Return the YAML key of a parameter: its name, with `_` added if terms have a setting of this name (`weight`)."""
    return f"{name}_" if name in _RESERVED else name


def entity_data(settings: Any) -> dict[str, Any]:
    """Return the members of a `SceneEntityCfg` that differ from their defaults, for a YAML task.

    Raises:
        ValueError: if it selects fixed tendons or objects of a collection.
    """
    for key in ("fixed_tendon_names", "object_collection_names"):
        if settings.get(key) is not None:
            raise ValueError(f"{key} is not supported by rlcli; remove it")
    data = {"name": settings["name"]}
    for key in ("joint_names", "body_names"):
        if is_missing(settings.get(key)):
            raise ValueError(f"missing '{key}'; give it a value")
        if settings.get(key) is not None:
            value = settings[key]
            data[key] = value if isinstance(value, str) else list(value)
    if settings.get("preserve_order"):
        data["preserve_order"] = True
    return data


_CHECKS_FOR_LIST = re.compile(r"isinstance\([\w.]+\.(joint|body)_ids, list\)")
"""Source text of terms that need the ids of joints or bodies as a list. Other terms get tensors: faster on a GPU."""
_AFTER_RESET = {"rewards": ("reward_manager", torch.float32), "terminations": ("termination_manager", torch.bool)}
"""Section whose terms Isaac Lab calls for the first time in the first step -> (its manager, the type of the values)."""


class _Bound:
    """Term in one environment that calls the user's function with Isaac Lab's `env` and the configured parameters."""

    def __init__(self, function: Any, section: str, env: Any, params: dict[str, Any]) -> None:
        self.term, self._section, self._env, self.params = function, section, env, params
        self._reads_reset = section == "observations" and "hasattr(env" in source_text(function)

    def __call__(self, selection: Selection | None = None) -> Any:
        if selection is not None:
            self._env.selection = selection
            call = functools.partial(self.term, self._env, selection.env_ids(), **self.params)
            value = self._env.managed.task_log.call_reset(call)
            # a curriculum term may return several values to log; rlcli logs one
            return next(iter(value.values()), None) if isinstance(value, dict) else value
        if self._reads_reset:  # reset events create attributes that decide the shape of the value
            self._reads_reset = False
            self._env.run_own_reset_events()
        manager, dtype = _AFTER_RESET.get(self._section, ("num_envs", None))
        try:
            value = self.term(self._env, **self.params)
        except Exception:
            if hasattr(self._env.managed, manager):
                raise
            # rlcli calls the term before the first reset to find its shape; the reset creates attributes that it reads
            return torch.zeros(self._env.num_envs, device=self._env.device, dtype=dtype)
        if self._section == "observations" and value.dim() == 1:
            return value.unsqueeze(1).float()  # Isaac Lab allows (num_envs,) in groups that are not concatenated
        if self._section == "observations" and value.dim() not in (2, 4):
            return value.flatten(1 if value.dim() == 3 else 3)  # a history, as in Isaac Lab; images (n, h, w, 1, 1)
        return value.bool() if self._section == "terminations" and value.dtype != torch.bool else value


class _BoundClass(_Bound, BoundObject):
    """Term in one environment that calls an object of the user's class: a term with a state."""

    def __call__(self, selection: Selection | None = None) -> Any:
        if self._section == "observations":
            return call_once_per_step(self._env.managed, [self.term], super().__call__)
        return super().__call__(selection)


class _ActionSteps(Substeps):
    """Caller of an action's `apply`, which resets the asset of the action before the reset events, as Isaac Lab."""

    def reset(self, selection: Selection) -> None:
        """Reset the asset in the environments whose episode starts."""
        self._code.reset_asset(selection)  # type: ignore[attr-defined]


class _BoundAction(BoundObject):
    """Action term in one environment that runs an object of the user's class, an `ActionTerm`."""

    unit = ""

    def __init__(self, term: Any, managed: Any, name: str) -> None:
        self.term = term
        self.size = term.action_dim
        self.elements = tuple(f"{name}[{i}]" for i in range(self.size))
        self.sinks = (f"action {name}",)
        term._asset.start_wrenches(by_task=True)
        self._substeps = _ActionSteps(managed, f"action {name}", self)

    def process(self, action: Tensor) -> None:
        """Pass the policy's action to `process_actions` of the user's class. (num_envs, action_dim)"""
        self.term.process_actions(action)
        self._substeps.start()

    def apply(self) -> None:
        """Call `apply_actions` of the user's class, before each physics step."""
        self.term.apply_actions()
        self.term._asset.write_data_to_sim()
        self.term._asset.apply_wrenches()

    def reset_asset(self, selection: Selection) -> None:
        """Remove the forces on the asset, before the reset events."""
        self.term._asset.reset(selection.env_ids())

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the tensors of the action and of its asset."""
        asset = {f"asset.{name}": value.clone() for name, value in self.term._asset.state().items()}
        return {**super().state_dict(), **asset}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors returned by `state_dict`."""
        for name, value in self.term._asset.state().items():
            value.copy_(state[f"asset.{name}"])
        super().load_state_dict({name: value for name, value in state.items() if not name.startswith("asset.")})


def _bind_object(term: UserObject, env: Any, **params: Any) -> BoundObject:
    from rlcli_isaaclab.runtime import facade_of

    cfg, facade = term.settings(params), facade_of(env)
    cfg.debug_vis = False
    facade.use(term.context)
    if term.section == "commands":
        cfg.resampling_time_range = tuple(env.config.commands[term.name].resampling_time_s)
    with building(env):
        made = adapt_to_device(term.function, env.device)(cfg, facade)
    return _BoundAction(made, env, term.name) if term.section == "actions" else BoundCommand(made, env, term.name)


def _bind_setting(term: SettingTerm, env: Any, **opened: Tensor) -> _BoundClass:
    from rlcli_isaaclab.runtime import facade_of

    facade = facade_of(env)
    facade.use(term.context)
    cfg = SimpleNamespace(func=term.function, params=term.params, setting=term.setting)
    return _BoundClass(term.function(cfg, facade), "curriculum", facade, {**term.params, **opened})


def _bind_term(term: UserTerm, env: Any, **params: Any) -> _Bound:
    from rlcli_isaaclab.runtime import facade_of

    facade = facade_of(env)
    facade.use(term.context)
    if term.section == "curriculum":
        facade.open_weights()  # first, because the reward manager copies weights that are not marked as changeable
    if any(word in file_text(term.function) for word in ("external_force", "wrench_composer")):
        for asset in facade.scene.articulations.values():
            asset.start_wrenches()
    values: dict[str, Any] = {key: resolved(value, facade.scene) for key, value in term.objects.items()}
    for key, value in params.items():
        if isinstance(value, EntityModel):
            facade.scene.resolve(value := SceneEntityCfg(**value.model_dump()))
        values[term.original[key]] = value
    if _CHECKS_FOR_LIST.search(file_text(term.function)):
        for chosen in values.values():
            for key in ("joint_ids", "body_ids"):
                if isinstance(chosen, SceneEntityCfg) and isinstance(getattr(chosen, key), Tensor):
                    setattr(chosen, key, getattr(chosen, key).tolist())
    if not term.is_class:
        return _Bound(adapt_to_device(term.function, env.device), term.section, facade, values)
    with building(env):
        cfg = ManagerTermBaseCfg(func=term.function, params=values)
        instance = adapt_to_device(term.function, env.device)(cfg=cfg, env=facade)
    return _BoundClass(instance, term.section, facade, values)
