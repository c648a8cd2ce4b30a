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

_ALLOWED = {
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

    contrast_dn: Annotated[float, Field(gt=0, lt=255)] = 24.0
    """B: a target's largest grey value exceeds its smallest by more than this. Keep it above five times the
    noise at a target's brightest, or its noise is split into targets."""
    step_dn: Annotated[int, Field(ge=1)] = 1
    """s: from one threshold to the next. 1 parts close targets best and costs nothing."""
    lowest_dn: Annotated[int | float, Field(ge=0)] = 16
    """h_min: all thresholds lie above it. Keep it at least four times the noise above the background."""
    minimum_size_px: Annotated[int | float, Field(ge=0)] = 1.0
    """D_min: both sides of a target's box are longer than this."""
    maximum_size_px: int | float = 40.0
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
    read_noise_dn: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.13
    """Dark noise, standard deviation of a pixel without light (10 electrons of 20,000 in 255 DN)."""
    gain_dn_per_e: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0128
    """Grey values per electron (EMVA 1288: system gain K; 20,000 electrons in 255 DN)."""

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
        if not self.lowest_dn < math.floor(255 - self.contrast_dn / 2):
            limit = f"0 to below 255 - contrast_dn / 2 = {math.floor(255 - self.contrast_dn / 2)}"
            raise _out_of_range("lowest_dn", self.lowest_dn, limit)
        if not self.minimum_size_px < self.maximum_size_px:
            limit = f"0 to below maximum_size_px = {self.maximum_size_px:g}"
            raise _out_of_range("minimum_size_px", self.minimum_size_px, limit)


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
    """Whether all targets are of one size, so that an image of odd size is partly hidden or merged and is trusted
    less; false for particles."""
    target: Literal["point", "ball"] = "point"
    """'ball' frees images of a ball's eccentricity; 'point' leaves them (small targets, discs)."""


@dataclass(frozen=True, config=SETTINGS)
class TrackSettings:
    """How targets move, and what makes a track."""

    model: Literal["acceleration", "velocity"] = "acceleration"
    """Singer's acceleration with a memory of ``memory_s``, or constant velocity (white acceleration)."""
    memory_s: Positive = 0.1
    """Correlation time of the acceleration [s]."""
    acceleration_mps2: Positive = 20.0
    """Standard deviation of the targets' acceleration, an axis; adapted for each track from there."""
    speed_mps: Positive = 1.5
    """Standard deviation of a new track's velocity, an axis."""
    gate_sigma: Positive = 4.5
    """How many standard deviations a point may lie from its prediction."""
    gate_m: Positive = 0.08
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
    limb_m: NotNegative = 0.6
    """How far limb mates may be [m]; 0: particles, no limbs."""


def _out_of_range(key: str, value: object, allowed: str) -> InputError:
    return InputError(f"detection: key '{key}': {value!r} given; {allowed} is allowed")
