"""Keys of a scenario file: the cameras, their poses, and their effects on light and time.

The tables [errors], [optics], [timing], [mount], [sensor] and [delivery] hold for all cameras; a [[camera]] with a
name changes its keys for that camera only. The meanings are those of ``twin.cameras``.
"""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mosca.data.files.rig_file import Pixels
from mosca.data.files.toml import NotNegative, Positive, Table, Vector
from mosca.data.lamp_codes import LAMP_NUMBERS

Share = Annotated[float, Field(ge=0, le=1)]
Pair = tuple[float, float]


class Cameras(Table):
    """The rig: cameras on a ring around the working space, or a rig file."""

    rig: str | None = Field(None, description="rig file; the ring's keys are then not used")
    count: int = Field(4, ge=2, le=32, description="cameras on the ring")
    azimuth_deg: tuple[float, ...] | None = Field(None, description="where on the ring; default: evenly spaced")
    radius_m: Positive = Field(4.0, description="radius of the ring about the working space's centre [m]")
    height_m: float | tuple[float, ...] = Field(1.6, description="height of the cameras above the floor [m]")
    look_at_m: Vector | None = Field(None, description="where they look; default: the working space's centre")
    size_px: tuple[Pixels, Pixels] = Field((656, 491), description="image width and height [px]")
    pixel_pitch_mm: Positive = Field(0.0099, description="pixel pitch mx = my [mm]")
    c_mm: Positive = Field(7.5, description="principal distance [mm]")
    K1_per_mm2: float = Field(1.0e-3, description="radial distortion, as the paper's Table 2 has it")
    K2_per_mm4: float = Field(-1.5e-5, description="radial distortion")
    P1_per_mm: float = Field(1.0e-4, description="decentring distortion")
    P2_per_mm: float = Field(5.0e-5, description="decentring distortion")
    a: float = Field(-6.0e-3, description="affinity")

    @model_validator(mode="after")
    def _lists_fit(self) -> "Cameras":
        for name in ("azimuth_deg", "height_m"):
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) != self.count:
                raise ValueError(f"{name} holds {len(value)} numbers for count = {self.count} cameras")
        return self


class ErrorsSpec(Table):
    """Errors of the virtual cameras. The defaults are the gentlest that an accuracy claim may rest on."""

    trigger_jitter_s: NotNegative = Field(20e-6, description="jitter of each exposure's start, rms [s]")
    body_px: NotNegative = Field(0.03, description="shake of the camera body, rms an axis [px]")
    psf_sigma_px: Annotated[float, Field(ge=0.1, le=10)] = Field(0.6, description="blur of the lens [px]")
    marker_signal: Positive = Field(0.6, description="light of a covered pixel over the full well")
    full_well_e: Positive = Field(20_000.0, description="saturation capacity [e-]")
    read_noise_e: Positive = Field(10.0, description="dark noise [e-]")
    background_e: NotNegative = Field(200.0, description="ambient light a pixel [e-]")
    bits: Literal[8, 10, 12] = Field(8, description="bits of a pixel")


class OpticsSpec(Table):
    """What the lenses do beyond their distortion; blur in focus is ``errors.psf_sigma_px``."""

    lens: str | None = Field(None, description="a lens of the library: its focal length and its range of f-numbers")
    focus_m: Positive | None = Field(None, description="distance of sharp focus [m]; default: sharp everywhere")
    f_number: Positive = Field(4.0, description="aperture")
    curvature_px: float = Field(0.0, description="blur circle that field curvature adds at the corner [px]")
    coma_px: float = Field(0.0, description="length of the coma at the corner [px]")
    vignetting: Annotated[float, Field(ge=0, lt=1)] = Field(0.0, description="share of light lost at the corner")
    tilt_deg: Pair | None = Field(None, description="tilt of the sensor; default: what model_gap stands for")
    pupil_shift_m: float | None = Field(
        None, description="shift of the entrance pupil at 45 deg [m]; default: what model_gap stands for"
    )
    principal_distance_ppm_per_s: float = Field(0.0, description="warming: growth of the principal distance")
    principal_point_px_per_s: Pair = Field((0.0, 0.0), description="warming: way of the principal point [px/s]")


class TimingSpec(Table):
    """When the cameras expose and how they stamp; jitter is ``errors.trigger_jitter_s``."""

    delay_s: float = Field(0.0, description="a delay of the trigger that the stamps know nothing of [s]")
    skew_s: float = Field(0.0, description="a known offset from the pulse, which the stamps tell [s]")
    rate_hz: Positive | None = Field(None, description="free running at its own rate [Hz]; default: triggered")
    offset_s: float = Field(0.0, description="free running: first frame after the start [s]")
    drift_ppm: float = Field(0.0, description="free running: how much faster than stated")
    exposure_s: Positive | None = Field(None, description="own exposure [s]; default: capture.exposure_s")
    row_time_s: NotNegative = Field(0.0, description="rolling shutter: from row to row [s]; 0: global")
    strobe_s: Positive | None = Field(None, description="how long the light is on [s]; default: always")
    strobe_delay_s: float = Field(0.0, description="from the opening (own) or the pulse (rig) to the light [s]")
    strobe: Literal["own", "rig"] = Field("own", description="whose light: each camera's, or one for the rig")
    stamp_event: Literal["exposure_start", "exposure_middle", "readout"] = Field(
        "exposure_start", description="instant of the exposure that the camera stamps"
    )
    clock: Literal["session", "device", "host"] = Field(
        "session", description="whose clock stamps: the session's, the camera's own, or the computer's at arrival"
    )
    clock_offset_s: float = Field(0.0, description="what the camera's clock reads at the session's start [s]")
    clock_drift_ppm: float = Field(0.0, description="how much faster the camera's clock runs")
    stamp_resolution_ns: int = Field(1, ge=1, description="tick of the camera's clock [ns]")
    stamp_jitter_s: NotNegative = Field(0.0, description="host clock: mean lateness of a stamp [s]")


class MountSpec(Table):
    """How the camera bodies move; white shake is ``errors.body_px``."""

    vibration_px: NotNegative = Field(0.0, description="vibration, rms each axis [px]")
    vibration_hz: tuple[Positive, Positive] = Field((5.0, 60.0), description="its band [Hz]")
    vibration_slope: float = Field(0.0, description="its power density goes with this power of the frequency")
    drift_px_per_s: Pair = Field((0.0, 0.0), description="steady drift (x, y) [px/s]")
    wander_px: NotNegative = Field(0.0, description="random walk, rms in the first second [px]")
    wander_bound_px: Positive = Field(1.0, description="where the walk is reflected [px]")
    bump_s: NotNegative | None = Field(None, description="when somebody hits the camera [s]")
    bump_px: Pair = Field((0.0, 0.0), description="how far its image moves then, for good (x, y) [px]")
    bump_m: Vector = Field((0.0, 0.0, 0.0), description="how far the camera moves then, its own axes [m]")
    bump_rise_s: Positive = Field(0.01, description="within what time [s]")


class SensorSpec(Table):
    """The sensor in EMVA 1288 terms; full well, dark noise, bits and background are in [errors]."""

    name: str | None = Field(
        None, description="a sensor of the library: size, pitch, full well, noise, bits and row time are its own"
    )
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)] = Field(0.6, description="electrons a photon")
    black_dn: NotNegative = Field(4.0, description="black level, 8-bit counts")
    dark_current_e_per_s: NotNegative = Field(0.0, description="dark current [e-/s]")
    dsnu_e: NotNegative = Field(0.0, description="fixed pattern of the dark signal, rms [e-]")
    prnu: Share = Field(0.0, description="fixed pattern of the response, rms share")
    linearity: Annotated[float, Field(ge=0, le=0.2)] = Field(0.0, description="response lost at full well, share")
    hot_pixels: Share = Field(0.0, description="share of pixels that are hot")
    hot_e: Positive = Field(1000.0, description="mean of what they collect too many [e-]")
    dead_pixels: Share = Field(0.0, description="share of pixels that see nothing")


class DeliverySpec(Table):
    """What happens to frames on their way from the camera."""

    dropped_share: Share = Field(0.0, description="frames lost at random")
    burst_share: Share = Field(0.0, description="frames lost in bursts")
    burst_frames: int = Field(10, ge=1, description="length of a burst")
    corrupt_share: Share = Field(0.0, description="frames without a usable image")
    late_share: Share = Field(0.0, description="frames that come late")
    late_frames: int = Field(50, ge=1, description="by how many frames of the rig")
    reordered_share: float = Field(
        0.0, ge=0, le=0.5, description="frames that come after the camera's next one, which then does not"
    )
    doubled_share: Share = Field(0.0, description="frames that come twice")
    dies_s: NotNegative | None = Field(None, description="when the camera dies [s]")
    returns_s: NotNegative | None = Field(None, description="when it is back [s]")


class CameraSpec(Table):
    """What is different with one camera: only the keys that are written count."""

    name: str = Field(description="the camera's name; a new name adds a camera that rides on a body")
    body: str | None = Field(None, description="body of the scene that a new camera rides on")
    place_m: Vector = Field((0.0, 0.0, 0.0), description="where on the body it sits, body axes [m]")
    forward: Vector = Field((1.0, 0.0, 0.0), description="where it looks, body axes")
    up: Vector = Field((0.0, 0.0, 1.0), description="its upper side, body axes")
    size_px: tuple[Pixels, Pixels] | None = Field(None, description="image of a new camera [px]")
    fisheye_deg: Annotated[float, Field(gt=10, le=190)] | None = Field(
        None, description="a new camera is a fisheye that sees this angle across the image's width [deg]"
    )
    c_mm: Positive | None = Field(None, description="principal distance of a new camera [mm]")
    lamp_m: Vector | None = Field(
        None,
        description="where a new camera's LED sits, its own axes (right, down, ahead) [m]; default: it carries none",
    )
    lamp_diameter_m: Positive = Field(0.012, description="diameter of the LED's ball [m]")
    lamp_number: Annotated[int, Field(ge=0, lt=LAMP_NUMBERS)] | None = Field(
        None, description="number that the LED blinks, a bit for a frame period of the capture; default: always on"
    )
    window_px: tuple[int, int, int, int] | None = Field(
        None, description="windowed readout: left, top, width, height [px]"
    )
    errors: ErrorsSpec = ErrorsSpec()
    optics: OpticsSpec = OpticsSpec()
    timing: TimingSpec = TimingSpec()
    mount: MountSpec = MountSpec()
    sensor: SensorSpec = SensorSpec()
    delivery: DeliverySpec = DeliverySpec()

    @model_validator(mode="after")
    def _rides_with_a_lens(self) -> "CameraSpec":
        rider_only = {
            "place_m", "forward", "up", "size_px", "fisheye_deg", "c_mm", "lamp_m", "lamp_diameter_m",
            "lamp_number",
        } & self.model_fields_set  # fmt: skip
        if self.body is None and rider_only:
            raise ValueError(
                f"camera '{self.name}': {min(rider_only)} is for a camera that rides on a body; the rig's "
                "cameras have theirs from [cameras] or the rig file"
            )
        if self.body is not None and (self.size_px is None or (self.c_mm is None) == (self.fisheye_deg is None)):
            raise ValueError(
                f"camera '{self.name}' rides on '{self.body}': give its size_px and one of c_mm and fisheye_deg"
            )
        return self


class BackdropSpec(Table):
    """How uneven the background is, and what lies on the glass."""

    gradient: Pair = Field((0.0, 0.0), description="change from edge to edge (x, y), share of the background")
    blob_e: NotNegative = Field(0.0, description="more light in the middle of a soft spot [e-]")
    blob_xy: Pair = Field((0.5, 0.5), description="where, share of width and height")
    blob_radius: Positive = Field(0.2, description="its sigma, share of the width")
    dust: int = Field(0, ge=0, description="dark spots on the glass")
    dust_loss: Share = Field(0.1, description="light that a spot takes")
    dust_radius_px: Positive = Field(6.0, description="their mean radius [px]")

    @model_validator(mode="after")
    def _light_everywhere(self) -> "BackdropSpec":
        if abs(self.gradient[0]) + abs(self.gradient[1]) > 2.0:
            raise ValueError(
                f"gradient = {list(self.gradient)} given; 2 together at most, or a corner is darker than dark"
            )
        return self


class ClothSpec(Table):
    """What the geoms of a name pattern are covered with."""

    pattern: str = Field(description="geom names, with * and ?")
    reflectance: Annotated[float, Field(ge=0, le=1.5)] = Field(description="of a matt surface")
    retro: NotNegative = Field(0.0, description="times brighter than white under the camera's own lamp")
    band_m: Pair | None = Field(None, description="only between these places along the geom [m]")


class ContextSpec(Table):
    """The picture of scene and body behind the targets."""

    rate_hz: Positive = Field(10.0, description="how often it is made anew [Hz]")
    step_px: int = Field(2, ge=1, le=16, description="one ray for so many pixels each way")
    ambient: NotNegative = Field(0.01, description="light of a white surface in the room, over the full well")
    lamp: NotNegative = Field(0.02, description="what the camera's lamp adds at at_m, over the full well")
    at_m: Positive = Field(3.0, description="distance at which the lamp is so bright [m]")
    clothes: tuple[ClothSpec, ...] = Field(
        (), description="cloths on the scene's bodies; [[surroundings.context.clothes]]"
    )


class RingLightSpec(Table):
    """What cameras see of each other's ring lights."""

    radius_m: Positive = Field(0.04, description="of the ring about the lens [m]")
    strength: Positive = Field(20.0, description="times as bright as a marker, seen head on")
    half_deg: Annotated[float, Field(gt=0, lt=90)] = Field(30.0, description="angle at which it is half as bright")


class ShinySpotSpec(Table):
    """A fixed point that reflects light like a marker."""

    position_m: Vector = Field(description="its centre, world frame [m]")
    radius_m: Positive = Field(description="of the ball [m]")
    strength: Positive = Field(description="times as bright as a marker")
    facing: Vector | None = Field(None, description="where it shines best; default: everywhere alike")
    half_deg: Annotated[float, Field(gt=0, lt=90)] = Field(
        20.0, description="angle from 'facing' at which it is half as bright"
    )
    at_m: Positive | None = Field(
        None,
        description="distance at which it is so bright, which falls with its square [m]; default: the same at all",
    )


class MirrorSpec(Table):
    """A reflecting rectangle, in which the cameras see the targets once more."""

    center_m: Vector = Field(description="its middle, world frame [m]")
    normal: Vector = Field(description="where it faces")
    x_axis: Vector = Field(description="direction of its first side, at right angles to the normal")
    size_m: tuple[Positive, Positive] = Field(description="lengths of its sides [m]")
    reflectance: Annotated[float, Field(gt=0, le=1)] = Field(0.9, description="share of the light that it returns")


class GlareSpec(Table):
    """Haze in the lenses."""

    share: Annotated[float, Field(ge=0, lt=1)] = Field(0.0, description="share of the light that comes as haze")
    sigma: Positive = Field(0.125, description="its width over the image's")


class SurroundingsSpec(Table):
    """Surroundings of rig and subject; none by default."""

    backdrop: BackdropSpec = BackdropSpec()
    context: ContextSpec | None = None
    ring_light: RingLightSpec | None = None
    spots: tuple[ShinySpotSpec, ...] = Field((), description="shiny spots; [[surroundings.spots]]")
    mirrors: tuple[MirrorSpec, ...] = Field((), description="mirrors; [[surroundings.mirrors]]")
    glare: GlareSpec = GlareSpec()
