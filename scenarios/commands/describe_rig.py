"""Description of the cameras in a rig file, and of implausible values in it."""

from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.sparse.csgraph import connected_components

from mosca.camera.projection import lens_directions
from mosca.data.arrays import Array
from mosca.data.files.rig_file import read_rig
from mosca.data.rig import Camera, Rig
from scenarios.build.cameras import overlap_of

FARTHEST_APART_M = 50.0
"""Median distance of two cameras above which a rig is taken to be in millimetres: halls are smaller, and cameras 50
mm apart rarely make a rig."""
SAME_PLACE = 1e-6
"""Bound for one pose stated twice: distance over the median distance of two cameras, and difference of rotations."""


def describe_rig(path: Path) -> list[str]:
    """Return lines on a rig's cameras, the overlap of their views, and implausible values."""
    rig = read_rig(path)
    lines = [
        f"{c.name}: {c.lens.model} lens, {c.width} x {c.height} px, {_view(c)}, at "
        f"({', '.join(f'{x:.3f}' for x in c.world_from_camera.translation)}) m"
        for c in rig.cameras
    ]
    share = _overlaps(rig)
    for k, j in combinations(range(len(rig.cameras)), 2):
        if np.isfinite(share[k, j]):
            seen = f"{100 * share[k, j]:.0f} % of the first one's view can be seen by the second"
            lines.append(f"{rig.names[k]} - {rig.names[j]}: {seen}")
    return [*lines, *(f"WARNING: {text}" for text in (*_identical(rig), *_units(rig), *_apart(rig, share)))]


def _view(camera: Camera) -> str:
    """Return a camera's field of view in words, from the middles of its image's edges."""
    middle_x, middle_y = (camera.width - 1) / 2, (camera.height - 1) / 2
    edges = np.array([[0, middle_y], [camera.width - 1, middle_y], [middle_x, 0], [middle_x, camera.height - 1]])
    v = lens_directions(camera.lens, edges)
    angles = [np.degrees(np.arccos(np.clip(v[k] @ v[k + 1], -1, 1))) for k in (0, 2)]
    if not np.isfinite(angles).all():
        return "whose lens model ends within the image"
    return f"sees {angles[0]:.0f} x {angles[1]:.0f} deg"


def _distances(rig: Rig) -> Array:
    """Return the distances (n, n) [m] of the cameras from each other."""
    at = np.array([camera.world_from_camera.translation for camera in rig.cameras])
    return np.asarray(np.linalg.norm(at[:, None] - at, axis=2))


def _overlaps(rig: Rig) -> Array:
    """Return the share (n, n) of each camera's view that another camera can see; NaN for two at one position."""
    distance = _distances(rig)
    share = np.full(distance.shape, np.nan)
    for k, camera in enumerate(rig.cameras):
        for j, other in enumerate(rig.cameras):
            if distance[k, j] > 0:
                share[k, j] = overlap_of(camera, other)
    return share


def _identical(rig: Rig) -> list[str]:
    distance = _distances(rig)
    near = SAME_PLACE * np.median(distance[distance > 0]) if (distance > 0).any() else 0.0
    found = []
    for k, j in combinations(range(len(rig.cameras)), 2):
        one, other = rig.cameras[k], rig.cameras[j]
        turned = np.abs(one.world_from_camera.rotation - other.world_from_camera.rotation).max()
        if distance[k, j] > near:
            continue
        same = "pose" if turned <= SAME_PLACE else "position"
        lens = " and the same lens" if one.lens == other.lens else ""
        found.append(
            f"cameras '{one.name}' and '{other.name}' have the same {same}{lens}, so that one of them is wrong; "
            "calibrate again"
        )
    return found


def _units(rig: Rig) -> list[str]:
    distance = _distances(rig)[np.triu_indices(len(rig.cameras), 1)]
    if not len(distance) or not np.median(distance) > FARTHEST_APART_M:
        return []
    return [
        f"half of the cameras are more than {np.median(distance):.3g} m apart; if these are millimetres, divide "
        "positions by 1000 (mosca rig convert --unit mm where the file comes from another program)"
    ]


def _apart(rig: Rig, share: Array) -> list[str]:
    """Return lines on cameras that share no field of view with the others, directly or through third cameras."""
    joined = np.nan_to_num(share) > 0
    # two cameras at one position cannot be judged by their overlap
    count, group_of = connected_components(joined | joined.T | np.isnan(share), directed=False)
    if count < 2:
        return []
    groups = [", ".join(rig.names[k] for k in np.flatnonzero(group_of == group)) for group in range(count)]
    return [
        f"the fields of view of {' | '.join(groups)} have nothing in common: no point can be measured by cameras of "
        "two of these groups; turn the cameras, or look for wrong poses in the file"
    ]
