"""Numbers of coded targets and lamps: distances by brute force, and what a wrong bit does."""

import hashlib
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mosca.data.cyclic_codes import CyclicCode, cyclic_code, longest_runs
from mosca.data.lamp_codes import LAMP_BITS, LAMP_NUMBERS, lamp_bits, lamp_code, m_sequence
from mosca.data.target_codes import NUMBERS, SECTORS, code_bits, ring_code
from mosca.errors import InputError


def distances(code: CyclicCode) -> np.ndarray:
    """Hamming distance (n, n, length) of each word from each other one rotated by each number of bits."""
    table = np.array([code.bits(k) for k in range(len(code.words))], dtype=np.int64)
    ones = table.sum(axis=1)
    common = np.stack([table @ np.roll(table, turn, axis=1).T for turn in range(code.length)], axis=2)
    return ones[:, None, None] + ones[None, :, None] - 2 * common


def runs(bits: tuple[bool, ...]) -> dict[bool, int]:
    found = {True: 0, False: 0}
    for bit, run in groupby(bits * 3):
        found[bit] = max(found[bit], len(list(run)))
    return found


@pytest.mark.parametrize(("code", "between", "own"), [(ring_code, 4, 4), (lamp_code, 3, 4)])
def test_words_differ_enough_however_they_are_turned(code, between, own):
    found = distances(code())
    n = len(found)
    assert found[~np.eye(n, dtype=bool)].min() >= between
    assert found[np.arange(n), np.arange(n)][:, 1:].min() >= own
    assert (found[np.arange(n), np.arange(n), 0] == 0).all()


def test_runs_are_bounded():
    for number in range(NUMBERS):
        assert max(runs(code_bits(number)).values()) <= 5
    for number in range(LAMP_NUMBERS):
        bits = lamp_bits(number)
        assert runs(bits)[False] <= 3
        assert runs(bits)[True] <= 5


def test_the_tables_are_what_has_been_published():
    """Plates are printed once: a changed table would rename them."""
    assert (len(ring_code().words), SECTORS) == (NUMBERS, 20)
    assert (len(lamp_code().words), LAMP_BITS) == (LAMP_NUMBERS, 16)
    sums = [hashlib.sha256(repr(code().words).encode()).hexdigest()[:16] for code in (ring_code, lamp_code)]
    assert sums == ["36ffae94ff2551bc", "b0e53e40a36fbb10"]
    # 16647 = 2^14 + 2^8 + 2^2 + 2 + 1
    assert [k for k, bit in enumerate(code_bits(0)) if bit] == [0, 1, 2, 8, 14]


def test_the_greedy_choice_is_that_of_a_plain_search():
    """All words of 9 bits one by one, as strings."""
    kept: list[str] = []
    for value in range(2**9):
        word = f"{value:09b}"
        turns = [word[k:] + word[:k] for k in range(9)]
        if word != min(turns) or any(run in word * 2 for run in ("0000", "1111")):
            continue
        if any(0 < sum(a != b for a, b in zip(word, t, strict=True)) < 2 for t in turns) or len(set(turns)) < 9:
            continue
        if all(sum(a != b for a, b in zip(old, t, strict=True)) >= 3 for old in kept for t in turns):
            kept.append(word)
    code = cyclic_code(9, distance=3, own_distance=2, most_zeros=3, most_ones=3)
    assert code.words == tuple(int(word, 2) for word in kept)
    assert len(kept) > 1


@pytest.mark.parametrize(("length", "counts"), [(14, (288, 36, 21)), (15, (487, 62, 33)), (17, (2832, 187, 99))])
def test_the_trade_off_table_is_true(length, counts):
    found = [len(cyclic_code(length, d, 4, most_zeros=5, most_ones=5).words) for d in (2, 3, 4)]
    assert tuple(found) == counts


@pytest.mark.parametrize(("length", "counts"), [(14, (27, 14)), (15, (45, 25)), (17, (126, 69))])
def test_the_trade_off_table_of_lamps_is_true(length, counts):
    found = [len(cyclic_code(length, d, 4, most_zeros=3, most_ones=5).words) for d in (3, 4)]
    assert tuple(found) == counts


@given(number=st.integers(0, NUMBERS - 1), turn=st.integers(0, SECTORS - 1))
def test_a_number_is_read_from_any_start(number, turn):
    bits = code_bits(number)
    read = bits[turn:] + bits[:turn]
    found, start = ring_code().find(read)
    assert found == number
    assert read[start:] + read[:start] == bits


@given(
    number=st.integers(0, NUMBERS - 1),
    turn=st.integers(0, SECTORS - 1),
    wrong=st.sets(st.integers(0, SECTORS - 1), min_size=1, max_size=3),
)
def test_up_to_three_misread_sectors_make_no_number(number, turn, wrong):
    bits = [bit ^ (k in wrong) for k, bit in enumerate(code_bits(number))]
    assert ring_code().find(tuple(bits[turn:] + bits[:turn])) is None


@given(
    number=st.integers(0, LAMP_NUMBERS - 1), start=st.integers(0, LAMP_BITS - 1), wrong=st.integers(0, LAMP_BITS - 1)
)
def test_a_lamp_is_read_from_any_frame_and_not_with_a_wrong_one(number, start, wrong):
    bits = lamp_bits(number)
    assert lamp_code().find(bits[start:] + bits[:start])[0] == number
    flipped = tuple(bit ^ (k == wrong) for k, bit in enumerate(bits))
    assert lamp_code().find(flipped) is None


@given(st.lists(st.booleans(), max_size=40))
def test_what_is_no_word_is_no_number(bits):
    found = ring_code().find(tuple(bits))
    if found is not None:
        word = code_bits(found[0])
        assert tuple(bits) in {word[k:] + word[:k] for k in range(SECTORS)}
    if len(bits) != SECTORS:
        assert found is None


def test_runs_wrap_around():
    assert longest_runs(0b1001110111, 10) == (2, 4)
    assert longest_runs(0, 5) == (5, 0)
    assert longest_runs(0b11111, 5) == (0, 5)


@pytest.mark.parametrize("number", [-1, NUMBERS])
def test_an_unknown_number_is_refused(number):
    with pytest.raises(InputError, match=f"number = {number} given; coded targets have numbers 0 to 506"):
        code_bits(number)


def test_unknown_lamps_and_orders_are_refused():
    with pytest.raises(InputError, match="number = 75 given; lamps have numbers 0 to 74"):
        lamp_bits(75)
    with pytest.raises(InputError, match="order = 2 given; a sequence has an order from 3 to 12"):
        m_sequence(2)
    with pytest.raises(IndexError, match="number = 507"):
        ring_code().bits(507)


@pytest.mark.parametrize("order", range(3, 13))
def test_a_maximum_length_sequence_tells_the_time(order):
    bits = m_sequence(order)
    n = 2**order - 1
    assert len(bits) == n
    assert sum(bits) == 2 ** (order - 1)
    windows = {(bits * 2)[k : k + order] for k in range(n)}
    assert len(windows) == n
    signs = 2.0 * np.array(bits) - 1
    spectrum = np.fft.fft(signs)
    correlation = np.fft.ifft(np.abs(spectrum) ** 2).real
    np.testing.assert_allclose(correlation, np.where(np.arange(n) == 0, n, -1), atol=1e-8 * n)
