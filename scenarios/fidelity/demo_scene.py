"""A small scene for pictures: a few markers before one still camera, with or without one disturbance.

The camera is at the origin, its axis along z, x to the right and y down. ``by_px`` gives positions in pixels from the
image's middle.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import Camera, Lens, OpenCVLens, Pose
from reports.fidelity import Crop
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.stray_light.stray import Surroundings
from twin.cameras.virtual_camera import VirtualCamera
from twin.scenes.emission import Glow
from twin.scenes.figure import Figure
from twin.scenes.scene import Scene
from twin.scenes.target_motion import carried_body
from twin.scenes.target_plate import add_ball_at, add_plate
from twin.scenes.world import Shape, add_shape, compiled, new_stage

SIZE, F_PX, DEPTH_M, SEED, RATE_HZ = (120, 90), 300.0, 2.0, 1288, 100.0
AHEAD = Pose(np.eye(3), np.zeros(3))
GAP_PX, GAP_GREY = 8, 118
"""Width and grey value of the gap between panels: the grey is visible on white and on black."""
CARRIED = "carried"
WITHOUT = "without"
"""Label of a panel that lacks the disturbance."""
BACK = np.diag([1.0, -1.0, -1.0])
"""Rotation of the carried body by 180 degrees about x: its +z, along which lamps shine, points to the camera."""


def by_px(x: float, y: float, depth_m: float = DEPTH_M, f_px: float = F_PX) -> Array:
    """Return the point (3,) [m] at ``depth_m`` whose image is ``x`` to the right of and ``y`` below the middle."""
    return np.array([x, y, f_px]) * depth_m / f_px


def metres(px: float, depth_m: float = DEPTH_M, f_px: float = F_PX) -> float:
    """Return the length at ``depth_m`` whose image is ``px`` long."""
    return px * depth_m / f_px


def quiet_camera(
    size: tuple[int, int] = SIZE,
    f_px: float = F_PX,
    *,
    name: str = "camera",
    lens: Lens | None = None,
    pose: Pose = AHEAD,
    **more: Any,
) -> VirtualCamera:
    """Return a camera with noise and no other disturbance except those in ``more``."""
    lens = OpenCVLens(f_px, f_px, (size[0] - 1) / 2, (size[1] - 1) / 2) if lens is None else lens
    still: dict[str, Any] = {
        "optics": Optics(gap_px=0.0),
        "timing": Timing(jitter_s=0.0),
        "mount": Mount(body_px=0.0),
    }
    return VirtualCamera(Camera(name, *size, lens, pose), **{**still, **more})


@dataclass(frozen=True, eq=False)
class Ball:
    """A ball marker at ``at`` (3,) [m]."""

    at: Array
    diameter_m: float
    glow: Glow = field(default_factory=Glow)


def markers(diameter_px: float, *places_px: tuple[float, float]) -> list[Ball]:
    """Return balls of one size by their positions from the image's middle [px]."""
    return [Ball(by_px(x, y), metres(diameter_px)) for x, y in places_px]


@dataclass(frozen=True, eq=False)
class Plate:
    """A printed plate at ``at`` (3,) [m], its axes the columns of ``turn`` (3, 3); visible from its +z."""

    at: Array
    turn: Array
    figure: Figure
    half_m: tuple[float, float]
    glow: Glow = field(default_factory=Glow)


def stage(
    balls: Sequence[Ball] = (),
    *,
    plates: Sequence[Plate] = (),
    solids: Sequence[Shape] = (),
    velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scene:
    """Return a scene in which markers and plates move together and solids are still."""
    spec = new_stage(floor=False)
    body = carried_body(spec, CARRIED)
    for number, one in enumerate(balls):
        add_ball_at(body, f"ball {number}", BACK @ one.at, one.diameter_m)
    for number, plate in enumerate(plates):
        add_plate(body, f"plate {number}", *plate.half_m, BACK @ plate.at, BACK @ plate.turn)
    for shape in solids:
        add_shape(spec.worldbody, shape)
    names = [f"ball {k}" for k in range(len(balls))] + [f"plate {k}" for k in range(len(plates))]
    model, geoms = compiled(spec, names)
    speed = np.array(velocity_mps)

    def configuration(time_s: float) -> Array:
        return np.concatenate([speed * time_s, [0.0, 1.0, 0.0, 0.0]])

    glows = [*(one.glow for one in balls), *(one.glow for one in plates)]
    return Scene(
        model,
        tuple(names),
        geoms,
        configuration,
        1.0,
        figures={f"plate {k}": plate.figure for k, plate in enumerate(plates)},
        glows=dict(zip(names, glows, strict=True)),
    )


def photo(
    scene: Scene,
    camera: VirtualCamera,
    *,
    pulse: int = 0,
    exposure_s: float = 1e-3,
    others: Sequence[VirtualCamera] = (),
    surroundings: Surroundings | None = None,
) -> Array:
    """Return the counts (H, W) of the frame that ``camera`` takes at a pulse."""
    from twin.source import TwinSource

    with TwinSource(
        scene,
        (camera, *others),
        frame_rate_hz=RATE_HZ,
        exposure_s=exposure_s,
        pulses=pulse + 1,
        seed=SEED,
        surroundings=surroundings,
    ) as source:
        images = [frame.image for frame in source if frame.camera == camera.camera.name]
    image = images[-1]
    assert image is not None
    return image


def grey(counts: Array, dark: float = 0.0, bright: float = 255.0, gamma: float = 1.0) -> Array:
    """Return counts as grey (H, W) uint8: ``dark`` black, ``bright`` white, in between to the power ``gamma``."""
    share = np.clip((counts.astype(float) - dark) / (bright - dark), 0.0, 1.0)
    return np.asarray(np.rint(255 * share**gamma), dtype=np.uint8)


def difference(counts: Array, other: Array, full: float) -> Array:
    """Return ``counts`` less ``other`` as grey (H, W): 0 is middle grey, +-``full`` counts are white and black."""
    return grey(counts.astype(float) - other.astype(float), -full, full)


def side_by_side(*panels: Array, zoom: int) -> Array:
    """Return panels (h, w) uint8 side by side, each pixel enlarged to ``zoom`` x ``zoom``."""
    gap = np.full((len(panels[0]) * zoom, GAP_PX), GAP_GREY, dtype=np.uint8)
    parts: list[Array] = []
    for panel in panels:
        parts += [np.repeat(np.repeat(panel, zoom, axis=0), zoom, axis=1), gap]
    return np.concatenate(parts[:-1], axis=1)


def pair(
    scene: Scene,
    camera: VirtualCamera,
    levels: tuple[float, ...] = (),
    taken: dict[str, Any] | None = None,
    surroundings: Surroundings | None = None,
    **changed: Any,
) -> list[Array]:
    """Return two panels: by ``camera``, and by the camera with parts ``changed``, within ``surroundings``.

    ``levels``: arguments of ``grey``; ``taken``: arguments of ``photo`` for both.
    """
    taken = taken or {}
    with_it = photo(scene, replace(camera, **changed), surroundings=surroundings, **taken)
    return [grey(photo(scene, camera, **taken), *levels), grey(with_it, *levels)]


@dataclass(frozen=True, eq=False)
class Panels:
    """The recipe of a picture and its description: a ``Crop`` whose panels are not made yet."""

    name: str
    title: str
    labels: tuple[str, ...]
    caption: str
    scenario: str
    panels: Callable[[], Sequence[Array]]
    zoom: int = 4

    def __call__(self) -> Crop:
        """Return the picture; the same bytes each time."""
        image = side_by_side(*self.panels(), zoom=self.zoom)
        return Crop(self.name, self.title, self.labels, image, self.caption, self.scenario)
