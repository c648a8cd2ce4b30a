"""Cameras worn on the body that they film: the truth in that body's frame, and scores of lamps and paths."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mosca.camera.projection import project
from mosca.continuous.association.frame_detections import CameraDetections
from mosca.continuous.moving_cameras.body_worn import Worn
from mosca.data.arrays import Array
from mosca.data.rig import Pose, Rig
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth
from scenarios.build.worn_lamps import LAMP
from scenarios.build.worn_rig import known_lamps
from scenarios.score.tracks import SEEN_CAMERAS, SEEN_SHARE
from scenarios.spec.scenario import Scenario
from scenarios.types import Collected, Score
from twin.scenes.scene import Scene

NEAR_M = 0.02
"""Distance from a lamp's known position within which a curve is taken as that lamp's."""
NEAR_PX = 2.0
"""Distance from a lamp's expected image within which an image point is taken as that lamp's."""


def relative_truth(truth: Truth, scene: Scene, body: str) -> Truth:
    """Return the truth with the markers' positions in the body's frame; its lamps are left out."""
    sampler = scene.sampler()
    at = [scene.model.body(k).name for k in range(scene.model.nbody)].index(body)
    xyz = np.empty(truth.xyz.shape)
    for k, time_ns in enumerate(truth.time_ns):
        sampler.at(time_ns * 1e-9)
        turn = sampler.data.xmat[at].reshape(3, 3)
        xyz[k] = (truth.xyz[k] - sampler.data.xpos[at]) @ turn
    keep = np.array([not name.startswith(LAMP) for name in truth.names])
    return replace(
        truth,
        names=tuple(name for name in truth.names if not name.startswith(LAMP)),
        xyz=xyz[:, keep],
        visible=truth.visible[:, keep],
        image_xy_px=truth.image_xy_px[:, keep],
        diameter_px=truth.diameter_px[:, keep],
        frames=None,
    )


def lamp_positions(spec: Scenario, rig: Rig) -> dict[str, Array]:
    """Return camera -> known position of its lamp in the body's frame [m]."""
    return {
        own.name: rig.camera(own.name).world_from_camera.transform(np.array([own.lamp_m]))[0]
        for own in spec.camera
        if own.lamp_m is not None and own.name in rig.names
    }


def without_lamps(tracks: Tracks, places: dict[str, Array]) -> Tracks:
    """Return the tracks that do not belong to a camera's lamp."""
    kept = np.ones(len(tracks), dtype=bool)
    for track in np.unique(tracks.track):
        rows = tracks.track == track
        away = [np.median(np.linalg.norm(tracks.xyz[rows] - place, axis=1)) for place in places.values()]
        if away and min(away) < NEAR_M:
            kept &= ~rows
    return tracks.select(kept)


def lamp_scores(seen: Sequence[CameraDetections], rig: Rig, places: dict[str, Array]) -> dict[str, Score]:
    """Return the share of lamps that another camera sees in most frames, and the error of their images.

    ``lamp_px``: rms distance of the lamps' images (observed epipoles, except for the lamps' known offset from the
    lens) from their projections [px].
    """
    if not places:
        return {}
    found, squares = set(), []
    for camera, one in zip(rig.cameras, seen, strict=True):
        starts = one.start[:-1][np.diff(one.start) > 0]
        for name, place in places.items():
            wanted = project(camera, place[None])[0]
            inside = (wanted > 0).all() and wanted[0] < camera.width - 1 and wanted[1] < camera.height - 1
            if name == camera.name or not inside or not len(starts):
                continue
            away = np.minimum.reduceat(np.linalg.norm(one.xy_px - wanted, axis=1), starts)
            near = away[away < NEAR_PX]
            if len(near) > 0.5 * len(one.frame_ns):
                found.add(name)
                squares.append(near**2)
    scores = {"lamps_found": Score(len(found) / len(places), len(places))}
    if squares:
        all_of_them = np.concatenate(squares)
        scores["lamp_px"] = Score(float(np.sqrt(all_of_them.mean())), len(all_of_them))
    return scores


def reasons(truth: Truth) -> dict[str, str]:
    """Return in words the reasons for missing markers: how often two cameras see them, and the least seen markers."""
    cameras = (truth.visible >= SEEN_SHARE).sum(axis=2)
    two, one = (cameras >= SEEN_CAMERAS).mean(axis=0), (cameras >= 1).mean(axis=0)
    order = np.argsort(two)[:6]
    least = ", ".join(f"{truth.names[k]} {100 * two[k]:.0f} %" for k in order)
    twice, once = 100 * two.mean(), 100 * one.mean()
    return {
        "seen": (
            f"two cameras and more see a marker {twice:.1f} % of the time, one {once:.1f} %; the others are hidden "
            f"by the body or outside the images, most of all {least}"
        )
    }


def rig_in_the_middle(worn: Worn) -> Rig:
    """Return the rig in the middle of the recording."""
    found = worn.reconstructed
    assert found.cameras is not None
    times = found.observations.time_s
    rotations, centres = found.cameras.at(np.array([0.5 * (times.min() + times.max())]))
    return Rig(
        tuple(
            replace(one, world_from_camera=Pose(rotations[0, c], centres[0, c]))
            for c, one in enumerate(found.rig.cameras)
        )
    )


def moving_scores(
    spec: Scenario, collected: Collected, worn: Worn, truth: Truth, scene: Scene | None
) -> tuple[Collected, Truth, dict[str, Score]]:
    """Return the markers' tracks, the truth in the body's frame, and the scores of lamps and camera paths."""
    assert spec.continuous is not None
    assert spec.continuous.worn_on is not None
    scores = moving_lamp_scores(worn)
    if scene is None:
        return collected, truth, scores
    known = known_lamps(spec, worn.reconstructed.rig)[0]
    scores |= path_scores(worn, known, true_poses(spec, worn, truth, scene), truth.time_ns)
    truth = relative_truth(truth, scene, spec.continuous.worn_on)
    collected.assembly.notes.update(reasons(truth))
    return collected, truth, scores


def moving_lamp_scores(worn: Worn) -> dict[str, Score]:
    """Return the share of lamps that another camera identified by their numbers, and their rms reprojection error."""
    count = len(worn.reconstructed.rig.cameras)
    found = {int(k) for own in worn.by_code for k in np.unique(own) if k >= 0}
    images = sum(int((one >= 0).sum()) for one in worn.lamp)
    return {"lamps_found": Score(len(found) / count, count), "lamp_px": Score(worn.lamp_rms_px, images)}


def true_poses(spec: Scenario, worn: Worn, truth: Truth, scene: Scene) -> tuple[Array, Array]:
    """Return body_from_camera at the pulses: rotations (t, c, 3, 3) and positions (t, c, 3) [m], without shake."""
    from scenarios.build.worn_lamps import rider_pose

    assert spec.continuous is not None
    sampler = scene.sampler()
    names = [scene.model.body(k).name for k in range(scene.model.nbody)]
    body = names.index(spec.continuous.worn_on)
    of_name = {own.name: own for own in spec.camera}
    cameras = worn.reconstructed.rig.names
    own = [(names.index(of_name[name].body), rider_pose(of_name[name])) for name in cameras]
    rotations = np.empty((len(truth.time_ns), len(cameras), 3, 3))
    places = np.empty(rotations.shape[:3])
    for k, time_ns in enumerate(truth.time_ns):
        sampler.at(time_ns * 1e-9)
        turns, at = sampler.data.xmat.reshape(-1, 3, 3), sampler.data.xpos
        for c, (carrier, pose) in enumerate(own):
            rotations[k, c] = turns[body].T @ turns[carrier] @ pose.rotation
            places[k, c] = turns[body].T @ (turns[carrier] @ pose.translation + at[carrier] - at[body])
    return rotations, places


def path_scores(worn: Worn, known: tuple[str, ...], true: tuple[Array, Array], time_ns: Array) -> dict[str, Score]:
    """Return the rms errors of the poses of the cameras that were not ``known``: positions [m], rotations [rad]."""
    found = worn.reconstructed
    assert found.cameras is not None
    moving = [c for c, name in enumerate(found.rig.names) if name not in known]
    first = found.clocks[0]
    rotations, centres = found.cameras.at((time_ns - first.origin_ns) * 1e-9)
    away = np.linalg.norm(centres - true[1], axis=2)[:, moving]
    trace = np.einsum("tcij,tcij->tc", rotations, true[0])[:, moving]
    angle = np.arccos(np.clip((trace - 1) / 2, -1, 1))
    n = away.size
    return {
        "camera_position_rms": Score(float(np.sqrt((away**2).mean())), n),
        "camera_angle_rms": Score(float(np.sqrt((angle**2).mean())), n),
    }
