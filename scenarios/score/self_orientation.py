"""Both sides of a self-orientation against the truth, the Mosca paper's Table 4, and the budget of the difference.

The budget: each source of error is switched off separately (replaced by the truth), with the same images, noise and
frames otherwise. With d the difference of both sides over the frames, and d_i the difference without source i, the
share of the source is <d - d_i, d> / <d, d>. For errors that add up, the shares sum to 1, cross terms included, in
any order. The remainder to 1 is explained by none of the sources.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mosca.camera.eccentricity import eccentricity_px
from mosca.data.arrays import Array
from mosca.data.rig import Camera, Pose
from mosca.data.targets import CodedTarget
from mosca.machines.self_orientation.camera_path import CameraPath, at_instants, mean_nees, pose_errors
from mosca.machines.self_orientation.comparison import GAP_PERIODS
from mosca.machines.self_orientation.registration import Registration
from mosca.machines.self_orientation.resection import Resected, ResectionSettings, resect_frames
from mosca.machines.self_orientation.rig_side import LeverArm, camera_by_rig, with_clock
from mosca.machines.self_orientation.shutter import TargetImages
from reports.self_orientation_evidence import SelfOrientationEvidence
from scenarios.build.cameras import fitted_cameras
from scenarios.build.survey import survey_flight
from scenarios.score.paper_difference import enough_alone
from scenarios.score.tracks import BLOCKS, ratio_of_sums
from scenarios.session.estimated import true_pixels
from scenarios.session.self_orientation import (
    SESSION_M,
    SelfOrientation,
    drone_from_definition,
    drone_pose,
    true_lever_arm,
)
from scenarios.spec.scenario import Scenario
from scenarios.types import Score, Scored

PAPER = (-5.2618e-3, 8.0955e-3, 27.2022596e-3, -0.08392, 0.0232, 0.03281)
"""Mean differences of the Mosca paper's Table 4: X, Y, Z [m], omega, alpha, kappa (no unit is given)."""
SOURCES = {
    "shutter": "rolling shutter of the camera",
    "lens": "calibration of the camera",
    "targets": "coordinates of the targets",
    "noise": "image noise of the camera",
    "clock": "offset of the clocks",
    "lever": "where the camera sits on the body",
    "field": "registration of the field",
    "rig": "the rig's poses of the body",
}
"""Sources of error that are switched off, one after the other."""


@dataclass(frozen=True, eq=False)
class SelfOrientationScores:
    """Metrics, tables for the record, and data of the pictures."""

    scores: dict[str, Score]
    table: dict[str, dict[str, Any]]
    """Row -> mean and rms of X, Y, Z [m], omega, alpha, kappa [rad]."""
    budget: dict[str, dict[str, Any]]
    """Source -> share of the squared difference in position and in angle, and its change of the mean."""
    enough: dict[str, dict[str, Any]]
    """Source -> its size that alone gives the paper's difference in Z."""
    evidence: SelfOrientationEvidence
    """Data of the pictures."""

    def added_to(self, worth: Scored) -> Scored:
        """Return a run's scores with the tables."""
        return replace(worth, self_orientation=self.table, error_budget=self.budget, enough_alone=self.enough)


class _Sides:
    """Both sides of a take, any of its sources of error switched off."""

    def __init__(self, spec: Scenario, found: SelfOrientation, offset_s: float, shutter: bool) -> None:
        self.spec, self.found, self.offset_s, self.shutter = spec, found, offset_s, shutter
        self.there = found.prepared.there
        self.virtual = found.prepared.virtual
        self.true_lever = LeverArm(true_lever_arm(spec, found.prepared), 1e-18 * np.eye(6))
        self.true_field = Registration(self.there.world_from_field, 1e-18 * np.eye(6), 0.0, 0)
        frames = found.take.truth.frames
        assert frames is not None
        self.frames = frames
        self.row_of = {int(index): k for k, index in enumerate(frames.index)}
        to_field = self.there.world_from_field.inverse()
        self.true_rotation = to_field.rotation @ frames.camera_rotation
        self.true_position = to_field.transform(frames.camera_position)
        self._own: dict[frozenset[str], Resected] = {}

    def own(self, off: frozenset[str]) -> Resected:
        """Return the camera's own poses."""
        off = off & {"shutter", "lens", "targets", "noise"}
        if off not in self._own:
            camera = self._true_lens() if "lens" in off else self.found.prepared.camera
            targets = self.there.field if "targets" in off else self.found.prepared.told
            targets = replace(targets, sigma_m=self.found.prepared.told.sigma_m)
            # images of a global shutter need no correction of row times
            row_s = 0.0 if "shutter" in off or not self.shutter else self.virtual.timing.row_time_s
            seen = [self._images(one, camera, off) for one in self.found.take.seen]
            self._own[off] = resect_frames(seen, camera, targets, settings=ResectionSettings(row_time_s=row_s))
        return self._own[off]

    def by_rig(self, off: frozenset[str], own_time_ns: Array) -> tuple[CameraPath, Array]:
        """Return the rig's poses of the camera at the camera's stamps, and the indices of these stamps."""
        body = self.true_body() if "rig" in off else self.found.body
        lever = self.true_lever if "lever" in off else self.found.lever
        field = self.true_field if "field" in off else self.found.prepared.registration
        if "rig" in off:
            field = replace(field, by_calibration=None)
        offset_s = self.true_offset_s() if "clock" in off else self.offset_s
        path = camera_by_rig(body, lever, field)
        gap_s = GAP_PERIODS / self.spec.capture.frame_rate_hz
        return at_instants(path, own_time_ns - round(offset_s * 1e9), gap_s)

    def difference(self, off: frozenset[str]) -> dict[int, Array]:
        """Return camera frame -> own minus rig (6,)."""
        own = self.own(off)
        rig, inside = self.by_rig(off, own.path.time_ns)
        mine = own.path.select(inside)
        d = pose_errors(rig, mine.rotation, mine.position)
        return dict(zip(own.frame[inside].tolist(), d, strict=True))

    def true_offset_s(self) -> float:
        """Return the lead of the camera's clock in the middle of the flight [s]."""
        timing = self.virtual.timing
        middle = self.spec.capture.duration_s / 2
        if timing.clock == "session":
            return 0.0
        return timing.clock_offset_s + 1e-6 * timing.clock_drift_ppm * middle

    def true_body(self) -> CameraPath:
        """Return the true poses of the body's definition at the rig's instants."""
        scene = survey_flight(self.spec).scene
        sampler, definition = scene.sampler(), drone_from_definition(scene)
        at = self.found.body
        rotations, positions = [], []
        for time_ns in at.time_ns.tolist():
            sampler.at(time_ns * 1e-9)
            pose = drone_pose(scene, sampler) @ definition
            rotations.append(pose.rotation)
            positions.append(pose.translation)
        n = len(positions)
        return CameraPath(at.time_ns, np.array(rotations), np.array(positions), np.tile(1e-18 * np.eye(6), (n, 1, 1)))

    def _true_lens(self) -> Camera:
        """Return the camera with its lens model fitted to its true rays at the session's distance."""
        spec = self.spec.model_copy(
            update={
                "pipeline": self.spec.pipeline.model_copy(
                    update={"lens_model": self.found.prepared.camera.lens.model}
                )
            }
        )
        return fitted_cameras(spec, (self.virtual,), SESSION_M).rig.cameras[0]

    def _images(self, seen: TargetImages, camera: Camera, off: frozenset[str]) -> TargetImages:
        if not off & {"shutter", "noise"}:
            return seen
        k = self.row_of[seen.frame]
        names = self.found.take.truth.names
        rows = [names.index(f"code/{number:03d}") for number in seen.number.tolist()]
        with_rows = self.frames.image_xy_px[k, rows]
        targets = [self.there.field.targets[row] for row in rows]
        xyz = np.array([one.position for one in targets])
        pose = Pose(self.true_rotation[k], self.true_position[k])
        together = true_pixels(
            replace(self.virtual, camera=replace(self.virtual.camera, world_from_camera=pose)), xyz
        )
        xy = seen.xy_px
        if "noise" in off:
            radii = np.array([one.target.dot_radius_m for one in targets if isinstance(one.target, CodedTarget)])
            at = replace(camera, world_from_camera=pose)
            xy = with_rows + eccentricity_px(at, xyz, np.array([one.normal for one in targets]), radii)
        if "shutter" in off:
            xy = xy + together - with_rows
        good = np.isfinite(xy).all(axis=1)
        return TargetImages(seen.frame, seen.time_ns, seen.number[good], xy[good], seen.covariance_px2[good])


def self_orientation_scores(spec: Scenario, found: SelfOrientation) -> SelfOrientationScores:
    """Return metrics, table, budget and errors over time."""
    sides = _Sides(spec, found, found.offset_s, spec.self_orientation.shutter == "rolling")  # type: ignore[union-attr]
    own, path = found.own, found.own.path
    rows = np.array([sides.row_of[int(frame)] for frame in own.frame])
    own_errors = pose_errors(path, sides.true_rotation[rows], sides.true_position[rows])
    rig, inside = sides.by_rig(frozenset(), path.time_ns)
    rig = with_clock(rig, found.offset_sigma_s)
    kept = rows[inside]
    rig_errors = pose_errors(rig, sides.true_rotation[kept], sides.true_position[kept])
    mine = path.select(inside)
    scores = {
        **_scores("self", path, own_errors),
        **_scores("rig_camera", rig, rig_errors),
        "self_completeness": _completeness(sides, own),
        "light_clock_error": Score(abs(found.clock.offset_s - sides.true_offset_s()), 1),
    }
    bands = {"own": mean_nees(path, own_errors)[1], "by_rig": mean_nees(rig, rig_errors)[1]}
    as_paper = _Sides(spec, found, whole_frames_offset(found), shutter=False)
    budget, total, without = budget_of(as_paper)
    scores["budget_explained"] = Score(float(sum(one["position_share"] for one in budget.values())), len(total))
    difference = pose_errors(rig, mine.rotation, mine.position)
    table = {
        "paper, Table 4": {"mean": list(PAPER), "rms": None, "frames": None},
        "twin, as in the paper": _row(total),
        "twin, shutter and clock modelled": _row(difference),
        "twin, error sources off": _row(without),
        "camera's own poses, against the truth": _row(-own_errors) | {"nees_band": list(bands["own"])},
        "rig's, against the truth": _row(-rig_errors) | {"nees_band": list(bands["by_rig"])},
    }
    sigma = [np.sqrt(np.diagonal(one.total_covariance(), axis1=1, axis2=2)) for one in (mine, rig)]
    time_s = (mine.time_ns - mine.time_ns[0]) * 1e-9
    shares = {name: one["position_share"] for name, one in budget.items()}
    shown = SelfOrientationEvidence(time_s, -own_errors[inside], sigma[0], -rig_errors, sigma[1], shares)
    return SelfOrientationScores(scores, table, budget, enough_alone(found, rig), shown)


def budget_of(sides: _Sides) -> tuple[dict[str, dict[str, Any]], Array, Array]:
    """Return source -> its share, the differences (n, 6) with all sources, and with none of them."""
    variants = {name: sides.difference(frozenset({name})) for name in SOURCES}
    every, none = sides.difference(frozenset()), sides.difference(frozenset(SOURCES))
    common = sorted(set(every).intersection(none, *variants.values()))
    d, without = (np.array([one[frame] for frame in common]) for one in (every, none))
    budget = {}
    for name, told in SOURCES.items():
        change = d - np.array([variants[name][frame] for frame in common])
        budget[told] = {
            "position_share": float(np.sum(change[:, :3] * d[:, :3]) / np.sum(d[:, :3] ** 2)),
            "angle_share": float(np.sum(change[:, 3:] * d[:, 3:]) / np.sum(d[:, 3:] ** 2)),
            "mean": change.mean(axis=0).tolist(),
            "rms": np.sqrt(np.mean(change**2, axis=0)).tolist(),
        }
    return budget, d, without


def whole_frames_offset(found: SelfOrientation) -> float:
    """Return the clocks' offset to whole frames, from the first frame with the lamp lit on either side."""
    own, rig = (_first_lit(one.start_ns, one.light) for one in (found.own_light, found.rig_light))
    expected = rig + round(found.clock.offset_s * 1e9)
    k, j = divmod(int(np.argmin(np.abs(own[:, None] - expected[None]))), len(rig))
    return float(own[k] - rig[j]) * 1e-9


def _first_lit(start_ns: Array, light: Array) -> Array:
    lit = light > (light.min() + light.max()) / 2
    return np.asarray(start_ns[1:][lit[1:] & ~lit[:-1]])


def _row(difference: Array) -> dict[str, Any]:
    return {
        "mean": difference.mean(axis=0).tolist(),
        "rms": np.sqrt(np.mean(difference**2, axis=0)).tolist(),
        "frames": len(difference),
    }


def _scores(side: str, path: CameraPath, errors: Array) -> dict[str, Score]:
    n = len(errors)
    block = np.minimum(np.arange(n) * BLOCKS // n, BLOCKS - 1)
    count = np.bincount(block, minlength=BLOCKS)
    place = np.bincount(block, (errors[:, :3] ** 2).sum(axis=1), BLOCKS)
    turn = np.bincount(block, (errors[:, 3:] ** 2).sum(axis=1), BLOCKS)
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(path.total_covariance()), errors)
    return {
        f"{side}_position_rms": ratio_of_sums(place, count, n, np.sqrt),
        f"{side}_angle_rms": ratio_of_sums(turn, count, n, np.sqrt),
        f"{side}_nees": Score(float(nees.mean()), n),
    }


def _completeness(sides: _Sides, own: Resected) -> Score:
    """Return the share of frames with a pose, among those that show enough targets whole."""
    m = len(sides.there.field.targets)
    enough = (sides.frames.visible[:, :m] > 0.99).sum(axis=1) >= ResectionSettings().fewest
    wanted = set(sides.frames.index[enough].tolist())
    return Score(len(wanted & set(own.frame.tolist())) / max(len(wanted), 1), len(wanted))
