"""Biped velocity: the humanoid walks and turns as fast as it is told. Numbers and sources: docs/zoo/biped-velocity.md.

Its YAML lies beside the humanoid's model, which it shares.
"""

from rlcli.task import TaskSpec

MANAGED = TaskSpec(
    package="rlcli_tasks.humanoid",
    config="velocity.yaml",
    summary="Walk and turn with a human figure as commanded (manager-based).",
)
