"""Biped velocity: the humanoid follows velocity commands. Numbers and sources: docs/reference/zoo/biped-velocity.md."""

from rlcli.task import TaskSpec

MANAGED = TaskSpec(package=__name__, summary="Walk and turn with a human figure as commanded (manager-based).")
