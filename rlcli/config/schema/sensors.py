"""Contact sensors, ray sensors and cameras."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from rlcli.config.schema.base import Count, Direction, Names, NotNegative, Positive, StrictModel, Vec3


class TouchedConfig(StrictModel):
    """What a contact sensor listens to contacts with."""

    entity: str
    """Name of an entity."""
    bodies: Names | None = None
    """Names or regexes of its bodies; null: all of them."""


class ContactSensorConfig(StrictModel):
    """What touches bodies of an entity: net force, and how long they have been in contact or in the air."""

    kind: Literal["contact"]
    """contact."""
    entity: str = "robot"
    """Name of an entity."""
    bodies: Names
    """Names or regexes of its bodies, one slot each in the order written."""
    against: Literal["ground"] | TouchedConfig | None = None
    """Only contacts with this: ground (the plane or the terrain), or bodies of an entity; null: with anything."""
    history: Count = 1
    """Steps that `force_history` keeps."""
    force_threshold: NotNegative = 0.0
    """Net force from which on a body counts as in contact [N]; 0: any contact does."""


class GridPatternConfig(StrictModel):
    """Parallel rays that start from a grid about the sensor, x running fastest."""

    size: tuple[NotNegative, NotNegative]
    """Extent along x and y [m]."""
    resolution: Positive
    """Distance between neighbouring rays [m]."""
    direction: Direction = (0.0, 0.0, -1.0)
    """Where the rays go, in the sensor's frame."""


class RaySensorConfig(StrictModel):
    """Distances along rays from a body, as a height scanner or a lidar gives them."""

    kind: Literal["rays"]
    """rays."""
    entity: str = "robot"
    """Name of an entity."""
    body: str | None = None
    """The body that carries the sensor; null: the root."""
    pattern: GridPatternConfig | Annotated[list[Direction], Field(min_length=1)]
    """A grid of parallel rays, or a list of directions from one point, in the sensor's frame."""
    offset: Vec3 = (0.0, 0.0, 0.0)
    """Where the sensor sits in its frame [m]."""
    alignment: Literal["base", "yaw", "world"] = "base"
    """Axes of the sensor's frame: those of the body, those of the body's heading with z up, or the world's."""
    max_distance: Positive = 10.0
    """Range [m]; what lies farther is missed."""
    sees: Literal["ground", "all"] | Annotated[list[Annotated[int, Field(ge=0, le=5)]], Field(min_length=1)] = "ground"
    """ground: the plane or the terrain; all: every geom but those of the body; or a list of geom groups."""
    lookup: bool = False
    """Rays straight down find the ground in the table of the terrain's heights instead of among geoms: the same to
    rounding, and much faster on a GPU. For a terrain without boxes, and alignment yaw or world."""

    @model_validator(mode="after")
    def _straight_down(self) -> RaySensorConfig:
        if not self.lookup:
            return self
        pattern = self.pattern
        directions = [pattern.direction] if isinstance(pattern, GridPatternConfig) else pattern
        if any(x or y or z >= 0.0 for x, y, z in directions) or self.alignment == "base":
            raise ValueError("lookup is for rays straight down: directions [0, 0, -1], alignment yaw or world")
        if self.sees != "ground":
            raise ValueError("lookup is for rays that see the ground alone: sees: ground")
        return self


class CameraSensorConfig(StrictModel):
    """Pictures of every environment, drawn offscreen once an environment step: colours, or how far things are."""

    kind: Literal["camera"]
    """camera."""
    data: Literal["rgb", "depth", "distance"] = "rgb"
    """rgb: red, green and blue, 0 to 255; depth: along the camera's axis [m]; distance: from the camera's place [m]."""
    width: Annotated[int, Field(ge=1, le=1024)]
    """Columns of the picture."""
    height: Annotated[int, Field(ge=1, le=1024)]
    """Rows of the picture."""
    entity: str | None = None
    """The entity that the camera belongs to; null: it stands in the environment."""
    camera: str | None = None
    """A camera of the entity's MJCF, with its place and its field of view; null: what follows says them."""
    body: str | None = None
    """The body of the entity that carries the camera; null: its root."""
    eye: Vec3 = (-3.0, 0.0, 1.0)
    """Where the camera sits, in the frame of what carries it [m]."""
    lookat: Vec3 = (0.0, 0.0, 0.0)
    """A point in the middle of the picture, in the same frame [m]. The frame's z axis is up in it, or x if the camera
    looks along z."""
    fov: Annotated[float, Field(gt=0, lt=180)] = 45.0
    """Field of view from the lower to the upper edge [degrees]."""
    clip: tuple[Positive, Positive] = (0.01, 20.0)
    """What is nearer or farther than this along the camera's axis is not seen [m]."""
    samples: Annotated[int, Field(ge=1, le=8)] = 1
    """Each pixel is the mean of so many by so many: edges are soft, and things smaller than a pixel show."""

    @model_validator(mode="after")
    def _relations(self) -> CameraSensorConfig:
        if self.entity is None and (self.camera or self.body):
            raise ValueError("camera and body are those of an entity: name it")
        placed = sorted({"body", "eye", "lookat", "fov"} & self.model_fields_set)
        if self.camera is not None and placed:
            raise ValueError(f"a camera of the MJCF has its own place and field of view: leave {', '.join(placed)} out")
        if self.clip[0] >= self.clip[1]:
            raise ValueError(f"clip: {self.clip[0]:g} is not below {self.clip[1]:g}")
        if self.eye == self.lookat:
            raise ValueError("eye and lookat are one point: the camera has no direction")
        return self


SensorConfig = Annotated[ContactSensorConfig | RaySensorConfig | CameraSensorConfig, Field(discriminator="kind")]
