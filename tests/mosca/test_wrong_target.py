"""A wrong calibration target is told from sets spread over the recording, a late or seldom one is still taken."""

import numpy as np
import pytest
from coded_views import View, paint

from mosca.calibration.targets.read_session import check_shown
from mosca.calibration.targets.reader import reader_of
from mosca.data.boards import Board
from mosca.data.frames import CameraInfo, Frame
from mosca.data.sightings import Part
from mosca.data.targets import CodedTarget, PlacedTarget, TestField
from mosca.data.wands import Wand
from mosca.errors import InputError

NOTHING, OTHERS, TARGET = 0, 1, 2
"""What an image shows, in its pixels."""


class Shows:
    """A recording of two cameras; ``shows``: what each frame set has in the image of the second one."""

    def __init__(self, shows):
        self.shows, self.read = shows, 0
        self.cameras = tuple(CameraInfo(name, 2, 2, 8, 10.0) for name in "ab")

    def __iter__(self):
        for k, shown in enumerate(self.shows):
            self.read += 1
            for info, value in zip(self.cameras, (NOTHING, shown), strict=True):
                yield Frame(info.name, k, 100_000_000 * k, 1_000_000, np.full((2, 2), value, np.uint8))


class Reader:
    """Finds one mark in an image of TARGET."""

    def __init__(self):
        self.others, self.images = False, 0

    def read(self, image, camera, bit_depth):
        self.images += 1
        self.others |= image[0, 0] == OTHERS
        n = int(image[0, 0] == TARGET)
        return Part(0, 0, np.zeros(n, np.int64), np.zeros((n, 2)), np.zeros((n, 2, 2)), np.zeros(n))

    def seen_instead(self):
        return "; seen are others" if self.others else ""

    def advice(self):
        return ""

    def sees_others(self):
        return self.others


def looked(shows, every=1, known=True):
    """Return the images that each reader has examined, and the refusal ("" where there is none)."""
    readers = []

    def reader():
        readers.append(Reader())
        return readers[-1]

    source = Shows(shows)
    try:
        check_shown(source, reader, 2 * len(shows) if known else None, every)
    except InputError as error:
        return [one.images for one in readers], str(error)
    return [one.images for one in readers], ""


def test_a_wrong_target_is_told_after_60_sets_spread_over_the_recording():
    images, told = looked([OTHERS] * 300)
    assert images == [2 * 60]
    assert told.startswith("0 of 60 frame sets spread over 300 of a, b show the target; seen are others; check the")
    assert looked([OTHERS] * 3000, every=10) == (images, told)


@pytest.mark.parametrize(
    "shows",
    [[OTHERS] * 290 + [TARGET] * 10, [TARGET] * 5 + [OTHERS] * 295, [OTHERS] * 101 + [TARGET] * 5 + [OTHERS] * 194],
)
def test_a_target_in_a_sixtieth_of_the_recording_is_found_wherever_that_is(shows):
    assert looked(shows)[1] == ""


def test_nothing_at_all_is_told_after_300_sets():
    """What is not seen may be out of sight: only a longer look is enough."""
    images, told = looked([NOTHING] * 3000)
    assert images == [2 * 60, 2 * 300]
    assert told.startswith("0 of 300 frame sets spread over 3000 of a, b show the target; check the target file")
    # where the 60 do not look (0, 50, 100 ...) but the 300 do (0, 10, 20)
    assert looked(([NOTHING] * 17 + [TARGET] * 10 + [NOTHING] * 23) * 60) == ([2 * 60, 2 * 3], "")


def test_a_recording_that_is_short_or_of_unknown_length_is_read_whole_instead():
    assert looked([OTHERS] * 119) == ([], "")
    assert looked([OTHERS] * 300, known=False) == ([], "")
    assert looked([NOTHING] * 599) == ([2 * (599 // 9 + 1)], "")


def test_numbers_of_another_field_are_told_and_boards_and_wands_are_given_the_longer_look():
    up = np.array([0.0, 0.0, 1.0])
    image = paint((200, 240), [View(17, (60.0, 50.0), 9.0)], rng=np.random.default_rng(0))
    for number, others in ((5, True), (17, False)):
        field = TestField((PlacedTarget("code", CodedTarget.of_dot(number, 0.01), np.zeros(3), up),))
        reader = reader_of(field)
        assert (len(reader.read(image, "a", 8).mark), reader.sees_others()) == (int(not others), others)
    for target in (Board(6, 5, 0.03, 0.03), Wand((0.0, 0.15, 0.5), 0.02)):
        reader = reader_of(target)
        reader.read(image, "a", 8)
        assert not reader.sees_others()
