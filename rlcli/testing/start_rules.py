"""Rule of `rlcli lint` for robots that fall from their start pose although zero actions should hold the pose."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator

from rlcli.envs.managed import ManagedEnv
from rlcli.testing.fixed_policy_rollouts import RolloutEvidence
from rlcli.testing.remarks import Remark, warning_at

_FALLS_WITHIN_S = 1.0
"""Time before which a terminated episode of zero actions counts as a fall from the start pose [s]."""


def start_pose_falls(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that zero actions hold the start pose of a floating robot, if they are position targets of all joints."""
    (rollout,) = [rollout for rollout in evidence.rollouts if rollout.policy == "zero"]
    env = rollout.env
    if not isinstance(env, ManagedEnv) or not _holds_the_default_pose(env):
        return
    limit = min(math.ceil(_FALLS_WITHIN_S / env.step_dt), env.max_episode_length // 2)
    falls = [episode for episode in rollout.episodes if episode.terminated and episode.length <= limit]
    count = len(rollout.episodes) + sum(length > limit for length in rollout.unfinished)
    if not count or len(falls) <= 0.5 * count:
        return
    causes = ", ".join(name for name, _ in Counter(c for fall in falls for c in fall.causes).most_common(2))
    seconds = sum(fall.length for fall in falls) / len(falls) * env.step_dt
    message = f"with zero actions, which hold the default pose, {len(falls) / count:.0%} of the episodes end"
    message += f" after {seconds:.2g} s, by {causes or 'a reset'}"
    hint = "set scene.entities.NAME.init.joint_pos and pos to a pose in which the robot stands, or raise kp"
    yield warning_at("scene.entities: init", message, hint, {"share": len(falls) / count, "seconds": seconds})


def _holds_the_default_pose(env: ManagedEnv) -> bool:
    """Return whether there is a floating robot, and zero actions command the default positions of all its joints."""
    targets = set()
    for term in env.layout.actions:
        config = env.config.actions[term.name]
        if config is None or config.func != "joint_position":
            return False
        if not config.params.get("use_default_offset", True) or config.params.get("offset"):
            return False
        targets |= {(config.params.get("entity", "robot"), name) for name in term.elements}
    floating = {name: entity.joint_names for name, entity in env.entities.items() if entity.is_floating}
    joints = {(entity, joint) for entity, names in floating.items() for joint in names}
    return bool(joints) and joints <= targets
