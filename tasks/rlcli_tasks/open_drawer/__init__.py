"""Open drawer: an arm pulls a drawer open by its handle.

Parameters and their sources: docs/reference/zoo/open-drawer.md.
"""

from rlcli.task import TaskSpec

DIRECT = TaskSpec(
    package=__name__,
    summary="Pull a drawer open by its handle (direct, OmniIsaacGymEnvs' parameters).",
    task="rlcli_tasks.open_drawer.task:DrawerTask",
)
