"""Layouts of the planner beside those of lab-camera-optimizer on its own rooms. Run: ``python bench_plan.py``.

Both place the same wall cameras under the limits of lab-camera-optimizer 1.2.1 (PyPI, MIT): their number, field of
view, heights, spacing, range, place on a wall, cone inside the wall's aperture, and its fixed tilt. Its layout comes
from its own optimiser with the settings that each of its rooms comes with (restarts, steps, early stop, all points
that it evaluates), in its mode for markers: the subject is a cylinder whose markers face outward. Wall cameras alone
(``count_max: 0`` of tripods), first position of the zones; its optimiser draws, here with a fixed seed.

Ours: exchange among places along the same walls (``mosca.accuracy.planning.exchange``), then among places and
directions near the best; least rms sigma, its coverage score and the share of markers measured not lower. Both are
compared by OUR predicted covariance (images of 1280 px across the wide side, 14 mm markers; a marker is measured
where two cameras see it) and by ITS coverage score, at all points that it evaluates:

- rms sigma over the markers that both measure, its ratio, and the ratio of the rms of all that each measures;
- the same with one camera fewer, where its score, which counts cameras, is free;
- ``bound``: least ratio that any layout of these places and directions could reach that measures all that its layout
  measures, by convex relaxation of the choice (Boyd and Vandenberghe, Convex Optimization, 7.5; Frank-Wolfe's gap),
  cameras' spacing included, its score not.
"""

import argparse
import contextlib
import io
import os
import random
import time
import warnings
from pathlib import Path
from typing import Any

os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from bench_plan_bound import bound

from mosca.accuracy.planning.exchange import exchanged, information_of, variances_of
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
    MarkerRoom,
)  # fmt: skip

ROOMS = (
    "demo", "example_simple", "T_zone_direction_change", "example_evaluation_CHU", "labo_CHU_bis",
    "evaluate_labo_CHU", "example_real_world",
)  # fmt: skip
"""All that it ships; its ``labo_CHU`` is ``example_real_world`` under another name."""
WIDE_PX, BODY_PX, DIAMETER_M = 1280, 0.03, 0.014
TABLES = information_table(PixelNoiseModel(12_000.0, 200.0, 10.0, 20_000 / 255))[None]
MARKERS = 2000
"""Of all that it evaluates, for the search."""
COARSE_M, COARSE_DEG = 0.3, 8.0
FINE = ((0.1, 4.0), (0.05, 2.0), (0.02, 1.0))
"""Steps along walls [m] and of directions [deg] of the refinements, one after another."""
NEAR = 2
"""Fine steps to both sides of a camera."""
ROUNDS, LEAST_GAIN = 3, 1e-3
"""Refinements with the same steps, at most, and the gain of log sigma below which they end."""
FINE_STARTS = 2
RESERVE = 0.002
"""Of its score and of the share measured: what holds at the search's points must hold at all."""
SHARE_COST, SCORE_COST, HARD = 30.0, 3.0, 100.0
"""What is missing in the share and the score, as a change of log sigma; HARD times as much in the end."""
Cameras = list[tuple[Any, ...]]


class TheirRoom:
    """A room, cameras and scores as lab-camera-optimizer has them."""

    def __init__(self, name: str) -> None:
        import lab_camera_optimizer
        from core import candidates, config_loader, room

        path = Path(lab_camera_optimizer.__file__).parent / "configs" / f"{name}.yaml"
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self.cfg = cfg = config_loader.load_config(str(path))
        cfg.camera_sets = [one for one in cfg.camera_sets if one.mounting == "wall"]
        cfg.CAPTURE_MODE = cfg.opt.capture_mode = "markerbased"
        cfg.MARKER_BODY = cfg.opt.marker_body = "cylinder"
        self.cameras = cfg.camera_sets[0]
        self.state = self._state(room)
        self.points = candidates.build_sample_points(cfg, self.state)
        self.walls = self._walls(room)

    def _state(self, room: Any) -> dict[str, Any]:
        """Return what its ``optimize.py`` makes of the first position of the zones."""
        cfg = self.cfg
        x0, walk_y = cfg.CORRIDOR_X_STARTS[0], cfg.ZONE_Y_WALKS[0]
        x1, start = x0 + cfg.CORRIDOR_LENGTH, x0 + cfg.ZONE_OFFSETS[0]
        end, at = start + cfg.ZONE_LENGTH, (start + cfg.ZONE_LENGTH / 2, walk_y)
        polygons = [one for one in cfg.capture_zones if one.type == "polygon"]
        for one in polygons:
            one._translated_vertices = [(x + one.x_offsets[0], y + one.y_offsets[0]) for x, y in one.vertices]
        if cfg.CORRIDOR_LENGTH == 0 and polygons:
            x = np.concatenate([np.array(one._translated_vertices)[:, 0] for one in polygons])
            x0 = start = float(x.min())
            x1 = end = float(x.max())
            first = max(polygons, key=lambda one: one.priority)
            at = tuple(np.mean(first._translated_vertices, axis=0))
            walk_y = float(at[1])
        return {
            "walk_y": walk_y, "walk_x_start": x0, "walk_x_end": x1, "analysis_x_start": start, "analysis_x_end": end,
            "sts_x": at[0], "sts_y": at[1],
            "wall_segments": room.build_wall_segments(cfg.ROOM_CORNERS, cfg.obstacles, cfg.ROOM_HEIGHT),
        }  # fmt: skip

    def _walls(self, room: Any) -> list[tuple[np.ndarray, np.ndarray, float]]:
        """Return where its cameras may stand: start, end, direction of the normal into the room [deg]."""
        cfg, found = self.cfg, []
        outlines = [cfg.ROOM_CORNERS] + [
            one["vertices"] for one in cfg.obstacles if one["height"] >= cfg.ROOM_HEIGHT and one["can_mount_camera"]
        ]
        for outline in outlines:
            corners = np.array(outline, float)
            for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                along = end - start
                normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
                for side in (normal, -normal):
                    before = (start + end) / 2 + 0.1 * side
                    if room.point_in_room(*before, cfg.ROOM_CORNERS, cfg.obstacles, cfg.ROOM_HEIGHT):
                        found.append((start, end, float(np.degrees(np.arctan2(side[1], side[0])))))
                        break
        return found

    def layout(self, seed: int) -> Cameras:
        """Return its own layout."""
        from core import candidates, greedy

        cfg = self.cfg
        random.seed(seed)
        found, none = candidates.generate_candidates(
            cfg, self.state, wall_step=cfg.WALL_STEP, angle_steps=cfg.ANGLE_STEPS,
            tripod_grid_step=cfg.TRIPOD_GRID_STEP, sample_points=self.points,
        )  # fmt: skip
        with contextlib.redirect_stdout(io.StringIO()):
            placed = greedy.greedy_place_cameras(
                found, none, self.points, cfg, self.state, n_restarts=cfg.opt.restarts_per_combo, quiet=True
            )
        return list(placed[0])

    def score(self, cameras: Cameras) -> float:
        """Return its coverage score at all its points."""
        from core import scoring

        return float(scoring.score_configuration(cameras, [], self.points, self.cfg, self.state)[0])

    def standing(self, wall: int, along_m: float, angles: np.ndarray) -> Cameras:
        """Return cameras ``along_m`` from the start of a wall with each height and orientation, and with the
        directions nearest to ``angles`` [deg] that its limits allow there.
        """
        from core import candidates, room, scoring

        start, end, normal = self.walls[wall]
        length = float(np.linalg.norm(end - start))
        x, y = (float(one) for one in start + (end - start) * np.clip(along_m / length, 0, 1))
        limits = room.wall_angular_limits(x, y, self.state["wall_segments"])
        found = set()
        for orientation in "LP":
            fov, _ = scoring.get_fov(self.cameras, orientation)
            most = max(0.0, 92.0 - fov / 2)
            off = np.clip((angles - normal + 180) % 360 - 180, -most, most)
            for one in normal + off:
                angle = float(candidates._clamp_angle_to_aperture(one, fov, limits)[0])
                found |= {(x, y, round(angle, 3), orientation, height) for height in self.cameras.height_options}
        return sorted(found) if limits[0][0] is not None else []

    def everywhere(self) -> Cameras:
        """Return cameras at COARSE_M along all walls."""
        found = []
        for k, (start, end, normal) in enumerate(self.walls):
            for along in np.linspace(0, (length := float(np.linalg.norm(end - start))), int(length / COARSE_M) + 2):
                found += self.standing(k, along, normal + np.arange(-60, 61, COARSE_DEG))
        return found

    def near(self, camera: tuple[Any, ...], step_m: float, step_deg: float) -> Cameras:
        """Return cameras near one on a wall, by NEAR steps along the wall and of its direction."""
        found, at, steps = [], np.array(camera[:2]), np.arange(-NEAR, NEAR + 1)
        for k, (start, end, _) in enumerate(self.walls):
            length = float(np.linalg.norm(end - start))
            along = float((at - start) @ (end - start)) / length
            if np.linalg.norm(start + (end - start) * np.clip(along / length, 0, 1) - at) < 1e-6:
                for step in steps:
                    found += self.standing(k, along + step_m * step, camera[2] + step_deg * steps)
        return found


class Scores(dict[int, dict[int, Any]]):
    """Its score of chosen candidates at some points; what a candidate covers is asked of it once."""

    def __init__(self, there: TheirRoom, candidates: Cameras, points: list[Any], covered: dict[Any, Any]) -> None:
        from core import scoring

        super().__init__()
        self.asked = lambda cameras: scoring.precompute_coverage(cameras, [], points, there.cfg, there.state)
        self.summed = lambda chosen, meta: float(scoring.score_indexed(chosen, [], self, [], meta, there.cfg)[0])
        self.candidates, self.meta, self.covered = candidates, self.asked([])[2], covered

    def __missing__(self, chosen: int) -> dict[int, Any]:
        camera = self.candidates[chosen]
        if camera not in self.covered:
            self.covered[camera] = self.asked([camera])[0][0]
        self[chosen] = self.covered[camera]
        return self[chosen]

    def of(self, chosen: list[int]) -> float:
        """Return its score."""
        return self.summed(chosen, self.meta)


class Ours:
    """Our covariance of its cameras and markers."""

    def __init__(self, there: TheirRoom, points: list[Any]) -> None:
        from core import scoring

        self.there, cfg = there, there.cfg
        self.known: dict[tuple[Any, ...], np.ndarray] = {}
        self.covered: dict[tuple[Any, ...], dict[int, Any]] = {}
        rows = np.array([m for x, y, w in points for m in scoring.cylinder_markers(x, y, w, cfg)])
        angle = np.round(np.degrees(np.arctan2(rows[:, 4], rows[:, 3])), 3)
        rows = rows[np.argsort(angle, kind="stable")]
        self.at, self.weight = rows[:, :3], rows[:, 5] / rows[:, 5].sum()
        obstacles = obstacle_rows(_bodies(cfg))
        self.rooms = []
        for one in np.unique(angle):
            of_one = rows[np.sort(angle) == one]
            normal = np.array([[*of_one[0, 3:5], 0.0]])
            self.rooms.append(MarkerRoom(of_one[:, :3], normal, np.zeros(3), DIAMETER_M, obstacles, TABLES))

    def information(self, cameras: Cameras) -> np.ndarray:
        """Return what each camera tells of each marker (c, n, 6), within its range."""
        new = [one for one in dict.fromkeys(cameras) if one not in self.known]
        if new:
            self.known |= dict(zip(new, self._information(new), strict=True))
        return np.array([self.known[one] for one in cameras])

    def _information(self, cameras: Cameras) -> np.ndarray:
        rows = self.rows(cameras)
        found = np.concatenate([information_of(rows, one) for one in self.rooms], axis=1)
        away = np.linalg.norm(rows[:, None, :2] - self.at[:, :2], axis=2)
        limits = self.there.cameras
        found[(away > limits.max_range) | (away < limits.min_range)] = 0.0
        return found

    def variances(self, cameras: Cameras) -> np.ndarray:
        """Return the variance (n,) [m^2] of all markers, infinite where fewer than two cameras see one."""
        return variances_of(self.information(cameras), range(len(cameras)))

    def rows(self, cameras: Cameras) -> np.ndarray:
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


def _bodies(cfg: Any) -> list[Obstacle]:
    """Return its obstacles, as boxes around them, and walls."""
    bodies = []
    for one in cfg.obstacles:
        corners = np.array(one["vertices"], float)
        low, high = corners.min(axis=0), corners.max(axis=0)
        size = np.maximum(high - low, 1e-3)
        bodies.append(Obstacle("box", (*(low + high) / 2, one["height"] / 2), (*size, one["height"])))
    corners = np.array(cfg.ROOM_CORNERS, float)
    x, y = corners.T
    if float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) < 0:
        corners = corners[::-1]
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = end - start
        outward = np.array([along[1], -along[0]]) / np.linalg.norm(along)
        size = (float(np.linalg.norm(along)) - 0.02, 0.02, cfg.ROOM_HEIGHT)
        yaw = float(np.degrees(np.arctan2(along[1], along[0])))
        bodies.append(Obstacle("box", (*((start + end) / 2 + 0.03 * outward), cfg.ROOM_HEIGHT / 2), size, yaw))
    return bodies


class Search:
    """Layouts of ``count`` cameras that are not worse than ``start`` in its score and in what is measured.

    ``few``: of about MARKERS markers, with RESERVE, not all.
    """

    def __init__(
        self, there: TheirRoom, start: Cameras, count: int, candidates: Cameras, few: bool, ours: "Ours | None" = None
    ) -> None:
        self.there, self.start, self.count = there, start, count
        a_point = there.cfg.opt.marker_ring * there.cfg.opt.marker_levels
        points = there.points[:: max(1, round(len(there.points) * a_point / MARKERS))] if few else there.points
        self.ours, self.candidates = ours or Ours(there, points), start + candidates
        reserve, self.hard = RESERVE if few else 0.0, 1.0
        self.information = self.ours.information(self.candidates)
        self.places = np.array([one[:2] for one in self.candidates])
        scores = Scores(there, self.candidates, points, self.ours.covered)
        first = list(range(len(start)))
        self.score, self.least = scores.of, scores.of(first) * (1 + reserve)
        self.theirs = np.isfinite(variances_of(self.information, first))
        self.share = float(self.ours.weight @ self.theirs) + reserve

    def cost(self, variances: np.ndarray) -> np.ndarray:
        """Return log rms sigma of the markers that theirs measures too, and what a lower share costs."""
        weight, seen = self.ours.weight, np.isfinite(variances)
        squares = np.where(seen, variances, 0.0) @ (weight * self.theirs)
        both = seen @ (weight * self.theirs)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = 0.5 * np.log(squares / both) + self.hard * SHARE_COST * np.maximum(
                0.0, self.share - seen @ weight
            )
        return np.asarray(np.where(both > 0, found, np.inf))

    def more(self, chosen: list[int]) -> float:
        """Return what a lower score costs; nothing with fewer cameras, whose number it counts."""
        if self.count < len(self.start):
            return 0.0
        return self.hard * SCORE_COST * max(0.0, 1.0 - self.score(chosen) / self.least)

    def beside(self, others: list[int]) -> np.ndarray:
        """Return which candidates keep the spacing."""
        away = np.linalg.norm(self.places[:, None] - self.places[others], axis=2)
        return np.asarray((away >= self.there.cameras.min_spacing - 1e-9).all(axis=1))

    def drawn(self, draw: np.random.Generator) -> list[int]:
        """Return candidates to begin with, as far apart as it asks."""
        while True:
            chosen: list[int] = []
            while len(chosen) < self.count and (free := self.beside(chosen)).any():
                chosen.append(int(draw.choice(np.flatnonzero(free))))
            if len(chosen) == self.count:
                return chosen

    def found(self, chosen: list[int]) -> tuple[float, Cameras]:
        """Return cost and cameras after exchanges."""
        best, cost = exchanged(self.information, chosen, self.cost, self.beside, more=self.more)
        return cost, [self.candidates[k] for k in best]


def planned(coarse: Search, starts: int) -> list[Cameras]:
    """Return our layouts under its limits, the best first."""
    draw = np.random.default_rng(1)
    begin = [coarse.drawn(draw) for _ in range(starts)]
    if coarse.count == len(coarse.start):
        begin[0] = list(range(coarse.count))
    found = sorted((coarse.found(one) for one in begin), key=lambda one: one[0])
    layouts = {tuple(sorted(cameras)): cameras for _, cameras in found}
    fine = [refined(coarse, cameras) for cameras in list(layouts.values())[:FINE_STARTS]]
    return [one for _, one in sorted([*fine, *found], key=lambda one: one[0])]


def refined(coarse: Search, cameras: Cameras) -> tuple[float, Cameras]:
    """Return cost and cameras after exchanges among near ones, whose steps shrink, at all points."""
    there, first = coarse.there, len(coarse.start)
    ours = Ours(there, there.points)
    for step, hard in (*((one, 1.0) for one in FINE), (FINE[-1], HARD)):
        before = np.inf
        for _ in range(ROUNDS):
            near = [other for one in cameras for other in there.near(one, *step)]
            search = Search(there, coarse.start, coarse.count, cameras + near, False, ours)
            search.hard = hard
            cost, cameras = search.found(list(range(first, first + coarse.count)))
            if cost > before - LEAST_GAIN:
                break
            before = cost
    return cost, cameras


class Compared:
    """A layout beside its own, at all points that it evaluates."""

    def __init__(self, there: TheirRoom, theirs: Cameras) -> None:
        self.there, self.theirs, self.ours = there, theirs, Ours(there, there.points)
        self.variances, self.score = self.ours.variances(theirs), there.score(theirs)
        self.share = self._share(self.variances)

    def _share(self, variances: np.ndarray) -> float:
        return float(self.ours.weight @ np.isfinite(variances))

    def _rms(self, variances: np.ndarray, seen: np.ndarray) -> float:
        return float(np.sqrt(np.average(variances[seen], weights=self.ours.weight[seen])))

    def first_allowed(self, layouts: list[Cameras]) -> list[float]:
        """Return rms sigma of both [mm], their ratio, that of all that each measures, share measured [%] and score
        of the first layout that is not worse in these two, with fewer cameras in the share; NaN without one.
        """
        for cameras in layouts:
            variances, score = self.ours.variances(cameras), self.there.score(cameras)
            share = self._share(variances)
            fewer = len(cameras) < len(self.theirs)
            if share < self.share - 1e-12 or (score < self.score and not fewer):
                continue
            each = [self._rms(one, np.isfinite(one)) for one in (self.variances, variances)]
            both = np.isfinite(variances) & np.isfinite(self.variances)
            rms = [self._rms(one, both) for one in (self.variances, variances)]
            return [1e3 * rms[0], 1e3 * rms[1], rms[1] / rms[0], each[1] / each[0], 100 * share, score]
        return [np.nan] * 6


def compared(name: str, seed: int, starts: int, steps: int) -> str:
    """Return a line of the table."""
    begun = time.process_time()
    there = TheirRoom(name)
    theirs = there.layout(seed)
    their_s, begun = time.process_time() - begun, time.process_time()
    coarse, found = Search(there, theirs, len(theirs), there.everywhere(), few=True), Compared(there, theirs)
    same = found.first_allowed(planned(coarse, starts))
    our_s = time.process_time() - begun
    least = bound(coarse, steps) / _least_of(coarse) if steps else np.nan
    coarse.count, begun = coarse.count - 1, time.process_time()
    fewer = found.first_allowed(planned(coarse, starts))
    fewer_s = time.process_time() - begun
    seconds = f"{their_s:6.1f} {our_s:6.1f} {fewer_s:6.1f}"
    return (
        f"{name:24s} {len(theirs):2d} {same[0]:7.3f} {same[1]:7.3f} {same[2]:6.3f} {same[3]:6.3f} {least:6.3f}"
        f" {100 * found.share:6.2f} {same[4]:6.2f} {found.score:8.3f} {same[5]:8.3f} |"
        f" {fewer[2]:6.3f} {fewer[3]:6.3f} {fewer[4]:6.2f} {fewer[5]:8.3f} | {seconds}"
    )


def _least_of(search: Search) -> float:
    """Return the rms sigma [m] of its layout at the search's points."""
    variances = variances_of(search.information, range(len(search.start)))
    return float(np.sqrt(np.average(variances[search.theirs], weights=search.ours.weight[search.theirs])))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", nargs="*", default=list(ROOMS))
    parser.add_argument("--seed", type=int, default=1, help="of its optimiser")
    parser.add_argument("--starts", type=int, default=8)
    parser.add_argument("--bound", type=int, default=150, help="steps for the bound; 0: none")
    given = parser.parse_args()
    print(
        "room, cameras; rms sigma [mm] theirs, ours; ratio, ratio of all that each measures, bound; measured [%] and"
        " its score, theirs, ours | with one camera fewer: ratio, of all, measured, score | processor time [s]"
        " theirs, ours, with one fewer",
        flush=True,
    )
    for name in given.rooms:
        print(compared(name, given.seed, given.starts, given.bound), flush=True)


if __name__ == "__main__":
    main()
