"""The player's numbers: what is packed is what was measured, gaps stay gaps, and the page stays small."""

import base64
import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from reports_examples import example_evidence, example_rig, without_truth

import reports
from mosca.data.detections import Detections
from mosca.data.tracks import Points
from reports.evidence import ErrorTable, Evidence, KeptImage, KeptSet, MeasuredBy
from reports.playback.data import FOUND, HIDDEN, IMAGE_BYTES, MISSED, images_that_fit, packed, played
from reports.playback.keeper import MOST_FRAMES, MOST_SETS, PageKeeper, frame_stride, kept_image
from reports.playback.player import LIBRARY, SCRIPTS


def array(text: str, dtype: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype)


def with_rows(evidence: Evidence) -> Evidence:
    """Return the example with its errors' rows in the tracks, and cameras that measured each point."""
    assert evidence.errors is not None
    rows = np.arange(len(evidence.tracks))
    cameras = np.random.default_rng(5).random((len(rows), len(evidence.rig.cameras))) > 0.4
    errors = replace(evidence.errors, sample=rows)
    return replace(
        evidence, errors=errors, measured_by=MeasuredBy(evidence.tracks.frame, evidence.tracks.xyz, cameras)
    )


def test_packed_positions_and_errors_are_those_of_the_tracks() -> None:
    evidence = example_evidence()
    shown = played(evidence)
    assert shown is not None
    document = json.loads(packed(evidence, shown, 0.3))
    step, low = np.array(document["step"]), np.array(document["low"])
    steps = array(document["measured"], "<u2").reshape(document["frames"], len(document["names"]), 3)
    errors = array(document["error"], "<i2").reshape(steps.shape)
    tracks = evidence.tracks
    np.testing.assert_allclose((low + step * steps)[tracks.frame, tracks.track], tracks.xyz, atol=6e-5)
    assert evidence.errors is not None
    np.testing.assert_allclose(
        1e-3 * document["error_step_mm"] * errors[tracks.frame, tracks.track], evidence.errors.error_xyz_m, atol=1e-7
    )
    absent = np.ones(steps.shape[:2], bool)
    absent[tracks.frame, tracks.track] = False
    assert absent.any()
    assert (steps[absent] == 65535).all()
    assert (errors[absent] == -32768).all()
    assert (steps[~absent] < 65535).all()


def test_states_say_why_there_is_no_sample() -> None:
    evidence = example_evidence(frames=4, markers=2, views=0)
    could = np.zeros((4, 2, 6), bool)
    could[:, 0, :2] = True  # two cameras see marker 0 in all frames, one sees marker 1
    could[:, 1, :1] = True
    errors = ErrorTable(np.array([0, 2]), np.array([0.0, 0.02]), np.array([0, 0]), np.full((2, 3), 1e-3))
    shown = played(replace(evidence, errors=errors, could_see=could))
    assert shown is not None
    np.testing.assert_array_equal(shown.state[:, 0], [FOUND, MISSED, FOUND, MISSED])
    np.testing.assert_array_equal(shown.state[:, 1], [HIDDEN] * 4)
    assert np.isnan(shown.measured[[1, 3], 0]).all()


def test_each_sample_names_the_cameras_that_measured_it() -> None:
    evidence = with_rows(example_evidence())
    shown = played(evidence)
    assert shown is not None
    assert shown.used is not None
    assert evidence.measured_by is not None
    tracks = evidence.tracks
    np.testing.assert_array_equal(shown.used[tracks.frame, tracks.track], evidence.measured_by.cameras)
    assert not shown.used[shown.state != FOUND].any()
    document = json.loads(packed(evidence, shown, None))
    bits = np.unpackbits(array(document["used"], "u1").reshape(*shown.state.shape, 1), axis=2, bitorder="little")
    np.testing.assert_array_equal(bits[..., :6], shown.used)


def test_what_belongs_to_no_marker_is_a_ghost() -> None:
    evidence = with_rows(example_evidence(frames=6, markers=3, views=0))
    assert evidence.errors is not None
    kept = np.arange(len(evidence.tracks)) != 7
    errors = ErrorTable(*(getattr(evidence.errors, name)[kept] for name in evidence.errors.__dataclass_fields__))
    shown = played(replace(evidence, errors=errors))
    assert shown is not None
    assert [len(one) for one in shown.ghosts] == [int(f == evidence.tracks.frame[7]) for f in range(6)]
    np.testing.assert_array_equal(np.concatenate(shown.ghosts), evidence.tracks.xyz[7:8])


def test_long_runs_are_thinned_and_a_recording_plays_its_tracks() -> None:
    assert [frame_stride(n) for n in (1, MOST_FRAMES, MOST_FRAMES + 1, 1000, 1001)] == [1, 1, 2, 2, 3]
    shown = played(without_truth(example_evidence(frames=1200, markers=2, views=0)))
    assert shown is not None
    assert len(shown.time_s) == 400
    np.testing.assert_allclose(np.diff(shown.time_s), 0.03, atol=1e-6)
    assert shown.true is None
    assert shown.names == ("marker 00 (track 0)", "marker 01 (track 1)")


def test_images_are_thinned_without_losing_small_targets() -> None:
    image = np.zeros((1500, 2000), np.uint16)
    image[700, 1001] = 4000
    image[300, 17] = 4000
    found = Detections(
        "a", np.array([[1001.0, 700.0]]), np.eye(2)[None], np.array([3.0]), np.array([4000.0]), np.ones(1)
    )
    kept = kept_image(image, found)
    small = cv2.imdecode(np.frombuffer(kept.webp, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert small.shape == (500, 666)
    assert small[700 // 3, 1001 // 3] > 128
    assert small[100, 5] > 128
    assert (small > 128).sum() < 20
    assert kept.size_px == (2000, 1500)


def test_images_are_kept_evenly_over_a_run() -> None:
    keeper = PageKeeper(1000, 2)
    image, none = np.zeros((40, 60), np.uint8), {name: Detections.none(name) for name in "ab"}
    points = Points(np.ones((1, 3)), np.eye(3)[None], [2], [0.1], [[3, -1]], [0.01], [2.0])
    for pulse in range(1000):
        keeper.attend(pulse, {"a": image, "b": None if pulse else image}, none, points)
    pulses = [one.pulse for one in keeper.sets()]
    assert len(pulses) == MOST_SETS
    assert (pulses[0], pulses[-1]) == (0, 999)
    assert max(np.diff(pulses)) - min(np.diff(pulses)) <= 1
    assert [len(one.images) for one in keeper.sets()][:2] == [2, 1]  # a camera without an image is left out
    measured_by = keeper.measured_by()
    assert measured_by is not None
    np.testing.assert_array_equal(measured_by.frame, np.arange(0, 1000, 2))
    assert measured_by.cameras.tolist() == [[True, False]] * 500


def test_images_are_left_out_where_no_page_is_made() -> None:
    keeper = PageKeeper(40, 2, images=False)
    points = Points(np.ones((1, 3)), np.eye(3)[None], [2], [0.1], [[3, -1]], [0.01], [2.0])
    keeper.attend(0, {"a": np.zeros((40, 60), np.uint8)}, {"a": Detections.none("a")}, points)
    assert keeper.sets() == ()
    assert keeper.measured_by() is not None


@pytest.mark.parametrize(("cameras", "size", "kept"), [(4, 5_000, 40), (24, 5_000, 10), (4, 20_000, 14)])
def test_images_fit_the_page(cameras: int, size: int, kept: int) -> None:
    image = KeptImage("a", b"0" * size, (64, 48), np.empty((0, 2)), np.empty(0))
    sets = tuple(KeptSet(k, (image,) * cameras) for k in range(40))
    chosen, left_out = images_that_fit(sets)
    assert sum(len(i.webp) for one in chosen for i in one.images) <= IMAGE_BYTES
    assert (len(chosen), left_out) == (kept, 40 - kept)
    assert len({b.pulse - a.pulse for a, b in pairwise(chosen)}) == 1


def test_a_rig_of_many_cameras_has_a_bit_for_each() -> None:
    evidence = with_rows(replace(example_evidence(frames=5, markers=2, views=0), rig=example_rig(11)))
    shown = played(evidence)
    assert shown is not None
    document = json.loads(packed(evidence, shown, None))
    assert len(array(document["used"], "u1")) == 5 * 2 * 2
    assert len(document["cameras"]) == 11


def test_the_library_is_the_version_that_is_named() -> None:
    folder = Path(reports.__file__).parent
    file = folder / SCRIPTS["library"]
    version = LIBRARY.rsplit(maxsplit=1)[-1]
    head = file.read_text("utf-8")[:200]
    assert f"plotly.js (gl3d - minified) v{version}" in head
    assert "MIT" in (file.parent / "plotly-LICENSE.txt").read_text("utf-8")
    assert "</script" not in file.read_text("utf-8")
