"""Tracks of artefacts at known places, and the acceptance files that test them."""

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.accuracy.acceptance.artefact import AcceptanceFile
from mosca.data.tracks import Tracks

AT = np.array([0.0, 0.15, 0.4, 0.7, 0.95, 1.2])
CORNERS = np.array([[a, b, c] for a in (-0.48, 0.48) for b in (-0.48, 0.48) for c in (-0.48, 0.48)])
OFF = np.array([0.5, 0.1, 0.0])
"""A ball beside the bar."""


def tracks_of(places, sigma_m=1e-5, noise_m=0.0, names=None, period_ns=10_000_000, seed=1, kept=None):
    """Return tracks of markers at ``places`` (t, m, 3) [m]; ``kept`` (t, m): which samples there are."""
    t, m = places.shape[:2]
    rng = np.random.default_rng(seed)
    xyz = places + rng.normal(0.0, noise_m, places.shape) if noise_m else places
    frame, track = np.repeat(np.arange(t), m), np.tile(np.arange(m), t)
    rows = np.ones(t * m, bool) if kept is None else np.asarray(kept).ravel()
    label = np.tile(np.array(names if names is not None else [""] * m), t)
    made = Tracks(
        frame, frame * period_ns, track, label, xyz.reshape(-1, 3), np.tile(sigma_m**2 * np.eye(3), (t * m, 1, 1)),
        np.full(t * m, 4), np.full(t * m, 0.05), np.full(t * m, "measured"),
    )  # fmt: skip
    return made.select(rows)


def bar_places(corner, along=None):
    """Return the six balls of the bar (6, 3) from a corner of the box towards its middle, or along a direction."""
    unit = -np.sign(corner) / np.sqrt(3) if along is None else np.asarray(along) / np.linalg.norm(along)
    return corner + AT[:, None] * unit


def lines():
    """Return the places (6, 3) of the bar on seven lines: four diagonals, three diagonals of faces."""
    found = [bar_places(corner) for corner in CORNERS[:4]]
    return [*found, *(bar_places(CORNERS[k], way) for k, way in ((4, (-1, 1, 0)), (5, (0, 1, -1)), (6, (-1, 0, 1))))]


def seven_lines(scale=1.0, per_line=20, **rest):
    """Return tracks of the bar on seven lines, one after the other, measured too large by ``scale``."""
    places = np.repeat(np.stack(lines()), per_line, axis=0) * scale
    return tracks_of(places, names=[f"b{k}" for k in range(6)], **rest)


def bar_file(sigma_m=1e-6, per_line=20, count=7, **changes):
    """Return the acceptance file of ``seven_lines``: A = 0.1 mm, K = 0.1 mm/m, B = 0.2 mm."""
    document = {
        "title": "bar",
        "volume": {"size_m": [1.0, 1.0, 1.0]},
        "bar": [
            {
                "name": "bar",
                "length": [
                    {"markers": ["b0", f"b{k}"], "length_m": float(AT[k]), "sigma_m": sigma_m} for k in range(1, 6)
                ],
            }
        ],
        "line": [
            {
                "name": f"line {k}",
                "bar": "bar",
                "time_s": [k * per_line * 0.01 - 0.005 if k else 0.0, (k + 1) * per_line * 0.01 - 0.005],
            }
            for k in range(count)
        ],
        "length_error": {"A_m": 1e-4, "K": 1e-4, "B_m": 2e-4},
    }
    return AcceptanceFile.model_validate(document | changes)


LEFT = np.array([[-0.07, -0.04, 0.0], [0.05, -0.02, 0.01], [0.03, 0.065, 0.0], [-0.02, 0.03, 0.04]])
RIGHT = np.array([[-0.05, -0.055, 0.0], [0.06, -0.03, 0.015], [0.02, 0.06, 0.0], [-0.055, 0.03, 0.03]])
LEFT = LEFT - LEFT.mean(axis=0) - [0.15, 0, 0]
RIGHT = RIGHT - RIGHT.mean(axis=0) + [0.15, 0, 0]
NAMES = [f"left/{k}" for k in range(4)] + [f"right/{k}" for k in range(4)]


def cluster_places(frames, stretch_m=0.0, turn_deg=0.0, seed=3):
    """Return the markers (t, 8, 3) of a bar that is carried about; its right cluster stands ``stretch_m`` farther off
    and is rotated by ``turn_deg`` about an axis askew, about its own middle.
    """
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(np.radians(turn_deg) * np.array([1.0, 2.0, 2.0]) / 3)
    middle = RIGHT.mean(axis=0)
    right = turn.apply(RIGHT - middle) + middle + [stretch_m, 0, 0]
    both = np.concatenate([LEFT, right])
    phase = np.linspace(0, 3.0, frames)
    poses = Rotation.from_rotvec(np.stack([0.3 * np.sin(phase), 0.2 * phase, np.cos(phase)], axis=1))
    ways = 0.3 * np.stack([np.sin(phase), np.cos(phase), 0 * phase], axis=1) + rng.normal(0, 1e-3, 3)
    return np.stack([pose.apply(both) + way for pose, way in zip(poses, ways, strict=True)])


def cluster_file(frames, limits=None, static=None, origin=(0.0, 0.0, 0.0)):
    """Return the acceptance file of ``cluster_places``: its frames are six stretches in motion, and one at rest.

    ``origin``: of the artefact's frame, in which the markers' places are stated.
    """
    edges = np.linspace(0, frames, 8).astype(int)
    ways = [(path, way) for path in ("along", "across") for way in "xyz"]
    stretches = [
        {
            "path": path,
            "orientation": way,
            "motion": motion,
            "time_s": [max(edges[k] * 0.01 - 0.005, 0.0), edges[k + 1] * 0.01 - 0.005],
        }
        for k, (path, way, motion) in enumerate([*((*one, "dynamic") for one in ways), ("along", "x", "static")])
    ]
    return AcceptanceFile.model_validate(
        {
            "title": "clusters",
            "volume": {"size_m": [1.0, 1.0, 1.0]},
            "body": [
                {"name": "left", "markers": NAMES[:4], "positions_m": (LEFT - origin).tolist()},
                {"name": "right", "markers": NAMES[4:], "positions_m": (RIGHT - origin).tolist()},
            ],
            "clusters": {
                "left": "left",
                "right": "right",
                "distance_sigma_m": 3e-6,
                "angle_sigma_deg": 0.001,
                "path": stretches,
                "dynamic": limits or {},
                "static": static or {},
            },
        }
    )
