"""Read and set fields of MjModel, such as body_mass, whose values may differ between environments.

Events for domain randomisation and stress tests set these fields.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from rlcli.errors import did_you_mean, listing
from rlcli.scene.entity import Entity
from rlcli.scene.names import NameProblem
from rlcli.sim.column_views import as_index
from rlcli.sim.engine import Engine
from rlcli.sim.env_selection import Columns, Selection

FIELDS: dict[str, str] = {
    **dict.fromkeys(("body_mass", "body_inertia", "body_ipos", "body_iquat"), "Bodies"),
    **dict.fromkeys(("body_pos", "body_quat", "body_gravcomp"), "Bodies"),
    **dict.fromkeys(("jnt_stiffness", "jnt_range", "jnt_actfrcrange", "jnt_solref", "jnt_solimp"), "Joints"),
    **dict.fromkeys(("jnt_margin", "jnt_pos", "jnt_axis", "qpos0", "qpos_spring"), "Joints"),
    **dict.fromkeys(("dof_damping", "dof_armature", "dof_frictionloss", "dof_solref", "dof_solimp"), "Joints"),
    **dict.fromkeys(("geom_friction", "geom_size", "geom_pos", "geom_quat", "geom_rgba"), "Geoms"),
    **dict.fromkeys(("geom_solref", "geom_solimp", "geom_solmix", "geom_margin", "geom_gap"), "Geoms"),
    **dict.fromkeys(("site_pos", "site_quat"), "Sites"),
    **dict.fromkeys(("actuator_gainprm", "actuator_biasprm", "actuator_dynprm"), "Actuators"),
    **dict.fromkeys(("actuator_forcerange", "actuator_ctrlrange", "actuator_gear"), "Actuators"),
    **dict.fromkeys(("tendon_stiffness", "tendon_damping", "tendon_frictionloss", "tendon_armature"), "Tendons"),
    **dict.fromkeys(("tendon_range", "tendon_lengthspring", "tendon_margin"), "Tendons"),
    **dict.fromkeys(("pair_friction", "pair_solref", "pair_solimp", "pair_margin", "pair_gap"), "Pairs"),
    **dict.fromkeys(("opt.gravity",), ""),
}
"""Field that may differ between environments -> kind of element that its rows belong to; '' for the whole model."""

DERIVED_FROM = {
    *("qpos0", "qpos_spring", "body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat"),
    *("body_gravcomp", "jnt_pos", "jnt_axis", "dof_armature", "geom_size", "geom_pos", "geom_quat"),
    *("geom_margin", "geom_gap", "site_pos", "site_quat", "actuator_gear"),
    *("tendon_stiffness", "tendon_damping", "tendon_armature"),
}
"""Fields from which MuJoCo derives constants: after a change of such a field, `Engine.set_constants` must be called."""


class ModelField:
    """Some values of a model field, such as the masses of some bodies, in every environment, and their original values.

    Args:
        entity: the entity that has the elements.
        name: name of the field.
        elements: which bodies, joints and so on of the entity, as an index; None for a field of the whole model.
        axes: indices of the values of each element, for example [2] for z; None: all values.

    Raises:
        ValueError: if the field cannot differ between environments, or does not have an axis.
    """

    def __init__(
        self, entity: Entity, name: str, elements: Columns | None = None, axes: Sequence[int] | None = None
    ) -> None:
        engine = entity.engine
        self.name = name
        self.derives = name in DERIVED_FROM
        """Whether MuJoCo derives constants from the field."""
        ids = [0] if elements is None else element_ids(entity, name, elements)
        rows = model_rows(engine, name)
        self.width = rows.shape[1]
        if bad := [axis for axis in axes or () if not 0 <= axis < self.width]:
            raise NameProblem(f"{name} has no axis {bad[0]}", f"give axes from 0 to {self.width - 1}")
        self.axes = list(range(self.width)) if axes is None else list(axes)
        self.values = _expand(engine, name).view(engine.num_envs, -1)
        """Values of the field in every environment, flattened. (num_envs, n)"""
        columns = [i * self.width + axis for i in ids for axis in self.axes]
        self.columns = as_index(columns, engine.device)
        self.shape = (len(ids), len(self.axes))
        original = torch.as_tensor(rows[ids][:, self.axes].copy(), dtype=self.values.dtype)
        self.original = original.to(engine.device)
        """Values of the compiled model. (elements, axes)"""

    def write(self, selection: Selection, values: Tensor) -> None:
        """Set the values in the selected environments; `values` has a row for each of them. (rows, elements, axes)"""
        selection.write(self.values, values.to(self.values.dtype).flatten(1), self.columns)

    def read(self, selection: Selection) -> Tensor:
        """Return the values in the selected environments, a row for each environment. (rows, elements, axes)"""
        return selection.read(self.values, self.columns).view(-1, *self.shape)


def element_ids(entity: Entity, name: str, elements: Columns) -> list[int]:
    """Return the rows of the model field `name` that belong to some elements of an entity, in the order of `elements`.

    `elements` is an index into the entity's elements (bodies, joints, ...), by the kind in `FIELDS`.
    """
    if name in ("qpos0", "qpos_spring"):
        rows = entity.qpos_columns.cpu()
    elif name.startswith("dof_"):
        rows = entity.dof_columns.cpu()
    else:
        rows = torch.as_tensor(entity.ids[FIELDS[name]])
    return rows[elements.cpu() if isinstance(elements, Tensor) else elements].tolist()


def model_rows(engine: Engine, name: str) -> np.ndarray:
    """Return the values of the model field `name` in the compiled model, one element per row. (elements, values each)

    Raises:
        ValueError: for a field that cannot differ between environments.
    """
    if name not in FIELDS:
        suggestion = did_you_mean(name, FIELDS)
        allowed = f"fields that can differ: {listing(sorted(FIELDS), 60)}"
        hint = f"{suggestion}; {allowed}" if suggestion else allowed
        raise NameProblem(f"'{name}' cannot differ between environments", hint)
    owner, attribute = (engine.model.opt, name[4:]) if name.startswith("opt.") else (engine.model, name)
    value = np.asarray(getattr(owner, attribute), dtype=np.float64)
    return value.reshape(1, -1) if name.startswith("opt.") else value.reshape(len(value), -1)


def _expand(engine: Engine, name: str) -> Tensor:
    try:
        return engine.expand(name)
    except ValueError:
        allowed = [field for field in FIELDS if engine.can_expand(field)]
        message = f"'{name}' cannot differ between environments on this engine"
        raise NameProblem(message, f"fields that can differ: {listing(sorted(allowed), 60)}") from None
