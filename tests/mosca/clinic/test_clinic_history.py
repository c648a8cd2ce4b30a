"""Warnings of a calibration and the health of cameras as evidence of the clinic."""

import numpy as np
import pytest
from scipy.stats import norm

from mosca.calibration.quality.findings import CODES
from mosca.clinic.causes import CAUSES
from mosca.clinic.history import CAUSE_OF, calibration_causes, health_causes, poorly_connected
from mosca.data.calibration import Finding
from mosca.diagnostics.camera_health import CameraHealth

PERIOD_S = 0.01


def camera(name, late_s=0.0, sigma_s=2e-5, connected=0.99):
    return CameraHealth(name, 0.1, 0.02, connected, 0.0, late_s, sigma_s, ())


def test_every_code_and_cause_exists():
    assert set(CAUSE_OF) <= set(CODES)
    assert set(CAUSE_OF.values()) <= set(CAUSES)


def test_warnings_of_one_kind_are_one_cause_and_notes_are_none():
    found = calibration_causes(
        [
            Finding("little-depth", "warn", "cam1: 2 % of depth", "cam1"),
            Finding("weak-link", "refuse", "cam2: 1 common view", "cam2"),
            Finding("wrong-size", "warn", "1.02 of it"),
            Finding("lens-choice", "note", "opencv"),
            Finding("mirrored-pose", "note", "both"),
            Finding("unit-weight", "warn", "3.1"),
        ]
    )
    assert [one.code for one in found] == ["weak-calibration", "wrong-scale"]
    assert found[0].evidence == (
        "calibration, warning little-depth: cam1: 2 % of depth",
        "calibration, refused weak-link: cam2: 1 common view",
    )
    assert found[0].camera == "cam1"


@pytest.mark.parametrize(
    ("late_s", "sigma_s", "code"),
    [
        (0.003, 2e-5, "sync-lost"),
        (0.01003, 2e-5, "frames-one-off"),  # a period
        (-0.02, 2e-5, "frames-one-off"),
        (0.003, 1e-3, None),  # three of its sigmas, of four cameras
        (0.00009, 1e-6, None),  # certain, and small
        (np.nan, np.nan, None),
    ],
)
def test_a_late_camera_is_named_where_chance_does_not_make_it(late_s, sigma_s, code):
    cameras = [camera("cam1"), camera("cam2", late_s, sigma_s), camera("cam3"), camera("cam4")]
    found = health_causes(cameras, PERIOD_S, 5e-5)
    assert [one.code for one in found] == ([] if code is None else [code])
    if found:
        assert found[0].camera == "cam2"
        assert found[0].p_value == pytest.approx(8 * norm.sf(abs(late_s) / sigma_s))


def test_a_camera_that_hardly_connects_is_not_judged():
    assert poorly_connected([camera("cam1"), camera("cam2", connected=0.3)])[0].startswith("camera 'cam2'")
    assert poorly_connected([camera("cam1"), camera("cam2", connected=np.nan)]) == []
