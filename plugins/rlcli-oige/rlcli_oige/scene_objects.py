"""Robots, objects and shapes that a task creates on the stage."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from rlcli.errors import TaskError
from rlcli_oige.prim_paths import ZERO
from rlcli_oige.stage import get_current_stage, to_floats
from rlcli_oige.user_code import Counterpart, user_location


class XFormPrim(Counterpart):
    """A frame (coordinate system) on the stage, into which a model can be loaded."""

    def __init__(
        self,
        prim_path: str,
        name: str = "xform_prim",
        position: Any = None,
        translation: Any = None,
        orientation: Any = None,
        scale: Any = None,
        visible: bool | None = None,
        **kwargs: Any,
    ) -> None:
        self.prim_path = str(prim_path)
        self.name = name
        self.prim = get_current_stage().define(
            self.prim_path, position if translation is None else translation, orientation
        )
        self._build(scale)

    def _build(self, scale: Any) -> None:
        """Load the model that replaces the USD file to which the task refers at the path of the prim."""
        stage = self.prim.stage
        if self.prim.owner.prim_path in stage.references and self.prim.owner.child is None:
            stage.load(self.prim.owner, [kind.__name__ for kind in type(self).__mro__])
        if scale is not None and self.prim.owner.child is not None and set(to_floats(scale, ())) != {1.0}:
            stage.note_ignored(f"scale of {self.prim_path}", "give a model of the right size", lost=True)

    def set_collision_enabled(self, enabled: bool) -> None:
        """Turn the collisions of the object on or off."""
        self.prim.settings["collisions"] = bool(enabled)

    def apply_visual_material(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing: the model has the colours."""

    def set_world_pose(self, position: Any = None, orientation: Any = None) -> None:
        """Set position (3,) [m] and orientation (4,) (w, x, y, z), relative to the environment; None: unchanged."""
        self.prim.stage.define(self.prim_path, position, orientation)

    set_local_pose = set_world_pose

    def get_world_pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Return position (3,) [m] and orientation (4,) (w, x, y, z), relative to the environment."""
        return np.array(self.prim.owner.pos), np.array(self.prim.owner.quat)

    get_local_pose = get_world_pose


class Robot(XFormPrim):
    """A robot. `--model` or the YAML's `mjcf:` names its model; some classes have a built-in model."""

    def _build(self, scale: Any) -> None:
        self.prim.stage.load(self.prim, [kind.__name__ for kind in type(self).__mro__])


class WheeledRobot(Robot):
    """A robot with wheels."""

    def __init__(self, prim_path: str, name: str = "wheeled_robot", robot_path: Any = None, wheel_dof_names: Any = None,
                 wheel_dof_indices: Any = None, usd_path: Any = None, create_robot: bool = False,
                 **kwargs: Any) -> None:  # fmt: skip
        super().__init__(prim_path, name, **kwargs)
        self.wheel_dof_names = wheel_dof_names


class Cartpole(Robot):
    """A cart on a rail with a pole."""


class Ant(Robot):
    """A robot with four legs."""


class Humanoid(Robot):
    """A humanoid robot."""


class Crazyflie(Robot):
    """A palm-sized quadcopter."""


class Quadcopter(Robot):
    """A quadcopter whose arms tilt."""


class Ingenuity(Robot):
    """A helicopter with two rotors, one above the other."""


class RigidPrim(XFormPrim):
    """Rigid object on the stage. The task has loaded a USD file at its path; an MJCF replaces that file."""


class _Shape(XFormPrim):
    free, solid = True, True

    def __init__(self, prim_path: str, name: str = "shape", radius: float | None = None, size: Any = None,
                 height: float | None = None, color: Any = None, mass: float | None = None,
                 density: float | None = None, **kwargs: Any) -> None:  # fmt: skip
        self._radius, self._size, self._height = radius, size, height
        self._color, self._mass, self._density = color, mass, density
        super().__init__(prim_path, name, **kwargs)

    def _geom(self, scale: np.ndarray) -> dict[str, Any]:
        raise NotImplementedError

    def _build(self, scale: Any) -> None:
        child = mujoco.MjSpec()
        body = child.worldbody.add_body(name=self.prim.GetName())
        if self.free:
            body.add_freejoint(name="root")
        rgb = to_floats(self._color, (0.5, 0.5, 0.5))
        size = np.broadcast_to(np.asarray(to_floats(scale, (1.0, 1.0, 1.0))), 3)
        geom = body.add_geom(name="shape", rgba=[*rgb[:3], 1.0], **self._geom(size))
        if self._mass is not None:
            geom.mass = float(self._mass)
        geom.density = float(self._density) if self._density is not None else 1000.0
        assert self.prim.owner is self.prim, "a shape has a prim of its own"
        self.prim.child, self.prim.label, self.prim.shape = child, type(self).__name__, True
        self.prim.settings["collisions"] = self.solid


class _Sphere(_Shape):
    def _geom(self, scale: np.ndarray) -> dict[str, Any]:
        radius = (1.0 if self._radius is None else float(self._radius)) * scale[0]
        return {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [radius, 0.0, 0.0]}


class _Cuboid(_Shape):
    def _geom(self, scale: np.ndarray) -> dict[str, Any]:
        edges = np.broadcast_to(np.asarray(to_floats(self._size, (1.0,))), 3) * scale
        return {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": (0.5 * edges).tolist()}


class _Cylinder(_Shape):
    def _geom(self, scale: np.ndarray) -> dict[str, Any]:
        radius, height = self._radius or 1.0, self._height or 1.0
        return {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [radius * scale[0], 0.5 * height * scale[2], 0.0]}


class DynamicSphere(_Sphere):
    """A sphere that moves and collides."""


class FixedSphere(_Sphere):
    """A sphere that is fixed and collides."""

    free = False


class VisualSphere(_Sphere):
    """A sphere without collisions."""

    free, solid = False, False


class DynamicCuboid(_Cuboid):
    """A box that moves and collides."""


class FixedCuboid(_Cuboid):
    """A box that is fixed and collides."""

    free = False


class VisualCuboid(_Cuboid):
    """A box without collisions."""

    free, solid = False, False


class DynamicCylinder(_Cylinder):
    """A cylinder that moves and collides."""


class FixedCylinder(_Cylinder):
    """A cylinder that is fixed and collides."""

    free = False


class Cloner(Counterpart):
    """Replacement for Isaac Sim's Cloner: it copies prims inside an environment. rlcli copies the environments."""

    def __init__(self, spacing: float = 0.0, *args: Any, **kwargs: Any) -> None:
        self.spacing = spacing

    def generate_paths(self, root_path: str, num_paths: int) -> list[str]:
        """Return the paths `root_path_0` to `root_path_N`, N = `num_paths` - 1."""
        return [f"{root_path}_{number}" for number in range(num_paths)]

    def define_base_env(self, base_env_path: str) -> None:
        """Do nothing: the environments exist."""

    def filter_collisions(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing: environments never collide."""

    def clone(
        self,
        source_prim_path: str,
        prim_paths: list[str],
        positions: Any = None,
        orientations: Any = None,
        **kwargs: Any,
    ) -> None:
        """Copy a prim with its model to other paths.

        Raises:
            TaskError: for copies of an environment, which rlcli makes itself.
        """
        stage = get_current_stage()
        if any(not path.startswith(f"{ZERO}/") for path in prim_paths):
            hint = "call super().set_up_scene(scene): every environment is a copy of the first one"
            raise TaskError(f"{user_location()}a Cloner copies prims only inside {ZERO}", hint=hint)
        source = stage.find(source_prim_path)
        for number, path in enumerate(prim_paths):
            pos, quat = (None if values is None else values[number] for values in (positions, orientations))
            stage.clone(source, path, pos, quat)


class GridCloner(Cloner):
    """Replacement for Isaac Sim's GridCloner; rlcli itself places the environments on a grid."""


class GroundPlane:
    """The ground plane. `sim.add_ground_plane` of the YAML decides whether the scene has one."""

    def __init__(self, prim_path: str = "/World/defaultGroundPlane", **kwargs: Any) -> None:
        self.prim_path = prim_path
