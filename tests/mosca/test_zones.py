"""Zones: two volumes that each see a part of the same motion become one set of tracks."""

from dataclasses import replace

import numpy as np
import pytest

from mosca.data.tracks import Tracks
from mosca.errors import InputError
from mosca.stitching.stitch import ZoneSettings, stitched

SIGMA = 5e-4
PERIOD_NS = 10_000_000


def walk(frames, markers, seed=1, speed=1.5):
    """Markers (t, m, 3) of a body that walks along x from -1.5 m on, each swinging about its own position."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(frames)[:, None, None]
    place = rng.uniform([-0.25, -0.3, 0.2], [0.25, 0.3, 1.8], (markers, 3))
    f, phase = rng.uniform(0.5, 1.5, (2, 1, markers, 3))
    return place + 0.08 * np.sin(2 * np.pi * (f * t + phase)) + [-1.5, 0, 0] + t * [speed, 0, 0]


def zone(xyz, inside, names, seed, shift=(0.0, 0.0, 0.0), sigma=(1.0, 1.0, 1.0), first_frame=0, late_ns=0):
    """Tracks of the samples (t, m) that are ``inside``; ``names`` (t, m) are the zone's own numbers."""
    rng = np.random.default_rng(seed)
    frame, marker = np.nonzero(inside)
    n = len(frame)
    return Tracks(
        frame + first_frame,
        frame * PERIOD_NS + late_ns,
        names[frame, marker],
        np.full(n, ""),
        xyz[frame, marker] + np.array(shift) + SIGMA * rng.normal(0, 1, (n, 3)) * sigma,
        np.tile(SIGMA**2 * np.diag(np.square(sigma)), (n, 1, 1)),
        np.full(n, 4),
        np.full(n, 0.05),
        np.full(n, "measured"),
    )


def hall(frames=220, markers=12, overlap=0.3, **right):
    """A hall cut at x = 0 with an overlap to both sides; the zones number their tracks differently."""
    xyz = walk(frames, markers)
    names = np.tile(np.arange(markers), (frames, 1))
    left = zone(xyz, xyz[:, :, 0] < overlap, names, 1)
    return xyz, left, zone(xyz, xyz[:, :, 0] > -overlap, markers - 1 - names, 2, **right)


def joined(**how):
    """Return the true positions in a hall, and the tracks of its two zones as one set."""
    xyz, left, right = hall(**how)
    return xyz, stitched({"left": left, "right": right})


def markers_of(tracks, xyz):
    """The true marker that each sample is, by distance."""
    away = np.linalg.norm(tracks.xyz[:, None] - xyz[tracks.frame], axis=2)
    assert away.min(axis=1).max() < 0.01
    return away.argmin(axis=1)


def identities(result, xyz):
    """Return how many track numbers each marker has, and how many markers each number has."""
    pairs = {(int(k), int(m)) for k, m in zip(result.track, markers_of(result, xyz), strict=True)}
    numbers, who = [k for k, _ in pairs], [m for _, m in pairs]
    return max(map(who.count, who)), max(map(numbers.count, numbers))


def test_each_target_has_one_identity_and_one_sample_an_instant():
    xyz, left, right = hall()
    result = stitched({"left": left, "right": right})
    assert identities(result.tracks, xyz) == (1, 1)
    assert len(np.unique(result.tracks.track)) == 12
    assert result.handed_over == 12
    keys = result.tracks.frame * 1000 + result.tracks.track
    assert (np.diff(keys) > 0).all()
    both = np.intersect1d(left.frame * 1000 + 11 - left.track, right.frame * 1000 + right.track)
    assert result.merged == len(both)
    assert len(result.tracks) == len(left) + len(right) - len(both)
    assert result.notes == ()


def test_double_samples_are_weighted_by_their_covariances():
    # sigma 1 and 3 on one axis: variance 1 / (1 + 1/9) = 0.9; equal on the others: 0.5
    xyz, result = joined(sigma=(3.0, 1.0, 1.0))
    doubled = result.tracks.select(result.tracks.n_cameras == 8)
    assert len(doubled) == result.merged > 300
    np.testing.assert_allclose(
        doubled.covariance, np.tile(SIGMA**2 * np.diag([0.9, 0.5, 0.5]), (len(doubled), 1, 1)), rtol=1e-9
    )
    away = doubled.xyz - xyz[doubled.frame, markers_of(doubled, xyz)]
    nees = np.einsum("ni,nij,nj->n", away, np.linalg.inv(doubled.covariance), away)
    assert nees.mean() == pytest.approx(3.0, abs=4 * np.sqrt(6.0 / len(doubled)))


def test_a_shift_between_the_frames_is_told_and_taken_out():
    true = np.array([0.005, -0.002, 0.001])
    xyz, result = joined(shift=true)
    (shift,) = result.shifts
    assert shift.real
    assert shift.targets == 12
    away = shift.shift_m - true
    assert away @ np.linalg.solve(shift.covariance_m2, away) < 16.3  # 99.9 % of chi-square with 3
    (note,) = result.notes
    assert note.startswith("zones 'left' and 'right': frames differ by (4.98, -1.99, 0.96) mm, known to 0.3")
    assert identities(result.tracks, xyz) == (1, 1)
    late = result.tracks.select(result.tracks.frame > 200)
    assert np.abs((late.xyz - xyz[late.frame, markers_of(late, xyz)]).mean(axis=0)).max() < 2e-4


def test_what_the_calibrations_err_by_is_no_shift():
    _, result = joined(shift=(0.0004, 0.0, 0.0))
    assert not result.shifts[0].real
    assert result.notes == ()


def test_targets_go_on_where_no_zone_saw_them_for_a_moment():
    # the volumes only touch: a gap of 0.1 s at 1.5 m/s
    xyz, left, right = hall(overlap=-0.075)
    result = stitched({"left": left, "right": right})
    assert result.merged == 0
    assert identities(result.tracks, xyz) == (1, 1)
    assert any("shares no target" in note for note in result.notes)
    apart = stitched({"left": left, "right": right}, ZoneSettings(bridge_s=0.0))
    assert len(np.unique(apart.tracks.track)) == 24


def test_targets_in_one_place_one_after_the_other_stay_two():
    # as near as can be where one ends and the other begins, but one goes left and one goes right
    t = 0.01 * np.arange(60)[:, None, None]
    coming, going = t * [1.0, 0, 0], (1.2 - t) * [1.0, 0, 0]
    names = np.zeros((60, 1), int)
    one = zone(coming, t[:, :, 0] < 0.5, names, 1)
    two = zone(going, t[:, :, 0] > 0.55, names, 2)
    assert len(np.unique(stitched({"a": one, "b": two}).tracks.track)) == 2


def test_a_target_that_a_zone_lost_and_named_anew_is_one_by_the_other_zone():
    xyz = walk(220, 12)
    names = np.where((np.arange(220) < 110)[:, None], np.arange(12), 100 + np.arange(12))
    left = zone(xyz, xyz[:, :, 0] < 0.6, names, 1)
    right = zone(xyz, xyz[:, :, 0] > -0.9, np.tile(np.arange(12), (220, 1)), 2)
    result = stitched({"left": left, "right": right})
    assert identities(result.tracks, xyz) == (1, 1)


def test_neighbours_that_only_one_zone_sees_are_not_taken_for_each_other():
    # two markers 20 mm apart, each hidden in one of the zones: no distance of theirs is 0
    xyz = np.stack([walk(120, 1, speed=0.5)[:, 0], walk(120, 1, speed=0.5)[:, 0] + [0, 0.02, 0]], axis=1)
    names, all_of = np.zeros((120, 2), int), np.ones((120, 2), bool)
    one = zone(xyz, all_of & [True, False], names, 1)
    two = zone(xyz, all_of & [False, True], names, 2)
    third = zone(xyz + [1.0, 0, 0], all_of, np.tile([5, 6], (120, 1)), 3)
    fourth = zone(xyz + [1.0, 0, 0], all_of, np.tile([7, 8], (120, 1)), 4)

    def with_far(near, far):
        columns = (np.concatenate([getattr(near, n), getattr(far, n)]) for n in Tracks.__dataclass_fields__)
        return Tracks(*columns)

    result = stitched({"a": with_far(one, third), "b": with_far(two, fourth)})
    assert len(np.unique(result.tracks.track)) == 4
    assert not result.shifts[0].real


def test_three_zones_in_a_row_come_into_the_first_one_s_frame():
    xyz = walk(320, 8)
    names = np.tile(np.arange(8), (320, 1))
    x = xyz[:, :, 0]
    zones = {
        "a": zone(xyz, x < 0.2, names, 1),
        "b": zone(xyz, (x > -0.2) & (x < 1.4), names + 20, 2, (0.004, 0, 0)),
        "c": zone(xyz, x > 1.0, names + 40, 3, (0.004, 0.003, 0)),
    }
    result = stitched(zones)
    assert identities(result.tracks, xyz) == (1, 1)
    assert [(s.one, s.two, s.real) for s in result.shifts] == [("a", "b", True), ("b", "c", True)]
    late = result.tracks.select(result.tracks.frame > 310)
    assert np.abs((late.xyz - xyz[late.frame, markers_of(late, xyz)]).mean(axis=0)).max() < 4e-4


def test_labels_reach_all_of_a_target():
    xyz, left, right = hall()
    label = np.where(left.track == 3, "head", "")
    result = stitched({"left": replace(left, label=label), "right": right}).tracks
    head = result.select(result.label == "head")
    assert set(markers_of(head, xyz)) == {3}
    assert len(head) == (markers_of(result, xyz) == 3).sum()


def test_what_cannot_be_stitched():
    _, left, right = hall()
    with pytest.raises(InputError, match="1 given; two or more"):
        stitched({"left": left})
    _, _, later = hall(late_ns=3 * PERIOD_NS)
    with pytest.raises(InputError, match=r"zones 'left' and 'right': frame \d+ was taken 30 ms apart"):
        stitched({"left": left, "right": later})
    bare = replace(right, covariance=np.full((len(right), 3, 3), np.nan))
    with pytest.raises(InputError, match="zone 'right': its samples have no covariances"):
        stitched({"left": left, "right": bare})
    result = stitched({"left": left, "right": Tracks.none()})
    np.testing.assert_array_equal(result.tracks.xyz, left.xyz)
