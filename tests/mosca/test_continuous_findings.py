"""Findings on clocks: an ambiguous offset, time stamps that contradict the images."""

import re
from types import SimpleNamespace

import numpy as np
from continuous_sessions import Motion, rig, session

from mosca.continuous.association.coarse_sync import rival, tied_clocks
from mosca.continuous.association.tracklets_2d import tracklets
from mosca.continuous.findings import association_findings, late_cameras
from mosca.continuous.model.observations import TimedObservations, no_carriers


def test_another_top_of_like_height_is_a_rival():
    score = np.array([0.0, 0.1, 0.9, 1.0, 0.7, 0.1, 0.2, 0.88, 0.3])
    assert rival(score, 3) == 7
    score[7] = 0.7
    assert rival(score, 3) is None


def told_of_ties(seen, ties) -> tuple[str, ...]:
    """Findings where every image point has its marker and no image is missing."""
    gathered = SimpleNamespace(count=SimpleNamespace(unusable={}), seen=seen, ties=ties)
    camera = np.concatenate([np.full(len(one.xy_px), c) for c, one in enumerate(seen)])
    return association_findings(gathered, observations_of(camera))


def observations_of(camera: np.ndarray) -> TimedObservations:
    n = len(camera)
    none = np.zeros(n)
    return TimedObservations(
        rig().names, ("p",), camera, none, none, none, np.zeros((n, 2)), np.tile(np.eye(2), (n, 1, 1)),
        **no_carriers(("p",))
    )  # fmt: skip


def test_motion_that_repeats_itself_leaves_several_offsets_and_it_is_said():
    """All points go round in 1 s: an offset of a whole second more or less fits as well."""
    seen, _names, _true = session(4.0, motion=Motion(frequencies_hz=(1.0, 2.0, 3.0)))
    ties = tied_clocks(seen, [tracklets(one) for one in seen], rig(), 1.6)
    for tie in ties[1:]:
        assert tie.rival_s is not None
        turns = tie.rival_s - tie.offset_s
        assert abs(abs(turns) - round(abs(turns))) < 0.02
        assert abs(turns) > 0.9
    told = told_of_ties(seen, ties)
    assert [line.split(":")[0] for line in told] == ["camera 'c1'", "camera 'c2'"]
    assert all("fits about as well: the motion repeats itself; say how far apart" in line for line in told)


def test_motion_that_does_not_repeat_itself_has_no_rival():
    seen, _names, _true = session(4.0)
    ties = tied_clocks(seen, [tracklets(one) for one in seen], rig(), 1.6)
    assert all(tie.rival_s is None for tie in ties)
    assert told_of_ties(seen, ties) == ()


class _Truth:
    points = tuple(f"p{k}" for k in range(10))

    def at(self, time_s):
        return Motion().at(np.asarray(time_s))


def observed(late_s: dict[int, float]) -> TimedObservations:
    """Return what cameras see whose stamps are ``late_s`` before their exposures."""
    seen, names, true_s = session(3.0, own_clock=False)
    frame = [one.frame for one in seen]
    parts = [
        (np.full(len(n), c), n, frame[c], true_s[c][frame[c]] - late_s.get(c, 0.0), one.xy_px, one.covariance_px2)
        for c, (one, n) in enumerate(zip(seen, names, strict=True))
    ]
    columns = [np.concatenate(part) for part in zip(*parts, strict=True)]
    return TimedObservations(rig().names, _Truth.points, *columns, **no_carriers(_Truth.points))


def test_a_late_camera_is_told_by_how_much():
    told = late_cameras(_Truth(), observed({1: 0.0004}), rig())
    assert len(told) == 1
    said = re.match(r"camera 'c1': its images show points ([\d.]+) ms", told[0])
    # 0.01 ms is two of its standard deviations, and it is reported to 0.01 ms
    assert said is not None
    assert abs(float(said[1]) - 0.4) < 0.02
    assert "after its stamps" in told[0]


def test_cameras_in_time_are_not_accused():
    assert late_cameras(_Truth(), observed({}), rig()) == ()
