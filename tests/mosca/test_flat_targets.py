"""Flat round targets at a slant: outlines projected by OpenCV point by point, and integrated as polygons."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mosca.camera.ray_table import IMAGE_NOISE, make_ray_table
from mosca.correspondence.match import MatchSettings, match
from mosca.data.detections import Detections
from mosca.data.rays import Predicted
from mosca.data.rig import Camera, FisheyeLens, OpenCVLens, Pose, Rig
from mosca.detection.detect import NO_STATISTICS, DetectionSettings, detect_with_statistics

LENSES = {
    "opencv": OpenCVLens(1000.0, 990.0, 512.0, 500.0, -0.2, 0.06, 1e-3, -5e-4),
    "fisheye": FisheyeLens(420.0, 420.0, 512.0, 500.0, 0.02, -0.01),
}
RADIUS = 0.015
CENTRES = np.array([[0.22, 0.1, 0.0], [-0.2, -0.12, 0.05], [0.03, 0.18, -0.05], [-0.1, 0.16, 0.02]])
NORMALS = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 1.0], [0.0, 0.0, 1.0], [0.25, -0.3, 1.0]])
TURNED = np.linspace(0, 2 * np.pi, 720, endpoint=False)[:, None]


def rig_of(lens):
    """Four cameras around and above the discs, turned aside so that these lie off their axes."""
    cameras = []
    for k, (x, y, z) in enumerate(((0.6, 0.1, 0.5), (-0.1, 0.65, 0.45), (-0.6, -0.1, 0.6), (0.15, -0.6, 0.4))):
        forward = np.array([0.12, -0.1, 0.0]) - (x, y, z)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.1 * k, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.column_stack([right, np.cross(forward, right), forward])
        cameras.append(Camera(f"c{k}", 1024, 1000, lens, Pose(rotation, np.array([x, y, z]))))
    return Rig(tuple(cameras))


def pixels(camera, points):
    """Project world points (n, 3) by OpenCV."""
    lens, pose = camera.lens, camera.world_from_camera.inverse()
    turn = cv2.Rodrigues(pose.rotation)[0]
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    if isinstance(lens, FisheyeLens):
        bend = np.array([lens.k1, lens.k2, lens.k3, lens.k4])
        return cv2.fisheye.projectPoints(points[None], turn, pose.translation, matrix, bend)[0][0]
    bend = np.array([lens.k1, lens.k2, lens.p1, lens.p2, lens.k3])
    return cv2.projectPoints(points, turn, pose.translation, matrix, bend)[0][:, 0]


def outline(centre, normal, radius):
    """Points (n, 3) of a circle."""
    u = np.cross(normal, [0.3, 0.9, -0.2])
    u /= np.linalg.norm(u)
    v = np.cross(normal, u) / np.linalg.norm(normal)
    return centre + radius * (np.cos(TURNED) * u + np.sin(TURNED) * v)


def measured(xy):
    """Centroid, diameter and ellipticity of a polygon (n, 2) [px], by its moments (Green's theorem)."""
    middle = xy.mean(axis=0)
    (x, y), (u, v) = (xy - middle).T, np.roll(xy - middle, -1, axis=0).T
    cross = x * v - u * y
    area = cross.sum() / 2
    mean = np.array([((x + u) * cross).sum(), ((y + v) * cross).sum()]) / (6 * area)
    xx = ((x * x + x * u + u * u) * cross).sum() / (12 * area) - mean[0] ** 2
    yy = ((y * y + y * v + v * v) * cross).sum() / (12 * area) - mean[1] ** 2
    xy2 = ((x * v + 2 * x * y + 2 * u * v + u * y) * cross).sum() / (24 * area) - mean[0] * mean[1]
    # of an ellipse the moments are a quarter of the squared semi-axes
    values, axes = np.linalg.eigh([[xx, xy2], [xy2, yy]])
    turn = 2 * np.arctan2(axes[1, 1], axes[0, 1])
    stretch = 0.5 * np.log(values[1] / values[0])
    return middle + mean, 2 * np.sqrt(abs(area) / np.pi), stretch * np.array([np.cos(turn), np.sin(turn)])


def images_of(rig, outlines):
    """Detections of outlines, a function of camera and number to points (n, 3)."""
    found, n = {}, len(CENTRES)
    for camera in rig.cameras:
        xy, diameter, ellipticity = zip(
            *(measured(pixels(camera, outlines(camera, k))) for k in range(n)), strict=True
        )
        covariance = np.tile(0.02**2 * np.eye(2), (n, 1, 1))
        long = np.minimum(1 + np.linalg.norm(ellipticity, axis=1), 1.5)
        found[camera.name] = Detections(
            camera.name, np.array(xy), covariance, np.array(diameter), np.ones(n), long, np.zeros(n),
            0.01 * np.array(diameter), np.array(ellipticity), np.full(n, 0.02),
        )  # fmt: skip
    return found


def discs(camera, k):
    """Return the outline of disc k."""
    return outline(CENTRES[k], NORMALS[k], RADIUS)


def matched(rig, found, target="auto", diameter_m=2 * RADIUS, light="even"):
    settings = MatchSettings(target=target, light=light)
    table = make_ray_table(rig, found, 0.02, target)
    points = match(table, Predicted.nothing(), settings, typical_diameter_m=diameter_m)
    assert len(points) == len(CENTRES)
    away = np.linalg.norm(points.xyz[:, None] - CENTRES[None], axis=2)
    nearest = away.argmin(axis=0)
    assert sorted(nearest) == list(range(len(CENTRES)))
    return points, away.min(axis=0), nearest


def light_of_lamp(camera, k, power):
    """Centroid of disc k's image [px] where its light falls with the distance to this power."""
    u = np.cross(NORMALS[k], [0.3, 0.9, -0.2])
    u /= np.linalg.norm(u)
    v = np.cross(NORMALS[k], u) / np.linalg.norm(NORMALS[k])
    grid = (np.arange(60) + 0.5) / 30 - 1
    a, b = (part.ravel() for part in np.meshgrid(grid, grid))
    a, b = a[a * a + b * b < 1], b[a * a + b * b < 1]
    at = CENTRES[k] + RADIUS * (a[:, None] * u + b[:, None] * v)
    # the area of its image that a piece of the disc has
    by_u, by_v = (pixels(camera, at + 1e-5 * d) - pixels(camera, at - 1e-5 * d) for d in (u, v))
    area = np.abs(by_u[:, 0] * by_v[:, 1] - by_u[:, 1] * by_v[:, 0])
    light = area * np.linalg.norm(at - camera.world_from_camera.translation, axis=1) ** power
    return (light[:, None] * pixels(camera, at)).sum(axis=0) / light.sum()


def test_lamps_at_the_lens_light_the_nearer_side_more():
    rig = rig_of(LENSES["opencv"])
    found, even = images_of(rig, discs), {}
    for camera in rig.cameras:
        lit = np.array([light_of_lamp(camera, k, -2) - light_of_lamp(camera, k, 0) for k in range(len(CENTRES))])
        # a fit follows about half of it
        even[camera.name] = replace(found[camera.name], xy_px=found[camera.name].xy_px + 0.5 * lit)
    points, away, nearest = matched(rig, even, light="unknown")
    assert away.max() < 5e-6
    # the control: taken for evenly lit, and all of the centroid's shift
    assert matched(rig, even)[1].max() > 20e-6
    # what is not known is said: distant lamps, and the light's centroid itself, are two standard deviations off
    noise = matched(rig, found)[0]
    more = points.covariance[nearest] - noise.covariance[matched(rig, found)[2]]
    for lamp in (found, {n: replace(e, xy_px=2 * e.xy_px - found[n].xy_px) for n, e in even.items()}):
        off = matched(rig, lamp, light="unknown")[1]
        ratio = off / np.sqrt(np.trace(more, axis1=1, axis2=2))
        assert np.all((ratio > 1.0) & (ratio < 2.2))


@pytest.mark.parametrize("name", list(LENSES))
def test_discs_at_a_slant_are_measured_where_they_are(name):
    rig = rig_of(LENSES[name])
    found = images_of(rig, discs)
    points, away, _ = matched(rig, found)
    assert (points.n_cameras == 4).all()
    assert away.max() < 4e-6
    # control: as they are, the images' centroids lie beside
    beside = matched(rig, found, "point")[1]
    assert beside.max() > 40e-6
    assert away.max() < 0.1 * beside.max()
    # matched again, the same
    table = make_ray_table(rig, found, 0.02, "auto")
    one, two = (match(table, Predicted.nothing(), MatchSettings(light="even")) for _ in range(2))
    np.testing.assert_allclose(one.xyz, two.xyz, rtol=0, atol=2e-7)


def test_what_is_not_known_of_the_normals_is_in_the_covariance():
    rig = rig_of(LENSES["opencv"])
    found = images_of(rig, discs)
    poor = {name: replace(one, ellipticity_sigma=np.full(4, 0.1)) for name, one in found.items()}
    sure, unsure = matched(rig, found), matched(rig, poor)
    for k in range(4):
        a, b = sure[0].covariance[sure[2][k]], unsure[0].covariance[unsure[2][k]]
        assert np.linalg.eigvalsh(b - a).min() > -1e-3 * np.trace(a)
        assert np.trace(b) > np.trace(a)


@pytest.mark.parametrize("known_m", [0.0, 2 * RADIUS])
def test_apparent_sizes_of_discs_are_no_sign_of_hiding(known_m):
    rig = rig_of(LENSES["opencv"])
    found = images_of(rig, discs)
    points, _, nearest = matched(rig, found, diameter_m=known_m)
    assert points.trusted == pytest.approx(4.0)
    assert points.diameter_m == pytest.approx(2 * RADIUS, rel=0.01)
    # half of the first disc hidden from one camera: it counts for less there, and only there

    def hidden(camera, k):
        whole = discs(camera, k)
        if (camera.name, k) == ("c1", 0):
            along = (whole - CENTRES[0]) @ [1.0, 0.3, 0.0]
            return whole[along > 0.001]
        return whole

    points, away, nearest = matched(rig, images_of(rig, hidden), diameter_m=known_m)
    assert points.trusted[nearest[0]] < 3.5
    assert np.delete(points.trusted, nearest[0]) == pytest.approx(4.0)
    assert away.max() < 0.5e-3


def test_balls_smeared_by_their_motion_are_no_discs():
    rig = rig_of(LENSES["opencv"])
    speed = np.array([0.014, 0.008, 0.004])

    def moved(camera, k):
        """Outline of a long ellipsoid: the touching cone's circle, stretched along the motion."""
        ray = CENTRES[k] - camera.world_from_camera.translation
        round_one = outline(np.zeros(3), ray, RADIUS)
        return CENTRES[k] + round_one + np.outer(round_one @ speed / RADIUS**2 * 0.5, speed)

    found = images_of(rig, moved)
    assert min(np.linalg.norm(one.ellipticity, axis=1).max() for one in found.values()) > 0.2
    # as if nothing but their boxes' sides were known of their shapes
    plain = {
        name: replace(one, ellipticity=np.empty(0), ellipticity_sigma=np.empty(0)) for name, one in found.items()
    }
    (points, _, at), (expected, _, there) = matched(rig, found), matched(rig, plain)
    # an image that may be a round ball's, of motion along the ray, is freed of a ball's eccentricity
    clear = np.min([np.linalg.norm(one.ellipticity, axis=1) for one in found.values()], axis=0) > 0.15
    assert clear.sum() == 3
    at, there = at[clear], there[clear]
    np.testing.assert_allclose(points.xyz[at], expected.xyz[there], rtol=0, atol=1e-7)
    np.testing.assert_allclose(points.covariance[at], expected.covariance[there], rtol=0.02)


def ellipses(rng, a, b, blur, across=400, apart=25, fine=8):
    """An image of blurred ellipses at all angles, pixels of ``fine``^2 samples, noisy; their centres and angles."""
    image = np.zeros((across * fine, across * fine))
    grid = np.arange(apart // 2 + 8, across - apart, apart)
    centre = np.array([(x, y) for y in grid for x in grid]) + rng.uniform(-0.5, 0.5, (len(grid) ** 2, 2))
    angle = rng.uniform(0, np.pi, len(centre))
    half = int(fine * (a + 2))
    for (x, y), t in zip(centre, angle, strict=True):
        i, j = int(fine * x), int(fine * y)
        v, u = np.mgrid[j - half : j + half, i - half : i + half]
        dx, dy = (u + 0.5) / fine - 0.5 - x, (v + 0.5) / fine - 0.5 - y
        along, beside = np.cos(t) * dx + np.sin(t) * dy, -np.sin(t) * dx + np.cos(t) * dy
        image[v, u] += (along / a) ** 2 + (beside / b) ** 2 < 1
    smooth = gaussian_filter(image, blur * fine).reshape(across, fine, across, fine).mean(axis=(1, 3))
    electrons = 4000 * smooth + 100
    noisy = electrons + rng.normal(size=electrons.shape) * np.sqrt(electrons + 25)
    return np.clip(np.round(noisy / 25), 0, 255).astype(np.uint8), centre, angle


@pytest.mark.parametrize(("a", "b", "blur"), [(5.0, 2.6, 0.7), (4.0, 3.2, 0.7), (9.0, 6.0, 1.2), (4.0, 2.2, 0.4)])
def test_the_ellipticity_of_an_image_is_without_blur_and_its_noise_as_stated(a, b, blur):
    rng, learned = np.random.default_rng(5), NO_STATISTICS
    settings = DetectionSettings(read_noise_dn=0.35, gain_dn_per_e=0.04)
    for _ in range(3):
        image, centre, angle = ellipses(rng, a, b, blur)
        (found,), new = detect_with_statistics([image], ["a"], settings, statistics=learned)
        learned = learned.plus(new)
    away = np.linalg.norm(found.xy_px[:, None] - centre[None], axis=2)
    k = away.argmin(axis=1)
    assert (away.min(axis=1) < 0.3).all()
    assert len(set(k)) > 0.95 * len(centre)
    t, size = angle[k], np.log(a / b)
    along = found.ellipticity @ [1, 0] * np.cos(2 * t) + found.ellipticity @ [0, 1] * np.sin(2 * t) - size
    beside = found.ellipticity @ [0, 1] * np.cos(2 * t) - found.ellipticity @ [1, 0] * np.sin(2 * t)
    # the circle's fit allows for errors of shape that are common to images; blur left in would make 0.05 to 0.1
    assert abs(along.mean()) < IMAGE_NOISE
    assert abs(beside.mean()) < 0.003
    assert 0.5 < np.mean(beside**2 / found.ellipticity_sigma**2) < 2.0
