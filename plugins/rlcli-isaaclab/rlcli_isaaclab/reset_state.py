"""What a reset of Isaac Lab leaves unchanged: the state of entities that no event writes, and the episode counter."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from typing import Any

from rlcli.config.term_signatures import builtin_terms
from rlcli.registry import is_framework
from rlcli_isaaclab.scene_reader import SceneReader
from rlcli_isaaclab.settings import Report

_OF_JOINTS = (
    "reset_joints_by_offset",
    "reset_joints_by_scale",
    "reset_joints_by_gaussian",
    "reset_joints_within_limits",
)
_OF_ROOT = ("reset_root_state_uniform", "reset_root_state_with_random_orientation")
_WRITES_LENGTH = re.compile(r"\bself\.episode_length_buf\s*(\[[^=]*\])?\s*=(?!=|\s*0(\.0)?\s*$)")


def keeps_state(events: Mapping[str, Mapping[str, Any]], scene: SceneReader, entities: Mapping[str, Any]) -> bool:
    """Return whether an episode may depend on the last state of the previous one, which Isaac Lab does not reset.

    This is so if a reset event is the user's own function, which may read this state, and if built-in events do not
    write the whole state of an entity.

    Args:
        events: events of rlcli, by name.
        scene: the scene, with the joints of each entity.
        entities: the entities of rlcli's scene, by name.
    """
    from rlcli.scene.names import search

    resets = [event for event in events.values() if event.get("mode") == "reset"]
    if any(event["func"] not in builtin_terms("events") for event in resets):
        return True
    always = [event for event in resets if not event.get("min_steps_between")]
    if any(event["func"] == "reset_scene_to_default" for event in always):
        return False
    for name in entities:
        written: set[int] = set()
        moves_root = scene.is_fixed(name)
        joints = scene.names(name, "joint") or []
        for event in always:
            if event.get("entity", "robot") == name:
                moves_root |= event["func"] in _OF_ROOT
                selected = event.get("joints", ".*") if event["func"] in _OF_JOINTS else []
                for pattern in [selected] if isinstance(selected, str) else selected:
                    written.update(search(pattern, joints, "joint"))
        if scene.names(name, "body") and (len(written) < len(joints) or not moves_root):
            return True
    return False


def note_episode_lengths(env_class: type, report: Report) -> None:
    """Report as ignored the line of a direct task's `_reset_idx` that sets `episode_length_buf`, the steps so far."""
    for base in env_class.__mro__:
        method = None if is_framework(base.__module__) else vars(base).get("_reset_idx")
        if not inspect.isfunction(method):
            continue
        for number, line in enumerate(inspect.getsource(method).splitlines()):
            if _WRITES_LENGTH.search(line.partition("#")[0]):
                place = f"{inspect.getsourcefile(method)}:{method.__code__.co_firstlineno + number}"
                why = f"{place}: every episode starts at step 0; the values that _reset_idx writes are overwritten"
                report.entries[("_reset_idx", "episode_length_buf")] = ("ignored", why)
