"""``python -m witness.mitsuba SCENE.toml ... --out DIR``: one recording folder for each scene file."""

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np

from witness.mitsuba.recording import rendered, write_recording
from witness.mitsuba.scene_file import read_scene


def cache_folder() -> Path:
    """Return where renders are kept unless ``--cache`` says so."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "mosca-witness"


def main(arguments: list[str] | None = None) -> int:
    """Render the scenes named; 2 for a scene file that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m witness.mitsuba", description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path, metavar="SCENE.toml")
    parser.add_argument("--out", required=True, type=Path, help="a folder NAME is made in it for each scene")
    parser.add_argument("--draw", type=int, default=0, help="which noise; the render is kept and used again")
    parser.add_argument("--cache", type=Path, default=None, help="where noise-free renders are kept")
    parser.add_argument("--frames", type=int, default=None, help="only the first ones")
    given = parser.parse_args(arguments)
    for path in given.scenes:
        try:
            scene = read_scene(path)
        except (OSError, ValueError) as error:
            print(f"error: {error}", file=sys.stderr)
            return 2
        if given.frames:
            from dataclasses import replace

            scene = replace(scene, frames=min(scene.frames, given.frames))
        begun = time.monotonic()
        render, kept = rendered(scene, given.cache or cache_folder())
        spent = time.monotonic() - begun
        values = write_recording(scene, render, given.out / scene.name, given.draw)
        bound = 1e3 * np.sqrt(np.nanmedian(values["bound_m2"].trace(axis1=2, axis2=3))) if len(values["names"]) else 0
        with np.errstate(all="ignore"):
            sigma = (
                np.sqrt(np.nanmedian(values["bound_px2"].trace(axis1=3, axis2=4) / 2)) if len(values["names"]) else 0
            )
        print(
            f"{scene.name}: {'kept' if kept else 'rendered'} in {spent:.1f} s, written in "
            f"{time.monotonic() - begun - spent:.1f} s; median bound {sigma:.4f} px, {bound:.4f} mm; "
            f"render noise adds {values['render_noise_share']:.1%}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
