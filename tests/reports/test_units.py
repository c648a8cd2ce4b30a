"""Formatted figures against values by hand."""

import pytest

from reports.units import duration, figure, shown


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.24512, "0.245"),
        (12.345, "12.3"),
        (1234.56, "1 235"),
        (-0.0812, "−0.0812"),
        (99.9983, "99.9983"),
        (99.17, "99.17"),
        (0.9996, "0.9996"),
        (1.2e-12, "1.20e−12"),
        (3.0, "3"),
        (float("nan"), "–"),
        (float("inf"), "∞"),
        (1e7, "10 000 000"),
    ],
)
def test_figures(value: float, text: str) -> None:
    assert figure(value) == text


def test_units() -> None:
    assert shown((2.5e-4, 3e-4), "m") == (pytest.approx((0.25, 0.3)), "mm")
    assert shown((2.5,), "m") == ((2.5,), "m")
    assert shown((0.99,), "1", "completeness") == (pytest.approx((99.0,)), "%")
    assert shown((3.1,), "1", "nees") == ((3.1,), "")
    assert shown((0.01,), "s") == (pytest.approx((10.0,)), "ms")
    assert shown((0.5,), "px") == ((0.5,), "px")


def test_durations() -> None:
    assert duration(0.0123) == "12.3 ms"
    assert duration(4.3) == "4.3 s"
    assert duration(200.0) == "3 min 20 s"
