"""Balls before three cameras, one of them half hidden or grown together with another one: the pipeline's points."""

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from mosca.camera.projection import project
from mosca.camera.ray_table import rig_table
from mosca.data.frames import CameraInfo, Frame
from mosca.data.rig import Camera, MoscaLens, Pose, Rig
from mosca.detection.cut_targets.expected import expected_images
from mosca.pipeline import run

WIDTH, HEIGHT, FOCAL_PX, FINE, SETS, RATE_HZ = 240, 200, 400.0, 6, 66, 100.0
DIAMETER, LIGHT, BLUR = 0.016, 150.0, 0.7
GRID = np.array([[x, y, z] for x in (-0.2, 0.0, 0.2) for y in (-0.12, 0.12) for z in (-0.15, 0.15)])
WATCHED = np.array([0.07, 0.0, 0.02])


def rig():
    cameras = []
    for k, turn in enumerate((-0.7, 0.0, 0.7)):
        backward = np.array([np.sin(turn), 0.0, np.cos(turn)])
        right = np.array([np.cos(turn), 0.0, -np.sin(turn)])
        axes = np.column_stack([right, np.cross(-backward, right), -backward])
        lens = MoscaLens(
            c_mm=FOCAL_PX * 0.01, mx_mm_per_px=0.01, my_mm_per_px=0.01, xp_px=(WIDTH - 1) / 2, yp_px=(HEIGHT - 1) / 2
        )
        cameras.append(Camera(f"cam{k}", WIDTH, HEIGHT, lens, Pose(axes, 2.0 * backward)))
    return Rig(tuple(cameras))


def place(k):
    return np.array([0.0003 * k, 0.0002 * k, 0.0])


class Ball(NamedTuple):
    """A ball before a camera."""

    left: int  # of its pixels in the image
    top: int
    x: np.ndarray  # of parts of its pixels, from its centre [px]
    y: np.ndarray
    radius: float
    shape: np.ndarray  # what of a part it covers

    def blurred(self, shape):
        fine = gaussian_filter(shape, np.sqrt(BLUR**2 - 1 / 12) * FINE)
        return fine.reshape(19, FINE, 19, FINE).mean(axis=(1, 3))


def ball(camera, xyz):
    centre = project(camera, xyz[None])[0]
    radius = 0.5 * DIAMETER * FOCAL_PX / np.linalg.norm(xyz - camera.world_from_camera.translation)
    left, top = np.round(centre).astype(int) - 9
    at = (np.arange(19 * FINE) + 0.5) / FINE - 0.5
    x, y = np.meshgrid(at + left - centre[0], at + top - centre[1])
    return Ball(left, top, x, y, radius, np.clip((radius - np.hypot(x, y)) * FINE + 0.5, 0.0, 1.0))


@cache
def whole(number, k):
    """Whole balls before a camera at set k, ``WATCHED`` the last: column, row and light (19, 19) of each."""
    balls = [ball(rig().cameras[number], xyz) for xyz in np.vstack([GRID, WATCHED]) + place(k)]
    return [(one.left, one.top, one.blurred(one.shape)) for one in balls]


class Balls:
    """Frames of the balls; from set 40 on ``draw(shape, camera, x, y, radius)`` changes that of ``WATCHED``."""

    def __init__(self, draw):
        self.rig, self.draw, self.rng = rig(), draw, np.random.default_rng(1)
        self.cameras = tuple(CameraInfo(c.name, WIDTH, HEIGHT, 8, RATE_HZ) for c in self.rig.cameras)

    def __iter__(self):
        for k in range(SETS):
            for c, camera in enumerate(self.rig.cameras):
                image, seen = np.zeros((HEIGHT, WIDTH)), whole(c, k)
                if k >= 40:
                    seen = [*seen[:-1], self._changed(c, camera, k)]
                for left, top, light in seen:
                    image[top : top + 19, left : left + 19] += LIGHT * light
                noisy = image + 8.0 + self.rng.normal(0, 0.7, image.shape) * np.sqrt(1 + image / 20)
                yield Frame(
                    camera.name, k, round(k * 1e9 / RATE_HZ), 1_000_000, np.clip(noisy, 0, 255).astype(np.uint8)
                )

    def _changed(self, number, camera, k):
        one = ball(camera, WATCHED + place(k))
        return one.left, one.top, one.blurred(self.draw(one.shape, number, one.x, one.y, one.radius))

    def close(self):
        pass


def hidden_in_part(shape, camera, x, y, radius):
    """A third of the left camera's image is missing, the middle camera sees nothing."""
    return shape * (x < 0.25 * radius) if camera == 0 else 0.0 * shape if camera == 1 else shape


def errors(draw):
    source = Balls(draw)
    off, nees = [], []
    for step in run(source, source.rig):
        k = step.frame_set.pulse
        away = step.points.xyz - (WATCHED + place(k))
        row = np.linalg.norm(away, axis=1).argmin()
        if k >= 45 and np.linalg.norm(away[row]) < 0.01:
            off.append(away[row])
            nees.append(away[row] @ np.linalg.solve(step.points.covariance[row], away[row]))
    return np.array(off), np.array(nees)


def test_a_ball_that_is_hidden_in_part_to_one_of_its_two_cameras():
    off, nees = errors(hidden_in_part)
    assert len(off) > 18
    # detection's centre of what is seen is off by 0.3 radii, 2.4 mm
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.0004
    assert nees.mean() < 6.0


def test_two_balls_grown_together_in_one_of_two_cameras():
    def pair(shape, camera, x, y, radius):
        if camera == 0:
            return np.maximum(shape, np.clip((radius - np.hypot(x - 1.2 * radius, y)) * FINE + 0.5, 0.0, 1.0))
        return 0.0 * shape if camera == 1 else shape

    off, nees = errors(pair)
    assert len(off) > 18
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.0004
    assert nees.mean() < 6.0


def test_a_ball_that_is_hidden_in_part_beside_another_one_in_one_of_two_cameras():
    def beside(apart):
        def draw(shape, camera, x, y, radius):
            if camera == 0:
                other = np.clip((radius - np.hypot(x + apart * radius, y)) * FINE + 0.5, 0.0, 1.0)
                return np.maximum(shape * np.clip((0.1 * radius - x - y) * FINE + 0.5, 0.0, 1.0), other)
            return 0.0 * shape if camera == 1 else shape

        return draw

    for apart in (1.8, 3.0):  # grown together, side by side
        off, nees = errors(beside(apart))
        assert len(off) > 18
        assert np.sqrt((off**2).sum(axis=1).mean()) < 0.0006
        assert nees.mean() < 6.0


def test_whole_balls():
    off, nees = errors(lambda shape, *_: shape)
    assert len(off) > 18
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.0003
    assert nees.mean() < 6.0


def test_images_of_predictions_are_projections():
    rng, cameras = np.random.default_rng(8), rig().cameras
    xyz, factor = rng.uniform(-0.2, 0.2, (5, 3)), 1e-3 * rng.normal(size=(5, 3, 3))
    xyz[4] = cameras[0].world_from_camera.translation * 2.0  # behind the first camera
    table = rig_table(Rig(cameras))
    covariance = factor @ factor.swapaxes(1, 2)
    places, errors, away = expected_images(xyz, covariance, table.cameras, table.views, np.full(3, FOCAL_PX), 0.1)
    for c, camera in enumerate(cameras):
        seen = project(camera, xyz)
        np.testing.assert_array_equal(np.isfinite(places[c]), np.isfinite(seen))
        np.testing.assert_allclose(places[c][np.isfinite(seen)], seen[np.isfinite(seen)], atol=1e-9)
        distance = np.linalg.norm(xyz - camera.world_from_camera.translation, axis=1)
        np.testing.assert_allclose(away[c], distance)
        spread = np.sqrt(np.trace(covariance, axis1=1, axis2=2)) / distance * FOCAL_PX
        np.testing.assert_allclose(errors[c], np.sqrt(spread**2 + 0.01))
    assert np.isinf(places[0, 4]).all()
