"""Names as in `isaaclab.utils`."""

from rlcli.isaaclab.configclass import MISSING, configclass

__all__ = ["MISSING", "configclass"]
