"""Poses of all cameras in one world, chained over common views from the target's poses in the cameras' frames."""

import heapq
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from mosca.data.rig import Pose
from mosca.errors import CalibrationError

View = tuple[int, int]
"""A camera and a pose of the target, by index."""


def chain(
    views: Mapping[View, Pose], doubt: Mapping[View, float], reference: int, names: Sequence[str]
) -> tuple[dict[int, Pose], dict[int, Pose]]:
    """Return world_from_camera by camera and world_from_target by target pose; pose ``reference`` is the world.

    ``views``: camera_from_target of each view; ``doubt``: unreliability of each view. Poses are chained from the
    reference along the least doubtful views (a minimum spanning tree). Target poses that no placed camera saw are
    left out. CalibrationError names the cameras that no common view joins.
    """
    cameras: dict[int, Pose] = {}
    stands: dict[int, Pose] = {reference: Pose(np.eye(3), np.zeros(3))}
    by_camera: dict[int, list[View]] = {}
    by_stand: dict[int, list[View]] = {}
    for view in views:
        by_camera.setdefault(view[0], []).append(view)
        by_stand.setdefault(view[1], []).append(view)
    waiting = [(doubt[view], view) for view in by_stand.get(reference, [])]
    heapq.heapify(waiting)
    while waiting:
        _, view = heapq.heappop(waiting)
        camera, stand = view
        if camera in cameras and stand in stands:
            continue
        if camera in cameras:
            stands[stand] = cameras[camera] @ views[view]
            fresh = by_stand[stand]
        else:
            cameras[camera] = stands[stand] @ views[view].inverse()
            fresh = by_camera[camera]
        for other in fresh:
            heapq.heappush(waiting, (doubt[other], other))
    missing = [k for k in range(len(names)) if k not in cameras]
    if missing:
        raise _not_joined(cameras, missing, by_camera, names)
    return cameras, stands


def _not_joined(
    placed: Collection[int], missing: Sequence[int], seen: Mapping[int, list[View]], names: Sequence[str]
) -> CalibrationError:
    blind = [names[k] for k in missing if k not in seen]
    if blind:
        return CalibrationError(
            f"few-views: camera {', '.join(repr(name) for name in blind)}: the target was not seen, or with fewer "
            "than 4 marks at a time; show it to that camera, nearer or more slowly",
            tuple(blind),
        )
    one, other = (", ".join(names[k] for k in group) for group in (sorted(placed), missing))
    return CalibrationError(
        f"no-link: cameras {one} and {other} never saw the target at the same time, so that nothing says how they "
        "stand to each other; carry the target through where the views of one of each overlap",
        tuple(names[k] for k in min(sorted(missing), sorted(placed), key=len)),
    )
