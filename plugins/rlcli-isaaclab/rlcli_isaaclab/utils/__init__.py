"""Utilities that tasks import from `isaaclab.utils`, under the same names."""

from rlcli_isaaclab.config_class import MISSING, configclass

__all__ = ["MISSING", "configclass"]
