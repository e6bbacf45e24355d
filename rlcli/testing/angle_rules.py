"""Rules of `rlcli lint` for angles that are probably in degrees, and for radians that are read as degrees."""

from __future__ import annotations

import math
from collections.abc import Iterator

from rlcli.config.layers import leaves
from rlcli.scene.joint_unit_check import doubtful_limits
from rlcli.testing.fixed_policy_rollouts import RolloutEvidence
from rlcli.testing.remarks import Remark, warning_at

_TURN = 2.0 * math.pi
_LARGEST_ANGLES = {
    **{(section, "limit_angle"): math.pi for section in ("events", "terminations", "commands")},
    **{(s, k): _TURN for s in ("events", "terminations", "commands") for k in ("roll", "pitch", "yaw", "heading")},
    **{("events", "position"): _TURN, ("actions", "offset"): _TURN, ("scene", "joint_pos"): _TURN},
    **{("terminations", "bounds"): _TURN, ("rewards", "target"): _TURN, ("success", "target"): _TURN},
}
"""(section, key) of a parameter -> largest sensible angle [rad]; a larger one may be in degrees. A tilt is at most pi.

Joint positions are among the parameters, so that a slide by more than 6.28 m is reported, too."""


def degrees(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that no angle is so large that it may be in degrees: a limit of a tilt above pi, a rotation above 2 pi."""
    for path, value in leaves(evidence.subject.resolved.task.model_dump()):
        keys = [(str(path[0]), str(key)) for key in path[:-3:-1]]  # the last key may be the name of a joint
        bound = next((_LARGEST_ANGLES[key] for key in keys if key in _LARGEST_ANGLES), None)
        if keys[0][1] == "target" and isinstance(value, list | tuple):
            continue  # a point [m]
        numbers = [v for v in (value if isinstance(value, list | tuple) else [value]) if isinstance(v, int | float)]
        largest = max(map(abs, numbers), default=0.0)
        if bound is not None and bound * 1.01 < largest < math.inf:
            message = f"the angle {largest:g} rad is above {bound / math.pi:g} pi; angles are in radians"
            hint = f"write {math.radians(largest):.4g}, if {largest:g} is in degrees"
            yield warning_at(".".join(map(str, path)), message, hint, {"angle": largest})
    for name, condition in evidence.subject.resolved.task.success.items():
        bound_of_tilt = None if condition is None or condition.func != "root_tilt" else condition.at_most
        if bound_of_tilt is not None and bound_of_tilt > math.pi:
            message = f"the tilt {bound_of_tilt:g} rad is above pi, so the condition always holds"
            message += "; angles are in radians"
            hint = f"write {math.radians(bound_of_tilt):.4g}, if {bound_of_tilt:g} is in degrees"
            yield warning_at(f"success.{name}.at_most", message, hint, {"angle": bound_of_tilt})


def joint_limits(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that no limit of a hinge is above two turns, and not all are so small that they may be in radians."""
    env = evidence.rollouts[0].env
    for name, entity in env.entities.items():
        for message, hint, angle in doubtful_limits(env.engine.model, entity.joint_ids.tolist(), entity.joint_names):
            yield warning_at(f"scene.entities.{name}.model", message, hint, {"angle": angle})
