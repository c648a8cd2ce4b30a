"""Cameras worn on the body that they film: their rig in that body's frame, and the truth told in it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mosca.camera.projection import project
from mosca.continuous.association.frame_detections import CameraDetections
from mosca.data.arrays import Array
from mosca.data.rig import Rig
from mosca.data.tracks import Tracks
from mosca.data.truth import Truth
from mosca.errors import InputError
from mosca.pipeline import PipelineSettings
from scenarios.build.cameras import Calibrated, fitted_cameras
from scenarios.build.scene import stage_settings
from scenarios.build.worn_lamps import LAMP
from scenarios.score.tracks import SEEN_CAMERAS, SEEN_SHARE, Score
from scenarios.spec.scenario import Scenario
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.scene import Scene

NEAR_M = 0.02
"""A curve that stays so near to a lamp's known place is that lamp's."""
NEAR_PX = 2.0
"""An image point so near to where a lamp should be is that lamp's."""


def worn_cameras(spec: Scenario, cameras: tuple[VirtualCamera, ...]) -> tuple[VirtualCamera, ...]:
    """Return the cameras that ride on the body ``worn_on``, with ``moving`` then those on others that film it too.

    InputError where fewer than two ride on the body itself.
    """
    assert spec.continuous is not None
    body = spec.continuous.worn_on
    worn = tuple(v for v in cameras if v.mount.body == body)
    others = tuple(v for v in cameras if v.mount.body not in (None, body)) if spec.continuous.moving else ()
    if len(worn) < 2:
        raise InputError(
            f"continuous.worn_on = '{body}': {len(worn)} [[camera]] tables have body = '{body}'; two at "
            "least are wanted"
        )
    return worn + others


def worn_rig(spec: Scenario, worn: tuple[VirtualCamera, ...]) -> Calibrated:
    """Return the rig in the body's frame, the pipeline's lens model fitted to the true lenses' rays.

    Cameras on other bodies have no pose that anybody knows.
    """
    assert spec.continuous is not None
    found = fitted_cameras(spec, worn, 0.5 * spec.continuous.reach_m)
    if not spec.continuous.moving:
        return found
    from scenarios.score.continuous_limbs import without_poses

    return replace(
        found,
        rig=without_poses(
            found.rig, {v.camera.name for v in worn if v.mount.body == spec.continuous.worn_on}
        ),
    )


def worn_settings(spec: Scenario) -> PipelineSettings:
    """Return the pipeline's settings for markers around the body."""
    assert spec.continuous is not None
    r = spec.continuous.reach_m
    return stage_settings(spec.pipeline, ((-r, -r, -r), (r, r, r)))


def relative_truth(truth: Truth, scene: Scene, body: str) -> Truth:
    """Return the truth with the markers' places in the body's frame; its lamps are left out."""
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


def lamp_places(spec: Scenario, rig: Rig) -> dict[str, Array]:
    """Return camera -> known place of its lamp in the body's frame [m]."""
    return {
        own.name: rig.camera(own.name).world_from_camera.transform(np.array([own.lamp_m]))[0]
        for own in spec.camera
        if own.lamp_m is not None and own.name in rig.names
    }


def without_lamps(tracks: Tracks, places: dict[str, Array]) -> Tracks:
    """Return the tracks that are no camera's lamp."""
    kept = np.ones(len(tracks), dtype=bool)
    for track in np.unique(tracks.track):
        rows = tracks.track == track
        away = [np.median(np.linalg.norm(tracks.xyz[rows] - place, axis=1)) for place in places.values()]
        if away and min(away) < NEAR_M:
            kept &= ~rows
    return tracks.select(kept)


def lamp_scores(seen: Sequence[CameraDetections], rig: Rig, places: dict[str, Array]) -> dict[str, Score]:
    """Return the share of lamps that another camera sees in most frames, and how far from where they should be.

    ``lamp_px``: rms distance of the lamps' images (observed epipoles, but for the lamps' known way from the lens)
    from their projections [px].
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
    """Return in words why markers are missing: how often two cameras see them, and which are seen least."""
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
