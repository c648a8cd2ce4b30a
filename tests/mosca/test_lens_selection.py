"""The lens model that the images ask for is the one that they were made with."""

from dataclasses import replace

import numpy as np
import pytest
from rigid_scenes import carried, seen, some_rig
from wand_scenes import rig as wand_rig
from wand_scenes import seen as wand_seen
from wand_scenes import waved

from mosca.calibration.lens_selection import HeldOut, preferred
from mosca.calibration.session import EstimateSettings, calibrate_sightings
from mosca.calibration.single_camera.interior_orientation import LensChoice
from mosca.data.boards import Board
from mosca.data.rig import FisheyeLens, OpenCVLens, Rig
from mosca.data.wands import Wand
from mosca.errors import InputError

BOARD = Board(9, 6, 0.12, 0.12)
CHOOSE = EstimateSettings(LensChoice("mosca", 0.0099), choose_lens=True)
MIDDLE = (327.5, 245.0)
LENSES = {
    # an affinity of 0.4 %, which OpenCV's model has no term for
    "mosca": None,
    # 66 degrees from the axis at the corners: no polynomial of the tangent follows
    "fisheye": FisheyeLens(350.0, 350.0, *MIDDLE, 0.02, -0.01),
    # barrel distortion whose inverse is no polynomial of three terms
    "opencv": OpenCVLens(420.0, 420.5, *MIDDLE, -0.28, 0.09, 1e-4, -2e-4, -0.012),
}


def boards(model, noise=0.01):
    rng = np.random.default_rng(5)
    rig = some_rig(rng, 3, radius=1.5 if model != "mosca" else 4.0, height=0.3)
    if LENSES[model] is not None:
        rig = Rig(tuple(replace(camera, lens=LENSES[model]) for camera in rig.cameras))
    return rig, seen(rig, BOARD.corners(), carried(rng, 60 if model == "mosca" else 36), rng, noise=noise)


def notes(calibration):
    return [one.message for one in calibration.findings if one.code == "lens-choice"]


@pytest.mark.parametrize("model", list(LENSES))
def test_boards_show_which_lens_they_were_seen_through(model):
    rig, sightings = boards(model)
    found = calibrate_sightings(sightings, BOARD, CHOOSE)
    assert {camera.lens.model for camera in found.rig.cameras} == {model}
    (message,) = notes(found)
    assert message.startswith(f"lens model {model}: image points of held-out views are predicted to 0.0")
    assert all(f"{other} " in message for other in LENSES if other != model)
    for camera, true in zip(found.rig.cameras, rig.cameras, strict=True):
        pose = found.rig.cameras[0].world_from_camera.inverse() @ camera.world_from_camera
        there = rig.cameras[0].world_from_camera.inverse() @ true.world_from_camera
        assert np.linalg.norm(pose.translation - there.translation) < 2e-3


def test_an_order_is_obeyed():
    _, sightings = boards("opencv")
    sightings = sightings.only(sightings.frame < 12)
    found = calibrate_sightings(sightings, BOARD, EstimateSettings(LensChoice("mosca", 0.0099)))
    assert {camera.lens.model for camera in found.rig.cameras} == {"mosca"}
    assert not notes(found)
    with pytest.raises(InputError, match="name their model, too"):
        calibrate_sightings(sightings, BOARD, replace(CHOOSE, free=("c_mm",)))


def test_a_camera_that_saw_the_target_at_the_end_only_is_calibrated_all_the_same():
    _, sightings = boards("mosca")
    late = (sightings.camera != 2) | (sightings.frame >= 44)
    found = calibrate_sightings(sightings.only(late), BOARD, CHOOSE)
    assert {camera.lens.model for camera in found.rig.cameras} == {"mosca"}
    assert found.sigma0 == pytest.approx(1.0, abs=0.1)


def test_wands_show_it_too():
    lens = OpenCVLens(420.0, 420.5, *MIDDLE, -0.28, 0.09, 0.0, 0.0, -0.012)
    cameras = tuple(replace(camera, lens=lens) for camera in wand_rig(4, seed=3, radius=2.0))
    sightings = wand_seen(cameras, waved(250, seed=3, size=(0.9, 0.9, 0.8)), 0.01, seed=3)
    found = calibrate_sightings(sightings, Wand((0.0, 0.15, 0.5), 1e-6), CHOOSE)
    assert {camera.lens.model for camera in found.rig.cameras} == {"opencv"}
    assert len(notes(found)) == 1


def test_what_is_not_significant_changes_nothing():
    rng = np.random.default_rng(1)
    squares = rng.chisquare(20, 40)
    first = HeldOut("mosca", 0.1, squares)
    for gain, best in ((0.0, "mosca"), (0.02, "mosca"), (2.0, "opencv"), (-2.0, "mosca")):
        other = HeldOut("opencv", 0.1, squares - gain + rng.normal(0, 1, 40))
        assert preferred((first, other)).model == best
