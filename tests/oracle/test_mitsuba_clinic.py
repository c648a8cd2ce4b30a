"""The clinic on a recording that Mitsuba rendered: faults of rig file and frames are named, health is left alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mosca.clinic.diagnose import ClinicReport, diagnose_frames
from mosca.data.files.rig_file import read_rig
from mosca.data.rig import Camera, Pose, Rig
from mosca.recording import open_recording
from tests.oracle.needs_mitsuba import needs_mitsuba
from witness.mitsuba.__main__ import cache_folder
from witness.mitsuba.recording import rendered, write_recording
from witness.mitsuba.scene_file import read_scene

needs_mitsuba()

pytestmark = pytest.mark.slow
SCENE = Path(__file__).parents[2] / "witness" / "scenes" / "discs_8px.toml"


@pytest.fixture(scope="module")
def take(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording with its true rig."""
    folder = tmp_path_factory.mktemp("witness") / "discs"
    scene = read_scene(SCENE)
    write_recording(scene, rendered(scene, cache_folder())[0], folder)
    return folder


def diagnosed(folder: Path, rig: Rig) -> ClinicReport:
    """Return the clinic's report."""
    with open_recording(folder, rig, None) as source:
        return diagnose_frames(source, rig)


def turned(camera: Camera) -> Camera:
    """Return it turned by 2 mrad about its x axis and 1 about its y axis."""
    turn = Rotation.from_rotvec([0.002, 0.001, 0.0]).as_matrix()
    pose = camera.world_from_camera
    return replace(camera, world_from_camera=Pose(pose.rotation @ turn, pose.translation))


def carried(camera: Camera) -> Camera:
    """Return it in a world that lies 12 mm and 10 mrad elsewhere."""
    turn, pose = Rotation.from_rotvec([0.0, 0.0, 0.01]).as_matrix(), camera.world_from_camera
    away = np.array([0.01, -0.005, 0.004])
    return replace(camera, world_from_camera=Pose(turn @ pose.rotation, turn @ pose.translation + away))


def distorted(camera: Camera) -> Camera:
    """Return it with another lens."""
    return replace(camera, lens=replace(camera.lens, k1=camera.lens.k1 + 0.2))


def longer(camera: Camera) -> Camera:
    """Return it with a principal distance that is 2 % longer."""
    lens = camera.lens
    return replace(camera, lens=replace(lens, fx_px=1.02 * lens.fx_px, fy_px=1.02 * lens.fy_px))


def test_a_healthy_take_is_left_alone(take: Path) -> None:
    report = diagnosed(take, read_rig(take / "rig.toml"))
    assert report.causes == ()
    assert report.not_judged == ()


@pytest.mark.parametrize(
    ("change", "cameras", "code", "named"),
    [
        (turned, (2,), "camera-moved", "cam3"),
        (distorted, (1,), "wrong-lens", "cam2"),
        (carried, (2, 3), "mixed-calibrations", None),
        (longer, (3,), "other-resolution", None),
    ],
)
def test_a_wrong_rig_file_is_named_first(take: Path, change, cameras, code, named) -> None:  # type: ignore[no-untyped-def]
    rig = read_rig(take / "rig.toml")
    wrong = Rig(tuple(change(one) if k in cameras else one for k, one in enumerate(rig.cameras)))
    first = diagnosed(take, wrong).causes[0]
    assert (first.code, first.camera) == (code, named)


def test_frames_paired_one_off_are_named_first(take: Path, tmp_path: Path) -> None:
    rig = read_rig(take / "rig.toml")
    for k, name in enumerate(rig.names):
        (tmp_path / name).mkdir()
        images = sorted((take / name).glob("*.png"))
        for number, image in enumerate(images[1:] if k == 0 else images[:-1]):
            (tmp_path / name / f"{number:06d}.png").symlink_to(image)
    with open_recording(tmp_path, rig, 100.0) as source:
        first = diagnose_frames(source, rig).causes[0]
    assert (first.code, first.camera) == ("frames-one-off", "cam1")
