"""Pictures of the gallery: what the first two cameras of each scenario see at the first pulse.

``python docs/site/pictures.py [NAME ...]`` writes ``runs/site_pictures/FOLDER/NAME.webp``, some kilobytes each, for
the scenarios that have none or whose file is newer.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from mosca.errors import MoscaError
from reports.images import block_maxima
from scenarios.build.cameras import true_rig, twin_source, virtual_cameras
from scenarios.build.scene import build_scene
from scenarios.spec.catalog import built_in, scenario_name
from scenarios.spec.scenario import load_scenario

OUT = Path(__file__).resolve().parents[2] / "runs" / "site_pictures"
HEIGHT_PX = 260
CAMERAS = 2


def images(path: Path) -> list[np.ndarray]:
    """Return the first images (H, W) of the first cameras of a scenario."""
    spec = load_scenario(path)
    scene = build_scene(spec, path.parent)
    cameras = virtual_cameras(spec, true_rig(spec, path.parent))
    found: dict[str, np.ndarray] = {}
    with twin_source(spec, scene, cameras, 1) as source:
        wanted = [one.name for one in source.cameras][:CAMERAS]
        for frame in source:
            if frame.camera in wanted and frame.image is not None:
                found.setdefault(frame.camera, frame.image)
            if len(found) == len(wanted):
                break
    return [found[name] for name in wanted]


def picture(shown: list[np.ndarray]) -> np.ndarray:
    """Return images side by side, as 8 bits, markers bright: the brightest pixel of a block stays."""
    parts = []
    for image in shown:
        step = max(1, image.shape[0] // HEIGHT_PX)
        blocks = block_maxima(image, step)
        low, high = np.percentile(blocks, (5, 99.99))
        grey = np.clip((blocks - low) / max(high - low, 1.0), 0, 1) ** 0.6
        size = (round(blocks.shape[1] * HEIGHT_PX / blocks.shape[0]), HEIGHT_PX)
        parts.append(cv2.resize((255 * grey).astype(np.uint8), size, interpolation=cv2.INTER_AREA))
        parts.append(np.full((HEIGHT_PX, 4), 255, np.uint8))
    return np.hstack(parts[:-1])


def main(names: list[str]) -> int:
    """Make the pictures that are missing; returns how many could not be made."""
    failed = 0
    for path in built_in():
        name = scenario_name(path)
        out = OUT / f"{name}.webp"
        if (names and name not in names) or (out.exists() and out.stat().st_mtime > path.stat().st_mtime):
            continue
        try:
            made = picture(images(path))
        except MoscaError as error:
            print(f"{name}: no picture: {error}", flush=True)
            failed += 1
            continue
        out.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(out), made, [cv2.IMWRITE_WEBP_QUALITY, 60])
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]) > 0)
