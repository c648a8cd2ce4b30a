"""What is done with tracks once they are measured: gaps filled and never scored, names, smoothing on the way."""

from dataclasses import replace

import numpy as np
import pytest

from mosca.data.tracks import Samples, table
from mosca.data.truth import Truth
from mosca.formats.bodies.model_file import write_model
from mosca.labelling.marker_model import learn_model
from scenarios.run.postprocess import Postprocessing, Postprocessor, with_gaps_filled
from scenarios.score.tracks import metrics, pair

FRAMES, MARKERS, SIGMA = 200, 5, 5e-4
HIDDEN = slice(80, 88)


def motion():
    rng = np.random.default_rng(3)
    places = rng.uniform(-0.2, 0.2, (MARKERS, 3))
    t = 0.01 * np.arange(FRAMES)[:, None, None]
    return places + 0.3 * np.sin(2 * np.pi * 0.5 * t + np.array([0.0, 1.0, 2.0]))


def fed(finish, xyz=None):
    """A finisher that was given all samples but marker 2's during HIDDEN."""
    xyz = motion() if xyz is None else xyz
    rng = np.random.default_rng(4)
    finisher = Postprocessor(finish)
    for f in range(FRAMES):
        track = np.array([k for k in range(MARKERS) if k != 2 or not HIDDEN.start <= f < HIDDEN.stop])
        n = len(track)
        finisher.take(
            f,
            Samples(
                np.full(n, f), np.full(n, f * 10_000_000), track, xyz[f, track] + rng.normal(0, SIGMA, (n, 3)),
                np.tile(SIGMA**2 * np.eye(3), (n, 1, 1)), np.full(n, 4), np.full(n, 0.05), np.zeros(n, np.int8),
            ),
        )  # fmt: skip
    return finisher


def truth(xyz):
    visible = np.ones((FRAMES, MARKERS, 4))
    image = np.zeros((FRAMES, MARKERS, 4, 2))
    return Truth(
        time_ns=np.arange(FRAMES) * 10_000_000,
        names=tuple(f"M{k}" for k in range(MARKERS)),
        cameras=("a", "b", "c", "d"),
        xyz=xyz,
        visible=visible,
        image_xy_px=image,
        diameter_px=np.full((FRAMES, MARKERS, 4), 4.0),
        exposure_mid_ns=np.tile((np.arange(FRAMES) * 10_000_000)[:, None], (1, 4)),
    )


def test_nothing_is_done_unless_asked():
    tracks, told = fed(Postprocessing()).finished()
    assert told == []
    assert len(tracks) == FRAMES * MARKERS - 8
    assert (tracks.status == "measured").all()


def test_gaps_are_filled_and_no_score_changes():
    xyz = motion()
    plain, _ = fed(Postprocessing(), xyz).finished()
    tracks, told = fed(Postprocessing(fill_s=0.2), xyz).finished()
    new = tracks.select(tracks.status == "filled")
    assert new.frame.tolist() == list(range(80, 88))
    assert set(new.track) == {2}
    assert "8 samples filled in gaps up to 0.2 s, marked 'filled'" in told[0]
    again, line = with_gaps_filled(plain, 0.2)
    assert told == [line]
    np.testing.assert_array_equal(again.xyz, tracks.xyz)
    scores = [metrics(pair(one, truth(xyz), 1.0), 1.0) for one in (plain, tracks)]
    assert scores[0] == scores[1]
    assert scores[1]["completeness"].value == pytest.approx(1 - 8 / (FRAMES * MARKERS))
    # a gap that is longer than wanted stays open
    assert len(fed(Postprocessing(fill_s=0.05)).finished()[0]) == len(plain)


def test_with_a_lag_the_same_samples_come_smoothed_and_gaps_are_filled_all_the_same():
    xyz = motion()
    plain, _ = fed(Postprocessing(fill_s=0.2), xyz).finished()
    tracks, told = fed(Postprocessing(lag=10, fill_s=0.2), xyz).finished()
    assert told[0] == "positions are smoothed with a lag of 10 frames"
    for name in ("frame", "track", "status", "time_ns"):
        np.testing.assert_array_equal(getattr(tracks, name), getattr(plain, name))
    filled = tracks.status == "filled"
    np.testing.assert_array_equal(tracks.xyz[filled], plain.xyz[filled])

    def rms(one):
        one = one.select(one.status == "measured")
        return np.sqrt(np.mean((one.xyz - xyz[one.frame, one.track]) ** 2))

    assert rms(tracks) < 0.75 * rms(plain)


def test_names_reach_smoothed_and_filled_samples(tmp_path):
    plain, _ = fed(Postprocessing()).finished()
    names = np.array([f"M{k}" for k in plain.track])
    write_model(learn_model(replace(plain, label=names)), tmp_path / "model.toml")
    for finish in (
        Postprocessing(labels=tmp_path / "model.toml", fill_s=0.2),
        Postprocessing(2, tmp_path / "model.toml", 0.2),
    ):
        tracks, told = fed(finish).finished()
        assert f"5 of 5 markers of {tmp_path / 'model.toml'} found" in told
        assert tracks.label.tolist() == [f"M{k}" for k in tracks.track]


def test_no_samples_are_no_trouble(tmp_path):
    finisher = Postprocessor(Postprocessing(lag=3, fill_s=0.1))
    finisher.take(0, Samples.none())
    tracks, _ = finisher.finished()
    assert len(tracks) == len(table([])) == 0
