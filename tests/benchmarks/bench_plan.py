"""Layouts of the planner beside those of lab-camera-optimizer on its own rooms. Run: ``python bench_plan.py``.

Both place the same wall cameras under the limits of lab-camera-optimizer 1.2.1 (PyPI, MIT): their number, field of
view, heights, spacing, place on a wall, cone inside the wall's aperture, and its fixed tilt. Its rooms, first
position of the zones, wall cameras alone; its marker mode, in which the subject is a cylinder whose markers face
outward. Both are compared by OUR predicted covariance (rms sigma of the markers that both measure, images of 1280 px
across the wide side, 14 mm markers) and by ITS coverage score.

Here CMA-ES starts from its layout and minimises our sigma, with its score as a constraint.
"""

import argparse
import contextlib
import io
import os
import time
import warnings
from pathlib import Path
from typing import Any

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cma
import numpy as np

from mosca.accuracy.planning.image_noise import PixelNoiseModel, information_table
from mosca.accuracy.planning.obstacles import Obstacle, obstacle_rows
from mosca.accuracy.planning.views import (
    BLUR,
    COLUMNS,
    EXTRA,
    HALF_HEIGHT,
    HALF_WIDTH,
    PAN,
    SCALE,
    TILT,
    Softness,
    gather,
)  # fmt: skip

ROOMS = ("demo", "example_simple", "example_real_world", "labo_CHU_bis", "T_zone_direction_change")
WIDE_PX, BODY_PX, DIAMETER_M, UNSEEN_M = 1280, 0.03, 0.014, 0.05
NOISE = PixelNoiseModel(12_000.0, 200.0, 10.0, 20_000 / 255)
TABLES = information_table(NOISE)[None]
GRID_M = 0.1
POINTS = 60
"""Places of the subject, of all that it scores."""


class TheirRoom:
    """A room, cameras and scores as lab-camera-optimizer has them."""

    def __init__(self, name: str, restarts: int) -> None:
        import lab_camera_optimizer
        from core import candidates, config_loader, room

        path = Path(lab_camera_optimizer.__file__).parent / "configs" / f"{name}.yaml"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self.cfg = cfg = config_loader.load_config(str(path))
        cfg.camera_sets = [one for one in cfg.camera_sets if one.mounting == "wall"]
        cfg.CAPTURE_MODE = cfg.opt.capture_mode = "markerbased"
        cfg.MARKER_BODY = cfg.opt.marker_body = "cylinder"
        cfg.opt.restarts_per_combo = restarts
        self.cameras = cfg.camera_sets[0]
        self.state = self._state(room)
        everywhere = candidates.build_sample_points(cfg, self.state)
        step = max(1, len(everywhere) // POINTS)
        self.points = everywhere[::step]
        self.walls = self._walls(room)

    def _state(self, room: Any) -> dict[str, Any]:
        cfg = self.cfg
        x0 = cfg.CORRIDOR_X_STARTS[0]
        walk_y, x1 = cfg.ZONE_Y_WALKS[0], x0 + cfg.CORRIDOR_LENGTH
        start, end = x0 + cfg.ZONE_OFFSETS[0], x0 + cfg.ZONE_OFFSETS[0] + cfg.ZONE_LENGTH
        polygons = [one for one in cfg.capture_zones if one.type == "polygon"]
        if cfg.CORRIDOR_LENGTH == 0 and polygons:
            corners = np.concatenate([np.array(one.vertices) for one in polygons])
            x0, x1 = start, end = corners[:, 0].min(), corners[:, 0].max()
            first = max(polygons, key=lambda one: one.priority)
            walk_y = float(np.mean([y for _, y in first.vertices]))
        return {
            "walk_y": walk_y, "walk_x_start": x0, "walk_x_end": x1, "analysis_x_start": start, "analysis_x_end": end,
            "sts_x": (start + end) / 2, "sts_y": walk_y,
            "wall_segments": room.build_wall_segments(cfg.ROOM_CORNERS, cfg.obstacles, cfg.ROOM_HEIGHT),
        }  # fmt: skip

    def _walls(self, room: Any) -> list[tuple[float, float, float, Any]]:
        """Return places along the room's walls: x, y, direction of the normal [deg], angular limits."""
        cfg, found = self.cfg, []
        corners = np.array(cfg.ROOM_CORNERS, float)
        for one, other in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            along = (other - one) / np.linalg.norm(other - one)
            normal = np.array([-along[1], along[0]])
            middle = (one + other) / 2 + 0.1 * normal
            if not room.point_in_room(*middle, cfg.ROOM_CORNERS, cfg.obstacles, cfg.ROOM_HEIGHT):
                normal = -normal
            steps = int(np.linalg.norm(other - one) / GRID_M)
            for k in range(1, steps):
                x, y = one + (other - one) * k / steps
                limits = room.wall_angular_limits(x, y, self.state["wall_segments"])
                found.append((float(x), float(y), float(np.degrees(np.arctan2(normal[1], normal[0]))), limits))
        return found

    def layout(self) -> list[tuple[Any, ...]]:
        """Return its own layout."""
        from core import candidates, greedy

        cfg = self.cfg
        found, none = candidates.generate_candidates(
            cfg, self.state, wall_step=cfg.WALL_STEP, angle_steps=cfg.ANGLE_STEPS,
            tripod_grid_step=cfg.TRIPOD_GRID_STEP, sample_points=self.points,
        )  # fmt: skip
        with contextlib.redirect_stdout(io.StringIO()):
            placed = greedy.greedy_place_cameras(
                found, none, self.points, cfg, self.state, n_restarts=cfg.opt.restarts_per_combo, quiet=True
            )
        return list(placed[0])

    def score(self, cameras: list[tuple[Any, ...]]) -> float:
        """Return its coverage score."""
        from core import scoring

        return float(scoring.score_configuration(cameras, [], self.points, self.cfg, self.state)[0])

    def clamped(self, place: tuple[Any, ...], angle: float, orientation: str) -> float:
        """Return the direction [deg] nearest to ``angle`` that its limits allow at a place on a wall."""
        from core import candidates, scoring

        fov, _ = scoring.get_fov(self.cameras, orientation)
        most = max(0.0, 92.0 - fov / 2)
        off = np.clip((angle - place[2] + 180) % 360 - 180, -most, most)
        return float(candidates._clamp_angle_to_aperture(place[2] + off, fov, place[3])[0])


class Ours:
    """Our covariance of its cameras and markers."""

    def __init__(self, there: TheirRoom) -> None:
        from core import scoring

        self.there, cfg = there, there.cfg
        markers = [m for x, y, w in there.points for m in scoring.cylinder_markers(x, y, w, cfg)]
        rows = np.array([one[:5] for one in markers])
        self.weight = np.array([one[5] for one in markers])
        angle = np.round(np.degrees(np.arctan2(rows[:, 4], rows[:, 3])), 3)
        self.groups = [np.flatnonzero(angle == one) for one in np.unique(angle)]
        self.at, self.normals = rows[:, :3], np.column_stack([rows[:, 3:], np.zeros(len(rows))])
        bodies = []
        for one in cfg.obstacles:
            corners = np.array(one["vertices"], float)
            low, high = corners.min(axis=0), corners.max(axis=0)
            height = one.get("height", cfg.ROOM_HEIGHT)
            size = np.maximum(high - low, 1e-3)
            bodies.append(Obstacle("box", (*(low + high) / 2, height / 2), (*size, height)))
        corners = np.array(cfg.ROOM_CORNERS, float)
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            along = end - start
            outward = np.array([along[1], -along[0]]) / np.linalg.norm(along)
            if not _anticlockwise(corners):
                outward = -outward
            size = (float(np.linalg.norm(along)) - 0.02, 0.02, cfg.ROOM_HEIGHT)
            yaw = float(np.degrees(np.arctan2(along[1], along[0])))
            bodies.append(Obstacle("box", (*((start + end) / 2 + 0.03 * outward), cfg.ROOM_HEIGHT / 2), size, yaw))
        self.obstacles = obstacle_rows(bodies)

    def rows(self, cameras: list[tuple[Any, ...]]) -> np.ndarray:
        """Return rows of its cameras for ``mosca.accuracy.planning.views``: fixed tilt, WIDE_PX wide."""
        from core import room, scoring

        rows = np.zeros((len(cameras), COLUMNS))
        for k, (x, y, angle, orientation, height) in enumerate(cameras):
            wide, high = (np.tan(np.deg2rad(fov / 2)) for fov in scoring.get_fov(self.there.cameras, orientation))
            scale = WIDE_PX / 2 / max(wide, high)
            tilt = room.cam_fixed_tilt(x, y, height, angle, self.there.state["walk_y"], self.there.cfg.HUMAN_HEIGHT)
            rows[k, :3], rows[k, PAN], rows[k, TILT] = (x, y, height), np.deg2rad(angle), tilt
            rows[k, SCALE], rows[k, HALF_WIDTH], rows[k, HALF_HEIGHT] = scale, scale * wide, scale * high
            rows[k, BLUR], rows[k, EXTRA] = 0.6**2 + 1 / 12, BODY_PX**2
        return rows

    def sigma(self, cameras: list[tuple[Any, ...]], soft: Softness, unseen_m: float) -> np.ndarray:
        """Return sigma (n,) [m] of all markers; with ``unseen_m`` = inf those that one camera sees are infinite."""
        rows, found = self.rows(cameras), np.full(len(self.at), np.inf)
        for group in self.groups:
            total, count = gather(
                rows,
                self.at[group],
                self.normals[group[:1]],
                self.obstacles,
                np.zeros(3),
                DIAMETER_M,
                TABLES,
                soft.row,
            )
            matrix = np.zeros((len(group), 3, 3))
            upper = np.triu_indices(3)
            matrix[:, upper[0], upper[1]] = matrix[:, upper[1], upper[0]] = total[:, 0]
            good = count[:, 0] > 1.5 if np.isinf(unseen_m) else np.ones(len(group), bool)
            matrix += np.eye(3) * (0.0 if np.isinf(unseen_m) else unseen_m**-2)
            inverse = np.linalg.inv(matrix[good])
            found[group[good]] = np.sqrt(np.trace(inverse, axis1=1, axis2=2))
        return found


def planned(there: TheirRoom, ours: Ours, start: list[tuple[Any, ...]], evaluations: int) -> list[tuple[Any, ...]]:
    """Return our layout under its limits, its score not lower than that of ``start``."""
    count, heights = len(start), list(there.cameras.height_options)
    least, spacing = there.score(start), there.cameras.min_spacing
    best: list[Any] = [start, np.inf]

    def cameras_of(x: np.ndarray) -> list[tuple[Any, ...]]:
        found = []
        for s, pan, height, portrait in np.asarray(x).reshape(count, 4):
            place = there.walls[int((s % 1.0) * len(there.walls))]
            orientation = "P" if portrait > 0.5 else "L"
            angle = there.clamped(place, place[2] + 60 * pan, orientation)
            found.append(
                (place[0], place[1], angle, orientation, heights[int(np.clip(height, 0, 0.999) * len(heights))])
            )
        return found

    def value(x: np.ndarray) -> float:
        cameras = cameras_of(x)
        places = np.array([one[:2] for one in cameras])
        apart = np.linalg.norm(places[:, None] - places, axis=2) + 1e9 * np.eye(count)
        short = np.maximum(0.0, spacing - apart).sum()
        cost = float(np.log(np.sqrt(np.average(ours.sigma(cameras, Softness(), UNSEEN_M) ** 2, weights=ours.weight))))
        cost += 3.0 * short
        # its score takes long: asked only of layouts that would be the best
        if short == 0.0 and cost < best[1]:
            score = there.score(cameras)
            if score >= least:
                best[:] = [cameras, cost]
            else:
                cost += 2.0 * (1.0 - score / least)
        return cost

    first = []
    for x, y, angle, orientation, height in start:
        k = int(np.argmin([np.hypot(one[0] - x, one[1] - y) for one in there.walls]))
        off = (angle - there.walls[k][2] + 180) % 360 - 180
        first += [
            (k + 0.5) / len(there.walls),
            off / 60,
            (heights.index(height) + 0.5) / len(heights),
            float(orientation == "P"),
        ]
    options = {"verbose": -9, "maxfevals": evaluations // 2, "CMA_stds": [0.08, 0.3, 0.3, 0.3] * count}
    for seed, begin in ((1, first), (2, None)):
        if begin is None:
            begin = np.column_stack(
                [(np.arange(count) + 0.5) / count, *np.full((3, count), [[0.0], [0.5], [0.2]])]
            ).ravel()
        cma.CMAEvolutionStrategy(begin, 1.0, {**options, "seed": seed}).optimize(value)
    return best[0]


def _anticlockwise(corners: np.ndarray) -> bool:
    x, y = corners.T
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) > 0


def compared(name: str, restarts: int, evaluations: int) -> str:
    """Return a line of the table."""
    there = TheirRoom(name, restarts)
    ours = Ours(there)
    begun = time.process_time()
    their_layout = there.layout()
    their_s, begun = time.process_time() - begun, time.process_time()
    our_layout = planned(there, ours, their_layout, evaluations)
    our_s = time.process_time() - begun
    sigmas = [ours.sigma(one, Softness(), np.inf) for one in (their_layout, our_layout)]
    both = np.isfinite(sigmas).all(axis=0)
    rms = [float(np.sqrt(np.average(one[both] ** 2, weights=ours.weight[both]))) for one in sigmas]
    seen = [float(np.average(np.isfinite(one), weights=ours.weight)) for one in sigmas]
    scores = [there.score(one) for one in (their_layout, our_layout)]
    return (
        f"{name:26s} {len(their_layout):2d} {1e3 * rms[0]:8.3f} {1e3 * rms[1]:8.3f}"
        f" {100 * (rms[1] / rms[0] - 1):+6.1f} %"
        f" {100 * seen[0]:6.1f} {100 * seen[1]:6.1f} {scores[0]:9.3f} {scores[1]:9.3f} {their_s:7.1f} {our_s:7.1f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", nargs="*", default=list(ROOMS))
    parser.add_argument("--restarts", type=int, default=8)
    parser.add_argument("--evaluations", type=int, default=6000)
    given = parser.parse_args()
    print("room, cameras; rms sigma [mm] theirs, ours; measured [%]; its score; processor time [s]", flush=True)
    for name in given.rooms:
        print(compared(name, given.restarts, given.evaluations), flush=True)


if __name__ == "__main__":
    main()
