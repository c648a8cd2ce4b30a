"""[labels] in scenarios, from true positions of the twin's face: names, fault, what it needs, and the verb."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from track_tables import measured_tracks

from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.formats.tracks.tracks_file import read_tracks, write_tracks
from scenarios.build.scene import build_scene
from scenarios.commands.labels_auto import label_auto
from scenarios.run.labels import surface_labels
from scenarios.spec.catalog import LIBRARY
from scenarios.spec.scenario import load_scenario

FACE, CONTROL = LIBRARY / "people" / "face.toml", LIBRARY / "controls" / "swapped_face.toml"
FRAMES = 60


@pytest.fixture(scope="module")
def take() -> tuple[Tracks, np.ndarray]:
    """The scenario's face at 20 Hz, each marker a track of its own, and the true name of each track."""
    scene = build_scene(load_scenario(FACE, ("capture.duration_s=3.0",)), FACE.parent)
    sampler = scene.sampler()
    xyz = np.array([sampler.at(0.05 * k).marker_xyz for k in range(FRAMES)])
    order = np.random.default_rng(0).permutation(xyz.shape[1])
    frame, track = np.indices(xyz.shape[:2])
    tracks = measured_tracks(frame.ravel(), track.ravel(), xyz[:, order].reshape(-1, 3))
    return replace(tracks, time_ns=tracks.frame * 50_000_000), np.array(scene.marker_names)[order]


def test_the_scenarios_face_has_all_its_names(take: tuple[Tracks, np.ndarray]) -> None:
    tracks, true = take
    labelled = surface_labels(load_scenario(FACE), FACE.parent, tracks)
    assert (labelled.label == true[labelled.track]).mean() > 0.97
    named = labelled.label != ""
    assert (labelled.label[named] == true[labelled.track[named]]).all()


def test_the_control_swaps_the_mouths_corners(take: tuple[Tracks, np.ndarray]) -> None:
    tracks, true = take
    labelled = surface_labels(load_scenario(CONTROL), CONTROL.parent, tracks)
    wrong = np.unique(true[labelled.track[(labelled.label != "") & (labelled.label != true[labelled.track])]])
    assert wrong.tolist() == ["LMTC", "RMTC"]


def test_the_verb_names_a_face(take: tuple[Tracks, np.ndarray], tmp_path: Path) -> None:
    tracks, _ = take
    write_tracks(tracks, tmp_path / "take.npz", 20.0)
    lines = label_auto(tmp_path / "take.npz", tmp_path / "named.npz", "face", None, None, None, None)
    named = read_tracks(tmp_path / "named.npz")
    assert f"{len(set(named.label.tolist()) - {''})} of 40 markers of the set found" in lines[0]
    write_tracks(tracks.select(tracks.track < 4), tmp_path / "few.npz", 20.0)
    with pytest.raises(InputError, match="6 or more markers of the model must be seen"):
        label_auto(tmp_path / "few.npz", tmp_path / "out.npz", "face", None, None, None, None)
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize(
    ("path", "overrides", "told"),
    [
        (FACE, ["continuous={}"], "[labels] with [continuous]"),
        (FACE, ["skeleton={}"], "[labels] and [skeleton] given"),
        (FACE, ["limits.joint_center_rms=0.01"], "limits.joint_center_rms needs a skeleton"),
        (FACE, ["scene.size=2"], "'scene.face.size'"),
        (LIBRARY / "spaces" / "space_1m.toml", ["limits.label_f1=0.9"], "add [skeleton] (or [labels])"),
    ],
)
def test_wrong_keys_are_told_of_in_one_line(path: Path, overrides: list[str], told: str) -> None:
    with pytest.raises(InputError) as refused:
        load_scenario(path, tuple(overrides))
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_model_that_is_none_is_refused(take: tuple[Tracks, np.ndarray]) -> None:
    spec = load_scenario(FACE, ("labels.model=face.toml",))
    with pytest.raises(InputError, match="is a scenario, not a surface model"):
        surface_labels(spec, FACE.parent, take[0])
