"""Cameras on the limbs of a body: what is known of them beforehand, and how their paths meet the truth."""

from collections.abc import Set as AbstractSet
from dataclasses import replace

import numpy as np

from mosca.continuous.moving_cameras.body_worn import Lamps, Worn
from mosca.data.arrays import Array
from mosca.data.rig import Pose, Rig
from mosca.data.truth import Truth
from mosca.errors import InputError
from scenarios.run.record import Collected
from scenarios.score.tracks import Score
from scenarios.score.worn_cameras import reasons, relative_truth
from scenarios.spec.scenario import Scenario
from twin.scenes.scene import Scene

NO_POSE = Pose(np.eye(3), np.zeros(3))


def without_poses(rig: Rig, known: AbstractSet[str]) -> Rig:
    """Return the rig with the poses of the cameras ``known`` alone; the others' are no more than a place to write."""
    return Rig(
        tuple(one if one.name in known else replace(one, world_from_camera=NO_POSE) for one in rig.cameras)
    )


def worn_lamps_of(spec: Scenario, rig: Rig) -> tuple[tuple[str, ...], Lamps]:
    """Return the cameras on the body itself, whose places are known, and all cameras' lamps; InputError without."""
    assert spec.continuous is not None
    of_name = {own.name: own for own in spec.camera}
    numbers, places = [], []
    for name in rig.names:
        own = of_name[name]
        if own.lamp_m is None or own.lamp_number is None:
            raise InputError(
                f"camera '{name}': continuous.moving wants each worn camera's lamp_m and lamp_number; give them"
            )
        numbers.append(own.lamp_number)
        places.append(own.lamp_m)
    known = tuple(name for name in rig.names if of_name[name].body == spec.continuous.worn_on)
    return known, Lamps(tuple(numbers), np.array(places, dtype=float), 1.0 / spec.capture.frame_rate_hz)


def limb_notes(worn: Worn) -> dict[str, str]:
    """Return in words how cameras and lamps were found."""
    found = worn.reconstructed
    told = np.isfinite(worn.placed.centres).all(axis=2).mean(axis=0)
    shares = ", ".join(
        f"{name} {100 * share:.0f} %"
        for name, share in zip(found.rig.names, told, strict=True)
        if share < 1.0
    )
    code, images = (sum(int((one >= 0).sum()) for one in of) for of in (worn.by_code, worn.lamp))
    return {
        "lamps": (
            f"{code} images of lamps were told by their numbers, {images - code} by where they had to be; they lie "
            f"{worn.lamp_rms_px:.2f} px rms an axis from the estimated poses"
        ),
        "poses": f"lamps alone told where cameras were at these shares of the instants: {shares or 'all'}",
    }


def rig_in_the_middle(worn: Worn) -> Rig:
    """Return the rig as it was in the middle of the recording."""
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


def scored_limbs(
    spec: Scenario, collected: Collected, worn: Worn, truth: Truth, scene: Scene | None
) -> tuple[Collected, Truth, dict[str, Score]]:
    """Return the markers' tracks, the truth in the body's frame, and the scores of lamps and camera paths."""
    assert spec.continuous is not None
    assert spec.continuous.worn_on is not None
    scores = lamp_scores(worn)
    if scene is None:
        return collected, truth, scores
    known = worn_lamps_of(spec, worn.reconstructed.rig)[0]
    scores |= path_scores(worn, known, true_poses(spec, worn, truth, scene), truth.time_ns)
    truth = relative_truth(truth, scene, spec.continuous.worn_on)
    collected.assembly.notes.update(reasons(truth))
    return collected, truth, scores


def lamp_scores(worn: Worn) -> dict[str, Score]:
    """Return the share of lamps that another camera told by their numbers, and their rms distance from the poses."""
    count = len(worn.reconstructed.rig.cameras)
    found = {int(k) for own in worn.by_code for k in np.unique(own) if k >= 0}
    images = sum(int((one >= 0).sum()) for one in worn.lamp)
    return {
        "lamps_found": Score(len(found) / count, count),
        "lamp_px": Score(worn.lamp_rms_px, images),
    }


def true_poses(spec: Scenario, worn: Worn, truth: Truth, scene: Scene) -> tuple[Array, Array]:
    """Return body_from_camera at the pulses: rotations (t, c, 3, 3) and places (t, c, 3) [m], without their shake."""
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


def path_scores(
    worn: Worn, known: tuple[str, ...], true: tuple[Array, Array], time_ns: Array
) -> dict[str, Score]:
    """Return how far the paths of the cameras that were not ``known`` are off, rms: places [m], rotations [rad]."""
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
