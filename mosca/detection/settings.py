"""What is a target and how it is measured: settings of ``mosca.detection.detect`` in the units of people and of
kernels.
"""

import math
from functools import lru_cache
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from mosca.detection.centroid import Noise
from mosca.detection.search import Search
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
        """Raise an InputError in place of pydantic's error."""
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


DEFAULTS = DetectionSettings()


def _out_of_range(key: str, value: object, allowed: str) -> InputError:
    return InputError(f"detection: key '{key}': {value!r} given; {allowed} is allowed")


@lru_cache
def search_of(settings: DetectionSettings, bit_depth: int) -> Search:
    """Return the search in grey values of images of this bit depth."""
    scale = 2 ** (bit_depth - 8)
    return Search(
        highest=math.floor(2**bit_depth - 1 - settings.contrast_dn * scale / 2),
        lowest=math.floor(settings.lowest_dn * scale),
        step=int(settings.step_dn) * scale,
        contrast=float(settings.contrast_dn * scale),
        smallest_px=float(settings.minimum_size_px),
        largest_px=float(settings.maximum_size_px),
    )


@lru_cache
def noise_of(settings: DetectionSettings, bit_depth: int) -> Noise:
    """Return the noise in grey values of images of this bit depth, with that of rounding to whole ones."""
    scale = 2 ** (bit_depth - 8)
    return Noise(
        dark_dn2=float((settings.read_noise_dn * scale) ** 2 + 1 / 12),
        gain_dn=float(settings.gain_dn_per_e * scale),
    )
