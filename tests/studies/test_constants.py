"""The page of constants is that of the code, none comes without words, and the screen finds what matters."""

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from tests.studies.constants.inventory import ABOUT_ONE, NOT_CHOSEN, ROOT, Constant, constants, constants_of
from tests.studies.constants.outcomes import Outcomes, read_outcomes, surprises
from tests.studies.constants.page import PAGE, ground, page
from tests.studies.constants.screen import Figures, Kept, Question, departures, screen

ON_WORDS_ALONE = 592
"""Constants that stand on words without a source, an outcome or a trial. May only fall: a new one comes with any."""

TEXT = '''
A, B = 0.3, -2.5
"""What A trades for the other. More (Huber 1981)."""
# of the next
C = 4.0
D: float = f32(0.5)  # on its line; 0.25 gives twice as many
E = 7
F = 0.1

G = (0.1, 0.2)


class Settings:
    gate: float = 0.02
'''


@pytest.fixture(scope="module")
def listed() -> list[Constant]:
    return constants()


def test_the_page_is_that_of_the_code(listed: list[Constant]) -> None:
    assert PAGE.read_text(encoding="utf-8") == page(listed, read_outcomes()), (
        "docs/constants.md is older than the code: python -m tests.studies.constants page"
    )


def test_no_constant_is_without_words_and_few_stand_on_words_alone(listed: list[Constant]) -> None:
    assert [one.key for one in listed if one.stands_on == "nothing"] == []
    assert sum(ground(one, read_outcomes()) == "words" for one in listed) <= ON_WORDS_ALONE


def test_what_is_kept_of_constants_is_of_constants_that_there_are(listed: list[Constant]) -> None:
    """Also those that are said not to be chosen."""
    keys = {one.key for one in listed}
    kept = read_outcomes()
    named = {key for many in kept.matters.values() for group in many for key in group.split(" + ")}
    assert {*kept.single, *named} <= keys
    there = {
        f"{path.relative_to(ROOT).as_posix()}::{one.name}"
        for path in {ROOT / key.split("::")[0] for key in NOT_CHOSEN}
        for one in constants_of(path.read_text(encoding="utf-8"), "")
    }
    assert NOT_CHOSEN.keys() <= there
    assert keys >= ABOUT_ONE


def test_constants_and_their_words_are_found() -> None:
    found = {one.name: one for one in constants_of(TEXT, "mosca/a/b.py")}
    assert [(one.name, one.number) for one in found.values()] == [
        ("A", 0.3), ("B", -2.5), ("C", 4.0), ("D", 0.5), ("F", 0.1), ("G", None),
    ]  # fmt: skip
    assert found["B"].told == "What A trades for the other"
    assert [found[name].words for name in "CFG"] == ["of the next", "", ""]
    assert [found[name].stands_on for name in "ACDF"] == ["source", "words", "outcome", "nothing"]


BASE = {"cloud": {"completeness": 0.99, "position_rms": 1e-4, "identity_switches": 0.0}}


def planted(matters: dict[str, float], together: tuple[str, ...] = ()):
    """Return ``Answers`` of a product in which errors grow with constants, and what it was asked."""
    asked: list[Question] = []

    def answers(questions: Sequence[Question]) -> Iterator[tuple[Question, Figures]]:
        for keys, factor in questions:
            asked.append((keys, factor))
            rms = 1e-4 * (1 + sum(matters.get(key, 0.0) for key in keys) * abs(factor - 1))
            switches = 1.0 if together and set(together) <= set(keys) else 0.0
            yield (keys, factor), {"cloud": BASE["cloud"] | {"position_rms": rms, "identity_switches": switches}}

    return answers, asked


NAMES = [f"a.py::{k}" for k in range(40)]
BOTH = [(tuple(NAMES), 0.7), (tuple(NAMES), 1.3)]


def test_bisection_finds_the_planted_constants() -> None:
    answers, asked = planted({NAMES[3]: 1.0, NAMES[33]: 0.5, NAMES[20]: 0.05})
    found = screen(BOTH, BASE, answers, Kept(None, ""))
    assert set(found.matters) == {((NAMES[k],), f) for k in (3, 33) for f in (0.7, 1.3)}
    assert found.unasked == ()
    # one by one it would be 80
    assert len(asked) <= 50
    # the control: where nothing matters by more than is flat, one question a factor
    answers, asked = planted({NAMES[20]: 0.1})
    assert screen(BOTH, BASE, answers, Kept(None, "")).matters == {}
    assert len(asked) == 2


def test_what_only_matters_together_is_found_as_a_group() -> None:
    answers, _ = planted({}, (NAMES[4], NAMES[30]))
    (question,) = screen(BOTH[:1], BASE, answers, Kept(None, "")).matters
    assert question == (tuple(NAMES), 0.7)


def test_a_screen_goes_on_where_it_was_broken_off(tmp_path: Path) -> None:
    answers, asked = planted({NAMES[3]: 1.0})

    def out_of_time(questions: Sequence[Question]) -> Iterator[tuple[Question, Figures]]:
        for k, one in enumerate(answers(questions)):
            if len(asked) > 5:
                return
            yield one
            assert k < 6

    path = tmp_path / "answers.jsonl"
    broken = screen(BOTH[:1], BASE, out_of_time, Kept(path, "this"))
    assert broken.unasked
    assert ((NAMES[3],), 0.7) not in broken.matters
    before = len(asked)
    assert ((NAMES[3],), 0.7) in screen(BOTH[:1], BASE, answers, Kept(path, "this")).matters
    first = len(asked) - before
    # other code: all is asked again
    screen(BOTH[:1], BASE, answers, Kept(path, "other"))
    assert len(asked) - before - first > first


def test_departures_go_both_ways_and_what_is_missing_is_one() -> None:
    better = {"cloud": BASE["cloud"] | {"position_rms": 0.9e-4}}
    assert [one.figure for one in departures(BASE, better)] == ["position_rms"]
    assert departures(BASE, {"cloud": BASE["cloud"] | {"position_rms": 1.04e-4}}) == []
    assert len(departures(BASE, {})) == len(BASE["cloud"])
    assert len(departures(BASE, {"cloud": BASE["cloud"] | {"position_rms": float("nan")}})) == 1


def test_only_what_is_not_known_is_a_surprise() -> None:
    answers, _ = planted({NAMES[3]: 1.0, NAMES[33]: 0.5})
    found = screen(BOTH[:1], BASE, answers, Kept(None, ""))
    known = Outcomes(matters={"0.7": [NAMES[33]]})
    assert [question for question, _ in surprises(found, known)] == [((NAMES[3],), 0.7)]


def test_the_next_screen_asks_whether_flat_groups_still_are() -> None:
    matters = {NAMES[3]: 1.0, NAMES[33]: 0.5}
    kept = Outcomes()
    kept.add_screen(screen(BOTH, BASE, planted(matters)[0], Kept(None, "")), [0.7, 1.3])
    assert kept.matters["0.7"] == sorted(matters)
    groups = [[*NAMES, "new.py::A"]]
    first = kept.questions(groups, 0.7)
    assert first[-1] == (("new.py::A",), 0.7)
    assert sorted(key for keys, _ in first for key in keys) == sorted({*groups[0]} - {*matters})
    # all flat: no more questions than groups; one that matters from now on is found in its group
    answers, asked = planted(matters)
    assert screen(first, BASE, answers, Kept(None, "")).matters == {}
    assert len(asked) == len(first)
    answers, _ = planted(matters | {NAMES[11]: 1.0})
    assert set(screen(first, BASE, answers, Kept(None, "")).matters) == {((NAMES[11],), 0.7)}
    assert kept.questions(groups, 0.7, afresh=True) == [((*NAMES, "new.py::A"), 0.7)]


RUN_TIME = """
from tests.studies.constants import run_time
SAME_SIDE = "mosca/correspondence/nearest_ray.py::SAME_SIDE"
CLIPPED = "mosca/detection/disc_fit/residual_noise.py::CLIP"
run_time.install([SAME_SIDE, CLIPPED, "mosca/tracking/gating.py::SEEN_BONUS"])
import numba
import numpy as np
from mosca.detection.disc_fit.residual_noise import CLIP
from mosca.tracking.gating import SEEN_BONUS
PAIR = run_time.listed("pair", (1.0, 5.0))

@numba.njit
def compiled(x):
    return x * SEEN_BONUS, np.float32(x) * CLIP, PAIR[0] + PAIR[1]

def plain():
    return SEEN_BONUS, CLIP, PAIR

print(*compiled(1.0), *plain())
run_time.set_factors({"mosca/tracking/gating.py::SEEN_BONUS": 0.5, "pair": 2.0})
import mosca.tracking.gating
print(*compiled(1.0), mosca.tracking.gating.SEEN_BONUS)
run_time.set_factors({CLIPPED: 2.0})
print(*compiled(1.0))
import mosca.correspondence.nearest_ray
run_time.set_factors({SAME_SIDE: 2.0})
print(round(mosca.correspondence.nearest_ray.SAME_SIDE, 9))
"""


def test_compiled_functions_read_constants_at_run_time(tmp_path: Path) -> None:
    """Values by hand: both constants are 16 and are changed after the function was compiled."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", RUN_TIME], cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.splitlines() == [
        "16.0 16.0 6.0 16.0 16.0 (1.0, 5.0)", "8.0 16.0 12.0 8.0", "8.0 32.0 12.0", "0.999"
    ]  # fmt: skip
