"""MuJoCo's log."""

from __future__ import annotations

import mujoco


def quiet_mujoco() -> None:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT into the user's folder and warnings onto the terminal.

    The engines read MuJoCo's warning counters instead.
    """
    config = mujoco.MjLogConfig()
    config.logto_file = False
    config.logto_console = False
    config.set()
