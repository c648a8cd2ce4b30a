"""docs/first_lab.md, word for word: a lab from the twin, calibrated, reconstructed and judged with its commands."""

import re
import shlex
import subprocess
from pathlib import Path

import numpy as np
import pytest
from command_line import mosca, refusal

from mosca.data.files.rig_file import read_rig
from mosca.data.truth import read_truth
from mosca.formats.tracks.tracks_file import read_tracks
from mosca.recording.open import open_recording

PAGE = Path(__file__).parents[2] / "docs" / "first_lab.md"


def commands(title: str) -> list[str]:
    """Return the commands under a title of the page."""
    part = PAGE.read_text(encoding="utf-8").split(f"{title}\n", 1)[1].split("\n## ", 1)[0]
    return [line for block in re.findall(r"```sh\n(.*?)```", part, re.DOTALL) for line in block.splitlines()]


def follow(title: str, folder: Path) -> list[int]:
    """Run the commands under a title as a reader does; return the exit codes of ours."""
    codes = []
    for line in commands(title):
        if line.startswith("mosca "):
            codes.append(mosca(*shlex.split(line)[1:], cwd=folder).returncode)
        else:
            subprocess.run(["bash", "-c", line], cwd=folder, check=True)
    return codes


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("first")
    assert follow("# Ten minutes in a lab without cameras", folder) == [0]
    return folder


def test_the_page_leads_from_images_to_a_verdict(lab):
    for title in ("## Calibrate", "## Reconstruct", "## Judge"):
        assert set(follow(title, lab)) == {0}
    tracks = read_tracks(lab / "lab" / "take.csv")
    assert (len(np.unique(tracks.track)), len(tracks)) == (8, 1600)
    assert (lab / "lab" / "check" / "report.html").is_file()
    # nothing but the truth knows the rig: the calibrated one is another, near it
    found, true = read_rig(lab / "lab" / "rig.toml"), read_rig(lab / "lab" / "truth" / "rig.toml")
    for one, other in zip(found.cameras, true.cameras, strict=True):
        away = np.linalg.norm(one.world_from_camera.translation - other.world_from_camera.translation)
        assert 1e-7 < away < 1e-3
    # the commands that the folder's own README gives are the page's
    printed = (lab / "lab" / "README.md").read_text()
    assert all(line in printed for line in commands("## Calibrate") + commands("## Judge"))


@pytest.mark.slow
def test_swapped_cameras_fail(lab):
    if not (lab / "lab" / "rig.toml").exists():
        follow("## Calibrate", lab)
    assert follow("## Then make it fail", lab) == [0, 1]


def test_the_truth_is_apart(lab):
    names = {path.name for path in (lab / "lab").iterdir() if path.is_dir()}
    assert {"field", "take", "truth"} <= names
    assert read_truth(lab / "lab" / "truth" / "truth.npz").xyz.shape[1:] == (8, 3)
    with open_recording(lab / "lab" / "take") as take:
        assert len(take.cameras) == 4
    assert "pose" not in (lab / "lab" / "field.toml").read_text()


def test_bad_labs_are_refused_before_anything_is_rendered(tmp_path):
    (tmp_path / "there").mkdir()
    assert "there: is there already; choose a new folder" in refusal("demo", "lab", "there", cwd=tmp_path)
    line = refusal("demo", "lab", "new", "--set", "calibration.target=none", cwd=tmp_path)
    assert "add a [calibration] without fault" in line
    line = refusal("demo", "lab", "new", "--seconds", "0", cwd=tmp_path)
    assert "capture.duration_s" in line
    assert [path.name for path in tmp_path.iterdir()] == ["there"]
