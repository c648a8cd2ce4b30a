"""Two calibrations of one rig, compared on rays and in the volume: parameters may differ where rays agree.

    for line in compare_rigs(rig, other).lines(): print(line)

Rays are compared as lines at the working distance: a point on b's ray is imaged by a. The differences after one
similarity (or rigid motion) common to all cameras matter for shapes. The differences after each camera's own rotation
are those of its lens alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mosca.calibration.common.robust_fit import similarity
from mosca.camera.projection import image_grid, inside_image, lens_directions, lens_pixels, project
from mosca.data.arrays import Array
from mosca.data.rig import Camera, Pose, Rig
from mosca.data.rotations import nearest_rotation
from mosca.errors import InputError
from mosca.triangulation.triangulate import triangulate

GRID_CELLS = 24
VOLUME_POINTS = 7
VOLUME_SHARE = 0.5
"""Edge of the volume that is examined by default, in mean distances of the cameras from its middle."""
MOTIONS = ("similarity", "rigid", "none")


@dataclass(frozen=True)
class CameraDifference:
    """Differences of one camera's rays, in px of a: as they are, after the common motion, and by the lens alone.

    ``centre_m``, ``turn_rad``: how far the projection centre and the pose differ after the common motion.
    """

    camera: str
    before_rms_px: float
    before_max_px: float
    rms_px: float
    max_px: float
    lens_rms_px: float
    centre_m: float
    turn_rad: float


@dataclass(frozen=True, eq=False)
class RigDifference:
    """How rig b differs from rig a.

    ``motion``: a_from_b; ``scale``: lengths of a over those of b; ``volume`` (2, 3) low and high corner [m, a's
    world]; ``n_points`` of the volume that both rigs measure; ``before_rms_m``, ``before_max_m`` distances between
    the points that a and b reconstruct from the same images; ``rms_m``, ``max_m`` after the common motion,
    ``axes_rms_m`` (3,) of it.
    """

    cameras: tuple[CameraDifference, ...]
    aligned_by: str
    motion: Pose
    scale: float
    volume: Array
    n_points: int
    before_rms_m: float
    before_max_m: float
    rms_m: float
    max_m: float
    axes_rms_m: Array

    def lines(self) -> tuple[str, ...]:
        """Return the comparison as plain text, a line each."""
        turn = np.degrees(_angle(self.motion.rotation))
        shift = 1e3 * float(np.linalg.norm(self.motion.translation))
        wide = max(6, *(len(one.camera) for one in self.cameras))
        rows = [
            f"common motion ({self.aligned_by}): {turn:.4f} deg, {shift:.3f} mm, scale {self.scale - 1:+.3e}",
            f"{'camera':{wide}}  rays px rms   max   as they are rms   max   lens alone   centre mm   turn mrad",
        ]
        rows += [
            f"{one.camera:{wide}}  {one.rms_px:11.4f} {one.max_px:5.3f}  {one.before_rms_px:15.4f} "
            f"{one.before_max_px:5.3f}  {one.lens_rms_px:11.4f} {1e3 * one.centre_m:11.3f} {1e3 * one.turn_rad:11.4f}"
            for one in self.cameras
        ]
        if self.n_points:
            size = " x ".join(f"{v:.3g}" for v in self.volume[1] - self.volume[0])
            axes = " / ".join(f"{1e3 * v:.4f}" for v in self.axes_rms_m)
            rows.append(
                f"in the volume ({size} m, {self.n_points} points): {1e3 * self.rms_m:.4f} mm rms (x/y/z {axes}), "
                f"{1e3 * self.max_m:.4f} mm at most"
            )
            rows.append(
                f"as they are: {1e3 * self.before_rms_m:.4f} mm rms, {1e3 * self.before_max_m:.4f} mm at most"
            )
        else:
            rows.append("in the volume: no point is seen by two cameras")
        return tuple(rows)


def compare_rigs(
    a: Rig, b: Rig, volume: tuple[Sequence[float], Sequence[float]] | None = None, align: str = "similarity"
) -> RigDifference:
    """Compare rig ``b`` with rig ``a``: cameras by name, in a's order.

    ``volume`` (low, high) [m, a's world]: where to compare; by default a cube around the point nearest to the axes.
    ``align``: common motion that is removed: similarity, rigid or none. InputError where no camera is common,
    or the same camera has images of two sizes.
    """
    if align not in MOTIONS:
        raise InputError(f"rig comparison: align = '{align}' given, {', '.join(MOTIONS)} allowed")
    names = [name for name in a.names if name in b.names]
    if not names:
        raise InputError(
            f"rig comparison: no camera is in both rigs ({', '.join(a.names)}; {', '.join(b.names)}); "
            "give the cameras the same names"
        )
    pairs = [(a.camera(name), b.camera(name)) for name in names]
    for one, other in pairs:
        if (one.width, one.height) != (other.width, other.height):
            raise InputError(
                f"rig comparison: camera '{one.name}' has images of {one.width} x {one.height} and {other.width} x "
                f"{other.height}; compare calibrations made at one size"
            )
    rig_a, rig_b = (Rig(tuple(pair[k] for pair in pairs)) for k in (0, 1))
    box = _working_volume(rig_a) if volume is None else np.array(volume, dtype=float)
    grid = _grid(box)
    # b measures the images that a makes of the volume; the common motion carries b's points onto a's
    points_b = _measured(rig_a, rig_b, grid)
    met = np.isfinite(points_b).all(axis=1)
    if align == "none":
        scale, motion = 1.0, Pose(np.eye(3), np.zeros(3))
    elif met.sum() >= 4:
        scale, motion = similarity(points_b[met], grid[met], align == "similarity")
    else:
        first, second = pairs[0]
        scale, motion = 1.0, first.world_from_camera @ second.world_from_camera.inverse()
    moved = Rig(tuple(_carried(camera, scale, motion) for camera in rig_b.cameras))
    middle = box.mean(axis=0)
    cameras = tuple(
        _camera_difference(one, other, aligned, middle)
        for one, other, aligned in zip(rig_a.cameras, rig_b.cameras, moved.cameras, strict=True)
    )
    after = motion.transform(scale * points_b[met]) - grid[met]
    apart, rest = np.linalg.norm(points_b[met] - grid[met], axis=1), np.linalg.norm(after, axis=1)
    return RigDifference(
        cameras, align, motion, scale, box, int(met.sum()), _rms(apart), float(apart.max(initial=0.0)), _rms(rest),
        float(rest.max(initial=0.0)), np.sqrt(np.mean(after**2, axis=0)) if len(rest) else np.zeros(3)
    )  # fmt: skip


def _measured(seen_by: Rig, measured_by: Rig, points: Array) -> Array:
    """Return the positions (n, 3) that one rig measures from the other rig's images of ``points`` (n, 3)."""
    table = np.stack([_inside(camera, project(camera, points)) for camera in seen_by.cameras], axis=1)
    return triangulate(measured_by, table)[0]


def _inside(camera: Camera, xy: Array) -> Array:
    return np.where(inside_image(camera, xy)[:, None], xy, np.nan)


def _carried(camera: Camera, scale: float, motion: Pose) -> Camera:
    pose = camera.world_from_camera
    centre = scale * motion.rotation @ pose.translation + motion.translation
    return replace(camera, world_from_camera=Pose(motion.rotation @ pose.rotation, centre))


def _camera_difference(a: Camera, b: Camera, aligned: Camera, middle: Array) -> CameraDifference:
    xy = image_grid(a.width, a.height, a.width / GRID_CELLS)
    distance = float(np.linalg.norm(middle - a.world_from_camera.translation))
    before, after = _ray_distance(a, b, xy, distance), _ray_distance(a, aligned, xy, distance)
    mine, theirs = lens_directions(a.lens, xy), lens_directions(b.lens, xy)
    both = np.flatnonzero(np.isfinite(mine).all(axis=1) & np.isfinite(theirs).all(axis=1))
    # rotation that best brings b's rays onto a's: the remaining difference is that of the lens
    turn = nearest_rotation(mine[both].T @ theirs[both])[0]
    own = np.linalg.norm(lens_pixels(a.lens, theirs[both] @ turn.T) - xy[both], axis=1)
    pose, other = a.world_from_camera, aligned.world_from_camera
    return CameraDifference(
        a.name,
        _rms(before),
        _largest(before),
        _rms(after),
        _largest(after),
        _rms(own),
        float(np.linalg.norm(pose.translation - other.translation)),
        _angle(pose.rotation.T @ other.rotation),
    )


def _ray_distance(a: Camera, b: Camera, xy: Array, distance: float) -> Array:
    """Return the distances (n,) [px] from the rays' pixels to a's images of b's rays at ``distance`` [m] from b."""
    points = b.world_from_camera.transform(distance * lens_directions(b.lens, xy))
    return np.asarray(np.linalg.norm(project(a, points) - xy, axis=1))


def _rms(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


def _largest(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.max()) if len(finite) else float("nan")


def _angle(rotation: Array) -> float:
    """Return the angle of a rotation [rad]; exact for small ones too."""
    sine = 0.5 * np.linalg.norm(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return float(np.arctan2(sine, (np.trace(rotation) - 1) / 2))


def _working_volume(rig: Rig) -> Array:
    """Return low and high corner (2, 3) [m] of a cube around the point nearest to the cameras' axes."""
    centres = np.array([camera.world_from_camera.translation for camera in rig.cameras])
    axes = np.array([camera.world_from_camera.rotation[:, 2] for camera in rig.cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < 1e-3 * len(axes):
        # parallel axes do not meet: take three times the cameras' own extent in front of them
        reach = 3 * max(float(np.ptp(centres, axis=0).max()), 0.3)
        middle = centres.mean(axis=0) + reach * axes.mean(axis=0)
    else:
        middle = np.linalg.solve(total, np.einsum("nij,nj->i", across, centres))
    half = 0.5 * VOLUME_SHARE * float(np.mean(np.linalg.norm(centres - middle, axis=1)))
    return np.array([middle - half, middle + half])


def _grid(box: Array) -> Array:
    axes = [np.linspace(box[0, k], box[1, k], VOLUME_POINTS) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
