"""The comparison methods through their one entry: the same image points, trajectories near the truth."""

import numpy as np
import pytest
from continuous_sessions import POINTS, Motion, rig, session

from mosca.continuous.association.associate import AssociationSettings, gather_seen
from mosca.continuous.comparison_methods.compare import METHODS, reconstruct_by
from mosca.continuous.model.camera_paths import StillCameras
from mosca.continuous.reconstruct import EstimatedClock, Reconstructed
from mosca.errors import InputError

MOTION = Motion(frequencies_hz=(0.3, 0.5, 0.7))


@pytest.fixture(scope="module")
def found() -> Reconstructed:
    """Markers of cameras with a common clock, associated but not yet estimated."""
    seen, _names, _true = session(1.2, False, MOTION)
    cameras = rig()
    associated = gather_seen(tuple(seen), cameras, AssociationSettings(clocks="common"))
    clocks = tuple(EstimatedClock(name) for name in cameras.names)
    return Reconstructed(associated, None, associated.observations, clocks, (), cameras)


@pytest.mark.parametrize("method", METHODS)
def test_each_method_finds_the_markers(found, method):
    time_ns = np.arange(400, 1000, 20) * 1_000_000
    tracks = reconstruct_by(method, found, time_ns)
    assert set(tracks.frame) <= set(range(len(time_ns)))
    assert len(set(tracks.track)) == POINTS
    assert len(tracks.frame) > 0.9 * POINTS * len(time_ns)
    assert np.isnan(tracks.covariance).all()
    truth = MOTION.at(time_ns * 1e-9)[tracks.frame]
    away = np.linalg.norm(truth - tracks.xyz[:, None], axis=2).min(axis=1)
    assert np.sqrt(np.mean(away**2)) < 2e-3


def test_what_cannot_be_compared(found):
    from dataclasses import replace

    with pytest.raises(InputError, match="'quadratic' is unknown; allowed: linear, cubic, neural"):
        reconstruct_by("quadratic", found, np.zeros(1, np.int64))
    moving = replace(found, cameras=StillCameras.of(found.rig))
    with pytest.raises(InputError, match="cameras that move"):
        reconstruct_by("cubic", moving, np.zeros(1, np.int64))
