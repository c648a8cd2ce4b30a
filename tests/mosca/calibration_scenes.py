"""Calibrations for the tests of the judgement: closed-form projections, stated noise, the solver."""

from dataclasses import replace

import numpy as np
from bundle_scenes import HEIGHT, WIDTH, ring
from rigs import looking_at
from scipy.spatial.transform import Rotation

from mosca.calibration.bundle.solver import (
    BundleSettings,
    CameraUnknowns,
    ObjectPoints,
    Observations,
    Placements,
    Problem,
    solve,
)
from mosca.camera.projection import project_with_jacobians
from mosca.data.calibration import Calibration
from mosca.data.rig import Camera, OpenCVLens, Pose, Rig
from mosca.data.sightings import Sightings

NOISE_PX = 0.05
DIAMETER_M = 0.03
LENS = ("f_px", "cx_px", "cy_px", "k1", "k2")


def field_points(rng, extent=(2.4, 2.4, 1.6), n=(5, 5, 4)) -> np.ndarray:
    axes = [np.linspace(-e / 2, e / 2, k) for e, k in zip(extent, n, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid + rng.uniform(-0.05, 0.05, grid.shape) * np.minimum(np.array(extent), 1) + [0, 0, 1]


def seen(cameras, world, rng, noise_px=NOISE_PX, placement=-1, frame=0, marks=None, scale=1.0, keep=1.0):
    """Return rows (camera, frame, mark, placement, x, y, diameter) of what the cameras see."""
    rows = []
    for k, camera in enumerate(cameras):
        p = project_with_jacobians(camera, world)
        inside = ((p.xy_px > 3) & (p.xy_px < (WIDTH - 4, HEIGHT - 4))).all(axis=1)
        inside &= rng.random(len(world)) < keep
        size = np.linalg.svd(np.nan_to_num(p.by_point), compute_uv=False)[:, 1] * DIAMETER_M / scale
        for m in np.flatnonzero(inside):
            xy = p.xy_px[m] + rng.normal(0, noise_px, 2)
            mark = m if marks is None else marks[m]
            rows.append((k, frame, mark, placement, *xy, size[m] * (1 + rng.normal(0, 0.02))))
    return rows


def calibration_of(cameras, start, free, rows, marks, target, placements=(), held_first=False, noise_px=NOISE_PX,
                   *, free_marks=False, settings=None) -> Calibration:  # fmt: skip
    """Solve and return the calibration; ``marks`` fixed, cameras free."""
    table = np.array(rows)
    camera, frame, mark, placement = (table[:, k].astype(int) for k in range(4))
    unknowns = tuple(CameraUnknowns(c, free, held=held_first and k == 0) for k, c in enumerate(start))
    points = ObjectPoints.free(marks) if free_marks else ObjectPoints.fixed(marks)
    things = Placements.of(placements)
    see = Observations(camera, mark, table[:, 4:6], placement, noise_px)
    problem = Problem(unknowns, see, points, things, datum="points" if free_marks else "given")
    done = solve(problem, settings or BundleSettings(tolerance=1e-4))
    p = done.precision
    sightings = Sightings(
        tuple(c.name for c in cameras),
        np.array([(c.width, c.height) for c in cameras]),
        int(frame.max()) + 1,
        camera,
        frame,
        mark,
        table[:, 4:6],
        np.tile(noise_px**2 * np.eye(2), (len(table), 1, 1)),
        table[:, 6],
    )
    return Calibration(
        Rig(done.cameras), target, sightings, done.parameters, p.covariance, done.residuals_px, done.used,
        done.points, placement, done.placements.rotation, done.placements.translation, done.sigma0,
        np.column_stack([p.sigma_x_px, p.sigma_y_px]), np.column_stack([p.sigma_x_m, p.sigma_y_m]),
        done.weak, done.held, 0.0, "the target's file"
    )  # fmt: skip


def disturbed(cameras, rng, turn=0.01, shift=0.02, focal=1.01, keep_lens=False):
    out = []
    for c in cameras:
        pose = c.world_from_camera
        w = Rotation.from_rotvec(rng.normal(0, turn, 3)).as_matrix()
        pose = Pose(pose.rotation @ w, pose.translation + rng.normal(0, shift, 3))
        lens = c.lens if keep_lens else replace(c.lens, fx_px=c.lens.fx_px * focal, fy_px=c.lens.fy_px * focal)
        out.append(replace(c, world_from_camera=pose, lens=lens))
    return out


def good_rig(rng, n=None) -> list[Camera]:
    n = n or int(rng.integers(2, 6))
    cameras = ring(n, radius=float(rng.uniform(2.6, 3.6)), seed=int(rng.integers(1 << 30)))
    out = []
    for c in cameras:
        f = float(rng.uniform(900, 1300))
        lens = OpenCVLens(f, f * 1.001, 640 + rng.normal(0, 8), 510 + rng.normal(0, 8), k1=rng.uniform(-0.12, 0.05),
                          k2=rng.uniform(-0.02, 0.02))  # fmt: skip
        out.append(replace(c, lens=lens))
    return out


def field_calibration(seed, cameras=None, points=None, noise_px=NOISE_PX, free=LENS, scale=1.0, **kw) -> Calibration:
    """Return a rig calibrated from one view of a known field; ``scale``: its file's lengths over the true ones."""
    rng = np.random.default_rng(seed)
    cameras = good_rig(rng) if cameras is None else cameras
    world = field_points(rng) if points is None else points
    rows = seen(cameras, world, rng, noise_px)
    start = [
        replace(c, world_from_camera=Pose(c.world_from_camera.rotation, c.world_from_camera.translation * scale))
        for c in disturbed(cameras, rng)
    ]
    return calibration_of(cameras, start, free, rows, world * scale, "field", noise_px=noise_px, **kw)


def board_points(columns=8, rows=6, pitch=0.06) -> np.ndarray:
    x, y = np.meshgrid(np.arange(columns) * pitch, np.arange(rows) * pitch)
    grid = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    return grid - grid.mean(axis=0)


def board_poses(rng, count, tilt=0.6, spread=0.5, towards=(0.0, 0.0, 0.0)) -> list[Pose]:
    """Return boards about (0, 0, 1) that face up, tilted."""
    poses = []
    for _ in range(count):
        turn = Rotation.from_rotvec([*rng.uniform(-tilt, tilt, 2), rng.uniform(-3, 3)])
        poses.append(Pose(turn.as_matrix(), rng.uniform(-spread, spread, 3) + [0, 0, 1]))
    return poses


def board_calibration(seed, cameras=None, frames=25, poses=None, noise_px=NOISE_PX, free=LENS, marks=None,
                      who=None) -> Calibration:  # fmt: skip
    """Return a rig calibrated from a board waved about; ``who(frame)`` names the cameras that see it."""
    rng = np.random.default_rng(seed)
    cameras = overhead(rng) if cameras is None else cameras
    marks = board_points() if marks is None else marks
    poses = board_poses(rng, frames) if poses is None else poses
    rows = []
    for f, pose in enumerate(poses):
        here = seen(cameras, pose.transform(marks), rng, noise_px, f, f)
        rows += [r for r in here if who is None or r[0] in who(f)]
    used = sorted({r[1] for r in rows})
    rank = {f: k for k, f in enumerate(used)}
    rows = [(r[0], rank[r[1]], r[2], rank[r[1]], *r[4:]) for r in rows]
    start = disturbed(cameras, rng, 0.003, 0.005)
    start[0] = replace(start[0], world_from_camera=cameras[0].world_from_camera)
    return calibration_of(cameras, start, free, rows, marks, "board", [poses[f] for f in used], True, noise_px)


def overhead(rng, n=3, height=1.6) -> list[Camera]:
    """Return cameras aimed down at (0, 0, 1) from ``height`` above it."""
    out = []
    for k, c in enumerate(good_rig(rng, n)):
        a = 2 * np.pi * k / n
        centre = [0.6 * np.cos(a), 0.6 * np.sin(a) + 0.05, 1 + height + rng.normal(0, 0.1)]
        out.append(replace(c, world_from_camera=looking_at(centre, [0, 0, 1])))
    return out


def bar_sightings(cameras, length, frames, rng, noise_px=NOISE_PX) -> Sightings:
    """Return sightings of a scale bar of ``length`` [m] waved about (0, 0, 1)."""
    rows = []
    for f in range(frames):
        along = rng.normal(size=3)
        along *= length / 2 / np.linalg.norm(along)
        middle = rng.uniform(-0.5, 0.5, 3) + [0, 0, 1]
        rows += seen(cameras, np.array([middle - along, middle + along]), rng, noise_px, -1, f)
    table = np.array(rows)
    return Sightings(
        tuple(c.name for c in cameras), np.array([(c.width, c.height) for c in cameras]), frames, table[:, 0],
        table[:, 1], table[:, 2], table[:, 4:6], np.tile(noise_px**2 * np.eye(2), (len(table), 1, 1)), table[:, 6]
    )  # fmt: skip
