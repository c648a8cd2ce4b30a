"""Markers in camera images to trajectories with honest errors: the pipeline of the mosca testbench as a library.

The same functions run on rendered and on real frames. Five lines:

>>> import mosca
>>> rig = mosca.read_rig("rig.toml")                             # doctest: +SKIP
>>> tracks = mosca.reconstruct("recordings/take_1", rig)         # doctest: +SKIP
>>> tracks.xyz, tracks.covariance                                # doctest: +SKIP
>>> mosca.write_tracks(tracks, "take_1.c3d", frame_rate_hz=100)  # doctest: +SKIP

or stage by stage:

===================================  ==================================================================
``read_rig``, ``write_rig``          calibrated cameras, this project's file and that of other programs
``calibrate``                        cameras from a recording of a target, judged
``open_recording``                   frames from disk
``detect``                           one image -> sub-pixel centres with covariance
``project``                          world points -> pixels
``triangulate``                      pixels of known correspondence -> points with covariance
``match``                            detections of several cameras -> points with covariance
``track``                            points over time -> tracks
``reconstruct``                      all of it: recording -> tracks
``read_tracks``, ``write_tracks``    .npz, .csv, .parquet, .c3d, .trc
===================================  ==================================================================

Examples that run as printed: docs/library.md. Scenarios of the digital twin: ``scenarios.run_scenario``.

Conventions:

- SI units inside: m, s, rad; px for image quantities. Any other unit is part of the name
  (``K1_per_mm2``, ``_px``, ``_ns``, ``_mm``). The world is right-handed with Z up.
- Camera frame: x right, y down, z forward. Pixel (0, 0) is the *centre* of the top-left pixel.
  Points are (x, y), image arrays are (H, W).
- Poses are named so that neighbours cancel: ``world_from_camera``, ``camera_from_marker``.
  Quaternions are wxyz.
- Time is integer nanoseconds in data and float seconds from the session's start in computations.
  A Frame carries the raw stamp and the event that it marks; mid-exposure is computed once,
  in ``mosca.data.frames``.
- Data is frozen and really read-only; a change is a new value.
- One seed a run, split into named streams; no global random state.
"""

# ruff: noqa: F405
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mosca.api import *  # noqa: F403  (its __all__ has the names below)

__version__ = "0.2.0"
__all__ = [
    "Calibration",
    "CalibrationError",
    "Camera",
    "DetectionSettings",
    "Detections",
    "FisheyeLens",
    "InputError",
    "MatchSettings",
    "MoscaLens",
    "OpenCVLens",
    "PipelineSettings",
    "Points",
    "Pose",
    "Rig",
    "TrackSettings",
    "Tracks",
    "Triangulated",
    "calibrate",
    "detect",
    "match",
    "open_recording",
    "project",
    "read_rig",
    "read_tracks",
    "reconstruct",
    "track",
    "triangulate",
    "write_rig",
    "write_tracks",
]


def __getattr__(name: str) -> Any:
    """Import the pipeline when it is first used: ``import mosca`` alone answers at once and changes nothing."""
    if name in __all__:
        import mosca.api as api

        return getattr(api, name)
    raise AttributeError(f"module 'mosca' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
