"""A calibrated rig with everything that a person needs to judge it."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from mosca.data.arrays import Array, read_only
from mosca.data.rig import Rig
from mosca.data.sightings import Sightings

Severity = Literal["refuse", "warn", "note"]
"""refuse: the rig must not be used; warn: it may be wrong; note: for information."""


@dataclass(frozen=True)
class Finding:
    """Something that a person must know before believing a calibration.

    ``code``: one of ``mosca.calibration.quality.findings.CODES``, for scripts and tests; ``message``: one line,
    what was found (with its figure), what is allowed, and what to do next; ``camera``: whose, where it is one
    camera's.
    """

    code: str
    severity: Severity
    message: str
    camera: str | None = None


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated rig, the image points that it rests on, and its precision.

    ``parameters`` (u) names such as "cam1.c_mm", "cam1.turn_x_rad", "cam1.X_m" (turns about the camera's own
    axes) and their ``covariance`` (u, u), at the size that the data show (a-posteriori, with what moves whole
    images); ``residuals_px`` (n, 2) observed minus projected of each of ``sightings``; ``used`` (n,) bool, False
    for blunders and points that nothing places; ``marks_m`` (m, 3) adjusted places of the target's marks in the
    target's frame; ``placement`` (n,) which pose the target had, -1 for points of the world, of
    ``target_rotation`` (f, 3, 3) and ``target_translation`` (f, 3) [m] (world_from_target). ``sigma0`` of unit
    weight; ``sigma_px`` (c, 2) and ``sigma_m`` (c, 2): a-posteriori standard deviation of an image coordinate x,
    y of each camera, in the image and carried to the target (the Mosca paper's sigma_x, sigma_y, Table 2);
    ``weak``: parameters that the data hardly determine; ``held``: those of them held near their start;
    ``body_px`` how far whole images shake [px rms, an axis]. ``scaled_by``: what gives the scale. ``lasting_px``
    (c,): errors of image points that are the same in each exposure of a target that stands still (of the lens model,
    mostly), rms an axis [px], NaN where repeats do not tell them; empty where the target never stood.
    """

    rig: Rig
    target: str
    sightings: Sightings
    parameters: tuple[str, ...]
    covariance: Array
    residuals_px: Array
    used: Array
    marks_m: Array
    placement: Array
    target_rotation: Array
    target_translation: Array
    sigma0: float
    sigma_px: Array
    sigma_m: Array
    weak: tuple[str, ...]
    held: tuple[str, ...]
    body_px: float
    scaled_by: str
    findings: tuple[Finding, ...] = field(default=())
    lasting_px: Array = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        n, u, c = len(self.sightings), len(self.parameters), len(self.rig.cameras)
        f = len(np.asarray(self.target_translation))
        for name, shape, dtype in (
            ("covariance", (u, u), np.float64),
            ("residuals_px", (n, 2), np.float64),
            ("used", (n,), np.bool_),
            ("marks_m", (None, 3), np.float64),
            ("placement", (n,), np.int64),
            ("target_rotation", (f, 3, 3), np.float64),
            ("target_translation", (f, 3), np.float64),
            ("sigma_px", (c, 2), np.float64),
            ("sigma_m", (c, 2), np.float64),
            ("lasting_px", (None,), np.float64),
        ):
            object.__setattr__(self, name, read_only(getattr(self, name), shape, name, dtype))
        object.__setattr__(self, "findings", tuple(self.findings))

    @property
    def refused(self) -> tuple[Finding, ...]:
        """The findings for which the rig must not be used."""
        return tuple(one for one in self.findings if one.severity == "refuse")

    @property
    def standard_deviations(self) -> dict[str, float]:
        """Standard deviation of each parameter, by name."""
        return dict(zip(self.parameters, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def points_in_world(self) -> Array:
        """Return where each of the sightings' marks was (n, 3) [m, world]."""
        at = self.marks_m[self.sightings.mark]
        placed = self.placement >= 0
        if placed.any():
            which = self.placement[placed]
            at = at.copy()
            at[placed] = (
                np.einsum("nij,nj->ni", self.target_rotation[which], at[placed]) + self.target_translation[which]
            )
        return np.asarray(at)
