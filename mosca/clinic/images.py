"""Causes that images show: saturation, growing blur, merged markers, reflections."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mosca.camera.ray_table import make_ray_table
from mosca.clinic.causes import Diagnosis, merged
from mosca.clinic.observations import PointImages
from mosca.correspondence.match import EVERYWHERE, match
from mosca.data.arrays import Array
from mosca.data.detections import MERGED, Detections, Seen
from mosca.data.distributions import binom
from mosca.data.distributions import t as student
from mosca.data.frames import CameraInfo, FrameSet
from mosca.data.rays import Predicted
from mosca.data.rig import Rig
from mosca.data.settings import MatchSettings

MARKERS = 0.5
"""A camera's detections are taken for markers if at least this share of them belongs to points."""
PLATEAU = 0.5
"""Share of a marker's pixels that may be white: beyond it most pixels carry no information on the marker's place."""
MERGED_SHARE = 0.1
"""Share of images that may be merged with a neighbour's."""
BLUR_GROWTH = 0.2
"""Growth of a marker's edge over the take [px] from which a camera is out of focus: a third of the blur of a sharp
lens (0.6 px, Nyquist sampled)."""
FREE_SHARE = 0.15
"""Share of a camera's detections that may belong to no point."""
GLINT_PX, GLINT_FRAMES = 0.5, 0.8
"""A spot that stays within this distance [px] of one place, in this share of the frames, is no moving marker."""
MIRROR_M, MIRROR_VOTES = 0.01, 3
"""Largest distance of a mirror image from its marker mirrored in a plane [m]; number of these in two frame
sets that make a plane, ten in all at least."""


@dataclass
class ImageSums:
    """Figures of a camera's images: time, share of white pixels and edge width of its markers."""

    time_s: list[float] = field(default_factory=list)
    edge_px: list[float] = field(default_factory=list)
    white: list[float] = field(default_factory=list)
    merged: int = 0
    detections: int = 0


class ImageWitness:
    """Collects figures of the markers in the images; ``attend`` takes each frame set with its detections."""

    def __init__(self, cameras: Sequence[CameraInfo]) -> None:
        self.sums = {info.name: ImageSums() for info in cameras}
        self._white = {info.name: 2**info.bit_depth - 1 for info in cameras}

    def attend(self, frame_set: FrameSet, detections: Mapping[str, Detections]) -> None:
        """Take the images of a set."""
        for name, found in detections.items():
            frame, one = frame_set.frames.get(name), self.sums.get(name)
            if frame is None or frame.image is None or one is None:
                continue
            one.detections += len(found)
            one.merged += int((found.flags & MERGED > 0).sum())
            edges = []
            for xy, size, flag in zip(found.xy_px, found.diameter_px, found.flags, strict=True):
                if flag & MERGED:
                    continue
                white, edge = marker_image(frame.image, xy, size, self._white[name])
                one.white.append(white)
                edges.append(edge)
            usable = [edge for edge in edges if np.isfinite(edge)]
            if usable:
                one.time_s.append(1e-9 * frame_set.time_ns)
                one.edge_px.append(float(np.median(usable)))


def marker_image(image: Array, xy: Array, diameter_px: float, white: int) -> tuple[float, float]:
    """Return the share of white pixels of a disc in an image (H, W), and the width of its edge [px].

    The width of the edge is the disc's height over its steepest rise along the row and the column through its centre.
    For a Gaussian blur it is the standard deviation times sqrt(2 pi). NaN where the disc is not whole in the image.
    """
    reach = int(np.ceil(0.5 * diameter_px)) + 4
    x, y = round(float(xy[0])), round(float(xy[1]))
    if not (reach <= x < image.shape[1] - reach and reach <= y < image.shape[0] - reach):
        return 0.0, float("nan")
    cut = image[y - reach : y + reach + 1, x - reach : x + reach + 1].astype(float)
    area = max(0.25 * np.pi * diameter_px**2, 1.0)
    share = float(min((cut >= white).sum() / area, 1.0))
    height = float(cut.max() - np.median(cut[[0, -1]]))
    steps = [
        np.abs(np.diff(cut[reach - 1 : reach + 2].mean(axis=0))),
        np.abs(np.diff(cut[:, reach - 1 : reach + 2].mean(axis=1))),
    ]
    steep = float(np.mean([step.max() for step in steps]))
    return share, height / steep if steep > 0 else float("nan")


def image_causes(
    witness: ImageWitness, connected: Mapping[str, float], rate_hz: float, alpha: float
) -> list[Diagnosis]:
    """Return the faults that images of markers show; ``alpha``: chance of a false alarm of each cause.

    ``connected``: share of each camera's detections that belong to points. Where it is below ``MARKERS``, the
    detections may be no markers (a board, a room), and the camera is not judged.
    """
    found = []
    for name, one in witness.sums.items():
        if one.detections == 0 or connected.get(name, 0.0) < MARKERS:
            continue
        n = max(int(one.detections / max(0.1 * rate_hz, 1.0)), 1)  # images of a marker within 0.1 s count as one
        if len(one.white) and (share := float(np.mean(np.array(one.white) > PLATEAU))) > 0.5:
            chance = float(binom.sf(np.floor(share * n) - 1, n, 0.5))
            text = (
                f"camera '{name}': {100 * share:.0f} % of its markers have more than {100 * PLATEAU:.0f} % white "
                f"pixels ({100 * 0.5:.0f} % of them allowed, p = {chance:.1g})"
            )
            found.append(Diagnosis("saturated", chance, (text,), camera=name, figures={"share": share}))
        share = one.merged / one.detections
        chance = float(binom.sf(np.floor(share * n) - 1, n, MERGED_SHARE))
        text = (
            f"camera '{name}': {100 * share:.0f} % of its marker images are merged with another "
            f"({100 * MERGED_SHARE:.0f} % allowed, p = {chance:.1g})"
        )
        found.append(Diagnosis("markers-merged", chance, (text,), camera=name, figures={"share": share}))
        if (blurred := _focus(name, one)) is not None:
            found.append(blurred)
    return merged(sorted((one for one in found if one.p_value < alpha), key=lambda one: one.p_value))


def _focus(name: str, one: ImageSums) -> Diagnosis | None:
    if len(one.time_s) < 20:
        return None
    t, edge = np.array(one.time_s), np.array(one.edge_px)
    t = (t - t[0]) / max(t[-1] - t[0], 1e-9)
    # medians of blocks, since neighbouring images show the same markers at almost the same place
    parts = np.array_split(np.arange(len(t)), min(12, len(t) // 2))
    x, y = np.array([t[p].mean() for p in parts]), np.array([np.median(edge[p]) for p in parts])
    slope, start = np.polyfit(x, y, 1)
    rest = y - start - slope * x
    sigma = np.sqrt(rest @ rest / (len(x) - 2) / ((x - x.mean()) ** 2).sum())
    chance = float(2 * student.sf(abs(slope) / max(sigma, 1e-12), len(x) - 2))
    if abs(slope) / np.sqrt(2 * np.pi) < BLUR_GROWTH:
        return None
    text = (
        f"camera '{name}': the blur of marker edges goes from {start / np.sqrt(2 * np.pi):.2f} to "
        f"{(start + slope) / np.sqrt(2 * np.pi):.2f} px (a change of {BLUR_GROWTH:g} allowed, p = {chance:.1g})"
    )
    return Diagnosis("focus-drift", chance, (text,), camera=name, figures={"growth_px": float(slope)})


def reflection_causes(seen: Sequence[Seen], rig: Rig, observed: PointImages, alpha: float) -> list[Diagnosis]:
    """Return reflections: detections outside points that stay at one place, or mirror points in one plane."""
    free: dict[int, dict[str, list[int]]] = {}
    for row, frame in enumerate(observed.frame):
        of = free.setdefault(int(frame), {})
        for k, name in enumerate(rig.names):
            of.setdefault(name, []).append(int(observed.index[row, k]))
    shares, evidence, counts = [], [], 0
    left: list[tuple[int, dict[str, Detections]]] = []
    for frame_set, detections, _ in seen:
        used = free.get(frame_set.pulse, {})
        rest = {}
        for name, found in detections.items():
            keep = np.setdiff1d(np.arange(len(found)), np.array(used.get(name, []), int))
            rest[name] = _select(found, keep)
        left.append((frame_set.pulse, rest))
    for name in rig.names:
        total = sum(len(d[name]) for _, d, _ in seen if name in d)
        alone = sum(len(rest[name]) for _, rest in left if name in rest)
        share = alone / max(total, 1)
        shares.append(share)
        glints = _glints([rest[name].xy_px for _, rest in left if name in rest])
        if glints:
            places = ", ".join(f"({x:.0f}, {y:.0f})" for x, y in glints[:4])
            evidence.append(f"camera '{name}': spots that never move and belong to no point at {places} px")
            counts += len(glints)
    mirrored, planes = _mirrors(left, rig, observed)
    if planes:
        n, d = planes[0]
        evidence.append(
            f"{mirrored} points are markers mirrored in one plane, {d:.2f} m from the origin, normal "
            f"({n[0]:.2f}, {n[1]:.2f}, {n[2]:.2f})"
        )
    if not evidence or (max(shares) < FREE_SHARE and not counts and mirrored < 0.05 * len(observed)):
        return []
    evidence.insert(
        0,
        "detections that belong to no point: "
        + ", ".join(f"{name} {100 * share:.0f} %" for name, share in zip(rig.names, shares, strict=True)),
    )
    return [Diagnosis("reflections", alpha * 1e-3, tuple(evidence), figures={"free": max(shares)})]


def _select(found: Detections, rows: Array) -> Detections:
    names = [name for name in Detections.__dataclass_fields__ if name != "camera"]
    return Detections(found.camera, *(getattr(found, name)[rows] for name in names))


def _glints(places: list[Array]) -> list[tuple[float, float]]:
    """Return places at which nearly every image has a free detection."""
    filled = [xy for xy in places if len(xy)]
    if len(filled) < GLINT_FRAMES * len(places) or len(filled) < 20:
        return []
    glints = []
    for xy in filled[len(filled) // 2]:
        hits = sum(bool((np.linalg.norm(other - xy, axis=1) < GLINT_PX).any()) for other in filled)
        if hits >= GLINT_FRAMES * len(places):
            glints.append((float(xy[0]), float(xy[1])))
    return glints


def _mirrors(
    left: list[tuple[int, dict[str, Detections]]], rig: Rig, observed: PointImages
) -> tuple[int, list[tuple[Array, float]]]:
    """Return the number of points of free detections that mirror markers in the best plane, and that plane."""
    settings = MatchSettings(camera_sigma_px=0.3, minimum_cameras=2, judge_sizes=False)
    sets = []
    for pulse, rest in left[:: max(1, len(left) // 30)]:
        table = make_ray_table(rig, rest, np.full(len(rig.cameras), 0.3), settings.target)
        ghosts = match(table, Predicted.nothing(), settings, EVERYWHERE).xyz
        real = observed.xyz[observed.frame == pulse]
        if len(ghosts) and len(real):
            sets.append((real, ghosts))
    best, plane = 0, []
    for real, ghosts in sets[:5]:
        for x in real:
            for y in ghosts:
                n = (y - x) / max(float(np.linalg.norm(y - x)), 1e-9)
                d = float(n @ (x + y) / 2)
                votes = sum(_votes(r, g, n, d) for r, g in sets)
                if votes > best:
                    best, plane = votes, [(n, d)]
    return (best, plane) if best >= MIRROR_VOTES * len(sets) / 2 and best >= 10 else (0, [])


def _votes(real: Array, ghosts: Array, n: Array, d: float) -> int:
    mirrored = real - 2 * (real @ n - d)[:, None] * n
    away = np.linalg.norm(mirrored[:, None] - ghosts[None], axis=2)
    return int((away.min(axis=0) < MIRROR_M).sum())
