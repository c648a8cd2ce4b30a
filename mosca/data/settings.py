"""Settings of the pipeline's stages: what is a target, which rays meet, how targets move.

One class a stage. A settings file and a scenario have the same keys, bounds and descriptions: their tables are made
from these classes. Importing this module compiles nothing.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from mosca.data.files.toml import NotNegative, Positive
from mosca.errors import InputError


@dataclass(frozen=True)
class DetectionSettings:
    """What is a target and how it is measured.

    Grey values [DN] are those of an 8-bit image; for an image of more bits they are scaled by
    ``2**(bits - 8)``, so that the same settings serve the same scene.
    """

    contrast_dn: Positive = 24.0
    """B: a target's largest grey value exceeds its smallest by more than this. Keep it above five times the
    noise at a target's brightest, or its noise is split into targets."""
    step_dn: Annotated[int, Field(ge=1)] = 1
    """s: from one threshold to the next. 1 parts close targets best and costs nothing."""
    lowest_dn: Annotated[int, Field(ge=0)] = 16
    """h_min: all thresholds lie above it. Keep it at least four times the noise above the background."""
    minimum_size_px: NotNegative = 1.0
    """D_min: both sides of a target's box are longer than this."""
    maximum_size_px: Positive = 40.0
    """D_max: both sides of a target's box are shorter than this."""
    centroid: Literal["refined", "background", "paper"] = "refined"
    """Fit of a blurred disc (``mosca.detection.disc_fit.camera_statistics``), centroid above the local background
    over the grown mask, or as printed in the paper."""
    dilation_px: Annotated[int, Field(ge=0, le=2)] = 1
    """How far the mask of the "background" centroid reaches beyond the region, 0 to 2. At 0 the centroid is
    drawn to pixel centres by up to 0.04 px; at 2 it gathers noise."""
    split_pairs: bool = False
    """Targets whose images have grown together or nearly touch are fitted together, which takes 0.1 to 0.5 ms a
    pair; else they keep the uncertain places of images that touch. With the refined centroid alone."""
    read_noise_dn: NotNegative = 0.13
    """Dark noise, standard deviation of a pixel without light (10 electrons of 20,000 in 255 DN)."""
    gain_dn_per_e: NotNegative = 0.0128
    """Grey values per electron (EMVA 1288: system gain K; 20,000 electrons in 255 DN)."""

    def __post_init__(self) -> None:
        if not 0 < self.contrast_dn < 255:
            raise _out_of_range("contrast_dn", self.contrast_dn, "more than 0 and less than 255")
        if not 0 <= self.lowest_dn < math.floor(255 - self.contrast_dn / 2):
            limit = f"0 to below 255 - contrast_dn / 2 = {math.floor(255 - self.contrast_dn / 2)}"
            raise _out_of_range("lowest_dn", self.lowest_dn, limit)
        if not (self.step_dn >= 1 and self.step_dn == int(self.step_dn)):
            raise _out_of_range("step_dn", self.step_dn, "a whole number from 1")
        if not 0 <= self.minimum_size_px < self.maximum_size_px:
            limit = f"0 to below maximum_size_px = {self.maximum_size_px:g}"
            raise _out_of_range("minimum_size_px", self.minimum_size_px, limit)
        if self.centroid not in ("refined", "background", "paper"):
            raise _out_of_range("centroid", self.centroid, "'refined', 'background' or 'paper'")
        if self.dilation_px not in (0, 1, 2):
            raise _out_of_range("dilation_px", self.dilation_px, "0, 1 or 2")
        for key in ("read_noise_dn", "gain_dn_per_e"):
            value = getattr(self, key)
            if not (value >= 0 and math.isfinite(value)):
                raise _out_of_range(key, value, "0 or more")


@dataclass(frozen=True)
class MatchSettings:
    """Which rays of different cameras are images of one target."""

    gate_sigma: Positive = 4.5
    """How many standard deviations a ray may pass beside the point."""
    camera_sigma_px: Positive = 0.06
    """Random error of image points besides detection noise (body, trigger, lens model), an axis."""
    minimum_cameras: Annotated[int, Field(ge=2)] = 2
    """Smallest number of rays in a group."""
    support_sigma: Positive = 4.0
    """How near a track's prediction supports a group."""
    outlier_sigma: Positive = 4.0
    """A group of three rays and more loses its worst ray beyond this."""
    worst_sigma_m: Positive = math.inf
    """Points less certain than this are withheld [m]: two cameras that face each other, an image of odd size."""
    judge_sizes: bool = True
    """Trust images of odd size less, as partly hidden or merged; false where targets differ in size (particles)."""
    target: Literal["point", "ball"] = "point"
    """'ball' frees images of the eccentricity that a ball's have; 'point' leaves them (small targets, discs)."""


@dataclass(frozen=True)
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
