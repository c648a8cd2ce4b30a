"""Scenes for the tests of wand calibration: rigs, waved wands, and what cameras see of them."""

from dataclasses import replace

import numpy as np
from rigs import looking_at

from mosca.camera.projection import project
from mosca.data.rig import Camera, MoscaLens
from mosca.data.sightings import Sightings

WIDTH, HEIGHT, PITCH = 656, 491, 0.0099
NOISE_PX = 0.05


def camera(name, rng, centre, target, c_mm=7.5) -> Camera:
    lens = MoscaLens(
        c_mm * (1 + rng.normal(0, 0.01)),
        (WIDTH - 1) / 2 + rng.uniform(-5, 5),
        (HEIGHT - 1) / 2 + rng.uniform(-5, 5),
        PITCH,
        PITCH,
        K1_per_mm2=1e-3 * (1 + rng.normal(0, 0.1)),
    )
    return Camera(name, WIDTH, HEIGHT, lens, looking_at(centre, target))


def rig(n=4, seed=0, focals=(7.5,), radius=4.0) -> tuple[Camera, ...]:
    """Return n cameras around a volume of about 3 m, aimed inwards."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(n):
        a = 2 * np.pi * k / n + rng.normal(0, 0.1)
        centre = [radius * np.cos(a), radius * np.sin(a), 2 + rng.normal(0, 0.3)]
        out.append(camera(f"cam{k + 1}", rng, centre, rng.normal(0, 0.2, 3) + [0, 0, 1], focals[k % len(focals)]))
    return tuple(out)


def outward_ring(n=8, seed=0) -> tuple[Camera, ...]:
    """Return n cameras on a small circle, aimed outwards: only neighbours have common views."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(n):
        a = 2 * np.pi * k / n
        way = np.array([np.cos(a), np.sin(a), 0.0])
        side = np.array([-np.sin(a), np.cos(a), 0.0])
        out.append(
            camera(f"cam{k + 1}", rng, way + [0, 0, 1.5 + 0.4 * (k % 2)], 4 * way + 0.3 * side + [0, 0, 1], 3.6)
        )
    return tuple(out)


def waved(frames, along=(0.0, 0.15, 0.5), size=(1.2, 1.2, 1.0), seed=1, middle=(0.0, 0.0, 1.0)):
    """Return the balls (f, b, 3) of a wand waved through a box about ``middle`` of half edges ``size``."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-1, 1, (frames, 3)) * size + middle
    return _balls(centre, along, rng)


def waved_around(frames, along=(0.0, 0.15, 0.5), seed=1, radius=(2.8, 5.0)):
    """Return the balls of a wand carried around a ring of cameras aimed outwards."""
    rng = np.random.default_rng(seed)
    a, r = rng.uniform(0, 2 * np.pi, frames), rng.uniform(*radius, frames)
    centre = np.column_stack([r * np.cos(a), r * np.sin(a), rng.uniform(0.2, 2.2, frames)])
    return _balls(centre, along, rng)


def _balls(centre, along, rng):
    way = rng.normal(size=centre.shape)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    place = np.array(along) - (along[0] + along[-1]) / 2
    return centre[:, None] + way[:, None] * place[None, :, None]


def seen(cameras, world, noise_px=NOISE_PX, blunders=0.03, seed=2, share=0.95) -> Sightings:
    """Return what cameras see of balls (f, b, 3): whole wands only, ``blunders`` of the balls off by 30 px."""
    rng = np.random.default_rng(seed)
    frames, balls = world.shape[:2]
    parts = []
    for k, one in enumerate(cameras):
        px = project(one, world.reshape(-1, 3)).reshape(frames, balls, 2)
        with np.errstate(invalid="ignore"):
            inside = ((px > 0) & (px < (WIDTH - 1, HEIGHT - 1))).all(axis=(1, 2))
        f = np.flatnonzero(inside & (rng.random(frames) < share))
        px = px + rng.normal(0, noise_px, px.shape)
        bad = rng.random((frames, balls)) < blunders
        px = np.where(bad[..., None], px + rng.normal(0, 30, px.shape), px)
        mark = np.tile(np.arange(balls), len(f))
        parts.append((np.full(len(mark), k), np.repeat(f, balls), mark, px[f].reshape(-1, 2)))
    camera_, frame, mark, xy = (np.concatenate(one) for one in zip(*parts, strict=True))
    n = len(xy)
    return Sightings(
        tuple(one.name for one in cameras),
        np.array([[one.width, one.height] for one in cameras]),
        frames,
        camera_,
        frame,
        mark,
        xy,
        np.tile(np.eye(2) * noise_px**2, (n, 1, 1)),
        np.full(n, 8.0),
    )


def behind_bars(cameras, world, sightings, most_m, alike_from_m=None) -> Sightings:
    """Return the sightings with balls moved away from bars that point at the camera, by up to ``most_m`` [m].

    ``alike_from_m``: by as many pixels at all distances as at this one; None: in proportion to the image.

    As Mitsuba renders balls of 40 mm on a bar of 8 mm: nothing up to a cosine of 0.1 between bar and line of sight,
    all from 0.6 on. Bars join neighbouring balls.
    """
    xy = np.array(sightings.xy_px)
    for k, one in enumerate(cameras):
        mine = np.flatnonzero(sightings.camera == k)
        frame, ball = sightings.frame[mine], sightings.mark[mine]
        at = world[frame, ball]
        sight = one.world_from_camera.translation - at
        distance = np.linalg.norm(sight, axis=1)
        sight /= distance[:, None]
        most = most_m * (distance / alike_from_m if alike_from_m else 1.0)
        for step in (-1, 1):
            other = ball + step
            there = (other >= 0) & (other < world.shape[1])
            bar = world[frame, np.clip(other, 0, world.shape[1] - 1)] - at
            bar /= np.maximum(np.linalg.norm(bar, axis=1, keepdims=True), 1e-9)
            cosine = np.einsum("ni,ni->n", bar, sight)
            across = bar - cosine[:, None] * sight
            across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
            away = np.where(there, most * np.clip((cosine - 0.1) / 0.5, 0.0, 1.0), 0.0)
            xy[mine] += project(one, at - away[:, None] * across) - project(one, at)
    return replace(sightings, xy_px=xy)


def similarity(source, target, stretch=True):
    """Return scale, rotation and shift that bring points (n, 3) nearest to others (Umeyama 1991)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    left, sizes, right = np.linalg.svd((target - b).T @ (source - a))
    signs = np.array([1.0, 1.0, np.linalg.det(left @ right)])
    turn = (left * signs) @ right
    scale = float(sizes @ signs / ((source - a) ** 2).sum()) if stretch else 1.0
    return scale, turn, b - scale * turn @ a
