"""Keys of a scenario file, with units, bounds and defaults; nothing is computed here.

The published JSON schema (``mosca schema``) is made from these tables, so that editors complete and check.
"""

import tomllib
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, WithJsonSchema, model_validator

from mosca.calibration.quality.findings import CODES
from mosca.data.files.toml import (
    NotNegative,
    Positive,
    Table,
    UnboundedTomlError,
    Vector,
    check,
    described,
    parse_toml,
    read_toml,
)
from mosca.errors import InputError
from reports.metrics import METRICS
from scenarios.spec.acceptance import AcceptanceSpec, check_acceptance
from scenarios.spec.calibration import CalibrationSpec
from scenarios.spec.cameras import (
    Cameras,
    CameraSpec,
    DeliverySpec,
    ErrorsSpec,
    MountSpec,
    OpticsSpec,
    SensorSpec,
    SurroundingsSpec,
    TimingSpec,
)
from scenarios.spec.clinic import ClinicSpec
from scenarios.spec.continuous import ContinuousSpec
from scenarios.spec.faults import FaultSpec, LabelFault, RateFault
from scenarios.spec.flight import FlightSpec, check_flight
from scenarios.spec.identification import IdentificationSpec, check_identification
from scenarios.spec.limits import breaks_schema, end_of, limits_schema, read_breaks, read_limits
from scenarios.spec.scenes import ActorScene, GlowSpec, LampsSpec, PanelScene, SceneSpec
from scenarios.spec.self_orientation import SelfOrientationSpec, check_self_orientation
from scenarios.spec.skeleton import LabelsSpec, SkeletonSpec
from scenarios.spec.stages import StageTables
from scenarios.spec.vibration import VibrationSpec
from scenarios.spec.virtual import VirtualSpec, check_virtual_spec


class WorkingSpace(Table):
    """The box in which accuracy is claimed. Its longest edge is "the working space" of relative figures."""

    center_m: Vector = Field((0.0, 0.0, 0.0), description="centre of the box, world frame [m]")
    size_m: tuple[Positive, Positive, Positive] = Field(description="edges of the box [m]")


class Capture(Table):
    """When the cameras expose."""

    duration_s: Positive = Field(10.0, le=3600, description="length of the capture [s]")
    frame_rate_hz: Positive = Field(100.0, le=2000, description="trigger pulses a second [Hz]")
    exposure_s: Positive = Field(1e-3, description="exposure window [s]")

    @model_validator(mode="after")
    def _window_fits(self) -> "Capture":
        if self.exposure_s >= 1.0 / self.frame_rate_hz:
            raise ValueError(
                f"exposure_s {self.exposure_s} does not fit between pulses at {self.frame_rate_hz} Hz; "
                f"it must be below {1 / self.frame_rate_hz:g} s"
            )
        return self

    @property
    def pulses(self) -> int:
        """Number of trigger pulses."""
        return round(self.duration_s * self.frame_rate_hz)


class ZoneSpec(Table):
    """A part of the working space with cameras of its own; zones overlap, and their tracks are stitched."""

    name: str = Field(min_length=1, description="its name in tracks and notes")
    cameras: tuple[str, ...] = Field(min_length=2, description="its own cameras; no other zone has them")
    center_m: Vector = Field(description="centre of its box, world frame [m]")
    size_m: tuple[Positive, Positive, Positive] = Field(description="edges of its box [m]")


class PipelineSpec(StageTables):
    """The pipeline as a lab user would set it for this subject."""

    watch: bool = Field(False, description="watch the rig while it runs, and re-orient a bumped camera")
    bodies: bool = Field(
        False, description="poses of the scene's rigid bodies (three markers and more each) into bodies.csv"
    )
    tracker: Literal["mosca", "nearest"] = Field(
        "mosca", description="'nearest': the guide's nearest-neighbour tracker, the baseline of comparisons"
    )
    lens_model: Literal["mosca", "opencv", "fisheye"] = Field("mosca", description="lens model of the calibration")
    step_by: Literal["time", "pulse"] = Field(
        "time",
        description="'pulse': time is the pulse's number times the period, whatever the stamps say, so that two "
        "takes of the same pulses give the same tracks to the bit",
    )
    fill_s: Positive | None = Field(
        None, description="fill tracks' gaps up to this in what is written [s]; filled samples are never scored"
    )


class Premises(Table):
    """What must hold for a score to mean anything; the run refuses to score where it does not."""

    marker_px: NotNegative = Field(2.0, description="median image diameter of the markers, at least [px]")
    blur_px: Positive = Field(4.0, description="95th percentile of the motion in an exposure, at most [px]")
    views: NotNegative = Field(2.0, description="mean number of cameras that see a marker, at least")


class LengthSpec(Table):
    """A certified length that is seen: a scale bar, two balls of a wand. It is measured without any truth."""

    name: str = Field(min_length=1, description="its name in notes and on the page")
    length_m: Positive = Field(description="distance of its two markers' centres [m]")
    within: Annotated[float, Field(gt=0, lt=0.5)] = Field(
        0.02, description="share by which two markers' distance may differ and still be taken for it"
    )
    markers: tuple[str, str] | None = Field(
        None, description="labels of its two markers; default: the two that stay so far apart"
    )


Limits = Annotated[
    dict[str, float | tuple[float, float]], BeforeValidator(read_limits), WithJsonSchema(limits_schema())
]
"""Metric -> limit in the metric's unit, or the range in which it must lie."""
Breaks = Annotated[dict[str, tuple[float, float]], BeforeValidator(read_breaks), WithJsonSchema(breaks_schema())]
"""Metric -> range in the metric's unit."""


class Scenario(Table):
    """One scenario: subject, cameras, disturbances, and the accuracy that is claimed."""

    FILE_KIND: ClassVar[str] = "scenario"

    title: str = Field(description="what is claimed, in one line")
    description: str = Field("", description="why, and where the limits come from")
    tier: Literal["quick", "full"] = Field("full", description="'quick' runs in CI, 'full' at night")
    expect: Literal["pass", "fail", "caught", "diagnosed"] = Field(
        "pass",
        description="'fail' for a control, 'caught' for a calibration that must be refused or warned of, "
        "'diagnosed' for a fault that the clinic must name",
    )
    caught_as: str | None = Field(None, description="the finding's code: " + ", ".join(CODES))
    told: tuple[str, ...] = Field((), description="phrases that the record's notes must hold: what it must notice")
    seed: int = Field(1, ge=0, description="seed of all random streams")
    model_gap: Literal["none", "measured", "stress"] = Field(
        "measured", description="how far the true lens is from what the pipeline's model can express"
    )
    working_space: WorkingSpace
    capture: Capture = Capture()
    scene: SceneSpec = Field(description="what is before the cameras, by its kind")
    glow: GlowSpec | None = None
    lamps: LampsSpec | None = None
    cameras: Cameras = Cameras()
    errors: ErrorsSpec = ErrorsSpec()
    optics: OpticsSpec = OpticsSpec()
    timing: TimingSpec = TimingSpec()
    mount: MountSpec = MountSpec()
    sensor: SensorSpec = SensorSpec()
    delivery: DeliverySpec = DeliverySpec()
    surroundings: SurroundingsSpec = SurroundingsSpec()
    camera: tuple[CameraSpec, ...] = Field((), description="what is different with one camera, by its name")
    zone: tuple[ZoneSpec, ...] = Field((), description="volumes with cameras of their own, two or more; [[zone]]")
    calibration: CalibrationSpec | None = None
    acceptance: AcceptanceSpec | None = Field(None, description="the acceptance test of what the scene shows")
    clinic: ClinicSpec | None = Field(
        None, description="what the clinic is told, and the cause that it must name first"
    )
    fault: FaultSpec | None = Field(None, description="what is done wrong in a control, unknown to the pipeline")
    pipeline: PipelineSpec = PipelineSpec()
    continuous: ContinuousSpec | None = Field(None, description="cameras that are not synchronised")
    skeleton: SkeletonSpec | None = Field(None, description="the skeleton of the scene's person, fitted and scored")
    labels: LabelsSpec | None = Field(None, description="labels from a surface model, found and scored")
    vibration: VibrationSpec | None = Field(None, description="modes of the scene's panel, found and scored")
    identification: IdentificationSpec | None = Field(
        None, description="the linear model from the robot's commands to its motion, identified and scored"
    )
    self_orientation: SelfOrientationSpec | None = Field(
        None, description="a camera on the scene's drone that finds its pose from a test field, against the rig's"
    )
    flight: FlightSpec | None = Field(None, description="the scene's drone is steered by the poses, as they arrive")
    virtual: VirtualSpec | None = Field(None, description="objects of a second scene that tracked bodies move")
    length: tuple[LengthSpec, ...] = Field(
        (), description="certified lengths that are seen, for length_rms and length_max; [[length]]"
    )
    premises: Premises = Premises()
    limits: Limits = Field({}, description="metric = limit, or [low, high]; " + ", ".join(METRICS))
    breaks: Breaks = Field(
        {},
        description="of a control: metric = [low, high], the range beyond the metric's limit in which the fault "
        "must put it; all other limits must hold",
    )
    loose_limit: Annotated[float, Field(gt=1)] = Field(
        20.0,
        description="a limit that is met so many times over is told of: it may be in another unit than was meant. A "
        "percent for a share is 100 times too loose, a metre for a millimetre 1000 times: 20 tells of the first up "
        "to a measured value of 5 times what was meant, 40 up to 2.5 times; 10 also tells of much in reserve",
    )

    @property
    def session(self) -> CalibrationSpec | None:
        """The session from which the rig is estimated; None: the true rig."""
        given = self.calibration
        return None if given is None or given.target == "none" else given

    @model_validator(mode="after")
    def _consistent(self) -> "Scenario":
        if (self.expect == "caught") != (self.caught_as is not None):
            raise ValueError("expect = 'caught' and caught_as belong together: say which finding there must be")
        if (self.expect == "diagnosed") != (self.clinic is not None):
            raise ValueError("expect = 'diagnosed' and [clinic] belong together: say which cause must come first")
        if self.expect == "caught":
            if self.session is None:
                raise ValueError("expect = 'caught' needs a [calibration] in which something is wrong")
            if self.caught_as not in CODES:
                raise ValueError(f"caught_as = '{self.caught_as}' is no finding; there are {', '.join(CODES)}")
        elif self.clinic is None and not self.limits:
            raise ValueError("[limits] is empty: a scenario without a limit claims nothing; add one")
        if self.zone:
            _check_zones(self)
        for name in ("length_rms", "length_max"):
            if name in self.limits and not self.length:
                raise ValueError(f"limits.{name} needs a [[length]] that is seen; add one, or take the limit away")
        compared = () if self.continuous is None else self.continuous.compare
        for name in ("linear", "cubic", "neural"):
            if f"rms_{name}" in self.limits and name not in compared:
                raise ValueError(f"limits.rms_{name} needs continuous.compare = ['{name}']; add it")
        counted, other = ("frames", "sets") if self.continuous is not None else ("sets", "frames")
        if f"{other}_complete" in self.limits:
            where = "with" if self.continuous is not None else "without"
            raise ValueError(
                f"limits.{other}_complete is not measured {where} [continuous]; limit {counted}_complete"
            )
        if "rigidity_rms" in self.limits and not self.pipeline.bodies:
            raise ValueError("limits.rigidity_rms needs rigid bodies; set pipeline.bodies = true")
        check_acceptance(self.acceptance, self.limits)
        _check_skeleton(self)
        _check_vibration(self)
        check_identification(self.identification, self.scene, self.limits, self.pipeline.bodies, self.fault)
        own = self.self_orientation
        check_self_orientation(
            own, self.scene, self.camera, self.limits, self.pipeline.bodies, self.session is not None
        )
        more = bool(self.continuous is not None or self.zone or self.lamps is not None)
        check_flight(self.flight, self.scene, self.limits, self.capture.duration_s, self.fault, more)
        if self.flight is not None and not self.pipeline.bodies:
            raise ValueError("[flight] needs the drone's poses; set pipeline.bodies = true")
        moved = self.virtual, self.limits, self.pipeline.bodies, self.continuous is not None, self.fault
        check_virtual_spec(*moved)
        _check_control(self)
        return self


def _check_skeleton(spec: Scenario) -> None:
    if spec.continuous is not None and (spec.skeleton or spec.labels):
        name = "skeleton" if spec.skeleton else "labels"
        raise ValueError(f"[{name}] with [continuous]: it is of frame sets; leave one of them out")
    if spec.skeleton is None:
        for name in spec.limits:
            if name.startswith("joint_") or (name.startswith("label_") and spec.labels is None):
                more = " (or [labels])" if name.startswith("label_") else ""
                raise ValueError(f"limits.{name} needs a skeleton; add [skeleton]{more}, or take the limit away")
        if isinstance(spec.fault, LabelFault) and spec.labels is None:
            raise ValueError(
                "fault.kind = 'swapped_labels' needs the labels of a skeleton; add [skeleton] or [labels]"
            )
        return
    if spec.labels is not None:
        raise ValueError("[labels] and [skeleton] given; a skeleton has labels of its own: leave one of them out")
    for name in spec.limits:
        if name.startswith("label_") and spec.skeleton.labels == "truth":
            raise ValueError(f"limits.{name} needs labels that are found; set skeleton.labels = 'auto'")
    if not isinstance(spec.scene, ActorScene):
        raise ValueError(f"[skeleton] with scene.kind = '{spec.scene.kind}': only an 'actor' has one; leave it out")
    if spec.scene.motion is not None and spec.skeleton.fit_to == "range_of_motion":
        raise ValueError(
            f"skeleton.fit_to = 'range_of_motion' with scene.motion = '{spec.scene.motion}': the person of a motion "
            "file makes no other movement; say fit_to = 'take'"
        )


def _check_vibration(spec: Scenario) -> None:
    if spec.vibration is None:
        for name in spec.limits:
            if name.startswith(("mode", "noise_floor")):
                raise ValueError(f"limits.{name} needs modes that are found; add [vibration], or take the limit away")
        if isinstance(spec.fault, RateFault):
            raise ValueError("fault.kind = 'wrong_rate' is of the analysis of vibration; add [vibration]")
        return
    if not isinstance(spec.scene, PanelScene):
        raise ValueError(f"[vibration] with scene.kind = '{spec.scene.kind}': only a 'panel' vibrates; leave it out")
    if spec.continuous is not None:
        raise ValueError("[vibration] with [continuous]: spectra are of frame sets; leave one of them out")


def _check_control(spec: Scenario) -> None:
    if spec.expect != "fail":
        if spec.breaks:
            raise ValueError(
                f"[breaks] {', '.join(spec.breaks)} and expect = '{spec.expect}' given; it belongs to expect = "
                "'fail': change that, or leave [breaks] out"
            )
        return
    if not spec.breaks:
        raise ValueError(
            "expect = 'fail' without [breaks]; add, for each limit that must break, the range in which the fault "
            "must put its metric: relative_accuracy = [0.0012, 0.003], for example"
        )
    for name, (low, high) in spec.breaks.items():
        if name not in spec.limits:
            raise ValueError(f"breaks.{name} has no limit that it breaks; add limits.{name}")
        upper, limit = METRICS[name].sense == "at_most", end_of(name, spec.limits[name])
        if low <= limit if upper else high >= limit:
            must = f"begin above {limit:g}" if upper else f"end below {limit:g}"
            raise ValueError(
                f"breaks.{name} = [{low:g}, {high:g}] and limits.{name} = {limit:g} given; a run that meets its "
                f"limit could land in that range: it must {must}"
            )
    if not set(spec.limits) - set(spec.breaks):
        raise ValueError(
            "[limits] holds only what must break; add a limit that must hold all the same and shows that targets "
            "were measured: completeness, for example"
        )


def _check_zones(spec: Scenario) -> None:
    names = [zone.name for zone in spec.zone]
    if len(names) < 2 or len(set(names)) < len(names):
        raise ValueError(f"[[zone]]: {', '.join(names)} given; two or more zones of different names are wanted")
    if spec.pipeline.watch:
        raise ValueError("[[zone]] and pipeline.watch: zones are not watched; leave one of them out")


def load_scenario(path: Path, overrides: tuple[str, ...] = ()) -> Scenario:
    """Read a scenario file; ``overrides`` are ``KEY=VALUE`` with dotted keys and TOML values.

    InputError names file, key, value and what is allowed.
    """
    document = read_toml(path)
    apply_overrides(document, overrides)
    return check(Scenario, document, path)


def apply_overrides(document: dict[str, Any], overrides: tuple[str, ...]) -> None:
    """Change ``document`` by ``KEY=VALUE`` texts: dotted keys, TOML values, bare words as strings."""
    for text in overrides:
        _override(document, text)


def _override(document: dict[str, Any], text: str) -> None:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise InputError(f"--set {text}: KEY=VALUE is wanted, for example --set capture.duration_s=2")
    try:
        parsed = parse_toml(f"value = {value}")
    except UnboundedTomlError as error:
        raise InputError(f"--set {key.strip()[:60]}: {error}") from None
    except tomllib.TOMLDecodeError:
        parsed = {"value": value}  # a bare word is a string
    # a list may have several lines, a word or another key may not
    if len(parsed) > 1 or "\n" in key or (parsed["value"] == value and "\n" in value):
        raise InputError(f"--set {text[:60]}: holds several lines; give each KEY=VALUE a --set of its own")
    set_key(document, key.strip(), parsed["value"], f"--set {text}")


def set_key(document: dict[str, Any], key: str, value: Any, given: str) -> None:
    """Set a dotted ``key`` of ``document``; ``given``: beginning of an InputError's message."""
    *tables, last = key.split(".")
    here = document
    for name in tables:
        here = here.setdefault(name, {})
        if not isinstance(here, dict):
            raise InputError(f"{given}: '{name}' is a value, not a table")
    here[last] = value


def changed_keys(path: Path, spec: Scenario) -> dict[str, tuple[Any, Any]]:
    """Return dotted key -> (value of the file, value of ``spec``) where the two differ; defaults count as values.

    Empty where the file is not a valid scenario without the changes.
    """
    try:
        before = _flat(load_scenario(path).model_dump(mode="json"))
    except InputError:
        return {}
    after = _flat(spec.model_dump(mode="json"))
    keys = [key for key in {**before, **after} if before.get(key) != after.get(key)]
    return {key: (before.get(key), after.get(key)) for key in keys}


def _flat(values: dict[str, Any], start: str = "") -> dict[str, Any]:
    """Return nested tables as one of dotted keys."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{start}{key}.") if isinstance(value, dict) else {f"{start}{key}": value}
    return flat


def scenario_schema() -> dict[str, Any]:
    """Return the JSON schema of scenario files."""
    return described(Scenario.model_json_schema())
