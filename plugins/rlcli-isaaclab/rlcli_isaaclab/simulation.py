"""`env.sim`: the simulation under Isaac Lab's names, as far as rlcli has counterparts."""

from __future__ import annotations

from typing import Any

from rlcli.errors import TaskError
from rlcli_isaaclab.missing_names import MissingMemberError, reason_of, user_place


class Simulation:
    """Settings of the simulation, and the replacement of its USD stage.

    Args:
        cfg: the settings `sim` of the task.
        device: device of the tensors.
        physics_dt: period of a physics step [s].
    """

    def __init__(self, cfg: Any, device: str, physics_dt: float) -> None:
        self.cfg, self.device, self._physics_dt = cfg, device, physics_dt

    @property
    def stage(self) -> Any:
        """Replacement of the USD stage."""
        from rlcli_isaaclab.usd_stage import Stage

        return Stage()

    def get_initial_stage(self) -> Any:
        """Return the replacement of the USD stage."""
        return self.stage

    def get_physics_dt(self) -> float:
        """Return the period of a physics step [s]."""
        return self._physics_dt

    def has_gui(self) -> bool:
        """Return False: rlcli's viewers show policies, not the training."""
        return False

    def has_rtx_sensors(self) -> bool:
        """Return False: rlcli's cameras do not use Isaac Sim's renderer."""
        return False

    def is_playing(self) -> bool:
        """Return True: the simulation is never paused."""
        return True

    def is_stopped(self) -> bool:
        """Return False: the simulation is never stopped."""
        return False

    def set_camera_view(self, eye: Any = None, target: Any = None, **view: Any) -> None:
        """Do nothing: the viewer has its own camera."""

    def step(self, render: bool = True) -> None:
        """Raise TaskError, because a task may not step the simulation itself, for example in a reset."""
        what = f"{user_place()}env.sim.step cannot be used: a task cannot step the simulation itself"
        raise TaskError(what, hint="rlcli steps all environments at once; set joint positions in a reset instead")

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        reason, hint = reason_of(f"env.sim.{name}")
        raise MissingMemberError(f"env.sim.{name} cannot be used: {reason}", hint)
