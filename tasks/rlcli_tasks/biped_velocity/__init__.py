"""Biped velocity: the humanoid follows velocity commands.

Parameters and their sources: docs/reference/zoo/biped-velocity.md.
"""

from rlcli.task import TaskSpec

MANAGED = TaskSpec(package=__name__, summary="Follow velocity commands with a humanoid robot (manager-based).")
