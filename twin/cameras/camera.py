"""A virtual camera: the calibrated camera of the rig with everything that makes a real one."""

from dataclasses import dataclass, field

from mosca.data.rig import Camera
from twin.cameras.sensor import Sensor


@dataclass(frozen=True)
class Errors:
    """Random and systematic errors of a camera at work. The defaults are those no scenario may soften.

    ``trigger_jitter_s`` rms of each exposure's start about its pulse; ``trigger_delay_s`` a constant delay
    that the stamps know nothing of; ``body_px`` rms shake of the camera body a frame, each image axis;
    ``psf_sigma_px`` Gaussian blur of the lens; ``lens_gap_px`` amplitude of what no lens model of the
    pipeline expresses (``twin.cameras.lens``); ``marker_signal`` light of a fully covered pixel over
    the full well.
    """

    trigger_jitter_s: float = 20e-6
    trigger_delay_s: float = 0.0
    body_px: float = 0.03
    psf_sigma_px: float = 0.6
    lens_gap_px: float = 0.05
    marker_signal: float = 0.6


@dataclass(frozen=True, eq=False)
class VirtualCamera:
    """``camera``: the true geometry; ``errors`` and ``sensor`` what it does to light and time."""

    camera: Camera
    errors: Errors = field(default_factory=Errors)
    sensor: Sensor = field(default_factory=Sensor)
