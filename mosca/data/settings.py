"""Settings of the pipeline's stages: what is a target, which rays meet, how targets move.

One class a stage, checked where it is made. A settings file and a scenario have the same keys, bounds and text:
their tables are made from these classes. Importing this module compiles nothing.
"""

import math
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from mosca.data.files.toml import SETTINGS, NotNegative, Positive
from mosca.errors import InputError

PAPER_VALUES = {"contrast_dn": 24.0, "step_dn": 1, "lowest_dn": 16}
"""Values of the paper's thresholds where none are given."""
_ALLOWED = {
    "thresholds": "'noise' or 'paper'",
    "false_alarms": "more than 0, up to 1",
    "contrast_dn": "more than 0 and less than 255",
    "step_dn": "a whole number from 1",
    "lowest_dn": "0 to below 255 - contrast_dn / 2",
    "minimum_size_px": "0 to below maximum_size_px",
    "maximum_size_px": "more than minimum_size_px",
    "centroid": "'refined', 'background' or 'paper'",
    "dilation_px": "0, 1 or 2",
    "split_pairs": "true or false",
    "read_noise_dn": "0 or more",
    "gain_dn_per_e": "0 or more",
}
"""The limits of the fields below in words."""


@dataclass(frozen=True, config=ConfigDict(extra="forbid", use_attribute_docstrings=True))
class DetectionSettings:
    """What is a target and how it is measured.

    Grey values [DN] are those of an 8-bit image; for an image of more bits they are scaled by
    ``2**(bits - 8)``, so that the same settings serve the same scene. Raises InputError for a value that is not
    allowed.
    """

    thresholds: Literal["noise", "paper"] = "noise"
    """How targets are decided on: by the noise and background that each camera's images show, or by grey values as in
    the Mosca paper (section 3.1), ``contrast_dn``, ``step_dn`` and ``lowest_dn``."""
    false_alarms: Annotated[float, Field(gt=0, le=1)] = 0.01
    """Targets that noise alone may make in an image, on average, with thresholds by noise."""
    contrast_dn: Annotated[float, Field(gt=0, lt=255)] | None = None
    """B of the paper: a target's largest grey value exceeds its smallest by more than this [24]. Keep it above five
    times the noise at a target's brightest, or its noise is split into targets."""
    step_dn: Annotated[int, Field(ge=1)] | None = None
    """s of the paper: from one threshold to the next [1]."""
    lowest_dn: Annotated[int | float, Field(ge=0)] | None = None
    """h_min of the paper: all thresholds lie above it [16]. Keep it four times the noise above the background."""
    minimum_size_px: Annotated[int | float, Field(ge=0)] = 1.0
    """D_min: the longer side of a target's box is longer than this (with the paper's thresholds, both are)."""
    maximum_size_px: int | float = 64.0
    """D_max: both sides of a target's box are shorter than this."""
    centroid: Literal["refined", "background", "paper"] = "refined"
    """Fit of a blurred disc (``mosca.detection.disc_fit.camera_statistics``), centroid above the local background
    over the grown mask, or as printed in the paper."""
    dilation_px: Annotated[int, Field(ge=0, le=2)] = 1
    """How far the mask of the "background" centroid reaches beyond the region, 0 to 2. At 0 the centroid is
    drawn to pixel centres by up to 0.04 px; at 2 it gathers noise."""
    split_pairs: bool = False
    """Targets whose images have grown together or nearly touch are fitted together, which takes 0.1 to 0.5 ms a
    pair; else they keep the uncertain centres of images that touch. With the refined centroid alone."""
    read_noise_dn: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    """Dark noise, standard deviation of a pixel without light; learned from the images where it is not given."""
    gain_dn_per_e: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    """Grey values per electron (EMVA 1288: system gain K); learned from the images where it is not given."""

    @model_validator(mode="wrap")
    @classmethod
    def _as_input_error(cls, values: Any, validate: Any) -> Any:
        """Raise an InputError instead of pydantic's error."""
        try:
            return validate(values)
        except ValidationError as error:
            first = error.errors()[0]
            key = str(first["loc"][0])
            if first["type"] == "unexpected_keyword_argument":
                raise TypeError(f"DetectionSettings has no '{key}'") from None
            raise _out_of_range(key, first["input"], _ALLOWED[key]) from None

    def __post_init__(self) -> None:
        for name in PAPER_VALUES:
            if (value := getattr(self, name)) is not None and self.thresholds != "paper":
                raise InputError(
                    f"detection.{name} {value:g} given; it is a threshold of the paper's: add thresholds = 'paper'"
                )
        contrast, _, lowest = self.paper_thresholds()
        highest = math.floor(255 - contrast / 2)
        if not lowest < highest:
            raise _out_of_range("lowest_dn", lowest, f"0 to below 255 - contrast_dn / 2 = {highest}")
        if not self.minimum_size_px < self.maximum_size_px:
            limit = f"0 to below maximum_size_px = {self.maximum_size_px:g}"
            raise _out_of_range("minimum_size_px", self.minimum_size_px, limit)

    def paper_thresholds(self) -> tuple[float, float, float]:
        """Return B, s and h_min of the paper, as given or by default [grey values of 8 bits]."""
        contrast, step, lowest = (
            value if (given := getattr(self, name)) is None else given for name, value in PAPER_VALUES.items()
        )
        return contrast, step, lowest


@dataclass(frozen=True, config=ConfigDict(use_attribute_docstrings=True))
class MatchSettings:
    """Settings of correspondence."""

    gate_sigma: Positive = 4.5
    """Gate of a ray about a point, in standard deviations: larger finds more targets of poor images and more chance
    hypotheses."""
    camera_sigma_px: Annotated[float, Field(ge=0)] = 0.06
    """Random error of image points besides detection noise (body, trigger, lens model), an axis."""
    minimum_cameras: Annotated[int, Field(ge=2)] = 2
    """Smallest number of rays of a point."""
    support_sigma: Positive = 4.0
    """Gate of a hypothesis about a track's prediction, in standard deviations."""
    outlier_sigma: Positive = 4.0
    """A hypothesis of three rays and more loses its worst one beyond this."""
    worst_sigma_m: Positive = math.inf
    """A point whose largest standard deviation exceeds this is withheld (two cameras that face each other, an image
    of odd size)."""
    judge_sizes: bool = True
    """Whether an image of odd size is taken as partly hidden or merged and trusted less, where targets are found to
    be of one size (``mosca.correspondence.typical_size``)."""
    mend: bool = True
    """Whether images of targets that something hides in part, or that have grown together, are fitted again with the
    size that their points tell (``mosca.detection.cut_targets.mend``); needs pixels: without them, as where stations
    or recordings give detections alone, they stay as they are."""
    turns: bool = True
    """Whether turns of the cameras from frame set to frame set (bodies that shake) are estimated from all points
    together and removed from them (``mosca.correspondence.shared_turns``)."""
    target: Literal["auto", "point", "ball"] = "auto"
    """'ball' frees images of a ball's eccentricity; 'point' leaves them (small targets, discs); 'auto' frees
    round images of a ball's, and a point's ellipses that are images of one circle of this circle's."""
    light: Literal["unknown", "even"] = "unknown"
    """Whether flat targets are lit evenly: lamps at the lens light the nearer side of one at a slant more, which
    moves its image by up to half of its eccentricity. 'unknown' takes half of that, with its uncertainty; 'even':
    none (distant lamps, targets that glow)."""


@dataclass(frozen=True, config=SETTINGS)
class TrackSettings:
    """How targets move, and what makes a track."""

    model: Literal["acceleration", "velocity"] = "acceleration"
    """Singer's acceleration with a memory of ``memory_s``, or constant velocity (white acceleration)."""
    memory_s: Positive = 0.1
    """Correlation time of the acceleration [s]."""
    acceleration_mps2: Positive | None = None
    """Standard deviation of the targets' acceleration, an axis; adapted for each track from there. By default this
    and the other lengths and speeds are of a person (20 m/s^2, 1.5 m/s, 0.08 m, 0.6 m in 2.5 m), scaled to the volume
    or to the cameras' fields of view (``mosca.tracking.motion_scale``)."""
    speed_mps: Positive | None = None
    """Standard deviation of a new track's velocity, an axis."""
    gate_sigma: Positive = 4.5
    """How many standard deviations a point may lie from its prediction."""
    gate_m: Positive | None = None
    """Never farther than this; a confirmed track takes a point of two cameras from half as far, with an image of odd
    size from a quarter (two cameras agree by chance, and the gate of a track long unseen admits much clutter)."""
    confirm_weight: Positive = 5.0
    """Weight of the points that confirms a track."""
    coast_s: NotNegative = 0.25
    """How long a track is predicted by its own motion without a point."""
    remember_s: NotNegative = 60.0
    """How long a lost track can be reacquired under its identity."""
    name_wait_s: NotNegative = 0.2
    """How long a new track that may be a lost one waits for its identity; its samples are returned with it."""
    limb_m: NotNegative | None = None
    """How far limb mates may be [m]; 0: particles, no limbs."""
    worst_sigma_m: Positive | None = None
    """A sample whose largest standard deviation exceeds this is left out of the tracks and counted; identities are
    still followed by it."""


def _out_of_range(key: str, value: object, allowed: str) -> InputError:
    return InputError(f"detection: key '{key}': {value!r} given; {allowed} is allowed")
