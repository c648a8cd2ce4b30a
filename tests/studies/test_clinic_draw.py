"""Draws of takes for the fault clinic: which they are, whatever the code says of them."""

from scenarios.spec.catalog import find
from tests.studies.clinic_draw import PLANTED, SLOW, fault_names, healthy, other_names, seed

PHRASE = "clinic held out, fourth draw, 335fb089"


def test_a_seed_is_of_the_phrase_and_the_name() -> None:
    """By ``printf 'night healthy' | sha256sum``."""
    assert seed("night", "healthy") == 0xBD0804
    assert len(fault_names()) == 20


def test_healthy_takes_have_nothing_planted() -> None:
    names = other_names(PHRASE)
    assert names[:2] == ["lenses/fisheye_190", "rigs/points_200_minute"]
    assert not {"light/glare", "light/ring_lights", "targets/checkerboard", "subjects/dance"} & set(names)
    assert all(find(name).is_file() for name in PLANTED | SLOW)


def test_an_alarm_in_a_healthy_take_is_wrong() -> None:
    """The lamps of ``light/ring_lights`` stand in three images and are no markers."""
    ((_, well, told),) = healthy(PHRASE, ["light/ring_lights"])
    assert (well, told) == (False, "reflections")
