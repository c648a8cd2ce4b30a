"""Delivery: what is injected is what the assembly counts, and nothing else happens to the frames."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mosca.data.frames import CameraInfo, Frame, FrameSet
from mosca.errors import InputError
from mosca.synchronisation import Assembly, AssemblySettings, assemble
from twin.cameras.delivery import SHARES, Delivery, Taken, deliver, fate_of

RATE_HZ, PERIOD_NS, SEED = 100.0, 10_000_000, 5
NAMES = ("a", "b", "c")
IMAGE = np.zeros((2, 2), dtype=np.uint8)


def taken(pulses: int) -> list[Taken]:
    return [
        Taken(Frame(name, k, k * PERIOD_NS, 1_000_000, IMAGE), k / RATE_HZ, k / RATE_HZ)
        for k in range(pulses)
        for name in NAMES
    ]


def delivered(pulses: int, **deliveries: Delivery) -> list[Frame]:
    return list(deliver(taken(pulses), deliveries, SEED))


def order(frames: list[Frame]) -> list[tuple[str, int]]:
    return [(frame.camera, frame.index) for frame in frames]


def fates(delivery: Delivery, pulses: int, name: str = "b") -> Counter[str]:
    return Counter(fate_of(delivery, SEED, name, k, k / RATE_HZ) for k in range(pulses))


def assembled(frames: list[Frame], **kept: int) -> tuple[list[FrameSet], Assembly]:
    counts = Assembly()
    infos = [CameraInfo(name, 2, 2, 8, RATE_HZ) for name in NAMES]
    return list(assemble(frames, infos, AssemblySettings(**kept), counts)), counts


def test_without_troubles_all_comes_as_it_was() -> None:
    made = taken(20)
    assert list(deliver(made, {}, SEED)) == [one.frame for one in made]
    assert list(deliver(made, {"b": Delivery()}, SEED)) == [one.frame for one in made]


@pytest.mark.parametrize(
    ("delivery", "counted", "fate"),
    [
        (Delivery(dropped_share=0.1), "dropped", "dropped"),
        (Delivery(burst_share=0.1, burst_frames=8), "dropped", "dropped"),
        (Delivery(corrupt_share=0.1), "corrupt", "corrupt"),
        (Delivery(late_share=0.1, late_frames=40), "late", "late"),
        (Delivery(doubled_share=0.1), "doubled", "doubled"),
        (Delivery(reordered_share=0.1), "reordered", "reordered"),
        (Delivery(dies_s=1.0, returns_s=2.0), "dropped", "dead"),
    ],
    ids=["dropped", "burst", "corrupt", "late", "doubled", "reordered", "dead"],
)
def test_the_assembly_counts_what_was_injected(delivery: Delivery, counted: str, fate: str) -> None:
    pulses = 600
    injected = fates(delivery, pulses)[fate]
    sets, counts = assembled(delivered(pulses, b=delivery))
    count = counts.cameras["b"]
    assert getattr(count, counted) == injected
    assert injected > 20
    lost = injected if counted in ("dropped", "corrupt", "late") else 0
    assert count.delivered == pulses - lost
    assert len(sets) == pulses
    # the others are unaffected
    for name in "ac":
        assert counts.cameras[name].delivered == pulses
    total = replace(count, delivered=0, last_pulse=0)
    assert sum(vars(total).values()) == injected


def test_all_troubles_at_once_add_up() -> None:
    troubled = Delivery(0.03, 0.05, 6, 0.03, 0.03, 45, 0.03, 0.03, dies_s=3.0, returns_s=3.4)
    pulses = 1500
    injected = fates(troubled, pulses)
    _sets, counts = assembled(delivered(pulses, b=troubled))
    count = counts.cameras["b"]
    assert count.dropped == injected["dropped"] + injected["dead"]
    assert count.corrupt == injected["corrupt"]
    assert count.late == injected["late"]
    assert count.doubled == injected["doubled"]
    assert count.delivered == injected["good"] + injected["doubled"] + injected["reordered"]


@pytest.mark.parametrize("share", SHARES)
def test_shares_are_what_they_say(share: str) -> None:
    # 20000 frames; single troubles are known to 2.2 %, bursts of 10 to some 7 %
    found = fates(Delivery(**{share: 0.1}), 20_000)
    hit = 20_000 - found["good"]
    assert hit / 20_000 == pytest.approx(0.1, rel=0.3 if share == "burst_share" else 0.1)


def test_bursts_are_as_long_as_they_say() -> None:
    delivery = Delivery(burst_share=0.02, burst_frames=12)
    lost = [fate_of(delivery, SEED, "b", k, 0.0) == "dropped" for k in range(20_000)]
    edges = np.flatnonzero(np.diff([False, *lost, False]))
    lengths = edges[1::2] - edges[::2]
    assert lengths.min() == 12 or edges[0] == 0
    assert np.median(lengths) == 12


def test_one_trouble_moves_no_other() -> None:
    some = Delivery(dropped_share=0.1)
    more = Delivery(dropped_share=0.1, corrupt_share=0.3, late_share=0.3)
    for k in range(300):
        if fate_of(some, SEED, "b", k, 0.0) == "dropped":
            assert fate_of(more, SEED, "b", k, 0.0) == "dropped"
    assert fates(some, 300) != fates(some, 300, "c")


def test_a_dead_camera_comes_back() -> None:
    frames = delivered(100, b=Delivery(dies_s=0.2, returns_s=0.5))
    assert [f.index for f in frames if f.camera == "b"] == [*range(20), *range(50, 100)]
    frames = delivered(100, b=Delivery(dies_s=0.2))
    assert [f.index for f in frames if f.camera == "b"] == [*range(20)]


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
def test_a_reordered_frame_is_overtaken_by_one_and_no_more(share: float) -> None:
    came = np.array([f.index for f in delivered(2000, b=Delivery(reordered_share=share)) if f.camera == "b"])
    assert sorted(came) == list(range(2000))
    assert np.abs(came - np.arange(2000)).max() == 1
    assert np.mean(came > np.arange(2000)) == pytest.approx(share, rel=0.1)


def test_more_frames_cannot_be_reordered_than_overtake_them() -> None:
    with pytest.raises(InputError, match=r"0\.5 at most"):
        Delivery(reordered_share=0.6)


def test_a_late_frame_waits_for_so_many_of_the_rig() -> None:
    delivery = Delivery(late_share=0.05, late_frames=7)
    frames = order(delivered(100, b=delivery))
    made = order([one.frame for one in taken(100)])
    for k in range(90):
        if fate_of(delivery, SEED, "b", k, 0.0) == "late":
            place = frames.index(made[3 * k + 1])
            waited = [f for f in made[3 * k + 2 : 3 * k + 2 + 7] if f in frames[:place]]
            # those of the seven that are late themselves cannot have come before
            late = sum(
                name == "b" and fate_of(delivery, SEED, "b", number, 0.0) == "late"
                for name, number in made[3 * k + 2 : 3 * k + 2 + 7]
            )
            assert len(waited) == 7 - late
            assert made[3 * k + 2 + 7] not in frames[:place]


def test_a_corrupt_frame_has_no_image_and_says_why() -> None:
    frames = delivered(50, b=Delivery(corrupt_share=1.0))
    bad = [f for f in frames if f.camera == "b"]
    assert len(bad) == 50
    for frame in bad:
        assert (frame.image, frame.status, frame.rows) == (None, "corrupt", 2)
        assert "damaged" in frame.note


@settings(max_examples=60, deadline=None)
@given(data=st.data(), pulses=st.integers(0, 60))
def test_nothing_is_lost_but_what_must_be(data: st.DataObject, pulses: int) -> None:
    def drawn() -> Delivery:
        given_: dict[str, Any] = {name: data.draw(st.floats(0.0, 0.5)) for name in SHARES}
        return Delivery(
            **given_, burst_frames=data.draw(st.integers(1, 9)), late_frames=data.draw(st.integers(1, 200))
        )

    deliveries = {name: drawn() for name in NAMES[:2]}
    came = Counter((f.camera, f.index) for f in delivered(pulses, **deliveries))
    copies = {"good": 1, "corrupt": 1, "late": 1, "reordered": 1, "doubled": 2, "dropped": 0, "dead": 0}
    for name in NAMES:
        for k in range(pulses):
            fate = fate_of(deliveries.get(name, Delivery()), SEED, name, k, k / RATE_HZ)
            assert came[name, k] == copies[fate]


@pytest.mark.parametrize(
    "wrong", [{"late_share": 1.5}, {"dropped_share": -0.1}, {"late_frames": 0}, {"burst_frames": 0}]
)
def test_what_cannot_be_is_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=f"delivery: {next(iter(wrong))} = "):
        Delivery(**wrong)
