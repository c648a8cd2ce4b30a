"""The pipeline on recordings that Mitsuba rendered: whole scenes of ``witness/scenes``, renders kept between runs."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import mosca
from witness.mitsuba.__main__ import MOST_RENDER_NOISE, cache_folder
from witness.mitsuba.recording import rendered, write_recording
from witness.mitsuba.scene_file import read_scene

surfaces = pytest.importorskip("witness.mitsuba.surfaces")
try:
    surfaces.load_mitsuba()
except ImportError as error:
    pytest.skip(f"no Mitsuba: {error}; pip install -e '.[witness]'", allow_module_level=True)

pytestmark = pytest.mark.slow
SCENES = Path(__file__).parents[2] / "witness" / "scenes"
MOST_BIAS_PX = 0.005
"""A tenth of what a lens model leaves of real images (0.05 px): no place may be off by that in the mean."""
LEAST_COMPLETE = 0.97
"""Of markers that two cameras or more see without anything near."""


def _off_px(folder: Path, values: dict[str, Any], frame: int) -> np.ndarray:
    """Detections less places of light (n, 2) of a frame's targets that stand alone."""
    found = []
    for c, camera in enumerate(values["cameras"]):
        image = cv2.imread(str(folder / camera / f"{frame:06d}.png"), cv2.IMREAD_UNCHANGED)
        xy = mosca.detect(image).xy_px
        places = values["light_px"][frame, c][np.isfinite(values["bound_px2"][frame, c, :, 0, 0])]
        off = xy[None] - places[:, None]
        nearest = np.linalg.norm(off, axis=2).argmin(1)
        found.append(off[np.arange(len(places)), nearest])
    return np.concatenate(found)


@pytest.mark.parametrize("name", ["balls_2px", "balls_4px", "balls_8px", "balls_20px", "discs_8px", "defocus_4px"])
def test_places_and_points_have_no_bias(name: str, tmp_path: Path) -> None:
    scene = read_scene(SCENES / f"{name}.toml")
    render, _ = rendered(scene, cache_folder())
    values = write_recording(scene, render, tmp_path / name)
    assert values["render_noise_share"] < MOST_RENDER_NOISE
    off = np.concatenate([_off_px(tmp_path / name, values, frame) for frame in range(0, scene.frames, 3)])
    assert len(off) > 300
    assert np.abs(np.median(off, axis=0)).max() < MOST_BIAS_PX
    tracks = mosca.reconstruct(tmp_path / name, mosca.read_rig(tmp_path / name / "rig.toml"))
    alone = np.isfinite(values["bound_m2"][:, :, 0, 0])
    frame = np.searchsorted(values["time_ns"], tracks.time_ns - 500_000)
    reached = np.zeros(alone.shape, bool)
    radius = values["diameter_m"].max() / 2
    for f in range(scene.frames):
        distance = np.linalg.norm(values["xyz"][f][:, None] - tracks.xyz[frame == f][None], axis=2)
        reached[f] = distance.min(axis=1, initial=np.inf) < radius
    assert reached[alone].mean() >= LEAST_COMPLETE
