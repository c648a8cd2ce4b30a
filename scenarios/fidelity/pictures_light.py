"""Pictures of light that no marker sends straight: sensor patterns, background, stray light, the context image."""

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import Pose
from reports.fidelity import Crop
from scenarios.fidelity.demo_scene import (
    Ball,
    by_px,
    change,
    difference,
    grey,
    metres,
    photo,
    quiet_camera,
    side_by_side,
    stage,
)
from twin.cameras.sensor.background_light import Backdrop
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.stray_light.context_image import Cloth, Context
from twin.cameras.stray_light.mirror import PlaneMirror
from twin.cameras.stray_light.stray import Surroundings
from twin.cameras.stray_light.world import RingLight, ShinySpot
from twin.scenes.actor import build_actor
from twin.streams import rng

WITHOUT = "without"
SMALL = (60, 45)


def hot_and_dead_pixels() -> Crop:
    """Hot and dead pixels."""
    scene = stage([Ball(by_px(-12.0, -6.0), metres(8.0)), Ball(by_px(13.0, 8.0), metres(5.0))])
    camera = quiet_camera(SMALL, sensor=Sensor(background_e=2_500.0))
    bad = change(camera, sensor=Sensor(background_e=2_500.0, hot_pixels=0.006, hot_e=6_000.0, dead_pixels=0.006))
    panels = [grey(photo(scene, which), 0.0, 200.0) for which in (camera, bad)]
    return Crop(
        "hot_and_dead_pixels",
        "Hot and dead pixels",
        (WITHOUT, "0.6 % hot, 0.6 % dead"),
        side_by_side(*panels, zoom=8),
        "Drawn once for a camera and then the same in all its frames. A hot pixel is taken for a small marker, a "
        "dead one in a marker moves its centroid.",
        "sensors/hot_and_dead_pixels",
    )


def fixed_patterns() -> Crop:
    """Pixels that differ."""
    scene = stage([Ball(by_px(-10.0, 0.0), metres(14.0))])
    sensor = Sensor(bits=8, background_e=5_000.0)
    camera = quiet_camera(SMALL, sensor=sensor)
    uneven = change(camera, sensor=Sensor(background_e=5_000.0, prnu=0.04, dsnu_e=150.0))
    alone, with_them = photo(scene, camera), photo(scene, uneven)
    return Crop(
        "fixed_patterns",
        "DSNU and PRNU",
        (WITHOUT, "150 e- and 4 %", "difference, 8 times"),
        side_by_side(*[grey(p, 30.0, 240.0) for p in (alone, with_them)], difference(with_them, alone, 16.0), zoom=6),
        "Each pixel has a dark signal and a response of its own (EMVA 1288): the patterns stay where they are while "
        "noise changes. Brightness is stretched; in the difference grey means none.",
        "sensors/fixed_patterns",
    )


def uneven_background() -> Crop:
    """Light on the wall behind."""
    scene = stage([Ball(by_px(x, y), metres(7.0)) for x in (-45.0, 0.0, 45.0) for y in (-30.0, 30.0)])
    camera = quiet_camera(sensor=Sensor(background_e=2_000.0))
    look = Backdrop(gradient=(1.4, 0.5), blob_e=4_000.0, blob_xy=(0.3, 0.6), blob_radius=0.12)
    panels = [grey(photo(scene, which), 0.0, 200.0) for which in (camera, change(camera, backdrop=look))]
    return Crop(
        "uneven_background",
        "Uneven background",
        ("even", "gradient and a soft spot"),
        side_by_side(*panels, zoom=4),
        "A window to one side and a spot of light on the wall: both add electrons and their noise, and pull "
        "centroids along the gradient. Brightness is stretched a little.",
        "light/uneven_background",
    )


def ring_lights() -> Crop:
    """Two cameras that shine into this one."""
    scene = stage([Ball(by_px(x, y), metres(7.0)) for x, y in ((-30.0, 20.0), (4.0, -8.0), (34.0, 26.0))])
    camera = quiet_camera()
    back = np.diag([-1.0, 1.0, -1.0])
    others = [
        quiet_camera(name=f"other {k}", pose=Pose(back, by_px(x, y, 4.0)))
        for k, (x, y) in enumerate(((-34.0, -24.0), (30.0, -28.0)))
    ]
    lit = photo(scene, camera, others=others, surroundings=Surroundings(ring_light=RingLight(radius_m=0.06)))
    return Crop(
        "ring_lights",
        "Ring lights of other cameras",
        (WITHOUT, "two cameras across the room"),
        side_by_side(grey(photo(scene, camera)), grey(lit), zoom=4),
        "Cameras that look at each other see each other's lights: bright discs that saturate, hide markers and are "
        "taken for markers. They shine while their camera's strobe does.",
        "light/ring_lights",
    )


def mirror() -> Crop:
    """A polished floor."""
    balls = [Ball(by_px(x, y), metres(7.0)) for x, y in ((-34.0, -14.0), (0.0, -4.0), (32.0, -17.0))]
    scene, camera = stage(balls), quiet_camera()
    floor = PlaneMirror((0.0, 0.06, 1.6), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (3.0, 3.0), 0.5)
    seen = photo(scene, camera, surroundings=Surroundings(mirrors=(floor,)))
    return Crop(
        "mirror",
        "PlaneMirror images",
        (WITHOUT, "above a floor that reflects half"),
        side_by_side(grey(photo(scene, camera)), grey(seen), zoom=4),
        "The image of each marker stands where plane geometry has it, dimmer by the reflectance. Such images are "
        "consistent in all cameras: only the volume of interest tells them from markers.",
        "light/polished_floor",
    )


def shiny_spot() -> Crop:
    """A chromed screw."""
    scene = stage([Ball(by_px(x, y), metres(7.0)) for x, y in ((-34.0, 16.0), (20.0, -20.0))])
    camera = quiet_camera()
    x, y, z = (float(v) for v in by_px(8.0, 18.0))
    spot = ShinySpot((x, y, z), metres(2.0), 4.0)
    seen = photo(scene, camera, surroundings=Surroundings(spots=(spot,)))
    return Crop(
        "shiny_spot",
        "Shiny spot",
        (WITHOUT, "a chromed screw"),
        side_by_side(grey(photo(scene, camera)), grey(seen), zoom=4),
        "A fixed bright place that throws the ring light back, four times as bright as a marker; it may shine to "
        "some cameras only.",
        "light/shiny_spots_outside",
    )


def context() -> Crop:
    """Scene and body behind the markers, and a stripe on the sleeve."""
    scene = build_actor(
        duration_s=0.5,
        box_center_m=np.array([0.0, 0.0, 1.25]),
        box_size_m=np.array([2.5, 2.5, 2.5]),
        rng=rng(1, "scene"),
        marker_diameter_m=0.016,
        gait="in_place",
    )
    camera = quiet_camera((100, 150), 275.0, pose=_looking(np.array([3.2, 1.6, 1.3]), np.array([0.0, 0.0, 0.88])))
    plain = Context(ambient=0.12, lamp=0.12, step_px=1)
    stripes = tuple(
        Cloth(f"?_{limb}/0", 0.5, retro=10.0, band_m=(-0.03, 0.03)) for limb in ("forearm", "shank", "upper_arm")
    )
    striped = Context(ambient=0.12, lamp=0.12, step_px=1, clothes=stripes)
    panels = [
        grey(photo(scene, camera, surroundings=Surroundings(context=look)), 3.0, 130.0, 0.6)
        for look in (None, plain, striped)
    ]
    return Crop(
        "context",
        "Context image and bright clothing",
        ("markers alone", "with scene and body", "and reflective stripes"),
        side_by_side(*panels, zoom=3),
        "What is seen besides the markers: rays through the lens meet floor and limbs, shaded in even light and in "
        "the camera's own; reflective tape shines like markers. Dark parts are brightened.",
        "light/reflective_stripe",
    )


def _looking(place: Array, target: Array) -> Pose:
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return Pose(np.column_stack([right, np.cross(forward, right), forward]), place)


CROPS = (hot_and_dead_pixels, fixed_patterns, uneven_background, ring_lights, mirror, shiny_spot, context)
