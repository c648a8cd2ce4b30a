"""Pictures of what time does: motion blur, strobe, rolling shutter, lamps that blink."""

from reports.fidelity import Crop
from scenarios.fidelity.demo_scene import Ball, by_px, change, grey, metres, photo, quiet_camera, side_by_side, stage
from twin.cameras.exposure.shutter import Timing
from twin.scenes.emission import Blink, Glow


def motion_blur() -> Crop:
    """Markers that run 20 px in an exposure."""
    exposure = 2e-3
    size = (90, 70)
    speed = metres(18.0) / exposure

    def balls(start_px: float) -> list[Ball]:
        return [Ball(by_px(x - start_px, y), metres(d)) for x, y, d in ((-14, -18, 9), (6, 4, 6), (-8, 22, 4))]

    camera = quiet_camera(size)
    running = stage(balls(9.0), velocity_mps=(speed, speed / 4, 0.0))
    flash = Timing(jitter_s=0.0, strobe_s=exposure / 10, strobe_delay_s=0.45 * exposure)
    panels = [
        photo(stage(balls(0.0)), camera, exposure_s=exposure),
        photo(running, camera, exposure_s=exposure),
        photo(running, change(camera, timing=flash, marker_signal=6.0), exposure_s=exposure),
    ]
    return Crop(
        "motion_blur",
        "Motion blur and strobe",
        ("at rest", "18 px in an exposure", "with a strobe a tenth as long"),
        side_by_side(*[grey(panel, 0.0, 170.0) for panel in panels], zoom=4),
        "Paths are integrated over the exposure, not drawn, also where they bend or speed up. The strobe is ten "
        "times as bright, so that it gives as much light.",
        "timing/strobe",
    )


def rolling_shutter() -> Crop:
    """A column of markers that runs sideways."""
    row_time = 40e-6
    speed = metres(9.0) / 1e-3
    balls = [Ball(by_px(-18.0, y), metres(8.0)) for y in (-34.0, -17.0, 0.0, 17.0, 34.0)]
    scene = stage(balls, velocity_mps=(speed, 0.0, 0.0))
    camera = quiet_camera()
    panels = [
        photo(scene, change(camera, timing=Timing(jitter_s=0.0, row_time_s=row)), exposure_s=3e-4)
        for row in (0.0, row_time)
    ]
    return Crop(
        "rolling_shutter",
        "Rolling shutter",
        ("global shutter", "40 us from row to row"),
        side_by_side(*[grey(panel, 0.0, 170.0) for panel in panels], zoom=4),
        "Five markers one above the other run to the right at 9 px/ms. Each row opens a little after the one above "
        "it: the column leans, and each ball with it.",
        "timing/rolling_shutter",
    )


def lamps() -> Crop:
    """Lamps that blink numbers, at two pulses."""
    codes = ((1, 0), (1, 1), (0, 1), (1, 0), (0, 0), (0, 1))
    at = [(x, y) for y in (-20.0, 20.0) for x in (-36.0, 0.0, 36.0)]
    balls = [
        Ball(by_px(x, y), metres(8.0), Glow("lamp", blink=Blink(tuple(map(bool, code)), 0.01, -0.0025)))
        for (x, y), code in zip(at, codes, strict=True)
    ]
    scene, camera = stage(balls), quiet_camera((120, 70))
    panels = [grey(photo(scene, camera, pulse=pulse)) for pulse in (0, 1)]
    return Crop(
        "lamps",
        "Lamps that blink",
        ("pulse 0", "pulse 1"),
        side_by_side(*panels, zoom=4),
        "Active markers say their numbers by being on or off from frame to frame; an exposure that meets an edge of "
        "the code gets part of the light.",
        "targets/blinking_lamps",
    )


CROPS = (motion_blur, rolling_shutter, lamps)
