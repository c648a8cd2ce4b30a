"""Rigs calibrated blind, from recordings that Mitsuba rendered, against the rigs that were rendered.

    python -m tests.oracle.blind_calibration wand field board --renders 4 --draws 5

A session is calibrated by the code behind ``mosca calibrate`` with its default settings; nothing is said of sensor
or optics. Renders of one kind differ in cameras and motion, draws in the sensor's noise. A test field or a board is
its own world, so that the rig found is compared as it is; of a wand the best rigid motion is removed, since its
covariance is that of the network in itself. Statistics are freed of that motion by the null space of its slopes, in
any datum alike (Baarda 1973, S-transformations).
"""

import argparse
import tempfile
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import null_space
from scipy.spatial import Delaunay
from scipy.stats import chi2

from mosca.calibration.common.robust_fit import rigid
from mosca.calibration.quality.accuracy_map import triangulated_points
from mosca.calibration.session import EstimateSettings, Shown, calibrate_session
from mosca.camera.projection import project as camera_pixels
from mosca.data.boards import Board
from mosca.data.calibration import Calibration
from mosca.data.files.target_file import read_target_file
from mosca.data.rig import Pose
from mosca.data.targets import TestField
from mosca.data.wands import LFrame
from mosca.recording import open_recording
from witness.mitsuba.__main__ import cache_folder
from witness.mitsuba.projection import in_image, project
from witness.mitsuba.recording import rendered, write_recording
from witness.mitsuba.scene import LensCamera, WitnessScene
from witness.mitsuba.scene_file import scene_of

Array = np.ndarray[Any, Any]

SCENES = Path(__file__).parents[2] / "witness" / "scenes"
KINDS = {"wand": "wand", "two_balls": "wand_two_balls", "field": "coded_field", "board": "chessboard"}
"""Kinds of sessions and their scene files; wands come with the L-frame's."""
CARRIED = ("wand", "board", "field")
GRID = 9
"""Points an axis of the grid on which rays are compared, over the box of all that was shown."""


@dataclass(frozen=True)
class Verdict:
    """How far a calibrated rig is from the true one.

    ``rays_px``, ``worst_px``: rms and largest distance of the images of points in the calibrated volume; ``scale``:
    lengths found over true ones, less 1; ``volume_m`` longest edge of the volume, ``point_rms_m`` of points measured
    without noise; ``nees``: squared error of all projection centres by their covariance, of ``degrees`` of freedom;
    ``centre_sigmas``: the largest error of one centre by its own covariance, as a normal deviate; ``covered``: share
    of points within the ellipsoid of 95 % of the calibration's covariance; ``seen_px``, ``seen_nees``: rms an axis
    of image points against the true ones, and their mean squared error over their stated variance (1: as stated).
    """

    rays_px: float
    worst_px: float
    scale: float
    volume_m: float
    point_rms_m: float
    nees: float
    degrees: int
    centre_sigmas: float
    covered: float
    sigma0: float
    seen_px: float
    seen_nees: float
    left_out: int

    def line(self) -> str:
        """Return the figures in words."""
        return (
            f"rays {self.rays_px:.4f} px rms, {self.worst_px:.3f} at most; points "
            f"{100 * self.point_rms_m / self.volume_m:.4f} % of {self.volume_m:.2f} m; scale {1e6 * self.scale:+.0f} "
            f"ppm; centres: nees / degrees {self.nees / self.degrees:.2f} of {self.degrees}, worst "
            f"{self.centre_sigmas:.1f} sigma; covered {100 * self.covered:.0f} %; sigma0 {self.sigma0:.2f}; image "
            f"points {self.seen_px:.4f} px, nees {self.seen_nees:.2f}, {self.left_out} left out"
        )


def scene_of_kind(name: str, variant: int) -> WitnessScene:
    """Return a scene of ``witness/scenes``, with other cameras and another motion for each ``variant`` but 0."""
    path = SCENES / f"{name}.toml"
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    if variant:
        table["cameras"] = {"seed": 5 + variant}
        for key in CARRIED:
            if key in table:
                for phases in ("phase_rad", "turn_phase_rad"):
                    table[key][phases] = [x + variant * (1.1 + 0.6 * k) for k, x in enumerate(table[key][phases])]
    return scene_of(table, name if not variant else f"{name}_{variant}", path.parent)


def recorded(name: str, variant: int, draw: int, out: Path, cache: Path) -> tuple[WitnessScene, Path, dict[str, Any]]:
    """Write the recording of a scene and return it with its folder and what ``witness.npz`` holds."""
    scene = scene_of_kind(name, variant)
    folder = out / scene.name
    return scene, folder, write_recording(scene, rendered(scene, cache)[0], folder, draw)


def calibrated_blind(folder: Path, axes: Path | None, settings: EstimateSettings | None = None) -> Calibration:
    """Return the calibration that ``mosca calibrate`` makes of a recording and the L-frame's, if any."""

    def shown(path: Path) -> Shown[Any]:
        return Shown(
            read_target_file(path / "target.toml"), lambda rig: open_recording(path, rig, None, times_matter=False)
        )

    l_frame = None if axes is None else shown(axes)
    assert l_frame is None or isinstance(l_frame.target, LFrame)
    return calibrate_session(shown(folder), settings or EstimateSettings(choose_lens=True), axes=l_frame)[0]


def judged(calibration: Calibration, scene: WitnessScene, folder: Path, values: dict[str, Any]) -> Verdict:
    """Return how far a rig is from the cameras of ``scene``, whose recording lies in ``folder``."""
    target = read_target_file(folder / "target.toml")
    own_world = isinstance(target, TestField | Board)
    cameras = [next(c for c in scene.cameras if c.name == name) for name in calibration.rig.names]
    shown = _shown_points(target, values)
    # what the true cameras image of the volume, the rig measures
    grid = _volume(shown.reshape(-1, 3))
    true_px = np.stack([np.where(in_image(c, p := project(c, grid), 0.0)[:, None], p, np.nan) for c in cameras], 1)
    point, camera = np.nonzero(np.isfinite(true_px).all(axis=2))
    seen = true_px[point, camera]
    found = triangulated_points(calibration, camera, point, seen, np.tile(np.eye(2), (len(point), 1, 1)))
    if own_world:
        first = int(calibration.sightings.frame[calibration.placement < 0].min())
        rig_from_world = Pose(values["body_rotation"][first, 0], values["body_position"][first, 0]).inverse()
    else:
        rig_from_world = rigid(grid[found.key], found.xyz)
    edge = float(np.ptp(grid, axis=0).max())
    grid = rig_from_world.transform(grid)
    truth = grid[found.key]
    apart = np.concatenate(
        [
            camera_pixels(one, grid[point[camera == k]]) - seen[camera == k]
            for k, one in enumerate(calibration.rig.cameras)
        ]
    )
    centres = rig_from_world.transform(np.array([c.position_m for c in cameras]))
    nees, degrees, worst = _of_centres(calibration, centres, own_world)
    free = np.eye(3 * len(truth)) if own_world else _without_motion(truth)
    image_off, covariance = _image_errors(calibration, cameras, shown)
    return Verdict(
        float(np.sqrt(np.mean((apart**2).sum(axis=1)))),
        float(np.linalg.norm(apart, axis=1).max()),
        _scale(found.xyz, truth),
        edge,
        float(np.sqrt(np.mean(((found.xyz - truth) ** 2).sum(axis=1)))),
        nees,
        degrees,
        worst,
        _covered(found.xyz - truth, found.by_parameter, calibration.covariance, free),
        calibration.sigma0,
        float(np.sqrt(np.mean(image_off**2))),
        float(np.mean(np.einsum("ni,nij,nj->n", image_off, np.linalg.inv(covariance), image_off)) / 2),
        int((~calibration.used).sum()),
    )


def _shown_points(target: Any, values: dict[str, Any]) -> Array:
    """Return where the marks truly were (frames, marks, 3) [m, world]."""
    if isinstance(target, TestField | Board):
        marks = target.corners() if isinstance(target, Board) else np.asarray(target.positions)
        turned = np.einsum("fij,mj->fmi", values["body_rotation"][:, 0], marks)
        return np.asarray(turned + values["body_position"][:, :1])
    return np.asarray(values["mean_xyz"])


def _volume(points: Array) -> Array:
    """Return the points (n, 3) of a grid that lie in the convex hull of ``points``."""
    axes = [np.linspace(points[:, k].min(), points[:, k].max(), GRID) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(grid[Delaunay(points).find_simplex(grid) >= 0])


def _scale(found: Array, truth: Array) -> float:
    """Return lengths found over true ones, less 1."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    return float(np.sqrt((a**2).sum() / (b**2).sum()) - 1)


def _without_motion(points: Array) -> Array:
    """Return a basis (3n, 3n - 6) of what no rigid motion of the points (n, 3) changes."""
    x = points - points.mean(axis=0)
    turns = [np.cross(axis, x) for axis in np.eye(3)]
    shifts = [np.tile(axis, (len(x), 1)) for axis in np.eye(3)]
    return np.asarray(null_space(np.stack([one.ravel() for one in turns + shifts])))


def _of_centres(calibration: Calibration, truth: Array, own_world: bool) -> tuple[float, int, float]:
    """Return nees of all centres, its degrees of freedom, and the worst centre's error as a normal deviate."""
    names = {name: k for k, name in enumerate(calibration.parameters)}
    columns = [names[f"{camera}.{axis}_m"] for camera in calibration.rig.names for axis in "XYZ"]
    found = np.array([c.world_from_camera.translation for c in calibration.rig.cameras])
    free = np.eye(truth.size) if own_world else _without_motion(truth)
    error = (found - truth).ravel() @ free
    covariance = free.T @ calibration.covariance[np.ix_(columns, columns)] @ free
    nees = float(error @ np.linalg.solve(covariance, error))
    back, spread = free @ error, free @ covariance @ free.T
    worst = max(
        float(back[k : k + 3] @ np.linalg.pinv(spread[k : k + 3, k : k + 3]) @ back[k : k + 3])
        for k in range(0, truth.size, 3)
    )
    return nees, free.shape[1], float(np.sqrt(chi2.isf(max(chi2.sf(worst, 3), 1e-300), 1)))


def _covered(error: Array, by_parameter: Array, covariance: Array, free: Array) -> float:
    """Return the share of points (n, 3) within their ellipsoids of 95 %."""
    moved = by_parameter.reshape(error.size, -1)
    if free.shape[1] < error.size:
        moved = free @ (free.T @ moved)
        error = (free @ (free.T @ error.ravel())).reshape(-1, 3)
    moved = moved.reshape(len(error), 3, -1)
    spread = moved @ covariance @ np.swapaxes(moved, 1, 2)
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(spread), error)
    return float(np.mean(squares < chi2.isf(0.05, 3)))


def _image_errors(calibration: Calibration, cameras: list[LensCamera], shown: Array) -> tuple[Array, Array]:
    """Return the used image points less the true ones (n, 2) [px], and their stated covariances (n, 2, 2)."""
    see = calibration.sightings
    off = np.full((len(see), 2), np.nan)
    for k, camera in enumerate(cameras):
        mine = np.flatnonzero(calibration.used & (see.camera == k))
        apart = see.xy_px[mine][:, None] - project(camera, shown[see.frame[mine]])
        nearest = np.linalg.norm(apart, axis=2).argmin(axis=1)
        off[mine] = apart[np.arange(len(mine)), nearest]
    known = np.isfinite(off).all(axis=1)
    return off[known], np.asarray(see.covariance_px2)[known]


def sessions(
    kind: str, renders: int, draws: int, cache: Path, settings: EstimateSettings | None = None
) -> Iterator[tuple[int, int, Verdict]]:
    """Yield variant, draw and verdict of each session of a kind."""
    for variant in range(renders):
        for draw in range(draws):
            with tempfile.TemporaryDirectory() as folder:
                scene, at, values = recorded(KINDS[kind], variant, draw, Path(folder), cache)
                axes = None
                if KINDS[kind].startswith("wand"):
                    axes = recorded("l_frame", variant, draw, Path(folder), cache)[1]
                yield variant, draw, judged(calibrated_blind(at, axes, settings), scene, at, values)


def main() -> None:
    """Print the verdicts of the kinds that are named, and their means."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="+", choices=list(KINDS))
    parser.add_argument("--renders", type=int, default=1)
    parser.add_argument("--draws", type=int, default=1)
    parser.add_argument("--cache", type=Path, default=cache_folder())
    given = parser.parse_args()
    for kind in given.kinds:
        every = []
        for variant, draw, verdict in sessions(kind, given.renders, given.draws, given.cache):
            print(f"{kind} {variant}.{draw}: {verdict.line()}", flush=True)
            every.append(verdict)
        mean = np.mean([one.nees / one.degrees for one in every])
        rms = np.sqrt(np.mean([one.rays_px**2 for one in every]))
        print(f"{kind}: {len(every)} sessions: rays {rms:.4f} px rms, nees of centres {mean:.2f}")


if __name__ == "__main__":
    main()
