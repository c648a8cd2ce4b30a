"""A calibrated rig with everything that a person needs to judge it."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from mosca.data.arrays import Array, set_read_only
from mosca.data.rig import Rig
from mosca.data.sightings import Sightings

Severity = Literal["refuse", "warn", "note"]
"""refuse: the rig must not be used; warn: it may be wrong; note: for information."""


@dataclass(frozen=True)
class Finding:
    """A result of the quality checks of a calibration.

    ``code``: one of ``mosca.calibration.quality.findings.CODES``, for scripts and tests; ``message``: one line with
    what was found (and its figure), what is allowed, and what to do next; ``camera``: the camera concerned, where it
    is one camera.
    """

    code: str
    severity: Severity
    message: str
    camera: str | None = None


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated rig, the image points that it rests on, and its precision."""

    rig: Rig
    target: str
    sightings: Sightings
    parameters: tuple[str, ...]
    """(u) names such as "cam1.c_mm", "cam1.turn_x_rad" (rotation about the camera's own axis), "cam1.X_m"."""
    covariance: Array
    """(u, u) a-posteriori covariance of ``parameters``, shake of whole images included."""
    residuals_px: Array
    """(n, 2) observed minus projected of each of ``sightings``."""
    used: Array
    """(n,) bool, False for blunders and points without a determined position."""
    marks_m: Array
    """(m, 3) adjusted positions of the target's marks in the target's frame."""
    placement: Array
    """(n,) index of the target's pose, -1 for points of the world."""
    target_rotation: Array
    """(f, 3, 3) of world_from_target."""
    target_translation: Array
    """(f, 3) [m] of world_from_target."""
    sigma0: float
    """Standard deviation of unit weight."""
    sigma_px: Array
    """(c, 2) a-posteriori standard deviation of an image coordinate x, y of each camera (the Mosca paper's sigma_x,
    sigma_y, Table 2)."""
    sigma_m: Array
    """(c, 2) the same, projected to the target."""
    weak: tuple[str, ...]
    """Parameters that the data hardly determine."""
    held: tuple[str, ...]
    """The parameters among ``weak`` that were constrained near their initial values."""
    body_px: float
    """Shake of whole images [px rms, an axis]."""
    scaled_by: str
    """Origin of the scale."""
    findings: tuple[Finding, ...] = field(default=())
    lasting_px: Array = field(default_factory=lambda: np.empty(0))
    """(c,) systematic errors of image points, mostly of the lens model, rms an axis [px]. They are equal in each
    exposure of a stationary target. NaN where repeats do not determine them; empty where it was never stationary.
    """

    def __post_init__(self) -> None:
        n, u, c = len(self.sightings), len(self.parameters), len(self.rig.cameras)
        f = len(np.asarray(self.target_translation))
        set_read_only(self, covariance=(u, u), residuals_px=(n, 2), marks_m=(None, 3), lasting_px=(None,))
        set_read_only(self, target_rotation=(f, 3, 3), target_translation=(f, 3), sigma_px=(c, 2), sigma_m=(c, 2))
        set_read_only(self, np.bool_, used=(n,))
        set_read_only(self, np.int64, placement=(n,))
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
