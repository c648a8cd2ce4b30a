"""On the path of a real rig nothing passes that did not happen: randomised campaigns of faults, and the truth."""

import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from campaign_check import Exposure, Outcome, Seen, SeenSet, Truth, checked
from campaigns import TRIGGERS, drawn, picture, run, shown

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "hardware"))
from loopback import free_address
from needs import needs_aravis

SECONDS = 60.0
AT_A_TIME = 4
SEEDS = range(20)
PERIOD_NS, EXPOSURE_NS, PULSES = 20_000_000, 1_000_000, 50
BEGIN_NS = 7_000_000_000


@pytest.mark.slow
@pytest.mark.parametrize("first", SEEDS[::AT_A_TIME])
def test_campaigns(tmp_path, first):
    """Four campaigns at a time: they mostly wait."""
    needs_aravis()
    campaigns = [drawn(seed, SECONDS) for seed in range(first, first + AT_A_TIME)]
    folders = [tmp_path / str(campaign.seed) for campaign in campaigns]
    for folder in folders:
        folder.mkdir()
    with ThreadPoolExecutor(AT_A_TIME) as threads:
        results = list(threads.map(run, campaigns, [free_address() for _ in campaigns], folders))
    told = []
    for campaign, (truth, outcome) in zip(campaigns, results, strict=True):
        figures, wrongs = checked(truth, outcome)
        print(f"{campaign}; limit {campaign.limit}\n    {figures}; exit code {outcome.code}")
        told += [f"{campaign}: {line}" for line in wrongs[:10]]
        # a campaign in which nothing came shows nothing
        assert figures.complete + figures.doubtful > 0, campaign
    assert not told, "\n".join(told)


def test_campaigns_are_drawn_from_their_seeds_and_of_all_kinds():
    campaigns = [drawn(seed) for seed in SEEDS]
    assert campaigns == [drawn(seed) for seed in SEEDS]
    faults = {"kill rig", "kill camera", "withhold", "reboot", "unplug", "late", "packets"}
    met = {(one.trigger, event.what) for one in campaigns for event in one.events}
    assert met == {(trigger, what) for trigger in TRIGGERS for what in faults}
    assert {one.wire for one in campaigns} == {"", "serial", "external"}
    assert all(2 <= len(one.events) <= 5 for one in campaigns)
    assert {len(one.cameras) for one in campaigns} == {2, 3, 4}


def test_images_show_their_exposures_or_nothing():
    for camera, serial in ((1, 0), (4, 6000), (2, 2**29)):
        assert shown(picture(camera, serial)) == (camera, serial)
    torn = np.concatenate([picture(1, 5)[:40], picture(1, 6)[40:]])
    assert shown(torn) == (-1, -1)
    assert shown(np.full_like(torn, 200)) == (-1, -1)


# a run as it should be, and the same with planted faults, each of which must be found


def true_log(limit=1.0, lost=()):
    """Return the truth of two cameras, and the outcome of a run that tells it; ``lost``: (camera, pulse)."""
    rng = np.random.default_rng(5)
    begun = {k: BEGIN_NS + k * PERIOD_NS + int(rng.integers(0, 2_000_000)) for k in range(PULSES)}
    exposures = {name: {k + 1: Exposure(begun[k], k) for k in range(PULSES)} for name in "ab"}
    sets = []
    for k in range(PULSES):
        mid_ns = begun[k] - BEGIN_NS + EXPOSURE_NS // 2
        frames = {name: Seen("ab".index(name) + 1, k + 1, mid_ns) for name in "ab" if (name, k) not in lost}
        sets.append(SeenSet(k, mid_ns, frames))
    truth = Truth(1e9 / PERIOD_NS, PULSES, limit, EXPOSURE_NS, exposures, BEGIN_NS)
    return truth, outcome_of(sets, limit)


def outcome_of(sets, limit):
    """Return the outcome of a run that received ``sets`` and tells of all that lacks."""
    share = sum(len(one.frames) == 2 and not any(s.doubt for s in one.frames.values()) for one in sets) / PULSES
    cameras = {}
    for name in "ab":
        seen = [one.frames[name] for one in sets if name in one.frames]
        doubtful = sum(bool(one.doubt) for one in seen)
        cameras[name] = {"delivered": len(seen), "dropped": len(sets) - len(seen), "unproven": doubtful}
    record = {
        "metrics": [{"name": "sets_complete", "value": share}],
        "passed": share >= limit,
        "counts": {"expected_sets": PULSES, "frame_sets": len(sets)},
        "cameras": cameras,
    }
    return Outcome(tuple(sets), record, 0 if share >= limit else 1)


def changed(outcome, change, limit=1.0):
    """Return the outcome of a run whose sets are changed one by one, and which tells them as they are now."""
    return outcome_of([change(one) for one in outcome.sets], limit)


def with_frame(one, name, **new):
    return replace(one, frames={**one.frames, name: replace(one.frames[name], **new)})


@pytest.mark.parametrize("lost", [(), (("a", 7), ("b", 30), ("b", 31))])
@pytest.mark.parametrize("limit", [1.0, 0.9])
def test_what_happened_and_is_told_passes_the_check(lost, limit):
    truth, outcome = true_log(limit, lost)
    figures, wrongs = checked(truth, outcome)
    assert wrongs == []
    assert (figures.complete, figures.wrong, figures.worst_ms) == (PULSES - len(lost), 0, 0)
    assert outcome.code == (1 if lost and limit == 1.0 else 0)


def test_numbering_that_is_off_by_one_is_found():
    truth, outcome = true_log()

    def off(one):
        return with_frame(one, "b", serial=one.frames["b"].serial + 1) if 20 < one.pulse < PULSES - 1 else one

    sets = [off(one) for one in outcome.sets[:-1]]
    _, wrongs = checked(truth, outcome_of(sets, 1.0))
    assert any("exposed" in line and "ms apart" in line for line in wrongs), wrongs


def test_sets_of_two_pulses_close_to_each_other_are_found():
    truth, outcome = true_log()
    late = truth.exposures["b"][12].start_ns - PERIOD_NS // 4
    truth.exposures["b"][11] = Exposure(late, 10)
    moved = with_frame(outcome.sets[11], "b", serial=11, time_ns=late - BEGIN_NS + EXPOSURE_NS // 2)
    sets = [one for one in outcome.sets if one.pulse != 10]
    sets[10] = moved
    _, wrongs = checked(truth, outcome_of(sets, 0.5))
    assert any("of pulses ['10', '11']" in line for line in wrongs), wrongs


def test_nominal_instead_of_true_times_are_found():
    truth, outcome = true_log()

    def nominal(one):
        mid_ns = one.pulse * PERIOD_NS + EXPOSURE_NS // 2
        return replace(with_frame(with_frame(one, "a", time_ns=mid_ns), "b", time_ns=mid_ns), time_ns=mid_ns)

    _, wrongs = checked(truth, changed(outcome, nominal))
    assert any("the time of a is off by" in line for line in wrongs)
    assert any("its time is off by" in line for line in wrongs)
    # also where the beginning of the session is not known
    assert checked(replace(truth, begin_ns=None), changed(outcome, nominal))[1]


def test_a_session_that_begins_a_pulse_early_is_found():
    truth, outcome = true_log()
    _, wrongs = checked(replace(truth, begin_ns=BEGIN_NS - PERIOD_NS), outcome)
    assert any("off by -20.000 ms" in line for line in wrongs)


def test_doubt_that_is_told_is_no_wrong_and_completes_no_set():
    truth, outcome = true_log(0.9)

    def doubtful(one):
        return with_frame(one, "b", time_ns=0, doubt="its time is not known") if one.pulse == 20 else one

    figures, wrongs = checked(truth, changed(outcome, doubtful, 0.9))
    assert (wrongs, figures.complete, figures.doubtful) == ([], PULSES - 1, 1)


def hiding(outcome, name, **told):
    record = {**outcome.record, "cameras": {**outcome.record["cameras"]}}
    record["cameras"][name] = {**record["cameras"][name], **told}
    return replace(outcome, record=record)


def test_losses_that_are_hidden_are_found():
    truth, outcome = true_log(0.5, (("a", 7),))
    _, wrongs = checked(truth, hiding(outcome, "a", dropped=0))
    assert wrongs == ["a: 49 came, 0 told to be lost, 0 after the end: not 50 pulses"]
    _, wrongs = checked(truth, hiding(outcome, "a", delivered=50, dropped=0))
    assert any("50 frames told, 49 came" in line for line in wrongs)
    ended = replace(outcome, sets=outcome.sets[:40])
    assert any("50 of 50 sets told; in truth 40" in line for line in checked(truth, ended)[1])


def test_a_wrong_verdict_is_found():
    truth, outcome = true_log(1.0, (("a", 7),))
    better = {**outcome.record, "passed": True, "metrics": [{"name": "sets_complete", "value": 1.0}]}
    _, wrongs = checked(truth, replace(outcome, record=better, code=0))
    assert any(line.startswith("sets_complete = 1.0000, in truth 0.98") for line in wrongs)
    assert any(line.startswith("passed: True, though 0.98") for line in wrongs)
    assert checked(truth, replace(outcome, code=0))[1] == ["exit code 0, passed: False"]
    gone = replace(outcome, record=None, code=2, stderr="mosca: pulse generator: is gone")
    assert checked(truth, gone)[1] == ["exit code 2 and no record: mosca: pulse generator: is gone"]


@pytest.mark.parametrize("new", [{"camera": 1}, {"serial": 99}, {"camera": -1, "serial": -1}])
def test_images_of_others_or_torn_ones_are_found(new):
    truth, outcome = true_log()
    wrong = changed(outcome, lambda one: with_frame(one, "b", **new) if one.pulse == 3 else one)
    assert any("set 3: b shows exposure" in line for line in checked(truth, wrong)[1])


def test_an_exposure_that_comes_twice_is_found():
    truth, outcome = true_log()
    twice = changed(outcome, lambda one: with_frame(one, "b", serial=4) if one.pulse == 4 else one)
    assert any("exposure 4 of b came before" in line for line in checked(truth, twice)[1])
