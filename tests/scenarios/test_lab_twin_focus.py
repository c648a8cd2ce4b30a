"""Focus and aperture of a lab's cameras: depths from the rig, keys that are not told, draws with correlation."""

from types import SimpleNamespace

import numpy as np
import pytest

from mosca.accuracy.lab_twin.defocus import Defocus
from mosca.accuracy.lab_twin.estimates import NotTold, ParameterEstimate
from mosca.data.detections import Detections
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from scenarios.lab_twin.apply import bounded, drawn
from scenarios.lab_twin.focus import NEEDS_DEPTH, NEEDS_RIG, depths_m, with_focus
from scenarios.lab_twin.lab_file import lab_document, read_lab, write_lab

LENS = OpenCVLens(600.0, 600.0, 256.0, 200.0)
PSF = ParameterEstimate("a", "errors.psf_sigma_px", 0.5, 0.01, "x")


def two_cameras():
    """Return a rig that looks along z from the origin and along -x from (2.2, 0, 2)."""
    aside = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    first = Camera("a", 512, 400, LENS, Pose(np.eye(3), np.zeros(3)))
    for rotation in (aside, aside.T):
        second = Camera("b", 512, 400, LENS, Pose(rotation, np.array([2.2, 0.0, 2.0])))
        if second.world_from_camera.rotation[0, 2] < 0.0:
            return Rig((first, second))
    raise AssertionError("neither looks along -x")


def test_depths_are_along_each_cameras_axis():
    xyz = np.array([[0.1, 0.2, 1.8], [-0.2, -0.1, 2.3], [0.3, 0.05, 2.1]])
    # pinhole cameras by hand: camera b's right is z and its depth 2.2 - x (or its right -z: mirrored)
    rig = two_cameras()
    right = rig.cameras[1].world_from_camera.rotation[2, 0]
    images = {
        "a": xyz[:, :2] / xyz[:, 2:] * 600.0,
        "b": np.stack([right * (xyz[:, 2] - 2.0), xyz[:, 1]], axis=1) / (2.2 - xyz[:, :1]) * 600.0,
    }
    depth = {"a": xyz[:, 2], "b": 2.2 - xyz[:, 0]}
    found, targets = {}, {}
    for name, xy in images.items():
        xy = xy + (256.0, 200.0)
        n = len(xy)
        found[name] = Detections(
            name, xy, np.tile(1e-4 * np.eye(2), (n, 1, 1)), np.full(n, 5.0), np.full(n, 99), np.ones(n)
        )
        targets[name] = [SimpleNamespace(xy_px=tuple(one), fit=SimpleNamespace(radius_px=2.5)) for one in xy]
    targets["a"].append(SimpleNamespace(xy_px=(10.0, 10.0), fit=SimpleNamespace(radius_px=2.5)))
    told = depths_m(rig, found, targets)
    assert told["a"][:3] == pytest.approx(depth["a"], abs=1e-4)
    assert np.isnan(told["a"][3])
    assert told["b"] == pytest.approx(depth["b"], abs=1e-4)


def test_what_is_not_told_says_why_and_keeps_the_blur():
    camera = two_cameras().cameras[0]
    for known, why in ((None, NEEDS_RIG), (camera, NEEDS_DEPTH)):
        told = with_focus([PSF], known, None)
        assert told[0] is PSF
        assert [one.key for one in told[1:]] == ["optics.focus_m", "optics.f_number"]
        assert all(isinstance(one, NotTold) and one.reason == why for one in told[1:])


def test_estimates_and_their_correlation_are_drawn_together(tmp_path):
    # a lens of 600 px x 9.9 um = 5.94 mm, focused at 4 m
    covariance = np.array([[0.0, 0.0, 0.0], [0.0, 1.6e-5, 1.2e-3], [0.0, 1.2e-3, 0.1]])
    told = with_focus([PSF], two_cameras().cameras[0], Defocus(0.1, 0.25, 13.0, covariance, 10, 0.005))
    known = {one.key: one for one in told}
    assert known["errors.psf_sigma_px"].value == 0.1
    assert known["optics.focus_m"].value == 4.0
    # the opening f / N is what makes 13 px m: s = f A F / (F - f) / pitch
    opening = 13.0 * 9.9e-6 / 5.94e-3 * (4.0 - 5.94e-3) / 4.0
    assert known["optics.f_number"].value == pytest.approx(5.94e-3 / opening)
    more = ParameterEstimate("a", "errors.read_noise_e", 10.0, 0.5, "x")
    write_lab(tmp_path / "lab.toml", lab_document([more, *told], ("static:a",), None))
    fitted = read_lab(tmp_path / "lab.toml")
    made = [drawn(fitted, np.random.default_rng(k)).camera[0] for k in range(500)]
    optics = np.array([(one.optics.focus_m, one.optics.f_number, one.errors.read_noise_e) for one in made])
    # 1 / F and s go up together: F goes down, and N, which goes with 1 / s, too
    turned = np.corrcoef(optics.T)
    assert turned[0, 1] == pytest.approx(1.2e-3 / np.sqrt(1.6e-5 * 0.1), abs=0.03)
    assert abs(turned[0, 2]) < 0.15
    assert optics.std(axis=0) == pytest.approx([16.0 * 4e-3, opening_share(known), 0.5], rel=0.15)
    assert {one.errors.psf_sigma_px for one in made} == {0.1}
    assert bounded("errors.psf_sigma_px", 0.2, 0.01) == 0.1  # the least that a scenario takes


def opening_share(known):
    """Return the f-number's standard deviation: that of s as a share, 0.1 ** 0.5 / 13."""
    return known["optics.f_number"].value * np.sqrt(0.1) / 13.0
