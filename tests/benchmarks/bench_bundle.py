"""Bundle adjustment beside scipy, aniposelib and Ceres: time to the same optimum. Run: ``python bench_bundle.py``.

4 cameras of 656 x 491 px see 1,000 frames of a two-ball wand at 80 %, 0.05 px noise; unknown are the poses, one focal
length and k1 a camera, and the points (aniposelib's own set). All begin with the same values (aniposelib triangulates
itself) and end at the same sum of squares, which is printed. One thread, except where a row states otherwise. On a
shared machine compare processor times, for rows of one thread.
Then the time of ours against the number of observations, up to a million.

``--aniposelib PYTHON``: the interpreter of an environment that has aniposelib; ``--ceres PROGRAM``: what
``bench_bundle_ceres.cpp`` was built to. Without them these rows are left out.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import cv2  # noqa: E402  (the threads must be set before)
import numpy as np  # noqa: E402

WIDTH, HEIGHT, NOISE_PX, SEEN, WAND_M = 656, 491, 0.05, 0.8, 0.5
ROUNDS = 25


def scene(frames: int, seed: int = 1) -> dict[str, np.ndarray]:
    """Return start cameras (4, 10: rvec, tvec, f, k1, cx, cy), start points, and observations of wand frames."""
    rng = np.random.default_rng(seed)
    cameras = []
    for k in range(4):
        a = np.pi / 4 + k * np.pi / 2 + rng.normal(0, 0.08)
        centre = np.array([4.2 * np.cos(a), 4.2 * np.sin(a), 2.4 + rng.normal(0, 0.2)])
        z = np.array([0, 0, 1.0]) + rng.normal(0, 0.05, 3) - centre
        z /= np.linalg.norm(z)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        turn = np.stack([x, np.cross(z, x), z])
        f, k1 = 640 + rng.normal(0, 8), -0.08 + rng.normal(0, 0.01)
        cameras.append([*cv2.Rodrigues(turn)[0].ravel(), *(-turn @ centre), f, k1, 327.5, 245.0])
    truth = np.array(cameras)
    middle = np.column_stack([rng.uniform(-0.9, 0.9, (frames, 2)), rng.uniform(0.3, 1.7, frames)])
    along = rng.normal(size=(frames, 3))
    along *= WAND_M / 2 / np.linalg.norm(along, axis=1, keepdims=True)
    points = np.stack([middle - along, middle + along], axis=1).reshape(-1, 3)
    xy = np.stack([pixels(c, points) for c in truth])
    seen = ((xy > 3) & (xy < (WIDTH - 4, HEIGHT - 4))).all(axis=2) & (rng.random(xy.shape[:2]) < SEEN)
    xy += rng.normal(0, NOISE_PX, xy.shape)
    kept = seen.sum(axis=0) >= 2
    points, xy, seen = points[kept], xy[:, kept], seen[:, kept]
    start = truth.copy()
    start[:, :3] += rng.normal(0, 0.01, (4, 3))
    start[:, 3:6] += rng.normal(0, 0.03, (4, 3))
    start[:, 6] *= 1 + rng.normal(0, 0.01, 4)
    start[:, 7] += 0.02
    point, camera = np.nonzero(seen.T)
    begin = points + rng.normal(0, 0.03, points.shape)
    return {"start": start, "points": begin, "camera": camera, "point": point, "xy": xy[camera, point]}


def pixels(camera: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return OpenCV's pixels (n, 2) of points by a camera (10,)."""
    matrix = np.array([[camera[6], 0, camera[8]], [0, camera[6], camera[9]], [0, 0, 1]])
    distortion = np.array([camera[7], 0, 0, 0, 0])
    return cv2.projectPoints(points, camera[:3], camera[3:6], matrix, distortion)[0].reshape(-1, 2)


def best_ms(work: Callable[[], object], rounds: int) -> tuple[float, float]:
    """Return the best time of ``work`` on the clock and the best on the processor [ms]."""
    taken = []
    for _ in range(rounds):
        start = time.perf_counter(), time.process_time()
        work()
        taken.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    clock, processor = zip(*taken, strict=True)
    return 1e3 * min(clock), 1e3 * min(processor)


def ours(data: dict[str, np.ndarray]):
    """Return the problem in the terms of ``mosca.calibration.bundle.solver``."""
    from mosca.calibration.bundle.solver import CameraUnknowns, ObjectPoints, Observations, Problem
    from mosca.data.rig import Camera, OpenCVLens, Pose

    cameras = []
    for k, c in enumerate(data["start"]):
        turn = cv2.Rodrigues(c[:3])[0]
        lens = OpenCVLens(c[6], c[6], c[8], c[9], c[7])
        camera = Camera(f"c{k}", WIDTH, HEIGHT, lens, Pose(turn.T, -turn.T @ c[3:6]))
        cameras.append(CameraUnknowns(camera, free=("f_px", "k1")))
    seen = Observations(data["camera"], data["point"], data["xy"], sigma_px=NOISE_PX)
    return Problem(tuple(cameras), seen, ObjectPoints.free(data["points"]), datum="points")


def scipy_solver(data: dict[str, np.ndarray], tolerance: float) -> tuple[float, int]:
    """Solve with scipy's least_squares and an analytic sparse Jacobian; return the cost and the evaluations."""
    from scipy.optimize import least_squares
    from scipy.sparse import csr_matrix

    start, ci, pi, xy = data["start"], data["camera"], data["point"], data["xy"]
    cameras, points, n = len(start), len(data["points"]), len(ci)
    at = np.concatenate(
        [
            np.broadcast_to((8 * ci)[:, None, None] + np.arange(8), (n, 2, 8)),
            np.broadcast_to((8 * cameras + 3 * pi)[:, None, None] + np.arange(3), (n, 2, 3)),
        ],
        axis=2,
    )
    indices, ends = at.reshape(-1).astype(np.int32), np.arange(0, 22 * n + 1, 11)

    def parts(z: np.ndarray):
        c, x = z[: 8 * cameras].reshape(-1, 8), z[8 * cameras :].reshape(-1, 3)
        turns = np.stack([cv2.Rodrigues(one[:3])[0] for one in c])
        p = np.einsum("nij,nj->ni", turns[ci], x[pi])
        y = p + c[ci, 3:6]
        z_inverse = 1 / y[:, 2]
        u = y[:, :2] * z_inverse[:, None]
        r2 = (u * u).sum(axis=1)
        return c, turns, p, u, z_inverse, r2, 1 + r2 * c[ci, 7]

    def residuals(z: np.ndarray) -> np.ndarray:
        c, _, _, u, _, _, d = parts(z)
        return ((c[ci, 6:7] * u * d[:, None] + start[ci, 8:10] - xy) / NOISE_PX).ravel()

    def jacobian(z: np.ndarray) -> csr_matrix:
        c, turns, p, u, z_inverse, r2, d = parts(z)
        f, k = c[ci, 6], c[ci, 7]
        by = np.empty((n, 2, 3))
        across = 2 * k * u[:, 0] * u[:, 1]
        by[:, 0, 0], by[:, 1, 1] = d + 2 * k * u[:, 0] ** 2, d + 2 * k * u[:, 1] ** 2
        by[:, 0, 1] = by[:, 1, 0] = across
        by[:, :, 2] = -(by[:, :, 0] * u[:, :1] + by[:, :, 1] * u[:, 1:])
        by *= (f * z_inverse / NOISE_PX)[:, None, None]
        left = np.stack([left_jacobian(one[:3]) for one in c])
        turn = np.einsum("nki,nij->nkj", np.cross(p[:, None, :], by), left[ci])
        lens = np.stack([u * d[:, None], u * (f * r2)[:, None]], axis=2) / NOISE_PX
        whole = np.concatenate([turn, by, lens, np.einsum("nki,nij->nkj", by, turns[ci])], axis=2)
        return csr_matrix((whole.reshape(-1), indices, ends), shape=(2 * n, 8 * cameras + 3 * points))

    first = np.concatenate([start[:, :8].ravel(), data["points"].ravel()])
    done = least_squares(
        residuals,
        first,
        jacobian,
        method="trf",
        tr_solver="lsmr",
        x_scale="jac",
        ftol=tolerance,
        xtol=1e-14,
        gtol=1e-14,
        max_nfev=300,
    )
    return 2 * done.cost, done.nfev


def left_jacobian(r: np.ndarray) -> np.ndarray:
    """Return the left Jacobian of SO(3)."""
    a = np.linalg.norm(r)
    k = np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])
    return np.eye(3) + (1 - np.cos(a)) / a**2 * k + (a - np.sin(a)) / a**3 * k @ k


def aniposelib_row(path: str) -> None:
    """Time aniposelib on the scene in ``path`` and print milliseconds and its cameras (in its own environment)."""
    import json
    import warnings

    warnings.filterwarnings("ignore")
    from aniposelib.cameras import Camera, CameraGroup

    data = dict(np.load(path))
    xy = np.full((4, len(data["points"]), 2), np.nan)
    xy[data["camera"], data["point"]] = data["xy"]
    taken = []
    for _ in range(3):
        group = CameraGroup(
            [
                Camera(
                    matrix=np.array([[c[6], 0, c[8]], [0, c[6], c[9]], [0, 0, 1.0]]),
                    dist=np.array([c[7], 0, 0, 0, 0.0]),
                    size=(WIDTH, HEIGHT),
                    rvec=c[:3],
                    tvec=c[3:6],
                    name=str(k),
                )
                for k, c in enumerate(data["start"])
            ]
        )
        start = time.perf_counter(), time.process_time()
        group.bundle_adjust(xy, ftol=1e-4, verbose=False, max_nfev=300)
        taken.append((1e3 * (time.perf_counter() - start[0]), 1e3 * (time.process_time() - start[1])))
    end = [
        [*c.rvec.ravel(), *c.tvec.ravel(), c.matrix[0, 0], c.dist.ravel()[0], c.matrix[0, 2], c.matrix[1, 2]]
        for c in group.cameras
    ]
    print(json.dumps([[min(t) for t in zip(*taken, strict=True)], np.array(end, dtype=float).tolist()]))


def compare(frames: int, aniposelib: str | None, ceres: str | None) -> None:
    """Print the table of one scene."""
    import json

    from mosca.calibration.bundle.solver import BundleSettings, solve

    data = scene(frames)
    problem = ours(data)
    rows: list[tuple[str, tuple[float, float], float, str]] = []
    for name, settings in (
        ("ours", BundleSettings(precision=False)),
        ("ours, with covariances, redundancy numbers, tests", BundleSettings()),
    ):
        result = solve(problem, settings)
        took = best_ms(lambda settings=settings: solve(problem, settings), ROUNDS)
        rows.append((name, took, result.cost, f"{result.steps} steps"))
    for tolerance in (1e-4, 1e-8):
        cost, evaluations = scipy_solver(data, tolerance)
        rounds = ROUNDS if frames <= 1_000 else 3
        took = best_ms(lambda tolerance=tolerance: scipy_solver(data, tolerance), rounds)
        rows.append((f"scipy, analytic sparse, ftol {tolerance:g}", took, cost, f"{evaluations} evaluations"))
    with tempfile.TemporaryDirectory() as folder:
        if ceres:
            path = Path(folder) / "scene.bin"
            with path.open("wb") as file:
                np.array([4, len(data["points"]), len(data["camera"])], dtype=np.int64).tofile(file)
                for name in ("start", "centre", "points", "camera", "point", "xy"):
                    values = data["start"][:, :8] if name == "start" else data.get(name, data["start"][:, 8:10])
                    np.ascontiguousarray(values).tofile(file)
                np.array([1 / NOISE_PX]).tofile(file)
            for tolerance in ("1e-4", "1e-8"):
                lines = subprocess.run(
                    [ceres, str(path), tolerance, str(ROUNDS)], check=True, capture_output=True, text=True
                ).stdout
                for line in lines.splitlines():
                    form, threads, clock, processor, iterations, cost = line.split()
                    name = f"Ceres DENSE_SCHUR {form}, {threads} thread(s), ftol {tolerance}"
                    rows.append((name, (float(clock), float(processor)), float(cost), f"{iterations} iterations"))
        if aniposelib:
            path = Path(folder) / "scene.npz"
            np.savez(path, **data)
            command = [aniposelib, str(Path(__file__).resolve()), "--aniposelib-row", str(path)]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            took, end = json.loads(done.stdout.splitlines()[-1])
            # its cost: its cameras with the best points for them, by scipy held at these cameras
            rows.append(("aniposelib bundle_adjust, ftol 1e-4", tuple(took), cost_with(problem, np.array(end)), ""))
    print(f"{frames} frames, {len(data['points'])} points, {len(data['camera'])} image points")
    print(f"  {'':<52} {'clock':>20} {'processor':>22}")
    for name, took, cost, note in rows:
        times = "".join(f"{t:10.2f} ms {t / own:6.1f} x" for t, own in zip(took, rows[0][1], strict=True))
        print(f"  {name:<52} {times}   cost {cost:.6f}  {note}")


def cost_with(problem, cameras: np.ndarray) -> float:
    """Return the least cost that the points can reach with the given cameras (4, 10) held."""
    from dataclasses import replace

    from mosca.calibration.bundle.solver import BundleSettings, solve
    from mosca.data.rig import OpenCVLens, Pose

    held = []
    for one, c in zip(problem.cameras, cameras, strict=True):
        turn = cv2.Rodrigues(c[:3])[0]
        lens, pose = OpenCVLens(c[6], c[6], c[8], c[9], c[7]), Pose(turn.T, -turn.T @ c[3:6])
        camera = replace(one.camera, lens=lens, world_from_camera=pose)
        held.append(replace(one, camera=camera, free=(), held=True))
    settings = BundleSettings(precision=False)
    return solve(replace(problem, cameras=tuple(held), datum="given"), settings).cost


def linearity() -> None:
    """Print the time of ours against the number of observations."""
    from mosca.calibration.bundle.solver import BundleSettings, solve

    print("ours against the number of image points (a step: one linearisation and its elimination)")
    for frames in (1_000, 10_000, 50_000, 158_000):
        problem = ours(scene(frames))
        n = len(problem.observations)
        line = f"  {n:>9} image points"
        for name, settings in (("adjusted", BundleSettings(precision=False)), ("and judged", BundleSettings())):
            solve(problem, settings)
            took, _ = best_ms(
                lambda problem=problem, settings=settings: solve(problem, settings), 3 if frames < 50_000 else 1
            )
            line += f"   {name} {took:9.1f} ms ({1e3 * took / n:5.2f} us a point)"
        print(line, flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--aniposelib")
    parser.add_argument("--ceres")
    parser.add_argument("--short", action="store_true", help="only 1,000 frames")
    parser.add_argument("--aniposelib-row", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.aniposelib_row:
        aniposelib_row(given.aniposelib_row)
        return
    compare(1_000, given.aniposelib, given.ceres)
    if not given.short:
        compare(10_000, None, given.ceres)
        linearity()


if __name__ == "__main__":
    sys.exit(main())
