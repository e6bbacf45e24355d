"""Schema of the sensors in a scene: contact sensors, ray sensors and cameras.

Sensors of the MJCF need no entry; terms read both kinds.
"""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rlcli.config.schema.base import Count, Direction, Names, NotNegative, Positive, StrictModel, Vec3

_MAX_RAYS = 1_000_000


class TouchedConfig(StrictModel):
    """The bodies of an entity with which a contact sensor measures contacts (its key `against`)."""

    entity: str
    """Entity whose bodies are touched."""
    bodies: Names | None = None
    """Names or regexes of bodies of the entity; null: all its bodies."""


class ContactSensorConfig(StrictModel):
    """Contact sensor of bodies of an entity: net contact force, and time in contact and in the air."""

    kind: Literal["contact"]
    """Kind of sensor: always contact."""
    entity: str = "robot"
    """Entity that has the sensor's bodies."""
    bodies: Names
    """Names or regexes of bodies of the entity. The sensor's values have one column for each body, in this order. A
    body without a geom that can collide reads 0; at least one body must have such a geom."""
    against: Literal["ground"] | TouchedConfig | None = None
    """The other side of the contacts: ground (the plane or the terrain) or bodies of an entity; null: everything."""
    history: Count = 1
    """Number of environment steps whose forces the sensor keeps, in `force_history`."""
    force_threshold: NotNegative = 0.0
    """Smallest net force with which a body counts as in contact [N]; 0: every contact counts."""


class GridPatternConfig(StrictModel):
    """Parallel rays that start from a grid around the sensor. x changes fastest in the order of the rays."""

    size: tuple[NotNegative, NotNegative]
    """Size of the grid along x and y [m]."""
    resolution: Positive
    """Distance between neighbouring rays [m]."""
    direction: Direction = (0.0, 0.0, -1.0)
    """Direction of the rays in the sensor's frame; it is normalised."""

    @model_validator(mode="after")
    def _limited(self) -> Self:
        if (self.size[0] / self.resolution + 1) * (self.size[1] / self.resolution + 1) > _MAX_RAYS:
            raise ValueError(f"the grid has more than {_MAX_RAYS:,} rays; give a larger resolution or a smaller size")
        return self


class RaySensorConfig(StrictModel):
    """Ray sensor: distances along rays from a body, like those of a height scanner or a lidar."""

    kind: Literal["rays"]
    """Kind of sensor: always rays."""
    entity: str = "robot"
    """Entity to which the sensor is attached."""
    body: str | None = None
    """The body to which the sensor is attached; null: the root body."""
    pattern: GridPatternConfig | Annotated[list[Direction], Field(min_length=1)]
    """A grid of parallel rays, or a list of directions of rays that start in one point, in the sensor's frame."""
    offset: Vec3 = (0.0, 0.0, 0.0)
    """Position of the sensor relative to the body, along the axes of `alignment` [m]."""
    alignment: Literal["base", "yaw", "world"] = "base"
    """Axes of the sensor's frame. base: the axes of the body; yaw: the body's heading with z up; world: the world's
    axes."""
    max_distance: Positive = 10.0
    """Range of the sensor [m]; objects beyond it are not detected."""
    sees: Literal["ground", "all"] | Annotated[list[Annotated[int, Field(ge=0, le=5)]], Field(min_length=1)] = "ground"
    """What rays can hit. ground: the plane or the terrain; all: every geom that is not on the body; or a list of
    MuJoCo geom groups (0 to 5)."""
    lookup: bool = False
    """true: rays that point straight down read the ground from the terrain's table of heights. The distances are equal
    up to rounding, and the sensor is much faster on a GPU. `lookup` needs a terrain without boxes, and alignment yaw
    or world."""

    @model_validator(mode="after")
    def _straight_down(self) -> Self:
        if not self.lookup:
            return self
        pattern = self.pattern
        directions = [pattern.direction] if isinstance(pattern, GridPatternConfig) else pattern
        if any(x or y or z >= 0.0 for x, y, z in directions) or self.alignment == "base":
            raise ValueError("lookup needs rays straight down: set directions [0, 0, -1] and alignment yaw or world")
        if self.sees != "ground":
            raise ValueError("lookup needs rays that hit only the ground: set sees: ground, or remove lookup")
        return self


class CameraSensorConfig(StrictModel):
    """Camera sensor: images of every environment, rendered offscreen once in each environment step."""

    kind: Literal["camera"]
    """Kind of sensor: always camera."""
    data: Literal["rgb", "depth", "distance", "segmentation"] = "rgb"
    """rgb: red, green and blue in 0 to 255; depth: distance along the camera's axis [m]; distance: distance from the
    camera's position [m]; segmentation: id of the visible body in MuJoCo's model."""
    width: Annotated[int, Field(ge=1, le=4096)]
    """Image width [pixels]."""
    height: Annotated[int, Field(ge=1, le=4096)]
    """Image height [pixels]."""
    entity: str | None = None
    """The entity to which the camera is attached; null: the camera is fixed in the environment."""
    camera: str | None = None
    """A camera of the entity's MJCF, which defines position and field of view; null: the keys below define them."""
    body: str | None = None
    """The body of the entity to which the camera is attached; null: the root body."""
    eye: Vec3 = (-3.0, 0.0, 1.0)
    """Position of the camera in the frame of the body, or of the environment [m]."""
    lookat: Vec3 = (0.0, 0.0, 0.0)
    """The point in the centre of the image, in the frame of `eye` [m]. The frame's z axis points up in the image,
    or its x axis if the camera looks along z."""
    fov: Annotated[float, Field(gt=0, lt=180)] = 45.0
    """Vertical field of view [degrees]."""
    clip: tuple[Positive, Positive] = (0.01, 20.0)
    """[near, far] distances along the camera's axis [m]; the camera does not see objects outside of them."""
    samples: Annotated[int, Field(ge=1, le=8)] = 1
    """Each pixel is the mean of `samples` x `samples` samples, which smooths edges and shows objects smaller than a
    pixel."""

    @model_validator(mode="after")
    def _relations(self) -> Self:
        if self.entity is None and (self.camera or self.body):
            raise ValueError("the keys camera and body need the key entity: set it, or remove them")
        placed = sorted({"body", "eye", "lookat", "fov"} & self.model_fields_set)
        if self.camera is not None and placed:
            keys = ", ".join(placed)
            raise ValueError(f"a camera of the MJCF has its own position and field of view: remove {keys}")
        if self.data == "segmentation" and self.samples > 1:
            raise ValueError("segmentation gives ids of bodies, which have no mean over samples: remove samples")
        if self.clip[0] >= self.clip[1]:
            raise ValueError(
                f"clip must be [near, far] in metres; near, {self.clip[0]:g}, is not below far, {self.clip[1]:g}"
            )
        if self.eye == self.lookat:
            raise ValueError("eye and lookat are the same point, so the camera has no direction: move one of them")
        return self


SensorConfig = Annotated[ContactSensorConfig | RaySensorConfig | CameraSensorConfig, Field(discriminator="kind")]
