"""Check of an MJCF's joint limits for a wrong unit of angles: degrees read as radians, or radians read as degrees.

`rlcli new --robot` and the linter warn about such files.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from rlcli.errors import listing

LARGEST_LIMIT = 4.0 * math.pi
"""Largest usual limit of a hinge, two turns [rad]."""
_SMALLEST_RANGE = math.radians(2.0 * math.pi)
"""A full turn in radians that is read as degrees [rad]."""


def doubtful_limits(
    model: mujoco.MjModel, joints: Sequence[int], names: Sequence[str]
) -> Iterator[tuple[str, str, float]]:
    """Yield a message, a hint and the largest angle [rad] for hinge limits that are probably in the wrong unit.

    There is at most one item for limits that are too large, and one for limits that are too small.

    Args:
        model: the compiled model.
        joints: ids of the joints.
        names: names of the joints.
    """
    hinges = [
        (name, model.jnt_range[joint])
        for joint, name in zip(joints, names, strict=True)
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE and model.jnt_limited[joint]
    ]
    if large := [(name, limits) for name, limits in hinges if np.abs(limits).max() > LARGEST_LIMIT]:
        message = f"{_first(large)}, which is more than two turns; the unit may be wrong"
        yield message, 'write <compiler angle="degree"/>, if the angles of the file are in degrees', _largest(large)
    if hinges and all(np.ptp(limits) < _SMALLEST_RANGE for _, limits in hinges):
        message = f"{_first(hinges)}, and no hinge with limits turns further than 6.28 degrees; the unit may be wrong"
        hint = 'write <compiler angle="radian"/>, if the angles of the file are in radians: degrees are the default'
        yield message, hint, _largest(hinges)


def _largest(hinges: Sequence[tuple[str, NDArray[np.float64]]]) -> float:
    return float(np.abs([limits for _, limits in hinges]).max())


def _first(hinges: Sequence[tuple[str, NDArray[np.float64]]]) -> str:
    """Return, as text, the limits of the first joint, and the names of the other joints in the list."""
    (name, (low, high)), others = hinges[0], [name for name, _ in hinges[1:]]
    also = f" (likewise: {listing(others, 3)})" if others else ""
    return f"joint '{name}' has the limits {low:.4g} to {high:.4g} rad{also}"
