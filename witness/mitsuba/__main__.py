"""``python -m witness.mitsuba SCENE.toml ... --out DIR``: one recording folder for each scene file."""

import argparse
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from witness.mitsuba.recording import rendered, write_recording
from witness.mitsuba.scene_file import read_scene


def cache_folder() -> Path:
    """Return the folder in which renders are kept unless ``--cache`` names one."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "mosca-witness"


MOST_RENDER_NOISE = 0.05
"""Largest share by which rendering noise may raise the rms error of positions; above it, more samples are needed."""


def main(arguments: list[str] | None = None) -> int:
    """Render the named scenes; return 1 where a render is too noisy, 2 for a scene file that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m witness.mitsuba", description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE.toml")
    parser.add_argument("--out", required=True, type=Path, help="a folder NAME is made in it for each scene")
    parser.add_argument("--draw", type=int, default=0, help="which noise; the render is kept and used again")
    parser.add_argument("--cache", type=Path, default=None, help="where noise-free renders are kept")
    parser.add_argument("--frames", type=int, default=None, help="only the first ones")
    given = parser.parse_args(arguments)
    noisy = False
    for path in given.scenes:
        try:
            scene = read_scene(path)
        except (OSError, ValueError) as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        if given.frames:
            scene = replace(scene, frames=min(scene.frames, given.frames))
        begun = time.monotonic()
        try:
            render, kept = rendered(scene, given.cache or cache_folder())
        except (ImportError, ValueError) as error:
            print(f"error: {path}: {error}", file=sys.stderr)
            return 2
        spent = time.monotonic() - begun
        values = write_recording(scene, render, given.out / scene.name, given.draw)
        print(f"{scene.name}: {'kept' if kept else 'rendered'} in {spent:.1f} s; {_figures(values)}")
        noisy |= values["render_noise_share"] > MOST_RENDER_NOISE
    return int(noisy)


def _figures(values: dict[str, Any]) -> str:
    """Return the median bounds and the noise of the rendering in words."""
    image, point = values["bound_px2"].trace(axis1=-2, axis2=-1), values["bound_m2"].trace(axis1=-2, axis2=-1)
    if not np.isfinite(point).any():
        return "no target whose place has a bound"
    sigma_px, sigma_mm = np.sqrt(np.nanmedian(image) / 2), 1e3 * np.sqrt(np.nanmedian(point))
    return (
        f"median bound {sigma_px:.4f} px an axis, {sigma_mm:.4f} mm; the rendering adds "
        f"{values['render_noise_share']:.1%} to the places' rms"
    )


if __name__ == "__main__":
    sys.exit(main())
