"""Virtual objects of a scenario, shown at simulated displays from the poses known by then."""

from pathlib import Path

import numpy as np

from mosca.data.bodies import BodyPoses, RigidBody
from mosca.data.tracks import Tracks
from mosca.rigid_bodies.prediction import PredictionSettings
from mosca.rigid_bodies.tracker import BodyTracker
from reports.viewer import RerunLog
from reports.virtual_evidence import VirtualEvidence
from scenarios.score.virtual_objects import ObjectErrors
from scenarios.spec.faults import UnpredictedFault
from scenarios.spec.scenario import Scenario
from scenarios.virtual.objects import CURRENT, BoundObjects, ShownObject, ShownPoses, bindings
from scenarios.virtual.scene import VirtualScene


def virtual_objects(
    spec: Scenario, folder: Path, tracks: Tracks, bodies: tuple[RigidBody, ...], log: RerunLog | None
) -> ShownPoses:
    """Return the objects at each display of the take.

    The poses are those of a live run: found forwards in time only, each known ``latency_s`` after its exposure.
    """
    assert spec.virtual is not None
    given = spec.virtual
    bound = bindings(given.bind, [one.name for one in bodies], "the scene", "virtual.bind")
    scene = None if given.scene is None else VirtualScene(folder / given.scene, tuple(bound))
    if scene is not None and log is not None:
        for k, (body, vertices, triangles, colour) in enumerate(scene.meshes()):
            log.log_object_mesh(body, k, vertices, triangles, colour)
    objects = BoundObjects(bound, PredictionSettings(horizon_s=given.horizon_s))
    parts = _forwards(tracks, tuple(one for one in bodies if one.name in bound.values()))
    known_ns = [int(part.time_ns[0]) + round(1e9 * given.latency_s) for part in parts]
    rows: list[ShownObject] = []
    taken = 0
    for k in range(int(spec.capture.duration_s * given.display_hz) + 1):
        display_ns = round(1e9 * k / given.display_hz)
        while taken < len(parts) and known_ns[taken] <= display_ns:
            objects.update(parts[taken])
            taken += 1
        shown = objects.at(display_ns)
        if isinstance(spec.fault, UnpredictedFault):
            shown = [one._replace(pose=one.measured) for one in shown]
        rows += shown
        if scene is not None:
            scene.show(1e-9 * display_ns, {one.object: (one.pose.rotation, one.pose.position) for one in shown})
            if log is not None:
                log.log_objects(display_ns, scene.placements(), {one.object: one.pose.status for one in shown})
    return ShownPoses.of(rows)


def virtual_evidence(shown: ShownPoses, errors: ObjectErrors) -> VirtualEvidence:
    """Return the data of the picture."""
    return VirtualEvidence(
        1e-9 * shown.time_ns,
        shown.age_s,
        np.linalg.norm(errors.position_m, axis=1),
        np.linalg.norm(errors.unpredicted_m, axis=1),
        np.sqrt(np.trace(shown.covariance[:, :3, :3], axis1=1, axis2=2)),
        ~np.isin(shown.status, CURRENT),
    )


def _forwards(tracks: Tracks, bodies: tuple[RigidBody, ...]) -> list[BodyPoses]:
    """Return the poses of each frame, found from that frame and earlier ones."""
    tracker = BodyTracker(bodies)
    measured = tracks.select(np.asarray(tracks.status) == "measured")
    measured = measured.select(np.argsort(measured.frame, kind="stable"))
    frames, first = np.unique(measured.frame, return_index=True)
    parts = []
    for frame, rows in zip(frames.tolist(), np.split(np.arange(len(measured)), first[1:]), strict=True):
        seen = measured.select(rows)
        parts.append(tracker.update(seen, frame, int(seen.time_ns[0])))
    return [part for part in parts if len(part)]
