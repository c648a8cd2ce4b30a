"""What a lens adds to the ideal image: blur that changes with distance and field, falling light, warming.

The pupil is cut into patches (``psf``): each images a point at its ray aberration, defocus proportional to the
place in the pupil, coma to its square times the field, blurred by diffraction and the rest as one Gaussian.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Optics:
    """Imaging errors of a lens beyond its distortion model.

    ``psf_sigma_px`` Gaussian blur in focus; ``focus_m`` distance of sharp focus (None: sharp everywhere),
    ``f_mm`` focal length and ``f_number``, from which the blur circle follows; ``pixel_pitch_mm``;
    ``curvature_px`` diameter of the blur circle that field curvature adds at the image's corner;
    ``coma_px`` length of the coma at the corner; ``vignetting`` share of light lost at the corner.
    What no lens model of the pipeline expresses: ``gap_px`` (``twin.cameras.optics.lens``), ``tilt_deg`` of the
    sensor about its x and y axes, ``pupil_shift_m`` of the entrance pupil along the axis at a field of 45 deg.
    Warming: ``principal_distance_ppm_per_s`` and ``principal_point_px_per_s`` (x, y) from the session's start.
    """

    psf_sigma_px: float = 0.6
    focus_m: float | None = None
    f_mm: float = 8.0
    f_number: float = 4.0
    pixel_pitch_mm: float = 0.0099
    curvature_px: float = 0.0
    coma_px: float = 0.0
    vignetting: float = 0.0
    gap_px: float = 0.05
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    pupil_shift_m: float = 0.0
    principal_distance_ppm_per_s: float = 0.0
    principal_point_px_per_s: tuple[float, float] = (0.0, 0.0)
