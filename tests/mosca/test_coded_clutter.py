"""Views without a target are read as none: a part of them here, all 10,000 where there is time."""

import numpy as np
import pytest
from coded_clutter import KINDS, other_rings, view
from coded_views import View, paint

from mosca.coded_targets.detect import CodedSettings, find_coded
from mosca.data.target_codes import NUMBERS

EITHER = CodedSettings(colour="both")
QUICK, ALL = 320, 10_000


def false_in(first: int, last: int, seed: int) -> list[tuple[int, str, list[int]]]:
    """Return view, kind and numbers of all false identifications."""
    false = []
    for index in range(first, last):
        found = find_coded(view(index, seed), "left", EITHER)
        read = [*found.number.tolist(), *found.twice.tolist()]
        if read:
            false.append((index, KINDS[index % len(KINDS)].__name__, read))
    return false


def test_clutter_is_no_target():
    assert false_in(0, QUICK, seed=1) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_ten_thousand_views_of_clutter_are_no_target(seed):
    """None in 10,000: with 95 % confidence fewer than 3 in 10,000."""
    assert false_in(0, ALL, seed) == []


def test_the_same_plates_with_numbers_are_read():
    """Control: the clutter that is most similar to targets is read where its rings are numbers."""
    rng = np.random.default_rng(3)
    read = total = 0
    for _ in range(12):
        plates = [
            View(int(rng.integers(NUMBERS)), at, 8.0, rng.uniform(0, 0.7), *rng.uniform(0, 6.28, 2))
            for at in ((40.0, 32.0), (120.0, 32.0), (40.0, 88.0), (120.0, 88.0))
        ]
        image = paint((120, 160), plates, rng=rng, black=5.0, around=5.0, noise=2.0, blur=0.7, samples=3)
        found = set(find_coded(image, "left", EITHER).number.tolist())
        read += len(found)
        total += len({plate.number for plate in plates})
        assert found <= {plate.number for plate in plates}
    assert read == total


def test_a_reader_that_puts_one_sector_right_would_be_fooled(monkeypatch):
    """Control: with one error corrected, rings that are no number become numbers."""
    from mosca.coded_targets import detect as coded

    code = coded.ring_code()

    def corrected(word: int) -> tuple[int, int] | None:
        for flip in (0, *(1 << k for k in range(20))):
            found = code.find(tuple(bool((word ^ flip) >> k & 1) for k in range(20)))
            if found is not None:
                return found
        return None

    images = [other_rings(np.random.default_rng([4, k])) for k in range(30)]
    assert sum(len(find_coded(image, "left").number) for image in images) == 0
    monkeypatch.setattr(coded, "_found", corrected)
    assert sum(len(find_coded(image, "left").number) for image in images) > 3
