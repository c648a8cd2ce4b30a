"""Pictures of what lens and mount do: defocus, coma, vignetting, glare, fisheye, vibration."""

import numpy as np

from mosca.data.rig import FisheyeLens
from reports.fidelity import Crop
from scenarios.fidelity.demo_scene import Ball, by_px, change, grey, metres, photo, quiet_camera, side_by_side, stage
from twin.cameras.exposure.mount import Mount
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.sensor.background_light import Backdrop
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.stray_light.glare import Glare
from twin.cameras.stray_light.stray import Surroundings
from twin.scenes.emission import Glow

WITHOUT = "without"


def defocus() -> Crop:
    """Three markers at 0.7, 2 and 6 m."""
    f_px = 1600.0  # 8 mm over pixels of 5 um
    places = ((-38.0, 0.7), (0.0, 2.0), (38.0, 6.0))
    scene = stage([Ball(by_px(x, 0.0, z, f_px), metres(9.0, z, f_px)) for x, z in places])
    sharp = quiet_camera((120, 50), f_px)
    lens = Optics(gap_px=0.0, f_mm=8.0, f_number=1.4, focus_m=2.0, pixel_pitch_mm=0.005)
    panels = [grey(photo(scene, camera)) for camera in (sharp, change(sharp, optics=lens))]
    return Crop(
        "defocus",
        "Defocus",
        ("sharp everywhere", "8 mm at f/1.4, focused at 2 m"),
        side_by_side(*panels, zoom=4),
        "Markers of 9 px at 0.7, 2 and 6 m. The blur circle follows from focal length, f-number and distance; the "
        "pupil is cut into patches and each images the marker exactly.",
        "lenses/defocus",
    )


def coma() -> Crop:
    """A whole small image of small markers."""
    at = [(x, y) for x in (-54.0, -18.0, 18.0, 54.0) for y in (-38.0, 0.0, 38.0)]
    scene = stage([Ball(by_px(x, y), metres(3.0)) for x, y in at])
    camera = quiet_camera()
    bent = change(camera, optics=Optics(gap_px=0.0, coma_px=10.0))
    panels = [grey(photo(scene, which), 4.0, 170.0, 0.6) for which in (camera, bent)]
    return Crop(
        "coma",
        "Coma",
        (WITHOUT, "10 px long in the corners"),
        side_by_side(*panels, zoom=4),
        "Markers of 3 px all over an image; light falls outwards in a comet's tail that grows with the distance from "
        "the middle. Dark parts are brightened, and the coma is several times a usable lens's.",
        "lenses/coma",
    )


def vignetting() -> Crop:
    """An evenly bright wall."""
    scene = stage([Ball(by_px(x, y), metres(7.0)) for x in (-45.0, 0.0, 45.0) for y in (-32.0, 32.0)])
    camera = quiet_camera(sensor=Sensor(background_e=6_000.0))
    falling = change(camera, optics=Optics(gap_px=0.0, vignetting=0.6))
    panels = [grey(photo(scene, which)) for which in (camera, falling)]
    return Crop(
        "vignetting",
        "Vignetting",
        (WITHOUT, "60 % of the light lost in the corners"),
        side_by_side(*panels, zoom=4),
        "A bright background through a lens whose light falls off as cos^4 of the field angle; markers lose as much.",
        "lenses/vignetting",
    )


def glare() -> Crop:
    """A lamp that shines into the lens."""
    lamp = Ball(by_px(28.0, -14.0), metres(12.0), Glow(strength=60.0))
    scene = stage([lamp, *[Ball(by_px(x, y), metres(6.0)) for x, y in ((-35.0, -20.0), (-30.0, 24.0), (20.0, 26.0))]])
    camera = quiet_camera()
    hazy = photo(scene, camera, surroundings=Surroundings(glare=Glare(0.05)))
    return Crop(
        "glare",
        "Veiling glare",
        (WITHOUT, "5 % of all light comes again as haze"),
        side_by_side(grey(photo(scene, camera), 0.0, 120.0, 0.7), grey(hazy, 0.0, 120.0, 0.7), zoom=4),
        "A lamp 60 times as bright as a marker. Lens surfaces scatter a share of it over the image, where it adds "
        "light and noise. Dark parts are brightened.",
        "light/glare",
    )


def fisheye() -> Crop:
    """Markers on a sphere about the camera, some of them behind it."""
    balls = []
    for angle in np.deg2rad([0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 92.0]):
        for turn in np.deg2rad(np.arange(0.0, 360.0, 30.0 if angle else 360.0)):
            way = np.array([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
            balls.append(Ball(1.5 * way, 0.09))
    scene = stage(balls)
    size, middle = (120, 120), 59.5
    straight = quiet_camera(size, 60.0)
    scale = 120 / np.deg2rad(190.0)
    round_ = quiet_camera(size, lens=FisheyeLens(scale, scale, middle, middle))
    return Crop(
        "fisheye",
        "Fisheye to 190 degrees",
        ("a lens of 90 degrees", "a fisheye of 190 degrees"),
        side_by_side(grey(photo(scene, straight)), grey(photo(scene, round_)), zoom=3),
        "Rings of equal markers 15 to 92 degrees off the axis at 1.5 m, by a straight lens and by the equidistant "
        "one of a body-worn camera: the last ring lies behind its plane.",
        "lenses/fisheye_190",
    )


def vibration() -> Crop:
    """A camera on a shaking mount."""
    scene = stage([Ball(by_px(x, y), metres(7.0)) for x in (-42.0, 0.0, 42.0) for y in (-28.0, 0.0, 28.0)])
    camera = quiet_camera()
    shaken = change(camera, mount=Mount(body_px=0.0, vibration_px=4.0, vibration_hz=(60.0, 120.0)))
    panels = [grey(photo(scene, which, pulse=3, exposure_s=6e-3)) for which in (camera, shaken)]
    return Crop(
        "vibration",
        "Vibration blur",
        ("still mount", "4 px rms at 60-120 Hz, 6 ms exposure"),
        side_by_side(*panels, zoom=4),
        "The mount's pose is a function of continuous time: what it does within an exposure blurs all markers alike, "
        "and what it does between exposures moves them.",
        "mounts/vibration",
    )


def dust() -> Crop:
    """Spots on the glass before an evenly bright wall."""
    scene = stage([Ball(by_px(x, y), metres(8.0)) for x in (-40.0, 0.0, 40.0) for y in (-25.0, 25.0)])
    camera = quiet_camera(sensor=Sensor(background_e=6_000.0))
    dirty = change(camera, backdrop=Backdrop(dust=25, dust_loss=0.7, dust_radius_px=8.0))
    panels = [grey(photo(scene, which)) for which in (camera, dirty)]
    return Crop(
        "dust",
        "Dust",
        (WITHOUT, "25 specks"),
        side_by_side(*panels, zoom=4),
        "Specks on the sensor's glass take part of the light of background and markers; a marker beside one leans "
        "away from it.",
        "light/dust",
    )


CROPS = (defocus, coma, vignetting, dust, glare, fisheye, vibration)
