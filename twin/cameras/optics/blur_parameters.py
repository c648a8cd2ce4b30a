"""Imaging errors of a lens: blur that changes with distance and field, vignetting, warming.

The pupil is cut into patches (``psf``). Each patch images a point displaced by the ray aberration: defocus in
proportion to the position in the pupil, coma to its square times the field. One Gaussian stands for diffraction and
all other blur.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Optics:
    """Imaging errors of a lens beyond its distortion model."""

    psf_sigma_px: float = 0.6
    """Gaussian blur in focus."""
    focus_m: float | None = None
    """Distance of sharp focus (None: sharp everywhere)."""
    f_mm: float = 8.0
    """Focal length, for the blur circle."""
    f_number: float = 4.0
    """For the blur circle."""
    pixel_pitch_mm: float = 0.0099
    """For the blur circle."""
    curvature_px: float = 0.0
    """Diameter of the blur circle that field curvature adds at the image's corner."""
    coma_px: float = 0.0
    """Length of the coma at the corner."""
    vignetting: float = 0.0
    """Share of light lost at the corner."""
    gap_px: float = 0.05
    """Higher radial orders that no lens model of the pipeline expresses, see ``twin.cameras.optics.lens``."""
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    """Tilt of the sensor about its x and y axes."""
    pupil_shift_m: float = 0.0
    """Shift of the entrance pupil along the axis at a field of 45 deg."""
    principal_distance_ppm_per_s: float = 0.0
    """Warming: growth of the principal distance from the session's start."""
    principal_point_px_per_s: tuple[float, float] = (0.0, 0.0)
    """Warming: motion of the principal point (x, y) from the session's start."""
