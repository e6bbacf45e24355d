"""Names as in `isaaclab.utils`."""

from rlcli_isaaclab.config_class import MISSING, configclass

__all__ = ["MISSING", "configclass"]
