"""A small drawing of a run's scene: working space, cameras and paths, seen from the side and above."""

import numpy as np

from mosca.data.arrays import Array
from reports.evidence import Evidence

WIDTH, HEIGHT, MARGIN = 132.0, 92.0, 5.0
AZIMUTH_DEG, ELEVATION_DEG = -58.0, 24.0
MOST_PATHS, MOST_STEPS = 30, 10
"""Most paths of a drawing, and most points of each: a page has a hundred such drawings."""


def thumbnail(evidence: Evidence) -> str:
    """Return the drawing as inline SVG, a few kilobytes; cameras far outside make the rest smaller."""
    center, half = evidence.working_space_center, evidence.working_space_size / 2
    corners = center + half * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    poses = [camera.world_from_camera for camera in evidence.rig.cameras]
    eyes = np.array([pose.translation for pose in poses]).reshape(-1, 3)
    # in their viewing direction, a tenth of the scene long
    reach = 0.12 * max(np.ptp(np.concatenate([corners, eyes]), axis=0).max(), 1e-9)
    ahead = eyes + reach * np.array([pose.rotation[:, 2] for pose in poses]).reshape(-1, 3)
    paths = _paths(evidence)
    every = _flat(np.concatenate([corners, eyes, ahead, *paths]))
    every = every[np.isfinite(every).all(axis=1)]
    low, high = every.min(axis=0), every.max(axis=0)
    scale = min(
        (WIDTH - 2 * MARGIN) / max(high[0] - low[0], 1e-9), (HEIGHT - 2 * MARGIN) / max(high[1] - low[1], 1e-9)
    )
    shift = np.array([WIDTH, HEIGHT]) / 2 - scale * (low + high) / 2

    def line(points: Array) -> str:
        placed = scale * _flat(points) + shift
        return "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in placed)

    edges = [(a, b) for a in range(8) for b in range(a + 1, 8) if bin(a ^ b).count("1") == 1]
    box = "".join(line(corners[[a, b]]) for a, b in edges)
    sights = "".join(line(np.stack(pair)) for pair in zip(eyes, ahead, strict=True))
    dots = "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.4"/>' for x, y in (scale * _flat(eyes) + shift if len(eyes) else ())
    )
    moved = "".join(line(path if len(path) > 1 else np.repeat(path, 2, axis=0)) for path in paths)
    alt = f"{len(eyes)} cameras around the working space, and {len(paths)} paths of measured points in it"
    return (
        f'<svg role="img" aria-label="{alt}" viewBox="0 0 {WIDTH:.0f} {HEIGHT:.0f}" fill="none">'
        f'<path d="{box}" stroke="var(--muted)" stroke-width=".7" opacity=".6"/>'
        f'<path d="{moved}" stroke="var(--blue)" stroke-width="1.3" stroke-linecap="round"/>'
        f'<path d="{sights}" stroke="var(--orange)" stroke-width="1"/><g fill="var(--orange)">{dots}</g></svg>'
    )


def _paths(evidence: Evidence) -> list[Array]:
    """Return the longest tracks, thinned: each (k, 3) [m]."""
    tracks = evidence.tracks
    names, lengths = np.unique(tracks.track, return_counts=True)
    paths = []
    for name in names[np.argsort(-lengths, kind="stable")[:MOST_PATHS]]:
        rows = np.flatnonzero(tracks.track == name)
        chosen = np.unique(np.linspace(0, len(rows) - 1, MOST_STEPS).astype(int))
        paths.append(tracks.xyz[rows[chosen]])
    return paths


def _flat(xyz: Array) -> Array:
    """Return parallel projections (n, 2) of world points (n, 3): right and down, in metres."""
    a, e = np.radians((AZIMUTH_DEG, ELEVATION_DEG))
    right = np.array([-np.sin(a), np.cos(a), 0.0])
    up = np.array([-np.sin(e) * np.cos(a), -np.sin(e) * np.sin(a), np.cos(e)])
    result: Array = np.asarray(xyz) @ np.stack([right, -up], axis=1)
    return result
