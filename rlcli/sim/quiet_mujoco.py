"""Turn off MuJoCo's log file and its warnings on the terminal."""

from __future__ import annotations

import mujoco


def quiet_mujoco() -> None:
    """Stop MuJoCo from writing MUJOCO_LOG.TXT into the current folder and warnings to the terminal.

    The engines read MuJoCo's warning counters instead.
    """
    config = mujoco.MjLogConfig()
    config.logto_file = False
    config.logto_console = False
    config.set()
