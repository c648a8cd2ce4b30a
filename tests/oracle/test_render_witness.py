"""The twin's images of markers against outlines worked out by OpenCV, brute-force pixels and averaged instants.

Limits: centroid 0.001 px rms, 0.004 px at most (asked for); measured figures stand beside each test.
"""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
import pytest
from scipy.integrate import simpson
from witness_render import (
    POINTS,
    Array,
    WitnessLens,
    area_and_centroid,
    ball_outline,
    disc_outline,
    fisheye_lens,
    image_centroid,
    opencv_lens,
    paper_lens,
    pixels_by_brute_force,
    with_gap,
)

from mosca.data.rig import FisheyeLens, Lens, MoscaLens, OpenCVLens
from twin.cameras.kernel import gaussian_kernel
from twin.cameras.lens import TwinLens
from twin.cameras.occlusion import occluders_of
from twin.cameras.render import BALL, FLAT, MarkersInCamera, Seen, render_markers
from twin.scenes.scene import Scene

W, H = 656, 491
ELECTRONS = 12_000.0
SIGMA = 0.6
KERNEL = gaussian_kernel(SIGMA)
NOTHING = occluders_of(Scene(mujoco.MjModel.from_xml_string("<mujoco/>"), (), (), lambda t: np.zeros(0), 1.0))

LENSES: dict[str, tuple[Lens, WitnessLens]] = {
    "mosca": (
        MoscaLens(6.5, 301.4, 255.5, 0.00943, 0.00944, -0.0067, 8.7e-4, -1.8e-5, 3e-7, 2.8e-4, 4.5e-5),
        paper_lens(6.5, 301.4, 255.5, 0.00943, 0.00944, -0.0067, (8.7e-4, -1.8e-5, 3e-7), (2.8e-4, 4.5e-5)),
    ),
    "opencv": (
        OpenCVLens(690.0, 694.0, 333.0, 238.0, -0.23, 0.07, 7e-4, -5e-4, -0.01, 0.02, 0.01, 0.002),
        opencv_lens(
            np.array([[690.0, 0, 333.0], [0, 694.0, 238.0], [0, 0, 1]]),
            np.array([-0.23, 0.07, 7e-4, -5e-4, -0.01, 0.02, 0.01, 0.002]),
        ),
    ),
    "fisheye": (
        FisheyeLens(270.0, 271.0, 322.0, 240.0, -0.03, 0.004, -0.001, 0.0002),
        fisheye_lens(
            np.array([[270.0, 0, 322.0], [0, 271.0, 240.0], [0, 0, 1]]),
            np.array([-0.03, 0.004, -0.001, 0.0002]),
        ),
    ),
}
PLACES = {"centre": (327.3, 245.8), "edge": (618.4, 251.7), "corner": (39.6, 450.2)}
DIAMETERS = (2.0, 3.1, 5.4, 8.0, 14.7, 25.3, 40.0)
EXPECTED_RMS, EXPECTED_MAX = 0.001, 0.004


@dataclass(frozen=True, eq=False)
class Placed:
    """A marker before a camera: ``path`` (3, 3) start, middle, end [m]; ``normal`` None for a ball."""

    path: Array
    radius: float
    normal: Array | None = None

    def outline(self, tau: float = 0.0) -> Array:
        """Return its outline at tau in -1..1, on the parabola through start, middle and end."""
        a, b, c = self.path
        centre = b + 0.5 * (c - a) * tau + 0.5 * (a - 2 * b + c) * tau**2
        if self.normal is None:
            return ball_outline(centre, self.radius)
        return disc_outline(centre, self.normal, self.radius)


def render(lens: Lens, gap: float, marker: Placed, size: tuple[int, int] = (W, H)) -> tuple[Array, Seen]:
    """Return the twin's noise-free image and what it says it saw."""
    light = np.zeros((size[1], size[0]), dtype=np.float32)
    normal = np.array([0.0, 0.0, -1.0]) if marker.normal is None else marker.normal
    one = MarkersInCamera(
        np.ascontiguousarray(marker.path[None]),
        np.ascontiguousarray(normal[None]),
        np.array([marker.radius]),
        np.array([BALL if marker.normal is None else FLAT], dtype=np.int64),
        np.array([ELECTRONS]),
    )
    vector = TwinLens.of(lens, size[0], size[1], gap).vector
    seen = render_markers(light, vector, KERNEL, one, NOTHING, np.zeros((0, 3)), np.zeros((0, 3, 3)))
    return light, seen


def still(centre: Array) -> Array:
    return np.repeat(centre[None], 3, axis=0)


def placed(witness: WitnessLens, xy: tuple[float, float], diameter: float, tilt_deg: float | None) -> Placed:
    """Return a marker whose image lies about ``xy`` [px] and is about ``diameter`` px large, 2 m away.

    ``tilt_deg``: None for a ball, else the angle between a disc's normal and the line of sight.
    """
    direction = witness.unproject(np.array([xy]))[0]
    direction = direction / np.linalg.norm(direction)
    beside = np.cross(direction, [0.31, 0.9, 0.2])
    beside /= np.linalg.norm(beside)
    other = np.cross(direction, beside)
    step = 1e-5
    around = witness.project(
        np.array([direction + step * beside, direction - step * beside, direction + step * other,
                  direction - step * other])
    )  # fmt: skip
    jacobian = np.array([around[0] - around[1], around[2] - around[3]]) / (2 * step)
    scale = np.sqrt(abs(np.linalg.det(jacobian)))  # px/rad
    radius = 2.0 * diameter / 2 / scale
    normal = None
    if tilt_deg is not None:
        tilt = np.deg2rad(tilt_deg)
        normal = -np.cos(tilt) * direction + np.sin(tilt) * (0.6 * beside + 0.8 * other)
    return Placed(still(2.0 * direction), radius, normal)


def mean_over_instants(witness: WitnessLens, marker: Placed, instants: int = 41) -> tuple[float, Array]:
    """Return area [px^2] and centroid (2,) [px] of the light of a whole exposure, Simpson's rule in time."""
    taus = np.linspace(-1.0, 1.0, instants)
    each = [area_and_centroid(witness.project(marker.outline(tau))) for tau in taus]
    areas, centroids = np.array([a for a, _ in each]), np.array([c for _, c in each])
    light = simpson(areas, x=taus)
    return float(light / 2), simpson(areas[:, None] * centroids, x=taus, axis=0) / light


@pytest.mark.parametrize("gap", [0.0, 0.25])
@pytest.mark.parametrize("name", LENSES)
def test_still_marker_lands_where_its_outline_does(name, gap):
    # measured, all lenses: 1.2e-5 px rms, 3.9e-5 at most (aliasing of the pixel kernel at 2 px), area 1.7e-6
    # (the polygon's own); the limits asserted stand 25 times above and 30 times below what is asked for
    lens, plain = LENSES[name]
    witness = with_gap(plain, gap, W, H)
    off, area_off = [], []
    for xy in PLACES.values():
        for number, diameter in enumerate(DIAMETERS):
            for tilt in (None, 0.0, 30.0, 60.0):
                nudge = 0.137 * number
                marker = placed(witness, (xy[0] + nudge, xy[1] - nudge / 2), diameter, tilt)
                outline = witness.project(marker.outline())
                area, centroid = area_and_centroid(outline)
                light, seen = render(lens, gap, marker)
                off.append(image_centroid(light) - centroid)
                area_off.append(light.sum(dtype=float) / ELECTRONS / area - 1)
                assert seen.visible[0] == 1.0
                true_centre = witness.project(marker.path[1:2])[0]
                np.testing.assert_allclose(seen.xy_px[0], true_centre, atol=1e-6)
                longest = np.hypot(*(outline[: POINTS // 2] - outline[POINTS // 2 :]).T).max()
                assert seen.diameter_px[0] == pytest.approx(longest, rel=0.2)  # fisheye 0.18, others 0.05
    distance = np.hypot(*np.transpose(off))
    assert np.sqrt(np.mean(distance**2)) < EXPECTED_RMS / 10
    assert distance.max() < EXPECTED_MAX / 10
    assert np.abs(area_off).max() < 1e-5


@pytest.mark.parametrize("tilt", [75.0, 85.0])
@pytest.mark.parametrize("diameter", [4.0, 16.0, 80.0])
def test_flat_target_seen_at_a_grazing_angle(diameter, tilt):
    lens, witness = LENSES["opencv"]
    marker = placed(witness, PLACES["centre"], diameter, tilt)
    area, centroid = area_and_centroid(witness.project(marker.outline()))
    light, _seen = render(lens, 0.0, marker)
    assert np.hypot(*(image_centroid(light) - centroid)) < EXPECTED_RMS
    assert light.sum(dtype=float) / ELECTRONS == pytest.approx(area, rel=1e-4)


def test_fisheye_looks_behind_its_own_plane():
    # equidistant by hand: radius = f theta, also at 100 degrees off the axis, where z < 0
    def project(v: Array) -> Array:
        theta = np.arctan2(np.hypot(v[:, 0], v[:, 1]), v[:, 2])
        about = np.arctan2(v[:, 1], v[:, 0])
        return np.column_stack([328 + 150 * theta * np.cos(about), 245 + 150 * theta * np.sin(about)])

    angle = np.deg2rad(100.0)
    marker = Placed(still(1.5 * np.array([np.sin(angle), 0.1, np.cos(angle)])), 0.05)
    area, centroid = area_and_centroid(project(marker.outline()))
    light, seen = render(FisheyeLens(150.0, 150.0, 328.0, 245.0), 0.0, marker)
    assert np.hypot(*(image_centroid(light) - centroid)) < EXPECTED_RMS
    assert light.sum(dtype=float) / ELECTRONS == pytest.approx(area, rel=1e-5)
    np.testing.assert_allclose(seen.xy_px[0], project(marker.path[1:2])[0], atol=1e-9)


def test_eccentricity_in_closed_form():
    # pinhole, f 1000 px: ball centroid minus image of its centre = f (Cx / Cz) r^2 / (Cz^2 - r^2);
    # at 0.3 m, 30 degrees and r 7 mm that is 0.31 px
    lens = OpenCVLens(1000.0, 1000.0, 100.0, 245.0)
    centre = np.array([0.3 * np.tan(np.deg2rad(30.0)), 0.0, 0.3])
    radius = 0.007
    light, seen = render(lens, 0.0, Placed(still(centre), radius), (720, 491))
    expected = 1000.0 * centre[0] / centre[2] * radius**2 / (centre[2] ** 2 - radius**2)
    assert expected == pytest.approx(0.31, abs=0.01)
    np.testing.assert_allclose(image_centroid(light) - seen.xy_px[0], [expected, 0.0], atol=1e-5)


@pytest.mark.parametrize(
    ("xy", "diameter", "tilt", "limit"),
    [
        ((24.3, 17.8), 8.0, None, 1e-4),
        ((22.6, 16.2), 17.0, 55.0, 1e-4),
        ((25.1, 15.3), 0.7, 20.0, 1e-4),
        ((39.2, 30.4), 12.0, None, 1e-4),
        ((-4.5, 15.0), 12.0, 40.0, 1e-4),
    ],
    ids=["ball", "tilted disc", "smaller than a pixel", "cut by the image's corner", "centre outside"],
)
def test_every_pixel_against_brute_force(xy, diameter, tilt, limit):
    # measured, in shares of a full pixel: 3.2e-5 with 32 cells and 2.2e-6 with 64, so the brute force's own
    # step; where the image's border cuts the marker too
    size = (40, 32)
    distortion = np.array([-0.2, 0.1, 2e-3, -1e-3, 0.0])
    lens = OpenCVLens(90.0, 92.0, 18.0, 14.0, -0.2, 0.1, 2e-3, -1e-3)
    witness = opencv_lens(np.array([[90.0, 0, 18.0], [0, 92.0, 14.0], [0, 0, 1]]), distortion)
    marker = placed(witness, xy, diameter, tilt)
    light, _seen = render(lens, 0.0, marker, size)
    share = pixels_by_brute_force(witness.project(marker.outline()), SIGMA, *size)
    assert np.abs(light / ELECTRONS - share).max() < limit
    assert share.max() > 0.1


@pytest.mark.parametrize("gap", [0.0, 0.25])
@pytest.mark.parametrize("name", LENSES)
def test_moving_marker_lands_at_the_mean_of_its_instants(name, gap):
    # measured: 6.7e-6 px at most, up to 80 px of blur, straight and bent; asked for 0.002 px
    lens, plain = LENSES[name]
    witness = with_gap(plain, gap, W, H)
    off, area_off = [], []
    for xy, diameter, blur, tilt in [
        ((327.3, 245.8), 3.0, 1.0, None),
        ((500.2, 251.7), 8.0, 12.0, None),
        ((90.6, 400.2), 6.0, 30.0, None),
        ((90.6, 400.2), 14.0, 6.0, 45.0),
        ((327.3, 245.8), 5.0, 80.0, None),
    ]:
        marker = placed(witness, xy, diameter, tilt)
        metre = 2 * marker.radius / diameter  # of a pixel, at the marker
        motion = metre * blur * np.array([0.75, -0.5, 0.43])
        bend = metre * 0.1 * blur * np.array([0.2, 0.7, 0.0])
        centre = marker.path[1]
        for path in (
            [centre - motion / 2, centre, centre + motion / 2],
            [centre - motion / 2 + bend, centre, centre + motion / 2 + bend],
        ):
            moving = Placed(np.array(path), marker.radius, marker.normal)
            area, centroid = mean_over_instants(witness, moving)
            light, _seen = render(lens, gap, moving)
            off.append(np.hypot(*(image_centroid(light) - centroid)))
            area_off.append(light.sum(dtype=float) / ELECTRONS / area - 1)
    assert max(off) < 0.002 / 10
    assert np.abs(area_off).max() < 1e-5


def blurred_by_brute_force(witness: WitnessLens, marker: Placed, size: tuple[int, int], blur: float) -> Array:
    """Return the mean of brute-force images at instants 0.25 px apart."""
    instants = int(4 * blur)
    taus = 2 * (np.arange(instants) + 0.5) / instants - 1
    return np.mean(
        [pixels_by_brute_force(witness.project(marker.outline(t)), SIGMA, *size, fine=8) for t in taus],
        axis=0,
    )


@pytest.mark.parametrize("blur", [8.0, 30.0, 60.0])
def test_every_pixel_of_a_streak(blur):
    # measured, in shares of the streak's peak: 2.6e-4 at each blur. With the witness's instants 0.5 px apart it is
    # 1.06e-3, four times as much, so what is left is mostly the witness's own step (second order)
    size = (90, 24)
    lens = OpenCVLens(700.0, 700.0, 45.0, 12.0)
    witness = opencv_lens(np.array([[700.0, 0, 45.0], [0, 700.0, 12.0], [0, 0, 1]]), np.zeros(5))
    centre, motion = np.array([0.003, 0.001, 2.0]), np.array([blur, 0.1 * blur, 0.0]) * 2.0 / 700.0
    marker = Placed(np.array([centre - motion / 2, centre, centre + motion / 2]), 3.0 * 2.0 / 700.0)
    light, _seen = render(lens, 0.0, marker, size)
    share = blurred_by_brute_force(witness, marker, size, blur)
    worst = np.abs(light / ELECTRONS - share).max() / share.max()
    assert worst < 1e-3


def test_what_is_not_seen_gives_no_light():
    lens, _witness = LENSES["opencv"]
    straight = np.array([0.0, 0.0, 2.0])
    for marker in (
        Placed(still(straight), 0.02, np.array([0.0, 0.0, 1.0])),  # a flat target from behind
        Placed(still(-straight), 0.02),  # behind the camera
        Placed(still(np.array([9.0, 0.0, 2.0])), 0.02),  # outside the image
    ):
        light, seen = render(lens, 0.0, marker)
        assert light.max() == 0.0
        assert seen.visible[0] == 0.0


def test_no_ghost_beyond_the_fold_of_the_distortion():
    # r (1 - 0.4 r^2 + 0.06 r^4) turns back at r = 1.09 and rises again from 1.55: no light from 61 degrees
    # off the axis (r = 1.8) reaches a real lens's image, where the polynomial lands at 180 px again
    folded = OpenCVLens(300.0, 300.0, 160.0, 110.0, -0.4, 0.06)
    light, seen = render(folded, 0.0, Placed(still(np.array([1.8, 0.0, 1.0]) / 2), 0.02), (360, 220))
    assert light.max() == 0.0
    assert seen.visible[0] == 0.0


@pytest.mark.parametrize("gap", [0.0, 0.25])
@pytest.mark.parametrize("name", LENSES)
def test_the_witness_agrees_with_itself(name, gap):
    # there and back through each of its lenses, and a circle's area
    witness = with_gap(LENSES[name][1], gap, W, H)
    xy = np.array([[12.0, 30.0], [327.3, 245.8], [640.0, 470.0]])
    np.testing.assert_allclose(witness.project(witness.unproject(xy)), xy, atol=1e-6)
    circle = disc_outline(np.array([3.0, 4.0, 1.0]), np.array([0.0, 0.0, 1.0]), 2.5)[:, :2]
    area, centroid = area_and_centroid(circle)
    assert area == pytest.approx(np.pi * 2.5**2, rel=2e-6)
    np.testing.assert_allclose(centroid, [3.0, 4.0], atol=1e-12)


def test_gross_faults_are_noticed():
    # control: each fault moves the centroid by more than ten times the limit
    lens, witness = LENSES["opencv"]
    marker = placed(witness, PLACES["edge"], 8.0, None)
    _area, centroid = area_and_centroid(witness.project(marker.outline()))
    assert isinstance(lens, OpenCVLens)
    shifted = replace(lens, cx_px=lens.cx_px + 0.5)
    mirrored = Placed(marker.path * [1.0, -1.0, 1.0], marker.radius)
    for faulty_lens, faulty in ((shifted, marker), (lens, mirrored)):
        light, _seen = render(faulty_lens, 0.0, faulty)
        assert np.hypot(*(image_centroid(light) - centroid)) > 10 * EXPECTED_MAX


def test_a_wrong_exposure_centre_is_noticed():
    # control: an image exposed half a window late, of a marker that moves by 4 px in the window
    lens, witness = LENSES["opencv"]
    marker = placed(witness, PLACES["centre"], 8.0, None)
    motion = np.array([4 * 2 * marker.radius / 8.0, 0.0, 0.0])
    centre = marker.path[1]
    true = Placed(np.array([centre - motion / 2, centre, centre + motion / 2]), marker.radius)
    late = Placed(true.path + motion / 2, marker.radius)
    _area, centroid = mean_over_instants(witness, true)
    light, _seen = render(lens, 0.0, late)
    assert np.hypot(*(image_centroid(light) - centroid)) > 10 * 0.002


def test_the_smallest_fault_that_must_fail():
    # control: a principal point off by three times the limit fails it
    lens, witness = LENSES["opencv"]
    assert isinstance(lens, OpenCVLens)
    marker = placed(witness, PLACES["corner"], 8.0, 30.0)
    _area, centroid = area_and_centroid(witness.project(marker.outline()))
    light, _seen = render(replace(lens, cy_px=lens.cy_px + 3 * EXPECTED_MAX), 0.0, marker)
    assert np.hypot(*(image_centroid(light) - centroid)) > EXPECTED_MAX
