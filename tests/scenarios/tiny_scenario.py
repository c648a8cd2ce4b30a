"""A scenario of eight points before four small cameras, that runs in a second."""

TINY = """
title = "tiny"
{top}
[working_space]
size_m = [1.0, 1.0, 1.0]
[capture]
duration_s = {duration_s}
[scene]
kind = "cloud"
markers = 8
marker_diameter_m = 0.02
[cameras]
radius_m = 2.0
height_m = 0.6
size_px = [320, 240]
pixel_pitch_mm = 0.02
{cameras}
[limits]
{limits}
"""


def write_tiny(folder, *, top="", duration_s=0.3, cameras="", limits="position_rms = 0.01"):
    """Write tiny.toml into a folder and return its path."""
    path = folder / "tiny.toml"
    path.write_text(TINY.format(top=top, duration_s=duration_s, cameras=cameras, limits=limits))
    return path
