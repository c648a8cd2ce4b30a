"""Keys of a scenario file: the scene before the cameras."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mosca.data.files.toml import NotNegative, Positive, Table, Vector


class ActorScene(Table):
    """A person with markers on the skin, who walks, boxes, dances, jumps or bends, or is moved by a motion file."""

    kind: Literal["actor"]
    motion: str | None = Field(None, description="AMC or BVH file; default: the built-in action")
    skeleton: str | None = Field(None, description="ASF file that belongs to an AMC file")
    start_s: NotNegative = Field(0.1, description="where in the motion file to begin [s]")
    metres_per_unit: Positive | None = Field(None, description="unit of the motion file, where it cannot say")
    motion_rate_hz: Positive | None = Field(None, description="frame rate of the motion file, where it lies")
    heading_deg: float = Field(0.0, description="turn of the motion file about the vertical [deg]")
    keep_in_box: bool = Field(True, description="whether a motion that leaves the working space is an error")
    action: Literal["walk", "run", "boxing", "dance", "jump", "range_of_motion"] = Field(
        "walk",
        description="what the person does without a motion file; all but 'walk' are loops drawn by the seed, "
        "over the middle of a working space of 2.5 m; 'range_of_motion' (24 s) moves every joint in turn, for "
        "calibrating a skeleton",
    )
    gait: Literal["circle", "in_place", "back_and_forth"] = Field("circle", description="path of action 'walk'")
    gait_detail: Literal["planar", "full"] = Field(
        "planar",
        description="whether the walker's hips and knees bend in the planes of the legs alone, or the pelvis sinks "
        "and hips adduct and rotate as in people",
    )
    speed_mps: Positive = Field(1.0, description="speed of action 'walk' [m/s]")
    markers: int = Field(50, ge=30, le=60, description="markers on the skin")
    marker_set: Literal["default", "anatomical"] = Field(
        "default",
        description="where they are; 'anatomical': 53, with one on both sides of each knee, ankle and elbow",
    )
    skin: Literal["off", "moderate", "strong"] = Field(
        "moderate", description="how far the markers slide on the bones (soft tissue; docs/people.md has millimetres)"
    )
    seat_sigma_m: float = Field(
        0.0,
        ge=0,
        le=0.02,
        description="how far markers sit from their set's places, along the skin (standard deviation) [m]",
    )
    marker_diameter_m: Positive = Field(0.016, description="diameter of the ball markers [m]")

    @model_validator(mode="after")
    def _has_one_set(self) -> "ActorScene":
        if self.marker_set != "default" and "markers" in self.model_fields_set:
            raise ValueError(f"markers is of the default set; '{self.marker_set}' has its own: leave markers out")
        return self

    @model_validator(mode="after")
    def _says_one_motion(self) -> "ActorScene":
        if self.motion is not None and "action" in self.model_fields_set:
            raise ValueError(f"action = '{self.action}' and motion = '{self.motion}' given; leave one of them out")
        for key in ("gait", "gait_detail", "speed_mps"):
            if self.action != "walk" and key in self.model_fields_set:
                raise ValueError(f"{key} is of action = 'walk'; '{self.action}' has its own: leave {key} out")
        return self


class FaceScene(Table):
    """A head that looks along +x and speaks, with 40 ball markers on its deforming face."""

    kind: Literal["face"]
    size: Annotated[float, Field(ge=0.7, le=1.3)] = Field(1.0, description="of the head, against the mean adult's")
    seat_sigma_m: float = Field(
        0.002,
        ge=0,
        le=0.01,
        description="how far markers sit from their places, along the skin (standard deviation) [m]",
    )
    marker_diameter_m: Positive = Field(0.003, description="diameter of the ball markers [m]")


class DroneScene(Table):
    """A quadrotor of AR.Drone 2.0 size and mass, flown along a path by a controller on MuJoCo's physics."""

    kind: Literal["drone"]
    path: Literal["figure_eight", "circle", "waypoints", "hover", "steps"] = Field(
        "figure_eight", description="path flown"
    )
    speed_mps: Positive = Field(0.5, description="speed along the path [m/s]")
    gust_n: NotNegative = Field(0.02, description="rms force of smooth gusts, each axis [N]; the drone weighs 3.6 N")
    markers: int = Field(8, ge=5, le=16, description="ball markers on the hull")
    marker_diameter_m: Positive = Field(0.02, description="diameter of the ball markers [m]")


class RobotScene(Table):
    """A four-wheel skid-steered robot on contact physics, driven by PWM commands."""

    kind: Literal["robot"]
    average_pwm: Positive = Field(30.0, description="a_m of the paper: largest average PWM value")
    difference_pwm: Positive = Field(60.0, description="d_m of the paper: largest command difference")
    marker_diameter_m: Positive = Field(0.03, description="diameter of the flat round targets [m]")
    commands: str | None = Field(
        None,
        description="what drives it in place of noise: a program file as of mosca capture --program, or a recording "
        'with its channel of commands; lines {"left": PWM, "right": PWM}',
    )
    target: str = Field("robot", description="name of the target whose commands it takes")
    heading_deg: float | None = Field(None, description="where it looks at the start; default: drawn")

    @model_validator(mode="after")
    def _one_driver(self) -> "RobotScene":
        for key in ("average_pwm", "difference_pwm"):
            if self.commands is not None and key in self.model_fields_set:
                raise ValueError(f"{key} is of the noise; commands = '{self.commands}' drive it: leave one out")
        return self


class CloudScene(Table):
    """Free points in the working space on smooth independent paths, never closer than a stated distance."""

    kind: Literal["cloud"]
    markers: int = Field(200, ge=1, le=2000, description="number of points")
    marker_diameter_m: Positive = Field(description="diameter of the balls [m]")
    speed_mps: NotNegative = Field(0.5, description="typical speed [m/s]")


class OwnScene(Table):
    """Your own MJCF or URDF model, with meshes and markers."""

    kind: Literal["own"]
    model: str = Field(description="MJCF (.xml) or URDF (.urdf) file")
    markers: str = Field(
        description="marker table (.csv or .toml): name, body, x, y, z, diameter [m], kind; or the model's own: "
        "'sites', 'sites:PATTERN', 'geoms:PATTERN' (spheres), with wildcards * and ?"
    )
    motion: str = Field("turntable", description="'turntable', 'physics', or a CSV file of time and qpos")
    speed_mps: Positive = Field(0.3, description="speed on the turntable [m/s]")


class FieldScene(Table):
    """A three-dimensional test field of coded targets that fills the working space."""

    kind: Literal["field"]
    markers: int = Field(100, ge=6, le=507, description="coded targets")
    layout: Literal["tower", "corner"] = Field("tower", description="how they stand: a tower, or a corner of walls")
    dot_radius_m: Positive | None = Field(None, description="radius of the centre dots [m]; default: by the room")
    target: str | None = Field(None, description="file that describes the field, in place of a made one")
    turn_deg_per_s: float = Field(0.0, description="how fast it is turned about the vertical [deg/s]")


class BoardScene(Table):
    """A checkerboard or ChArUco board carried through the working space; its only marker is "board"."""

    kind: Literal["board"]
    target: str | None = Field(None, description="file that describes the board; default: 9 x 6 squares")
    speed_mps: NotNegative = Field(0.2, description="rms speed [m/s]")
    turn_deg_per_s: NotNegative = Field(23.0, description="rms rate of tilt and roll [deg/s]")
    tilt_deg: NotNegative = Field(34.0, description="how far it is tilted at most [deg]")
    facing: Vector | None = Field(None, description="where it looks; default: all round")


class WandScene(Table):
    """A wand with balls at known distances waved through the working space."""

    kind: Literal["wand"]
    target: str | None = Field(None, description="file that describes the wand; default: three balls")
    speed_mps: NotNegative = Field(0.8, description="rms speed [m/s]")
    turn_deg_per_s: NotNegative = Field(57.0, description="rate of its turn [deg/s]")


class ScaleBarScene(Table):
    """A bar with two coded targets a certified length apart, waved through the working space."""

    kind: Literal["scale_bar"]
    target: str | None = Field(None, description="file that describes the bar")
    speed_mps: NotNegative = Field(0.4, description="rms speed [m/s]")
    turn_deg_per_s: NotNegative = Field(23.0, description="rate of its turn [deg/s]")


class LFrameScene(Table):
    """The frame of balls that sets the world's axes, standing at the bottom of the working space."""

    kind: Literal["l_frame"]
    target: str | None = Field(None, description="file that describes the frame")
    azimuth_deg: float = Field(0.0, description="how far it is turned about the vertical [deg]")


class LightScene(Table):
    """A lamp that blinks the time, for the synchronisation of cameras."""

    kind: Literal["light"]
    bit_s: Positive = Field(0.04, description="length of a bit of its code [s]")
    order: int = Field(8, ge=3, le=12, description="its code repeats after 2^order - 1 bits")
    marker_diameter_m: Positive | None = Field(None, description="diameter of the light's ball [m]")
    speed_mps: NotNegative = Field(0.3, description="how it is waved [m/s]")


class PanelScene(Table):
    """A vehicle's panel: a level sheet, simply supported at its rim, that vibrates in its lowest modes."""

    kind: Literal["panel"]
    size_m: tuple[Positive, Positive] = Field((0.6, 0.4), description="edges along x and y [m]")
    thickness_m: Positive = Field(0.0009, description="of the sheet [m]")
    youngs_pa: Positive = Field(210e9, description="Young's modulus; default: steel [Pa]")
    poisson: Annotated[float, Field(ge=0, lt=0.5)] = Field(0.3, description="Poisson's ratio")
    density_kg_m3: Positive = Field(7850.0, description="density [kg/m^3]")
    damping: tuple[Annotated[float, Field(gt=0, lt=0.5)], ...] = Field(
        (0.003, 0.003, 0.003, 0.003, 0.003),
        min_length=1,
        max_length=40,
        description="of each of the lowest modes, share of critical; as many modes as numbers",
    )
    grid: tuple[Annotated[int, Field(ge=1, le=40)], Annotated[int, Field(ge=1, le=40)]] = Field(
        (6, 5), description="targets along x and y"
    )
    marker_diameter_m: Positive = Field(0.01, description="diameter of the flat round targets [m]")
    rms_m: Positive = Field(0.0002, le=0.001, description="deflection of all modes together, rms [m]")
    band_hz: tuple[Positive, Positive] = Field((5.0, 95.0), description="band of the white random forces [Hz]")
    shake_m: NotNegative = Field(0.0, le=0.05, description="rigid motion of the carrier, rms an axis [m]")
    line_hz: NotNegative = Field(0.0, description="a steady line, such as an engine's order [Hz]")
    line_m: NotNegative = Field(0.0, le=0.001, description="its amplitude, in the shape of the lowest mode [m]")

    @model_validator(mode="after")
    def _bands(self) -> "PanelScene":
        low, high = self.band_hz
        if not low < high <= 5000:
            raise ValueError(f"band_hz = [{low:g}, {high:g}] given; the smaller first, up to 5000 Hz, is wanted")
        if (self.line_hz > 0) != (self.line_m > 0):
            raise ValueError(f"line_hz = {self.line_hz:g} and line_m = {self.line_m:g} given; they belong together")
        return self


SceneSpec = Annotated[
    ActorScene
    | FaceScene
    | DroneScene
    | RobotScene
    | CloudScene
    | OwnScene
    | FieldScene
    | BoardScene
    | WandScene
    | ScaleBarScene
    | LFrameScene
    | LightScene
    | PanelScene,
    Field(discriminator="kind"),
]


class GlowSpec(Table):
    """How all markers of the scene send their light; what is not written stays as the scene has it."""

    kind: Literal["plain", "retro", "paper", "lamp"] = Field("plain", description="what they are made of")
    strength: Positive = Field(1.0, description="factor on errors.marker_signal")
    half_deg: Annotated[float, Field(gt=0, lt=90)] = Field(45.0, description="angle at which half is left")
    at_m: Positive | None = Field(None, description="distance of full brightness under the ring light [m]")
    even_deg: Annotated[float, Field(ge=0, lt=90)] | None = Field(
        None, description="retro: even up to here, half at half_deg, nothing as far beyond; default: a cosine's power"
    )
    ring_m: NotNegative = Field(0.0, description="retro: radius of the ring light, for the observation angle [m]")
    lobe_deg: Annotated[float, Field(gt=0, le=90)] = Field(
        1.0, description="retro: observation angle at which 1/e is left"
    )
    lamp_half_deg: Annotated[float, Field(gt=0, lt=90)] | None = Field(
        None, description="retro: angle off the camera's axis at which its lamps send half; default: alike everywhere"
    )
    limb: Annotated[float, Field(ge=0, le=1)] = Field(0.0, description="brightness that a ball's rim lacks")
    shade: Annotated[float, Field(ge=-1, le=1)] = Field(0.0, description="change from the middle to the rim")
    shade_world: Vector = Field((0.0, 0.0, 1.0), description="the side that is brighter")

    @model_validator(mode="after")
    def _has_a_side(self) -> "GlowSpec":
        if not any(self.shade_world):
            raise ValueError(f"shade_world = {self.shade_world} given; a direction of 3 numbers is wanted")
        return self


class LampsSpec(Table):
    """Markers that are lamps and blink numbers, in step with the frames."""

    names: tuple[str, ...] | None = Field(None, description="which markers; default: all")
    frames_per_bit: int = Field(1, ge=1, description="frames that a bit lasts")
