"""Keys of a plan file: a volume, where cameras may stand, what hides markers, and cameras to choose from."""

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from mosca.data.files.rig_file import Pixels
from mosca.data.files.toml import NotNegative, Positive, Table, Vector, check, described, read_toml

Point2 = tuple[float, float]
Heights = tuple[float, float]


class MeasuredVolume(Table):
    """Where markers are to be measured: a box, or a prism over a polygon."""

    center_m: Vector | None = Field(None, description="centre of a box, world frame, z up [m]")
    size_m: tuple[Positive, Positive, Positive] | None = Field(None, description="edges of the box [m]")
    corners_m: tuple[Point2, ...] | None = Field(
        None, min_length=3, max_length=100, description="corners (x, y) of a prism instead, in order [m]"
    )
    heights_m: Heights | None = Field(None, description="lower and upper end of the prism [m]")
    marker_diameter_m: Positive = Field(description="diameter of the markers [m]")

    @model_validator(mode="after")
    def _one_shape(self) -> "MeasuredVolume":
        box, prism = (self.center_m, self.size_m), (self.corners_m, self.heights_m)
        if (None in box) == (None in prism) or (any(box) and any(prism)):
            raise ValueError("[volume]: give center_m and size_m of a box, or corners_m and heights_m of a prism")
        if self.heights_m is not None and not self.heights_m[0] < self.heights_m[1]:
            raise ValueError(f"volume.heights_m = {list(self.heights_m)} given; the lower end first")
        return self


class RoomSpec(Table):
    """Walls all round: none sees through them, and with ``mount_heights_m`` cameras may stand before them."""

    corners_m: tuple[Point2, ...] = Field(
        min_length=3, max_length=100, description="corners (x, y) in order, anticlockwise or clockwise [m]"
    )
    height_m: Positive = Field(3.0, description="height of the walls [m]")
    mount_heights_m: Heights | None = Field(
        None, description="lowest and highest place of cameras on the walls [m]; default: none there"
    )
    gap_m: Positive = Field(0.15, description="distance of cameras from the wall [m]")


class RailSpec(Table):
    """A rail on which cameras may stand."""

    from_m: Vector = Field(description="one end, world frame [m]")
    to_m: Vector = Field(description="the other end [m]")


class WallSpec(Table):
    """A part of a wall before which cameras may stand."""

    from_m: Point2 = Field(description="one end (x, y) [m]")
    to_m: Point2 = Field(description="the other end [m]")
    heights_m: Heights = Field(description="lowest and highest place [m]; the same twice: a line")


class ObstacleSpec(Table):
    """An upright body that hides what is behind it."""

    kind: Literal["box", "cylinder"] = Field(description="its shape")
    center_m: Vector = Field(description="its middle, world frame [m]")
    size_m: tuple[Positive, Positive, Positive] = Field(
        description="edges [m]; of a cylinder its diameter twice, then its height"
    )
    yaw_deg: float = Field(0.0, description="turned about the vertical by this angle [deg]")


class SubjectSpec(Table):
    """An upright cylinder or capsule that carries the markers: each is seen from before its tangent plane alone."""

    directions: int = Field(8, ge=3, le=64, description="directions in which markers face, evenly all round")
    radius_m: Positive = Field(0.15, description="its radius [m]: it hides its own markers, and their images overlap")


class CameraModelSpec(Table):
    """A camera on sale, and the lenses that go with it."""

    model: str = Field(min_length=1, description="its name")
    sensor: str | None = Field(None, description="a sensor of the library: size, pitch, full well, noise and bits")
    size_px: tuple[Pixels, Pixels] | None = Field(None, description="image width and height [px]")
    pixel_pitch_mm: Positive | None = Field(None, description="pixel pitch [mm]")
    full_well_e: Positive = Field(20_000.0, description="saturation capacity [e-]")
    read_noise_e: Positive = Field(10.0, description="dark noise [e-]")
    bits: Literal[8, 10, 12] = Field(8, description="bits of a pixel")
    focal_lengths_mm: tuple[Positive, ...] = Field(
        min_length=1, max_length=50, description="focal lengths to choose from [mm]"
    )
    f_number: Positive | None = Field(
        None,
        description="aperture, for the depth of field; focused on the volume's centre. Default: sharp everywhere",
    )
    price: NotNegative = Field(0.0, description="price with lens, in any currency")

    @model_validator(mode="after")
    def _one_chip(self) -> "CameraModelSpec":
        own = {"size_px", "pixel_pitch_mm", "full_well_e", "read_noise_e", "bits"} & self.model_fields_set
        if self.sensor is None and (self.size_px is None or self.pixel_pitch_mm is None):
            raise ValueError(f"camera '{self.model}': give sensor, or size_px and pixel_pitch_mm")
        if self.sensor is not None and own:
            raise ValueError(f"camera '{self.model}': {min(own)} is the sensor's own; leave it or sensor out")
        return self


class BudgetSpec(Table):
    """How many cameras there may be, and what they may cost."""

    cameras: int = Field(ge=2, le=32, description="cameras at most")
    money: Positive | None = Field(None, description="what all cameras may cost together; default: anything")


class GoalSpec(Table):
    """What is minimised."""

    quantile: Annotated[float, Field(ge=0.5, le=0.99)] = Field(
        0.9, description="share of the markers whose standard deviation is to be small"
    )
    seen_by: int = Field(2, ge=2, le=10, description="cameras that must see a marker for it to count as measured")
    spacing_m: NotNegative = Field(0.3, description="least distance of two cameras [m]")


class ImagesSpec(Table):
    """What images of markers are like; the defaults are those of ``[errors]`` in scenarios."""

    body_px: NotNegative = Field(0.03, description="shake of the camera body, rms an axis [px]")
    lens_px: NotNegative = Field(0.02, description="what the lens model leaves, rms an axis [px]")
    psf_sigma_px: Annotated[float, Field(ge=0.1, le=10)] = Field(0.6, description="blur of the lens in focus [px]")
    marker_signal: Annotated[float, Field(gt=0, le=1)] = Field(
        0.6, description="light of a covered pixel over the full well"
    )
    background_e: NotNegative = Field(200.0, description="ambient light a pixel [e-]")


class FieldSessionSpec(Table):
    """The session with a test field from which the rig is calibrated, as ``[calibration]`` of a scenario has it."""

    markers: int = Field(100, ge=20, le=500, description="coded targets of the field")
    stands: int = Field(10, ge=3, le=100, description="places at which it is put")
    frames: int = Field(2, ge=1, le=1000, description="exposures at each")
    world_frames: int = Field(10, ge=1, le=1000, description="exposures at the first, which is the world")
    known_to: Positive = Field(1e-5, description="standard deviation of its marks, share of its longest edge")
    shift: NotNegative = Field(0.45, le=1, description="how far from the first stand, share of the field's edges")
    tilt_deg: NotNegative = Field(25.0, le=60, description="how far it leans at most")


class PlanFile(Table):
    """What is to be planned."""

    FILE_KIND: ClassVar[str] = "plan"

    title: str = Field(description="what is planned, in one line")
    seed: int = Field(1, ge=0, description="seed of the search and of the simulation")
    volume: MeasuredVolume = Field(description="where markers are to be measured")
    room: RoomSpec | None = Field(None, description="walls all round")
    rail: tuple[RailSpec, ...] = Field((), max_length=100, description="rails for cameras; [[rail]]")
    wall: tuple[WallSpec, ...] = Field((), max_length=100, description="parts of walls for cameras; [[wall]]")
    obstacle: tuple[ObstacleSpec, ...] = Field((), max_length=100, description="what hides markers; [[obstacle]]")
    subject: SubjectSpec | None = Field(None, description="a body that hides its own markers")
    camera: tuple[CameraModelSpec, ...] = Field(
        min_length=1, max_length=20, description="cameras to choose from; [[camera]]"
    )
    budget: BudgetSpec = Field(description="how many cameras, and what they may cost")
    goal: GoalSpec = GoalSpec()
    images: ImagesSpec = ImagesSpec()
    calibration: FieldSessionSpec = FieldSessionSpec()

    @model_validator(mode="after")
    def _consistent(self) -> "PlanFile":
        if not self.rail and not self.wall and (self.room is None or self.room.mount_heights_m is None):
            raise ValueError("no place for cameras; give room.mount_heights_m, a [[wall]] or a [[rail]]")
        for where, heights in (
            *((f"wall[{k}].heights_m", one.heights_m) for k, one in enumerate(self.wall)),
            *([("room.mount_heights_m", self.room.mount_heights_m)] if self.room is not None else []),
        ):
            if heights is not None and heights[0] > heights[1]:
                raise ValueError(f"{where} = {list(heights)} given; the lower end first")
        if self.goal.seen_by > self.budget.cameras:
            raise ValueError(
                f"goal.seen_by = {self.goal.seen_by} with budget.cameras = {self.budget.cameras} given; a marker "
                "cannot be seen by more cameras than there are: lower the one or raise the other"
            )
        money, cheapest = self.budget.money, min(one.price for one in self.camera)
        if money is not None and 2 * cheapest > money:
            raise ValueError(
                f"budget.money = {money:g} given; two of the cheapest cameras cost {2 * cheapest:g}: raise it, or "
                "give a cheaper [[camera]]"
            )
        names = [one.model for one in self.camera]
        if len(set(names)) != len(names):
            twice = next(one for one in names if names.count(one) > 1)
            raise ValueError(f"[[camera]] model = '{twice}' stands twice; give all its focal_lengths_mm in one table")
        return self


def load_plan(path: Path) -> PlanFile:
    """Read a plan file; InputError names file, key, value and what is allowed."""
    return check(PlanFile, read_toml(path), path)


def plan_schema() -> dict[str, Any]:
    """Return the JSON schema of plan files."""
    return described(PlanFile.model_json_schema())
