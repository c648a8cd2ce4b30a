"""Starting values of a camera's interior orientation, from views of a target whose marks are known.

For a solid target, space resection estimates the parameters that its points determine (``adjust``). For a plane, the
homographies of its views give the principal distance, with the principal point in the middle of the image and square
pixels (Zhang 2000); an adjustment of that camera alone gives the rest.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mosca.calibration.bundle.solver import (
    FOCAL,
    BundleSettings,
    CameraUnknowns,
    ObjectPoints,
    Observations,
    Placements,
    Problem,
    solve,
)
from mosca.calibration.initial.target_pose import homography, plane_of, poses_of
from mosca.calibration.single_camera.adjust import AdjustmentSettings, adjust_camera
from mosca.camera.projection import lens_directions
from mosca.data.arrays import Array
from mosca.data.rig import Camera, FisheyeLens, Lens, MoscaLens, OpenCVLens, Pose
from mosca.errors import CalibrationError

FEWEST_MARKS = 8
FEWEST_PLANE_VIEWS = 3
PLANE = 1e-4
"""Relief of a target, over its extent, below which it is a plane."""
MOST_START_VIEWS = 40


@dataclass(frozen=True)
class LensChoice:
    """The lens model to estimate; ``pixel_pitch_mm`` is mx of a Mosca lens, which is held; ``own_pitch_mm``: mx by
    name for cameras with other pixels.
    """

    model: str = "mosca"
    pixel_pitch_mm: float = 0.01
    own_pitch_mm: Mapping[str, float] = field(default_factory=dict)

    def of(self, camera: str) -> "LensChoice":
        """Return the choice for one camera."""
        return LensChoice(self.model, self.own_pitch_mm.get(camera, self.pixel_pitch_mm))


@dataclass(frozen=True, eq=False)
class TargetView:
    """Marks that a camera saw in one stationary interval: ``mark`` (n,), their mean position ``xy_px`` (n, 2)."""

    mark: Array
    xy_px: Array


@dataclass(frozen=True, eq=False)
class CameraViews:
    """Views by camera ``name`` of ``size`` (width, height) of marks ``marks_m`` (m, 3) [m], by interval."""

    name: str
    size: tuple[int, int]
    views: Sequence[TargetView]
    marks_m: Array


def starting_camera(shown: CameraViews, lens: LensChoice, rng: np.random.Generator) -> Camera:
    """Return a camera at the origin with the interior orientation that its views determine.

    CalibrationError where they do not.
    """
    if plane_of(shown.marks_m)[2] < PLANE:
        return _from_plane(shown, lens)
    return _from_solid(shown, lens, rng)


def plain_lens(lens: LensChoice, f_px: float, size: tuple[int, int]) -> Lens:
    """Return a lens of a model without distortion, its principal point in the middle of the image."""
    middle = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    if lens.model == "mosca":
        return MoscaLens(f_px * lens.pixel_pitch_mm, *middle, lens.pixel_pitch_mm, lens.pixel_pitch_mm)
    if lens.model == "opencv":
        return OpenCVLens(f_px, f_px, *middle)
    if lens.model == "fisheye":
        return FisheyeLens(f_px, f_px, *middle)
    raise ValueError(f"lens model '{lens.model}' given; mosca, opencv or fisheye is wanted")


def _from_solid(shown: CameraViews, lens: LensChoice, rng: np.random.Generator) -> Camera:
    name, size = shown.name, shown.size
    views = sorted(shown.views, key=lambda seen: -len(seen.mark))
    count = len(views[0].mark) if views else 0
    if count < FEWEST_MARKS:
        raise CalibrationError(
            f"few-views: camera '{name}': {count} marks of the target in its best view, at least {FEWEST_MARKS} are "
            "wanted; show it more of the target",
            (name,),
        )
    # a thin prism estimated from one view would stay, since the adjustment of all views holds it
    settings = AdjustmentSettings(prism=False, pixel_pitch_mm=lens.pixel_pitch_mm, max_sigma0_px=5.0)
    first: CalibrationError | None = None
    for seen in views:
        if len(seen.mark) < FEWEST_MARKS:
            break
        try:
            adjusted = adjust_camera(name, size, lens.model, seen.xy_px, shown.marks_m[seen.mark], rng, settings)
        except CalibrationError as error:
            # with 20 marks for 16 unknowns some may fit a wrong camera: the next view has others
            first = first or error
        else:
            return Camera(name, *size, adjusted.camera.lens, Pose(np.eye(3), np.zeros(3)))
    assert first is not None  # the best view has enough marks
    raise first


def _from_plane(shown: CameraViews, lens: LensChoice) -> Camera:
    name, size, marks_m = shown.name, shown.size, shown.marks_m
    usable = sorted((s for s in shown.views if len(s.mark) >= FEWEST_MARKS), key=lambda s: -len(s.mark))
    if len(usable) < FEWEST_PLANE_VIEWS:
        raise CalibrationError(
            f"few-views: camera '{name}': {len(usable)} views of the flat target with {FEWEST_MARKS} marks or more, "
            f"at least {FEWEST_PLANE_VIEWS} are wanted; hold it before the camera at more angles",
            (name,),
        )
    # evenly from all views, since neighbouring ones are nearly the same
    picked = [usable[k] for k in np.unique(np.linspace(0, len(usable) - 1, MOST_START_VIEWS).astype(int))]
    f_px = _focal_px(replace(shown, views=picked))
    camera = Camera(name, *size, plain_lens(lens, f_px, size), Pose(np.eye(3), np.zeros(3)))
    placed = [poses_of(lens_directions(camera.lens, s.xy_px), marks_m[s.mark]) for s in picked]
    both = [(s, fits[0].camera_from_target) for s, fits in zip(picked, placed, strict=True) if fits]
    counts = [len(s.mark) for s, _ in both]
    observations = Observations(
        np.zeros(sum(counts)),
        np.concatenate([s.mark for s, _ in both]),
        np.concatenate([s.xy_px for s, _ in both]),
        np.repeat(np.arange(len(both)), counts),
    )
    poses = Placements.of([pose for _, pose in both])
    for free in _stages(lens.model):
        unknowns = CameraUnknowns(camera, free=free, held=True)
        problem = Problem((unknowns,), observations, ObjectPoints.fixed(marks_m), poses)
        result = solve(problem, BundleSettings(loss="huber", loss_scale=2.0, precision=False))
        camera, poses = result.cameras[0], result.placements
    return camera


def _stages(model: str) -> tuple[tuple[str, ...], ...]:
    if model == "mosca":
        return ("c_mm",), ("c_mm", "K1_per_mm2"), ("c_mm", "xp_px", "yp_px", "K1_per_mm2")
    return (FOCAL,), (FOCAL, "k1"), (FOCAL, "cx_px", "cy_px", "k1")


def _focal_px(shown: CameraViews) -> float:
    """Return the principal distance from homographies: B = diag(s, s, 1), s = 1 / f^2 (Zhang 2000, eq. 3, 4)."""
    size = shown.size
    middle, axes, _ = plane_of(shown.marks_m)
    flat = ((shown.marks_m - middle) @ axes)[:, :2]
    centre = (np.array(size) - 1) / 2
    left, right = [], []
    for seen in shown.views:
        h = homography(flat[seen.mark], (seen.xy_px - centre) / size[0])
        h = h / np.linalg.norm(h[:, :2])
        left += [h[0, 0] * h[0, 1] + h[1, 0] * h[1, 1], h[0, 0] ** 2 + h[1, 0] ** 2 - h[0, 1] ** 2 - h[1, 1] ** 2]
        right += [h[2, 0] * h[2, 1], h[2, 0] ** 2 - h[2, 1] ** 2]
    a, b = np.array(left), np.array(right)
    inverse_square = -(a @ b) / max(a @ a, 1e-300)
    if not inverse_square > 1 / 50.0**2:
        raise CalibrationError(
            f"little-depth: camera '{shown.name}': its views of the flat target show no perspective, which leaves "
            "the principal distance open; tilt the target by 20 to 50 deg, nearer to the camera"
        )
    return float(min(1 / np.sqrt(inverse_square), 50.0) * size[0])
