"""Pictures of the effects of lens, mount and time: blur, vignetting, dust, glare, vibration, shutters, lamps."""

from itertools import product

import numpy as np

from mosca.data.arrays import Array
from mosca.data.rig import FisheyeLens
from scenarios.fidelity.demo_scene import (
    WITHOUT,
    Ball,
    Panels,
    by_px,
    grey,
    markers,
    metres,
    pair,
    photo,
    quiet_camera,
    stage,
)
from twin.cameras.exposure.mount import Mount
from twin.cameras.exposure.shutter import Timing
from twin.cameras.optics.blur_parameters import Optics
from twin.cameras.sensor.background_light import Backdrop
from twin.cameras.sensor.sensor import Sensor
from twin.cameras.stray_light.glare import Glare
from twin.cameras.stray_light.stray import Surroundings
from twin.scenes.emission import Blink, Glow


def _defocus() -> list[Array]:
    f_px = 1600.0  # 8 mm over pixels of 5 um
    places = ((-38.0, 0.7), (0.0, 2.0), (38.0, 6.0))
    scene = stage([Ball(by_px(x, 0.0, z, f_px), metres(9.0, z, f_px)) for x, z in places])
    lens = Optics(gap_px=0.0, f_mm=8.0, f_number=1.4, focus_m=2.0, pixel_pitch_mm=0.005)
    return pair(scene, quiet_camera((120, 50), f_px), optics=lens)


def _glare() -> list[Array]:
    lamp = Ball(by_px(28.0, -14.0), metres(12.0), Glow(strength=60.0))
    scene = stage([lamp, *markers(6.0, (-35.0, -20.0), (-30.0, 24.0), (20.0, 26.0))])
    return pair(scene, quiet_camera(), (0.0, 120.0, 0.7), surroundings=Surroundings(glare=Glare(0.05)))


def _fisheye() -> list[Array]:
    balls = []
    for angle in np.deg2rad([0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 92.0]):
        for azimuth in np.deg2rad(np.arange(0.0, 360.0, 30.0 if angle else 360.0)):
            ray = np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
            balls.append(Ball(1.5 * ray, 0.09))
    scene, size, middle, scale = stage(balls), (120, 120), 59.5, 120 / np.deg2rad(190.0)
    cameras = quiet_camera(size, 60.0), quiet_camera(size, lens=FisheyeLens(scale, scale, middle, middle))
    return [grey(photo(scene, camera)) for camera in cameras]


def _motion_blur() -> list[Array]:
    exposure = 2e-3
    speed = metres(18.0) / exposure

    def balls(start_px: float) -> list[Ball]:
        return [Ball(by_px(x - start_px, y), metres(d)) for x, y, d in ((-14, -18, 9), (6, 4, 6), (-8, 22, 4))]

    camera = quiet_camera((90, 70))
    flash = Timing(jitter_s=0.0, strobe_s=exposure / 10, strobe_delay_s=0.45 * exposure)
    running = stage(balls(9.0), velocity_mps=(speed, speed / 4, 0.0))
    at_rest = photo(stage(balls(0.0)), camera, exposure_s=exposure)
    bright = (0.0, 170.0)
    return [
        grey(at_rest, *bright),
        *pair(running, camera, bright, {"exposure_s": exposure}, timing=flash, marker_signal=6.0),
    ]


def _rolling_shutter() -> list[Array]:
    column = markers(8.0, *((-18.0, y) for y in (-34.0, -17.0, 0.0, 17.0, 34.0)))
    scene = stage(column, velocity_mps=(metres(9.0) / 1e-3, 0.0, 0.0))
    rolling = Timing(jitter_s=0.0, row_time_s=40e-6)
    return pair(scene, quiet_camera(), (0.0, 170.0), {"exposure_s": 3e-4}, timing=rolling)


def _lamps() -> list[Array]:
    codes = ((1, 0), (1, 1), (0, 1), (1, 0), (0, 0), (0, 1))
    at = [(x, y) for y in (-20.0, 20.0) for x in (-36.0, 0.0, 36.0)]
    balls = [
        Ball(by_px(x, y), metres(8.0), Glow("lamp", blink=Blink(tuple(map(bool, code)), 0.01, -0.0025)))
        for (x, y), code in zip(at, codes, strict=True)
    ]
    return [grey(photo(stage(balls), quiet_camera((120, 70)), pulse=pulse)) for pulse in (0, 1)]


CROPS: tuple[Panels, ...] = (
    Panels(
        "defocus",
        "Defocus",
        ("sharp everywhere", "8 mm at f/1.4, focused at 2 m"),
        "Markers of 9 px at 0.7, 2 and 6 m. The blur circle follows from focal length, f-number and distance. The "
        "pupil is divided into patches, and each patch images the marker exactly.",
        "lenses/defocus",
        _defocus,
    ),
    Panels(
        "coma",
        "Coma",
        (WITHOUT, "10 px long in the corners"),
        "Markers of 3 px all over an image. Light falls outwards in a comet's tail that grows with the distance "
        "from the middle. Dark parts are brightened, and the coma is several times that of a usable lens.",
        "lenses/coma",
        lambda: pair(
            stage(markers(3.0, *product((-54.0, -18.0, 18.0, 54.0), (-38.0, 0.0, 38.0)))),
            quiet_camera(),
            (4.0, 170.0, 0.6),
            optics=Optics(gap_px=0.0, coma_px=10.0),
        ),
    ),
    Panels(
        "vignetting",
        "Vignetting",
        (WITHOUT, "60 % of the light lost in the corners"),
        "A bright background through a lens whose light falls off as cos^4 of the field angle; markers lose as much.",
        "lenses/vignetting",
        lambda: pair(
            stage(markers(7.0, *product((-45.0, 0.0, 45.0), (-32.0, 32.0)))),
            quiet_camera(sensor=Sensor(background_e=6_000.0)),
            optics=Optics(gap_px=0.0, vignetting=0.6),
        ),
    ),
    Panels(
        "dust",
        "Dust",
        (WITHOUT, "25 specks"),
        "Specks on the sensor's glass take part of the light of background and markers. The image of a marker "
        "beside a speck shifts away from it.",
        "light/dust",
        lambda: pair(
            stage(markers(8.0, *product((-40.0, 0.0, 40.0), (-25.0, 25.0)))),
            quiet_camera(sensor=Sensor(background_e=6_000.0)),
            backdrop=Backdrop(dust=25, dust_loss=0.7, dust_radius_px=8.0),
        ),
    ),
    Panels(
        "glare",
        "Veiling glare",
        (WITHOUT, "5 % of all light comes again as haze"),
        "A lamp 60 times as bright as a marker. Lens surfaces scatter a share of its light over the image, which "
        "adds signal and noise. Dark parts are brightened.",
        "light/glare",
        _glare,
    ),
    Panels(
        "fisheye",
        "Fisheye to 190 degrees",
        ("a lens of 90 degrees", "a fisheye of 190 degrees"),
        "Rings of equal markers 15 to 92 degrees off the axis at 1.5 m, through a rectilinear lens and through the "
        "equidistant lens of a body-worn camera. The last ring lies behind the camera's plane.",
        "lenses/fisheye_190",
        _fisheye,
        zoom=3,
    ),
    Panels(
        "vibration",
        "Vibration blur",
        ("still mount", "4 px rms at 60-120 Hz, 6 ms exposure"),
        "The mount's pose is a function of continuous time. Its motion within an exposure blurs all markers alike; "
        "its motion between exposures moves them.",
        "mounts/vibration",
        lambda: pair(
            stage(markers(7.0, *product((-42.0, 0.0, 42.0), (-28.0, 0.0, 28.0)))),
            quiet_camera(),
            taken={"pulse": 3, "exposure_s": 6e-3},
            mount=Mount(body_px=0.0, vibration_px=4.0, vibration_hz=(60.0, 120.0)),
        ),
    ),
    Panels(
        "motion_blur",
        "Motion blur and strobe",
        ("at rest", "18 px in an exposure", "with a strobe a tenth as long"),
        "Paths are integrated over the exposure, not drawn, also where they bend or speed up. The strobe is ten "
        "times as bright, so it gives as much light.",
        "timing/strobe",
        _motion_blur,
    ),
    Panels(
        "rolling_shutter",
        "Rolling shutter",
        ("global shutter", "40 us from row to row"),
        "Five markers one above the other run to the right at 9 px/ms. Each row opens a little after the one above "
        "it: the column leans, and each ball with it.",
        "timing/rolling_shutter",
        _rolling_shutter,
    ),
    Panels(
        "lamps",
        "Lamps that blink",
        ("pulse 0", "pulse 1"),
        "Active markers show their numbers by being on or off from frame to frame. An exposure that includes an "
        "edge of the code gets part of the light.",
        "targets/blinking_lamps",
        _lamps,
    ),
)
