"""The noise-free images of a scene: a still background for each camera, and windows around moving parts.

Values are radiances of the mean ray of a pixel, in the lamps' units. Markers' windows have many samples, in two
independent halves, whose difference is the noise of the rendering; boards, plates and meshes have fewer. Outside all
windows the image is that of the room without the moving parts: their shadows on it are missing there.
"""

from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter

from witness.mitsuba.projection import project
from witness.mitsuba.scene import Array, Bar, Chessboard, CodedPlate, Limb, MarkerBall, MarkerDisc, Part, WitnessScene
from witness.mitsuba.surfaces import load_mitsuba, mitsuba_scene
from witness.mitsuba.textures import PLATE_RADII
from witness.mitsuba.transport import SUB, PixelLight, PixelRenderer, Pixels

MOST_SLICES = 128
"""Most instants of an exposure: each holds its scene in memory, some 20 MB with textures."""
MARGIN_PX = 2.5
"""Dark pixels around a target's image in its window."""
SLICE_PX = 0.4
"""Largest motion of an image during one of the instants that make up an exposure."""
PROBE_SAMPLES = 16
"""Rays per pixel and instant that find the targets; a neighbourhood of 3 x 3 pixels covers what they miss."""
BACKGROUND_BLUR_PX = 1.0
"""Blur that removes the rendering's noise from the room where no target is; the room's textures are coarser."""
PROBE_SEES = 0.2
"""Share of a pixel's rays that meet a target. Where no pixel has more, it is blurred over more than its size, and
rays may miss it."""
INNER_SHARE = 0.25
"""Samples of pixels inside a target as a share of those at an edge: only lamps and shading vary there."""
PRINTED_EDGE = 0.15
"""Share of a window's brightest light above which pixels count as bright; a range over 3 x 3 pixels of twice this
share counts as an edge."""
VISIBLE_RAYS = 256
SPHERE_POINTS = 120
"""Points of a Fibonacci sphere; enlarged by 3 %, their hull encloses the ball."""


@dataclass(frozen=True)
class Markers:
    """Balls and discs, frame by frame: ``xyz`` (F, M, 3) at mid-exposure, ``mean_xyz`` averaged over the exposure,
    ``normal`` (F, M, 3) of discs (0 for balls).
    """

    names: tuple[str, ...]
    diameter_m: Array
    xyz: Array
    mean_xyz: Array
    normal: Array


@dataclass(frozen=True)
class Render:
    """A rendered scene: ``background`` (cameras, H, W) and n windows, in the order in which they overlay the images.

    ``place`` (n, 7): frame, camera, marker (-1: a surface), x, y, w, h. ``start`` (n + 1): where each window's pixels
    begin in ``total`` (two halves, pixels), ``contrast``, ``by_x`` and ``by_y``: the target's light less the
    background that it hides, and its derivatives by the image's position [radiance, radiance/px]. ``light_px`` (F, C,
    M, 2): centroid of that light on sub-pixels; ``area_px2``; ``visible`` (F, C, M): share of the target's disc that
    is visible from the lens's centre.
    """

    background: Array
    place: Array
    start: Array
    total: Array
    contrast: Array
    by_x: Array
    by_y: Array
    light_px: Array
    area_px2: Array
    visible: Array

    def save(self, path: Path) -> None:
        """Write ``path`` (.npz), whole or not at all."""
        part = path.with_suffix(".part.npz")
        np.savez_compressed(part, **{f.name: getattr(self, f.name) for f in fields(self)})
        part.replace(path)

    @classmethod
    def load(cls, path: Path) -> "Render":
        """Return the render in a file of ``save``."""
        with np.load(path) as data:
            return cls(**{f.name: data[f.name] for f in fields(cls)})

    def images(self, frame: int) -> Array:
        """Return the radiances (cameras, H, W) of a frame."""
        out = self.background.astype(np.float32).copy()
        for k in np.flatnonzero(self.place[:, 0] == frame):
            _, camera, _, x, y, w, h = self.place[k]
            pixels = self.total[:, self.start[k] : self.start[k + 1]].mean(0)
            out[camera, y : y + h, x : x + w] = pixels.reshape(h, w)
        return out


def markers(scene: WitnessScene) -> Markers:
    """Return the positions of all balls and discs; means over the exposure are by 9 Gauss-Legendre points."""
    parts = [
        (body, part) for body in scene.bodies for part in body.parts if isinstance(part, MarkerBall | MarkerDisc)
    ]
    nodes, weights = np.polynomial.legendre.leggauss(9)
    xyz = np.zeros((scene.frames, len(parts), 3))
    mean, normal = xyz.copy(), xyz.copy()
    for frame in range(scene.frames):
        t = scene.mid_exposure_s(frame)
        for m, (body, part) in enumerate(parts):
            rotation, position = body.motion.pose(t)
            xyz[frame, m] = position + rotation @ part.at_m
            if isinstance(part, MarkerDisc):
                normal[frame, m] = rotation @ part.normal / np.linalg.norm(part.normal)
            for node, weight in zip(nodes, weights, strict=True):
                rotation, position = body.motion.pose(t + node * scene.exposure_s / 2)
                mean[frame, m] += weight / 2 * (position + rotation @ part.at_m)
    names = tuple(part.name for _, part in parts)
    return Markers(names, np.array([part.diameter_m for _, part in parts]), xyz, mean, normal)


class Film:
    """Renders a scene frame by frame."""

    def __init__(self, scene: WitnessScene) -> None:
        load_mitsuba()
        self.scene, self.markers = scene, markers(scene)
        self._transport = PixelRenderer(scene.cameras, scene.room.bounces)

    def render(self, progress: Any = None) -> Render:
        """Return the whole scene's noise-free images; ``progress(frame)`` is called after each frame."""
        scene = self.scene
        background = self._background()
        shape = (scene.frames, len(scene.cameras), len(self.markers.names))
        light_px, area, visible = np.full((*shape, 2), np.nan), np.zeros(shape), np.zeros(shape)
        place, pieces = [], []
        for frame in range(scene.frames):
            windows, behind = self._windows(frame), background.copy()
            surfaces = [w for w in windows if w[2] < 0]
            targets = [w for w in windows if w[2] >= 0]
            most = max(scene.quality.plate_samples, scene.quality.edge_samples)
            for group, samples in ((surfaces, most), (targets, scene.quality.window_samples)):
                for w, halves in zip(group, self._exposed(frame, group, samples, behind), strict=True):
                    piece = _window_maps(w, halves, background)
                    place.append(w)
                    pieces.append(piece[:4])
                    _, c, marker, x, y, width, height = w
                    if marker >= 0:
                        light_px[frame, c, marker], area[frame, c, marker] = piece[4:]
                    else:
                        behind[c, y : y + height, x : x + width] = piece[0].mean(0).reshape(height, width)
            visible[frame] = self._visible(frame)
            if progress:
                progress(frame)
        start = np.concatenate([[0], np.cumsum([w[5] * w[6] for w in place], dtype=int)])
        total, contrast, by_x, by_y = (
            np.concatenate([piece[k] for piece in pieces], -1).astype(np.float32) if pieces else np.zeros((2, 0))
            for k in range(4)
        )
        table = np.array(place, int).reshape(-1, 7)
        return Render(background, table, start, total, contrast, by_x, by_y, light_px, area, visible)

    def _background(self) -> Array:
        scene = self.scene
        w, h = scene.cameras[0].size
        out = np.zeros((len(scene.cameras), h, w), np.float32)
        if scene.room.floor <= 0 and scene.room.walls <= 0:
            return out
        room = mitsuba_scene(scene, 0.0, 0, moving=False)
        y, x = np.mgrid[:h, :w]
        for c in range(len(scene.cameras)):
            pixels = Pixels(np.full(x.size, c), x.ravel(), y.ravel())
            light = self._transport.render(room, pixels, scene.quality.background_samples, scene.seed, maps=False)
            out[c] = gaussian_filter(light.total.reshape(h, w), BACKGROUND_BLUR_PX)
        return out

    def _paths(self, frame: int) -> list[tuple[int, Array]]:
        """Return each part's number (markers from 0, others -1) and its outline (3, n, 3) at the shutter's opening,
        at mid-exposure and at its closing.
        """
        scene, marker, found = self.scene, 0, []
        times = scene.mid_exposure_s(frame) + np.array([-0.5, 0.0, 0.5]) * scene.exposure_s
        for body in scene.bodies:
            poses = [body.motion.pose(float(t)) for t in times]
            for part in body.parts:
                number = -1
                if isinstance(part, MarkerBall | MarkerDisc):
                    number, marker = marker, marker + 1
                outline = _outline(part, frame)
                found.append((number, np.stack([p + outline @ r.T for r, p in poses])))
        return found

    def _windows(self, frame: int) -> list[tuple[int, ...]]:
        """Return frame, camera, marker, x, y, w, h of each window; nearer parts come later."""
        found: list[tuple[int, ...]] = []
        paths = self._paths(frame)
        for c, camera in enumerate(self.scene.cameras):
            here = []
            for number, path in paths:
                outline = path.reshape(-1, 3)
                box = self._box(c, outline)
                if box:
                    distance = float(np.linalg.norm(outline.mean(0) - camera.position_m))
                    here.append((distance, (frame, c, number, *box)))
            found += [w for _, w in sorted(here, reverse=True)]
        return found

    def _box(self, c: int, outline: Array) -> tuple[int, int, int, int] | None:
        camera = self.scene.cameras[c]
        pixels = project(camera, outline)
        if not np.isfinite(pixels).all():
            return None
        depth = (outline - camera.position_m) @ camera.rotation[:, 2]
        blur = max(camera.focal_px) * camera.aperture_m / 2 * np.abs(1 / depth - 1 / camera.focus_m).max() * 1.2
        low = np.floor(pixels.min(0) - MARGIN_PX - blur).astype(int)
        high = np.ceil(pixels.max(0) + MARGIN_PX + blur).astype(int) + 1
        x0, y0 = np.maximum(low, 0)
        x1, y1 = np.minimum(high, camera.size)
        return (int(x0), int(y0), int(x1 - x0), int(y1 - y0)) if x1 > x0 and y1 > y0 else None

    def slices(self, frame: int) -> int:
        """Return the number of instants that make up an exposure, a power of two."""
        scene = self.scene
        farthest = 0.0
        ends = np.concatenate([path[[0, 2]] for _, path in self._paths(frame)], axis=1)
        for camera in scene.cameras:
            first, last = project(camera, ends)
            farthest = max(farthest, float(np.nan_to_num(np.abs(last - first)).max()))
        count = 1 << max(0, int(np.ceil(np.log2(max(farthest / SLICE_PX, 1e-9)))))
        if count > MOST_SLICES:
            raise ValueError(
                f"scene {scene.name}, frame {frame}: something moves by {farthest:.0f} px during the exposure; "
                f"at most {MOST_SLICES * SLICE_PX:.0f} px can be rendered: shorten exposure_s or slow it down"
            )
        return count

    def _exposed(
        self, frame: int, windows: list[tuple[int, ...]], samples: int, behind: Array
    ) -> list[tuple[PixelLight, PixelLight]]:
        """Return each window's light in two independent halves of ``samples / 2`` each.

        ``behind`` (cameras, H, W): light of pixels that no target is near.
        """
        if not windows:
            return []
        scene, count = self.scene, self.slices(frame)
        grids = [np.mgrid[y : y + h, x : x + w] for *_, x, y, w, h in windows]
        pixels = Pixels(
            np.concatenate([np.full(g[0].size, w[1]) for g, w in zip(grids, windows, strict=True)]),
            np.concatenate([g[1].ravel() for g in grids]),
            np.concatenate([g[0].ravel() for g in grids]),
        )
        scenes = [
            mitsuba_scene(scene, scene.mid_exposure_s(frame) + ((s + 0.5) / count - 0.5) * scene.exposure_s, frame)
            for s in range(count)
        ]
        maps = windows[0][2] >= 0
        shares = self._shares if maps else self._surface_shares
        share = shares(scenes, pixels, grids, frame)
        halves = []
        for half in range(2):
            grid = (len(pixels), SUB, SUB) if maps else (len(pixels), 1, 1)
            whole = [np.zeros(grid[:1]), np.zeros(grid, np.float32), np.zeros(grid, np.float32)]
            for part in np.unique(share[share > 0])[::-1]:
                each = max(int(samples * part) // 2 // count, 4)
                seed, chosen = _seed(scene.seed, frame, half), pixels.where(share == part)
                lights = [
                    self._transport.render(instant, chosen, each, seed, maps, (s, count))
                    for s, instant in enumerate(scenes)
                ]
                mean = [sum(getattr(one, f.name) for one in lights) / count for f in fields(PixelLight)]
                for out, values in zip(whole, mean, strict=True):
                    out[share == part] = values
            unseen = share == 0
            whole[0][unseen] = behind[pixels.camera[unseen], pixels.y[unseen], pixels.x[unseen]]
            halves.append(PixelLight(*whole))
        ends = np.concatenate([[0], np.cumsum([g[0].size for g in grids])])
        return [
            tuple(PixelLight(h.total[a:b], h.target[a:b], h.hits[a:b]) for h in halves)  # type: ignore[misc]
            for a, b in pairwise(ends)
        ]

    def _shares(self, scenes: list[Any], pixels: Pixels, grids: list[Array], frame: int) -> Array:
        """Return the share of the samples that each pixel (n) needs: none where a few rays meet no target near it,
        few where all of them do, all at edges.
        """
        hits = sum(
            self._transport.render(one, pixels, PROBE_SAMPLES, _seed(self.scene.seed, frame, 2)).hits.mean((1, 2))
            for one in scenes
        ) / len(scenes)
        pieces, first = [], 0
        for grid in grids:
            met = np.asarray(hits)[first : first + grid[0].size].reshape(grid.shape[1:])
            inner = minimum_filter(met, 3) > 1 - 1e-6
            near = (maximum_filter(met, 3) > 0) | (met.max() < PROBE_SEES)
            pieces.append(np.where(inner, INNER_SHARE, near).ravel())
            first += grid[0].size
        return np.concatenate(pieces)

    def _surface_shares(self, scenes: list[Any], pixels: Pixels, grids: list[Array], frame: int) -> Array:
        """Return the share of the samples that each pixel (n) of surfaces needs: all at printed edges, fewer where
        the surface is bright, the fewest where it is dark.
        """
        quality = self.scene.quality
        if quality.edge_samples <= quality.plate_samples:
            return np.ones(len(pixels))
        light = sum(
            self._transport.render(one, pixels, PROBE_SAMPLES, _seed(self.scene.seed, frame, 2), maps=False).total
            for one in scenes
        ) / len(scenes)
        fewest = quality.plate_samples / quality.edge_samples
        pieces, first = [], 0
        for grid in grids:
            seen = np.asarray(light)[first : first + grid[0].size].reshape(grid.shape[1:])
            first += grid[0].size
            least = PRINTED_EDGE * max(float(seen.max()), 1e-30)
            edge = maximum_filter(seen, 3) - minimum_filter(seen, 3) > 2 * least
            bright = seen > least
            pieces.append(np.where(edge, 1.0, np.where(bright, max(INNER_SHARE, fewest), fewest)).ravel())
        return np.concatenate(pieces)

    def _visible(self, frame: int) -> Array:
        """Return the share (cameras, markers) of each disc visible from the lens's centre, inside the image."""
        import mitsuba as mi

        scene, m = self.scene, len(self.markers.names)
        out = np.zeros((len(scene.cameras), m))
        if not m:
            return out
        instant = mitsuba_scene(scene, scene.mid_exposure_s(frame), frame)
        turn = np.arange(VISIBLE_RAYS) * (np.pi * (3 - np.sqrt(5)))
        reach = np.sqrt((np.arange(VISIBLE_RAYS) + 0.5) / VISIBLE_RAYS)
        for c, camera in enumerate(scene.cameras):
            origin, centre = np.array(camera.position_m), self.markers.xyz[frame]
            axis = self.markers.normal[frame].copy()
            ball = ~axis.any(1)
            axis[ball] = (origin - centre[ball]) / np.linalg.norm(origin - centre[ball], axis=1)[:, None]
            side = np.cross(axis, np.where(np.abs(axis[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
            side /= np.linalg.norm(side, axis=1)[:, None]
            up, radius = np.cross(axis, side), self.markers.diameter_m[:, None] / 2
            around = np.cos(turn)[:, None] * side[:, None] + np.sin(turn)[:, None] * up[:, None]
            disc = centre[:, None] + (radius * reach)[..., None] * around
            pixels = project(camera, disc)
            inside = (pixels >= -0.5).all(-1) & (pixels <= np.array(camera.size) - 0.5).all(-1)
            length = np.linalg.norm(disc - origin, axis=-1)
            towards = ((disc - origin) / length[..., None]).reshape(-1, 3).T.astype(np.float32)
            ray = mi.Ray3f(mi.Point3f(origin.tolist()), mi.Vector3f(towards))
            reached = np.array(instant.ray_intersect_preliminary(ray).t).reshape(m, VISIBLE_RAYS)
            # a hit more than a radius before the disc is an occluder
            free = reached > length - 1.02 * radius - 1e-4
            front = ((origin - centre) * axis).sum(1) > 0
            out[c] = (inside & free).mean(1) * front
        return out


def _seed(scene: int, frame: int, half: int) -> int:
    return (scene * 1000003 + frame * 4099 + half * 2053 + 1) & 0x7FFFFFFF


def _outline(part: Part, frame: int) -> Array:
    """Return points (n, 3) in the body's frame whose hull encloses the part."""
    if isinstance(part, MarkerBall | MarkerDisc):
        k = np.arange(SPHERE_POINTS) + 0.5
        z, turn = 1 - 2 * k / SPHERE_POINTS, k * np.pi * (1 + np.sqrt(5))
        flat = np.sqrt(1 - z * z)
        sphere = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])
        return np.array(part.at_m) + sphere * (part.diameter_m / 2 * 1.03)
    if isinstance(part, Bar | Limb):
        ends = np.array([part.start_m, part.end_m])
        jitter = np.concatenate([np.eye(3), -np.eye(3)]) * part.diameter_m
        return np.asarray((ends[:, None] + jitter).reshape(-1, 3))
    if isinstance(part, Chessboard):
        x, y = (n * part.square_m / 2 + part.margin_m for n in (part.columns, part.rows))
        return np.array([[a, b, 0.0] for a in (-x, x) for b in (-y, y)])
    if isinstance(part, CodedPlate):
        half = PLATE_RADII * part.dot_radius_m / np.sqrt(2)
        return np.asarray(part.at_m + np.concatenate([np.eye(3), -np.eye(3)]) * half)
    with np.load(part.file) as data:
        vertices = data["vertices"][frame]
    corners = np.array([vertices.min(0), vertices.max(0)])
    return np.array([[corners[i, 0], corners[j, 1], corners[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def _window_maps(
    window: tuple[int, ...], halves: tuple[PixelLight, PixelLight], background: Array
) -> tuple[Any, ...]:
    """Return total of both halves, contrast, its derivatives, light centroid and area of a window."""
    _, camera, marker, x, y, w, h = window
    total = np.stack([half.total for half in halves])
    if marker < 0:
        nothing = np.zeros(w * h)
        return total, nothing, nothing, nothing, None, 0.0
    behind = background[camera, y : y + h, x : x + w].ravel()[:, None, None]
    target = (halves[0].target + halves[1].target) / 2
    hits = (halves[0].hits + halves[1].hits) / 2
    fine = target - hits * behind
    fine = fine.reshape(h, w, SUB, SUB).transpose(0, 2, 1, 3).reshape(h * SUB, w * SUB)

    def pixels(a: Array) -> Array:
        return np.asarray(a.reshape(h, SUB, w, SUB).mean((1, 3)).ravel())

    # the image moved by one sub-pixel to either side, with zeros coming in; inside the target by a pixel, since light
    # is smooth there, and the few samples of a sub-pixel would add their noise to the Fisher information
    wide, whole = np.pad(fine, 1), np.pad(pixels(fine).reshape(h, w), 1)
    inner = minimum_filter(hits.mean((1, 2)).reshape(h, w), 3, mode="constant").ravel() > 1 - 1e-6
    by_x = np.where(
        inner, (whole[1:-1, :-2] - whole[1:-1, 2:]).ravel() / 2, pixels(wide[1:-1, :-2] - wide[1:-1, 2:]) * SUB / 2
    )
    by_y = np.where(
        inner, (whole[:-2, 1:-1] - whole[2:, 1:-1]).ravel() / 2, pixels(wide[:-2, 1:-1] - wide[2:, 1:-1]) * SUB / 2
    )
    light = fine.sum()
    place = np.array([np.nan, np.nan])
    if light > 0:
        u = x + (np.arange(w * SUB) + 0.5) / SUB - 0.5
        v = y + (np.arange(h * SUB) + 0.5) / SUB - 0.5
        place = np.array([(fine.sum(0) @ u) / light, (fine.sum(1) @ v) / light])
    return total, pixels(fine), by_x, by_y, place, float(hits.mean((1, 2)).sum())


__all__ = ["Film", "Markers", "Render", "markers"]
