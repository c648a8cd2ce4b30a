"""Pictures of sensor patterns, background, stray light and the context image, and of targets."""

from dataclasses import replace
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from mosca.data.arrays import Array
from mosca.data.boards import Board
from mosca.data.rig import Pose
from mosca.data.targets import CodedTarget
from scenarios.build.camera_ring import looking_at
from scenarios.fidelity.demo_scene import (
    BACK,
    SIZE,
    WITHOUT,
    Ball,
    Panels,
    Plate,
    by_px,
    difference,
    grey,
    markers,
    metres,
    pair,
    photo,
    quiet_camera,
    stage,
)
from twin.cameras.sensor.background_light import Backdrop
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.stray_light.context_image import Cloth, Context
from twin.cameras.stray_light.mirror import PlaneMirror
from twin.cameras.stray_light.stray import Surroundings
from twin.cameras.stray_light.world import RingLight, ShinySpot
from twin.scenes.actor import build_actor
from twin.scenes.emission import Glow
from twin.scenes.figure import Figure
from twin.scenes.target_boards import board_figure
from twin.scenes.target_plate import INK, coded_figure
from twin.scenes.world import capsule
from twin.streams import rng

SMALL = (60, 45)
FACING = BACK
"""An upright plate that faces the camera."""
TILTED = Rotation.from_euler("y", 55.0, degrees=True).as_matrix() @ FACING


def _hot_and_dead_pixels() -> list[Array]:
    scene = stage([*markers(8.0, (-12.0, -6.0)), *markers(5.0, (13.0, 8.0))])
    good = Sensor(background_e=2_500.0)
    bad = replace(good, hot_pixels=0.006, hot_e=6_000.0, dead_pixels=0.006)
    return pair(scene, quiet_camera(SMALL, sensor=good), (0.0, 200.0), sensor=bad)


def _fixed_patterns() -> list[Array]:
    scene = stage(markers(14.0, (-10.0, 0.0)))
    camera = quiet_camera(SMALL, sensor=Sensor(bits=8, background_e=5_000.0))
    uneven = replace(camera, sensor=Sensor(background_e=5_000.0, prnu=0.04, dsnu_e=150.0))
    alone, with_them = photo(scene, camera), photo(scene, uneven)
    return [*(grey(p, 30.0, 240.0) for p in (alone, with_them)), difference(with_them, alone, 16.0)]


def _ring_lights() -> list[Array]:
    scene = stage(markers(7.0, (-30.0, 20.0), (4.0, -8.0), (34.0, 26.0)))
    back = np.diag([-1.0, 1.0, -1.0])
    others = [
        quiet_camera(name=f"other {k}", pose=Pose(back, by_px(x, y, 4.0)))
        for k, (x, y) in enumerate(((-34.0, -24.0), (30.0, -28.0)))
    ]
    lit = photo(scene, quiet_camera(), others=others, surroundings=Surroundings(ring_light=RingLight(radius_m=0.06)))
    return [grey(photo(scene, quiet_camera())), grey(lit)]


def _mirror() -> list[Array]:
    scene = stage(markers(7.0, (-34.0, -14.0), (0.0, -4.0), (32.0, -17.0)))
    floor = PlaneMirror((0.0, 0.06, 1.6), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (3.0, 3.0), 0.5)
    return pair(scene, quiet_camera(), surroundings=Surroundings(mirrors=(floor,)))


def _shiny_spot() -> list[Array]:
    x, y, z = (float(v) for v in by_px(8.0, 18.0))
    spot = ShinySpot((x, y, z), metres(2.0), 4.0)
    scene = stage(markers(7.0, (-34.0, 16.0), (20.0, -20.0)))
    return pair(scene, quiet_camera(), surroundings=Surroundings(spots=(spot,)))


def _context() -> list[Array]:
    scene = build_actor(
        duration_s=0.5,
        box_center_m=np.array([0.0, 0.0, 1.25]),
        box_size_m=np.array([2.5, 2.5, 2.5]),
        rng=rng(1, "scene"),
        marker_diameter_m=0.016,
        gait="in_place",
    )
    camera = quiet_camera(
        (100, 150), 275.0, pose=looking_at(np.array([3.2, 1.6, 1.3]), np.array([0.0, 0.0, 0.88]), "camera")
    )
    plain = Context(ambient=0.12, lamp=0.12, step_px=1)
    stripes = tuple(
        Cloth(f"?_{limb}/0", 0.5, retro=10.0, band_m=(-0.03, 0.03)) for limb in ("forearm", "shank", "upper_arm")
    )
    return [
        grey(photo(scene, camera, surroundings=Surroundings(context=context)), 3.0, 130.0, 0.6)
        for context in (None, plain, replace(plain, clothes=stripes))
    ]


def _plates(
    figure: Figure, half_m: tuple[float, float], glow: Glow, size: tuple[int, int], bright: float
) -> list[Array]:
    """Return a printed plate, facing the camera and tilted."""
    scenes = [stage(plates=[Plate(by_px(0.0, 0.0), turn, figure, half_m, glow)]) for turn in (FACING, TILTED)]
    return [grey(photo(scene, quiet_camera(size)), 0.0, bright) for scene in scenes]


def _coded_target() -> list[Array]:
    target = CodedTarget.of_dot(77, metres(9.0))
    half = target.plate_m / 2
    return _plates(coded_figure(target), (half, half), Glow("retro", half_deg=60.0), (90, 90), 255.0)


def _checkerboard() -> list[Array]:
    board = Board(8, 5, metres(11.0), metres(6.0))
    width, height = board.size_m
    return _plates(board_figure(board, INK), (width / 2, height / 2), Glow("paper"), SIZE, 190.0)


def _limb_darkening() -> list[Array]:
    glows = (Glow(), Glow(limb=0.8), Glow(limb=0.5, shade=0.5, shade_world=(-1.0, -0.6, 0.0)))
    scenes = [stage([Ball(by_px(0.0, 0.0), metres(38.0), glow)]) for glow in glows]
    return [grey(photo(scene, quiet_camera((54, 54))), 0.0, 190.0) for scene in scenes]


def _hidden_and_merging() -> list[Array]:
    places = ((-40.0, -18.0), (-40.0, 18.0), (14.0, -18.0), (14.0, 18.0))
    apart = markers(11.0, *places)
    near = [
        Ball(by_px(x + dx, y, 2.3), metres(11.0, 2.3)) for (x, y), dx in zip(places[2:], (17.0, 8.0), strict=True)
    ]
    limb = capsule(by_px(-52.0, -60.0, 1.5), by_px(-40.0, 60.0, 1.5), metres(7.0, 1.5))
    scenes = stage(apart), stage([*apart, *near], solids=[limb])
    return [grey(photo(scene, quiet_camera((120, 80))), 0.0, 170.0) for scene in scenes]


CROPS: tuple[Panels, ...] = (
    Panels(
        "hot_and_dead_pixels",
        "Hot and dead pixels",
        (WITHOUT, "0.6 % hot, 0.6 % dead"),
        "Drawn once for a camera and then the same in all its frames. A hot pixel is taken for a small marker; a "
        "dead pixel in a marker moves its centroid.",
        "sensors/hot_and_dead_pixels",
        _hot_and_dead_pixels,
        zoom=8,
    ),
    Panels(
        "fixed_patterns",
        "DSNU and PRNU",
        (WITHOUT, "150 e- and 4 %", "difference, 8 times"),
        "Each pixel has its own dark signal and response (EMVA 1288). The patterns stay the same while noise "
        "changes. Brightness is stretched; in the difference grey means none.",
        "sensors/fixed_patterns",
        _fixed_patterns,
        zoom=6,
    ),
    Panels(
        "uneven_background",
        "Uneven background",
        ("even", "gradient and a soft spot"),
        "A window to one side and a spot of light on the wall. Both add electrons and their noise, and pull "
        "centroids along the gradient. Brightness is stretched a little.",
        "light/uneven_background",
        lambda: pair(
            stage(markers(7.0, *product((-45.0, 0.0, 45.0), (-30.0, 30.0)))),
            quiet_camera(sensor=Sensor(background_e=2_000.0)),
            (0.0, 200.0),
            backdrop=Backdrop(gradient=(1.4, 0.5), blob_e=4_000.0, blob_xy=(0.3, 0.6), blob_radius=0.12),
        ),
    ),
    Panels(
        "ring_lights",
        "Ring lights of other cameras",
        (WITHOUT, "two cameras across the room"),
        "Cameras that look at each other see each other's lights: bright discs that saturate, hide markers and are "
        "taken for markers. They shine while their camera's strobe does.",
        "light/ring_lights",
        _ring_lights,
    ),
    Panels(
        "mirror",
        "Mirror images",
        (WITHOUT, "above a floor that reflects half"),
        "The image of each marker stands where plane geometry has it, dimmer by the reflectance. Such images are "
        "consistent in all cameras: only the volume of interest separates them from markers.",
        "light/polished_floor",
        _mirror,
    ),
    Panels(
        "shiny_spot",
        "Shiny spot",
        (WITHOUT, "a chromed screw"),
        "A fixed bright place that reflects the ring light, four times as bright as a marker. It may shine to some "
        "cameras only.",
        "light/shiny_spots_outside",
        _shiny_spot,
    ),
    Panels(
        "context",
        "Context image and bright clothing",
        ("markers alone", "with scene and body", "and reflective stripes"),
        "The scene besides the markers: rays through the lens meet floor and limbs, shaded in even light and in the "
        "camera's own. Reflective tape shines like markers. Dark parts are brightened.",
        "light/reflective_stripe",
        _context,
        zoom=3,
    ),
    Panels(
        "coded_target",
        "Coded target",
        ("facing the camera", "turned by 55 degrees"),
        "A dot within a ring of sectors that encode its number. Contours of lines and arcs go through the lens and "
        "are integrated over each pixel. The tape reflects less at an angle.",
        "targets/test_field",
        _coded_target,
    ),
    Panels(
        "checkerboard",
        "Checkerboard",
        ("facing the camera", "turned by 55 degrees"),
        "Black squares printed on white paper: a figure of straight contours, bent by the lens and integrated like "
        "the others. Only blur and noise keep its corners from being exact.",
        "targets/checkerboard",
        _checkerboard,
    ),
    Panels(
        "limb_darkening",
        "Limb darkening and shading",
        ("even", "rim lacks 80 %", "rim 50 %, lit from the left"),
        "A retroreflective ball is darker towards its rim. A ball lit from the side has its centre of light off its "
        "middle, an error that no detection can see.",
        "targets/shaded_spheres",
        _limb_darkening,
        zoom=6,
    ),
    Panels(
        "hidden_and_merging",
        "Partly hidden and merging markers",
        ("apart and in view", "behind a limb (left), with a neighbour (right)"),
        "The edge of an occluding object cuts a marker's image exactly, also within a pixel, and its centroid "
        "moves. Two images that run into each other become one detection.",
        "subjects/actor",
        _hidden_and_merging,
    ),
)
