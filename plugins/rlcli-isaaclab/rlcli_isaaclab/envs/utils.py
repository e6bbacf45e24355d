"""Decorators of term functions.

A task of Isaac Lab that imports a name from `isaaclab.envs.utils.io_descriptors` gets the object from here.
"""

from __future__ import annotations

from typing import Any


def generic_io_descriptor(function: Any = None, **settings: Any) -> Any:
    """Return the function itself: rlcli does not export descriptions of terms.

    Called with settings only, the function returns a decorator.
    """
    return function if callable(function) else lambda wrapped: wrapped


def _record(*arguments: Any, **settings: Any) -> None:
    """Do nothing: descriptions of observations are not exported."""


record_shape = record_dtype = record_joint_names = record_joint_pos_offsets = record_joint_vel_offsets = _record
record_joint_shape = record_body_names = _record
generic_io_descriptor_action = generic_io_descriptor
