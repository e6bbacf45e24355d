"""The environment and its configuration.

A task of Isaac Lab that imports a name from `isaaclab.envs` gets the object of this name from here.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli_isaaclab import mdp
from rlcli_isaaclab.config_class import MISSING, configclass, fill_missing, to_dict
from rlcli_isaaclab.runtime import OWN_CLASS, ManagerBasedRLEnv
from rlcli_isaaclab.sim import SimulationCfg


@configclass
class ViewerCfg:
    """Position of the camera."""

    eye: Any = (7.5, 7.5, 7.5)
    lookat: Any = (0.0, 0.0, 0.0)
    cam_prim_path: str = "/OmniverseKit_Persp"
    resolution: Any = (1280, 720)
    origin_type: str = "world"
    env_index: int = 0
    asset_name: Any = None
    body_name: Any = None


@configclass
class ManagerBasedEnvCfg:
    """Configuration of a manager-based environment without rewards."""

    viewer: Any = ViewerCfg()
    sim: Any = SimulationCfg()
    ui_window_class_type: Any = None
    seed: Any = None
    decimation: int = MISSING
    scene: Any = MISSING
    recorders: Any = None
    observations: Any = MISSING
    actions: Any = MISSING
    events: Any = None
    rerender_on_reset: bool = False
    num_rerenders_on_reset: int = 0
    wait_for_textures: bool = True
    xr: Any = None
    teleop_devices: Any = None
    export_io_descriptors: bool = False
    log_dir: Any = None

    __rlcli_fill__ = fill_missing

    def __rlcli_environment__(self, entry: Any) -> None:
        """Store the environment class that the task's Gymnasium registration names, as a class or `module:Class`."""
        self._rlcli_class = entry

    def __rlcli_task__(self, root: Path, models: Mapping[str, Any]) -> Any:
        """Return this configuration as a task of rlcli; `models` are the values of `--model`, NAME -> FILE."""
        from rlcli.config.python_task import PythonTask
        from rlcli_isaaclab.convert import task
        from rlcli_isaaclab.own_classes import WORKFLOW, warn_of_methods
        from rlcli_isaaclab.runtime import environment_class
        from rlcli_isaaclab.settings import Report

        report = Report()
        entry = getattr(self, "_rlcli_class", OWN_CLASS)
        if entry not in (OWN_CLASS, ManagerBasedRLEnv):
            why = "terms can call methods of the task's own environment class; rlcli itself calls none of them"
            self._rlcli_class = environment_class(entry)  # now: another package of this name may be imported later
            skipped = warn_of_methods("the environment", self._rlcli_class, WORKFLOW)
            report.entries[("entry_point",)] = ("ignored", f"{why}; {skipped}" if skipped else why)
        data = task(to_dict(self), report, root, models=models, cfg=self)
        return PythonTask(data, notes=report.user_notes())


@configclass
class ManagerBasedRLEnvCfg(ManagerBasedEnvCfg):
    """Configuration of a manager-based task."""

    is_finite_horizon: bool = False
    episode_length_s: float = MISSING
    rewards: Any = MISSING
    terminations: Any = MISSING
    curriculum: Any = None
    commands: Any = None


ManagerBasedEnv = ManagerBasedRLEnv

__all__ = [
    "ManagerBasedEnv",
    "ManagerBasedEnvCfg",
    "ManagerBasedRLEnv",
    "ManagerBasedRLEnvCfg",
    "ViewerCfg",
    "mdp",
]
