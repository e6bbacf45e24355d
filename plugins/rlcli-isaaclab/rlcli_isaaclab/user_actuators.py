"""Support for actuator models of the user (subclasses of `ActuatorBase`), which replace rlcli's actuator models."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from rlcli.config.term_signatures import Signature
from rlcli.managers.attribute_state import AttributeState
from rlcli.sim.env_selection import Selection
from rlcli_isaaclab.actuator_classes import ActuatorBase
from rlcli_isaaclab.utils.types import ArticulationActions


def is_user_actuator(class_type: Any) -> bool:
    """Return whether the class of an actuator is defined by the user, and not by this package."""
    own = isinstance(class_type, type) and issubclass(class_type, ActuatorBase)
    return own and not class_type.__module__.startswith("rlcli_isaaclab")


def actuator_events(found: Mapping[tuple[str, str], Mapping[str, Any]]) -> dict[str, Any]:
    """Return the startup events, by name, that install the user's actuators in an environment.

    `found` maps (entity, actuator group) to the settings of the group.
    """
    return {
        f"actuator_{entity}_{group}": {"func": ActuatorTerm(entity, group, settings), "mode": "startup"}
        for (entity, group), settings in found.items()
    }


class ActuatorTerm:
    """Startup event after which an object of the user's class computes the efforts of a group of joints."""

    def __init__(self, entity: str, group: str, settings: Mapping[str, Any]) -> None:
        self.actuator = f"{entity}.{group}"
        self.class_type: type = settings["class_type"]
        self.settings = dict(settings)
        self.__name__, self.__module__ = self.class_type.__name__, self.class_type.__module__
        self.target = functools.partial(_bind, self)

    def __deepcopy__(self, memo: Any) -> ActuatorTerm:
        return self

    def __call__(self, *args: Any) -> Any:
        """Raise a TypeError: only a term that is bound to an environment can be called."""
        raise TypeError("an actuator's term cannot be called before it is bound to an environment")

    def __rlcli_term__(self, name: str) -> Signature:
        """Return the signature of the term; `name` is the term's key in the task."""
        file = Path(inspect.getsourcefile(self.class_type) or "?")
        summary = (inspect.getdoc(self.class_type) or "").split("\n")[0]
        return Signature(name, self.__name__, True, file, 1, summary, (), target=self.target)


class _BoundActuator:
    """Object of the user's actuator class in one environment, in place of one of rlcli's actuator models."""

    def __init__(self, term: ActuatorTerm, env: Any) -> None:
        model = env.actuators[term.actuator]
        entity = model.entity
        names = [entity.joint_names[joint] for joint in model.joints]
        self._all = torch.arange(env.num_envs, device=env.device)
        ids = torch.tensor(model.joints, device=env.device)
        defaults = {"armature": self._field(env, "dof_armature", model), "effort_limit": model.effort_limit}
        cfg = SimpleNamespace(**term.settings)
        self._actuator: Any = term.class_type(cfg, names, ids, env.num_envs, env.device, **defaults)
        # shared, so that events can randomise them
        self._actuator.stiffness, self._actuator.damping = model.stiffness, model.damping
        self._state = AttributeState(self._actuator, ("stiffness", "damping", "cfg"))
        self._actuator.reset(self._all)
        model.controller = self.compute_efforts

    @staticmethod
    def _field(env: Any, name: str, model: Any) -> Tensor:
        values: Tensor = env.engine.expand(name)[:, model.entity.dof_columns][:, model.columns].float()
        return values

    def __call__(self, selection: Selection) -> None:
        """Do nothing: the actuator is installed when the term is bound."""

    def compute_efforts(self, targets: Tensor, position: Tensor, velocity: Tensor) -> tuple[Tensor, Tensor]:
        """Return the efforts of the user's actuator before and after its limits are applied.

        Args:
            targets: position, velocity and effort targets. (num_envs, 3, joints)
            position: joint positions. (num_envs, joints) [m or rad]
            velocity: joint velocities. (num_envs, joints) [m/s or rad/s]

        Returns:
            Efforts before, and after the limits. (num_envs, joints) each [N or N m]
        """
        wanted = ArticulationActions(*(row.clone() for row in targets.unbind(1)))
        self._actuator.compute(wanted, position, velocity)
        return self._actuator.computed_effort, self._actuator.applied_effort

    def reset(self, selection: Selection) -> None:
        """Reset the actuator in the environments whose episode starts."""
        self._actuator.reset(selection.env_ids())

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the tensors of the user's actuator, by name."""
        return self._state.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors returned by `state_dict`."""
        self._state.load_state_dict(state)


def _bind(term: ActuatorTerm, env: Any) -> _BoundActuator:
    return _BoundActuator(term, env)
