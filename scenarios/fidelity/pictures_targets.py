"""Pictures of targets: coded plates, boards, limb darkening, markers that hide and merge."""

from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.boards import Board
from mosca.data.targets import CodedTarget
from reports.fidelity import Crop
from scenarios.fidelity.demo_scene import (
    BACK,
    Ball,
    Plate,
    by_px,
    grey,
    metres,
    photo,
    quiet_camera,
    side_by_side,
    stage,
)
from twin.scenes.emission import Glow
from twin.scenes.target_boards import board_figure
from twin.scenes.target_plate import INK, coded_figure
from twin.scenes.world import capsule

FACING = BACK
"""An upright plate that faces the camera."""
TILTED = Rotation.from_euler("y", 55.0, degrees=True).as_matrix() @ FACING


def coded_target() -> Crop:
    """A coded target straight and askew."""
    target = CodedTarget.of_dot(77, metres(9.0))
    half = target.plate_m / 2

    def seen(turn: Array) -> Array:
        plate = Plate(by_px(0.0, 0.0), turn, coded_figure(target), (half, half), Glow("retro", half_deg=60.0))
        return photo(stage(plates=[plate]), quiet_camera((90, 90)))

    return Crop(
        "coded_target",
        "Coded target",
        ("facing the camera", "turned by 55 degrees"),
        side_by_side(grey(seen(FACING)), grey(seen(TILTED)), zoom=4),
        "A dot within a ring of sectors that say its number. Contours of lines and arcs go through the lens and are "
        "integrated over each pixel; the tape sends less at an angle.",
        "targets/test_field",
    )


def checkerboard() -> Crop:
    """A board straight and askew."""
    board = Board(8, 5, metres(11.0), metres(6.0))
    width, height = board.size_m

    def seen(turn: Array) -> Array:
        plate = Plate(by_px(0, 0), turn, board_figure(board, INK), (width / 2, height / 2), Glow("paper"))
        return photo(stage(plates=[plate]), quiet_camera())

    return Crop(
        "checkerboard",
        "Checkerboard",
        ("facing the camera", "turned by 55 degrees"),
        side_by_side(grey(seen(FACING), 0.0, 190.0), grey(seen(TILTED), 0.0, 190.0), zoom=4),
        "Black squares printed on white paper: a figure of straight contours, bent by the lens and integrated like "
        "the others. Blur and noise are all that keeps its corners from being exact.",
        "targets/checkerboard",
    )


def limb_darkening() -> Crop:
    """Large balls, even, dark at the rim, and lit from one side."""
    size = (54, 54)

    def seen(glow: Glow) -> Array:
        return grey(photo(stage([Ball(by_px(0.0, 0.0), metres(38.0), glow)]), quiet_camera(size)), 0.0, 190.0)

    panels = (seen(Glow()), seen(Glow(limb=0.8)), seen(Glow(limb=0.5, shade=0.5, shade_world=(-1.0, -0.6, 0.0))))
    return Crop(
        "limb_darkening",
        "Limb darkening and shading",
        ("even", "rim lacks 80 %", "rim 50 %, lit from the left"),
        side_by_side(*panels, zoom=6),
        "A retroreflective ball is darker towards its rim, and one lit from the side has its centre of light off its "
        "middle: an error that no detection can see.",
        "targets/shaded_spheres",
    )


def hidden_and_merging() -> Crop:
    """A limb before markers, and markers that come together."""
    size = (120, 80)
    places = ((-40.0, -18.0), (-40.0, 18.0), (14.0, -18.0), (14.0, 18.0))
    apart = [Ball(by_px(x, y), metres(11.0)) for x, y in places]
    near = [
        Ball(by_px(x + dx, y, 2.3), metres(11.0, 2.3)) for (x, y), dx in zip(places[2:], (17.0, 8.0), strict=True)
    ]
    limb = capsule(by_px(-52.0, -60.0, 1.5), by_px(-40.0, 60.0, 1.5), metres(7.0, 1.5))
    panels = [
        grey(photo(what, quiet_camera(size)), 0.0, 170.0)
        for what in (stage(apart), stage([*apart, *near], solids=[limb]))
    ]
    return Crop(
        "hidden_and_merging",
        "Partly hidden and merging markers",
        ("apart and in view", "behind a limb (left), with a neighbour (right)"),
        side_by_side(*panels, zoom=4),
        "The edge of what hides a marker cuts its image exactly, within a pixel too, and its centroid moves; two "
        "images that run into each other become one detection.",
        "subjects/actor",
    )


CROPS = (coded_target, checkerboard, limb_darkening, hidden_and_merging)
