"""Network geometry: number of views, connections between cameras, coverage of images and volume."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.spatial import ConvexHull, Delaunay, QhullError

from mosca.calibration.quality.findings import note, refuse, warn
from mosca.calibration.quality.jacobian import own_lens_parameters, principal_distance_column
from mosca.calibration.quality.limits import QualityLimits
from mosca.camera.projection import inside_image, project
from mosca.data.arrays import Array
from mosca.data.calibration import Calibration, Finding
from mosca.data.rig import Camera

FLAT = 1e-3
"""Ratio of the least to the largest extent below which object points lie in a plane."""
CORNERS = {"top left": (0, 0), "top right": (0, -1), "bottom left": (-1, 0), "bottom right": (-1, -1)}
VOLUME_CELLS = 6


def few_views(calibration: Calibration, settings: QualityLimits) -> tuple[Finding, ...]:
    """Return the cameras with too few image points or views to notice a mistake."""
    found = []
    for k, camera in enumerate(calibration.rig.cameras):
        rows = calibration.used & (calibration.sightings.camera == k)
        points = int(rows.sum())
        unknowns = sum(name.rpartition(".")[0] == camera.name for name in calibration.parameters)
        spare = 2 * points - unknowns
        where = f"camera '{camera.name}'"
        if spare < settings.least_redundancy:
            text = (
                f"{where}: {points} image points for {unknowns} unknowns leave {spare} spare equations, "
                f"{settings.least_redundancy} are needed to notice a mistake; take more pictures of the target"
            )
            found.append(refuse("few-views", text, camera.name))
            continue
        views, average = board_views(calibration, k)
        if views and principal_distance_column(calibration, k) is not None:
            fewest, wanted = settings.least_board_views
            if views < wanted:
                text = (
                    f"{where}: {views} views of a plane for an unknown principal distance, {fewest} determine it and "
                    f"{wanted} show a mistake; take more pictures, tilted about both axes by some 30 deg"
                )
                raise_ = refuse if views < fewest else warn
                found.append(raise_("few-views", text, camera.name))
                continue
            if average < settings.least_board_points:
                text = (
                    f"{where}: {average:.1f} points a view of the plane, {settings.least_board_points:g} are wanted; "
                    "come nearer or take a plane with more points"
                )
                found.append(warn("few-views", text, camera.name))
                continue
        if unknowns and 2 * points < settings.least_equations * unknowns:
            text = (
                f"{where}: {points} image points for {unknowns} unknowns, at least "
                f"{settings.least_equations * unknowns / 2:.0f} are wanted; a mistake would spread instead "
                "of showing: take more pictures of the target"
            )
            found.append(warn("few-views", text, camera.name))
    return tuple(found)


def board_views(calibration: Calibration, camera: int) -> tuple[int, float]:
    """Return the number of placements of a plane that a camera saw, and of points in each; (0, 0) without a plane."""
    rows = calibration.used & (calibration.sightings.camera == camera) & (calibration.placement >= 0)
    if len(calibration.marks_m) < 4 or not rows.any() or not is_flat(calibration.marks_m):
        return 0, 0.0
    views = len(np.unique(calibration.placement[rows]))
    return views, float(rows.sum() / views)


def is_flat(points: Array) -> bool:
    """Return whether the known ones of points (n, 3) lie in a plane, but not on a line."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 3:
        return False
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(sizes[2] < FLAT * sizes[0] and sizes[1] > 0.02 * sizes[0])


def links(calibration: Calibration, rigid_target: bool = False) -> Array:
    """Return the number of points (c, c) that connect each pair of cameras.

    These are points seen by both. For a rigid target with known geometry (a placement, or with ``rigid_target`` the
    field itself), it is the smaller of the two cameras' numbers of its points, since different points also connect.
    """
    count = len(calibration.rig.cameras)
    strength = np.zeros((count, count), dtype=np.int64)
    see, rows = calibration.sightings, calibration.used
    world = rows & (calibration.placement < 0)
    if world.any() and rigid_target:
        seen = np.bincount(see.camera[world], minlength=count)
        strength += np.minimum(seen[:, None], seen[None])
    elif world.any():
        points = np.zeros((len(calibration.marks_m), count), dtype=np.int64)
        points[see.mark[world], see.camera[world]] = 1
        strength += points.T @ points
    placed = rows & (calibration.placement >= 0)
    if placed.any():
        seen = np.zeros((len(calibration.target_translation), count), dtype=np.int64)
        np.add.at(seen, (calibration.placement[placed], see.camera[placed]), 1)
        strength += np.minimum(seen[:, :, None], seen[:, None]).sum(axis=0)
    np.fill_diagonal(strength, 0)
    return strength


def linked(calibration: Calibration, settings: QualityLimits, rigid_target: bool = False) -> tuple[Finding, ...]:
    """Return the cameras that are joined to the others by no or few common views."""
    names = calibration.rig.names
    if len(names) < 2:
        return ()
    strength = links(calibration, rigid_target)
    groups, label = connected_components(coo_array(strength), directed=False)
    if groups > 1:
        sets = [[names[k] for k in np.flatnonzero(label == g)] for g in range(groups)]
        words = "; ".join(", ".join(one) for one in sets)
        wanted = "; ".join(_in_words(calibration, *pair) for pair in missing_links(calibration, label))
        text = f"{groups} groups of cameras see no point in common: {words}; {wanted}, then calibrate again"
        return (refuse("no-link", text),)
    # the weakest link of the strongest tree decides how well the groups on its two sides are connected
    tree = minimum_spanning_tree(coo_array((1.0 / strength[strength > 0], np.nonzero(strength)))).tocoo()
    found = []
    views = common_views(calibration)
    flat = len(calibration.marks_m) >= 4 and is_flat(calibration.marks_m) and not (calibration.placement < 0).any()
    for i, j in zip(tree.row, tree.col, strict=True):
        points = int(strength[i, j])
        pair = f"cameras '{names[i]}' and '{names[j]}'"
        if points < settings.least_common_points:
            text = (
                f"{pair}, with what hangs on them, are joined by {points} common points only, "
                f"{settings.least_common_points} are wanted; show the target where both see it"
            )
            found.append(warn("weak-link", text))
        elif flat and views[i, j] < settings.least_common_views:
            text = (
                f"{pair}, with what hangs on them, are joined by {views[i, j]} views of a plane only, "
                f"{settings.least_common_views} are wanted; show it where both see it, tilted differently"
            )
            found.append(warn("weak-link", text))
    return tuple(found)


def common_views(calibration: Calibration) -> Array:
    """Return the number (c, c) of placements that both cameras of each pair saw."""
    rows = calibration.used & (calibration.placement >= 0)
    seen = np.zeros((len(calibration.target_translation), len(calibration.rig.cameras)), dtype=np.int64)
    seen[calibration.placement[rows], calibration.sightings.camera[rows]] = 1
    return np.asarray(seen.T @ seen)


def missing_links(calibration: Calibration, label: Array) -> tuple[tuple[int, int, int], ...]:
    """Return the links that would join the groups ``label`` (c,) to the first one.

    Each (i, j, n): n of the points that camera i saw lie in the image of camera j, the most of any such pair.
    """
    rig, points = calibration.rig, calibration.points_in_world()
    seen = [points[calibration.used & (calibration.sightings.camera == k)] for k in range(len(rig.cameras))]
    centres = np.array([camera.world_from_camera.translation for camera in rig.cameras])
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)
    found = []
    for other in np.unique(label[label != label[0]]):
        pairs = [
            (i, j) for i in range(len(label)) for j in range(len(label)) if {label[i], label[j]} == {label[0], other}
        ]
        counted = [(i, j, int(_inside(rig.cameras[j], seen[i]).sum())) for i, j in pairs]
        # of equally good links the shortest is taken: its cameras see the same side of the target
        found.append(max(counted, key=lambda one: (one[2], -apart[one[0], one[1]])))
    return tuple(found)


def _in_words(calibration: Calibration, one: int, other: int, count: int) -> str:
    """Return where the target must be shown to join two cameras."""
    first, second = calibration.rig.names[one], calibration.rig.names[other]
    if count == 0:
        return f"nothing that '{first}' saw lies in the image of '{second}': turn cameras so that they overlap"
    return (
        f"{count} of the places where '{first}' saw the target lie in the image of '{second}' too: show the target "
        "there while both watch"
    )


def _inside(camera: Camera, points: Array) -> Array:
    with np.errstate(invalid="ignore"):
        return inside_image(camera, project(camera, points))


def coverage(calibration: Calibration, camera: int, cells: tuple[int, int]) -> Array:
    """Return which cells (rows, columns) of an image the used points cover: cells with points, or in their hull."""
    columns, rows = cells
    size = np.array(calibration.sightings.sizes[camera], dtype=float)
    mine = calibration.used & (calibration.sightings.camera == camera)
    at = (calibration.sightings.xy_px[mine] + 0.5) / size * (columns, rows)
    covered = np.zeros((rows, columns), dtype=bool)
    place = np.clip(at.astype(int), 0, (columns - 1, rows - 1))
    covered[place[:, 1], place[:, 0]] = True
    middle = np.stack(np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5), axis=-1)
    covered |= _between(at, middle.reshape(-1, 2)).reshape(rows, columns)
    return covered


def volume_coverage(calibration: Calibration, low: Sequence[float], high: Sequence[float]) -> Array:
    """Return which cells (x, y, z) of a box [m, world] the used points cover: cells with points, or in their hull."""
    corner, extent = (np.asarray(low, dtype=float), np.asarray(high, dtype=float) - np.asarray(low, dtype=float))
    at = (calibration.points_in_world()[calibration.used] - corner) / extent * VOLUME_CELLS
    covered = np.zeros((VOLUME_CELLS,) * 3, dtype=bool)
    inside = ((at >= 0) & (at < VOLUME_CELLS)).all(axis=1)
    covered[tuple(at[inside].astype(int).T)] = True
    axis = np.arange(VOLUME_CELLS) + 0.5
    middle = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    covered |= _between(at, middle.reshape(-1, 3)).reshape(covered.shape)
    return covered


def _between(points: Array, places: Array) -> Array:
    """Return which ``places`` lie in the convex hull of ``points``; none where these span no hull."""
    try:
        hull = Delaunay(points[np.unique(ConvexHull(points).vertices)])
    except (QhullError, ValueError):
        return np.zeros(len(places), dtype=bool)
    return np.asarray(hull.find_simplex(places) >= 0)


def little_coverage(
    calibration: Calibration, settings: QualityLimits, volume: tuple[Sequence[float], Sequence[float]] | None = None
) -> tuple[Finding, ...]:
    """Return findings where a camera's image, or the ``volume`` (low, high) [m], was covered only in part."""
    found = []
    for k, camera in enumerate(calibration.rig.cameras):
        if not own_lens_parameters(camera.name, calibration.parameters):
            continue  # a lens that was held needs no points in the corners
        covered = coverage(calibration, k, settings.cells)
        share = float(covered.mean())
        empty = [name for name, (row, column) in CORNERS.items() if not covered[row, column]]
        corners = f"; corners without any: {', '.join(empty)}" if empty else ""
        text = (
            f"camera '{camera.name}': the target was seen in {share:.0%} of the image, "
            f"{settings.noted_coverage:.0%} wanted{corners}; rays outside are extrapolated: show the target there"
        )
        if share < settings.noted_coverage:
            found.append((warn if share < settings.warned_coverage else note)("little-coverage", text, camera.name))
    if volume is not None:
        share = float(volume_coverage(calibration, *volume).mean())
        text = (
            f"the target was seen in {share:.0%} of the volume, {settings.noted_coverage:.0%} wanted; "
            "measurements in the rest are extrapolated: show the target there"
        )
        if share < settings.noted_coverage:
            found.append((warn if share < settings.warned_coverage else note)("little-coverage", text))
    return tuple(found)
