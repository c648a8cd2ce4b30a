"""The pipeline on recordings that Mitsuba rendered: whole scenes of ``witness/scenes``, renders kept between runs."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import mosca
from tests.oracle.needs_mitsuba import needs_mitsuba
from tests.oracle.points import point_figures
from witness.mitsuba.__main__ import MOST_RENDER_NOISE, cache_folder
from witness.mitsuba.recording import rendered, write_recording
from witness.mitsuba.scene_file import read_scene

needs_mitsuba()

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
    complete, *_ = point_figures(tmp_path / name, values)
    assert complete >= LEAST_COMPLETE


MOST_RATIO = {
    "balls_1p2px": 1.3, "balls_2px": 1.1, "balls_4px": 1.1, "balls_8px": 1.1, "defocus_4px": 1.1, "discs_8px": 1.1,
    "balls_20px": 1.1, "motion_6px": 1.1,
}  # fmt: skip
"""Rms over the bound."""


@pytest.mark.parametrize("name", MOST_RATIO)
def test_points_reach_their_bound_and_state_their_errors(name: str, tmp_path: Path) -> None:
    """With the true rig and default settings; the bound knows the targets' sizes, the pipeline does not."""
    render, _ = rendered(scene := read_scene(SCENES / f"{name}.toml"), cache_folder())
    values = write_recording(scene, render, tmp_path / name)
    complete, ratio, nees, within, _ = point_figures(tmp_path / name, values)
    assert complete >= 0.995
    assert ratio <= MOST_RATIO[name]
    # 2.4 to 3.6, 0.93 to 0.97 are aimed at; what lamps do to discs is a range, and targets of a pixel tell no gain
    assert (2.2 if name == "balls_1p2px" else 2.4) <= nees <= 3.6
    assert 0.92 <= within <= (0.985 if name in ("discs_8px", "balls_1p2px", "balls_20px") else 0.975)
    if name == "balls_8px":  # the control: a ball's eccentricity left in
        wrong = point_figures(tmp_path / name, values, target="point")
        assert wrong.ratio > 1.1 * ratio
        assert wrong.nees > 3.6
        assert wrong.within < 0.92


def test_targets_before_a_bright_grainy_floor_are_found_and_state_their_errors(tmp_path: Path) -> None:
    render, _ = rendered(scene := read_scene(SCENES / "bright_floor.toml"), cache_folder())
    values = write_recording(scene, render, tmp_path / "a")
    complete, ratio, nees, within, _ = point_figures(tmp_path / "a", values)
    assert complete >= 0.995
    # 1.1, 3.6 and 0.93 are aimed at: the limb of balls is not learned before a textured floor
    assert ratio <= 1.4
    assert 2.4 <= nees <= 3.7
    assert within >= 0.9
    # the control: a run that learns the floor only while it runs misses targets of its first frame sets
    assert point_figures(tmp_path / "a", values, lookahead=0)[0] < 0.98
