"""The table of limits: what it calls loose."""

from reports.record import Metric, RunRecord
from tests.studies.limits_of_scenarios import limited_errors


def limits_of(scenario: str) -> dict[str, object]:
    """Limits of the only scenario."""
    return {"position_rms": 3e-4, "nees": (1.5, 6.0)} if scenario == "a/b" else {}


def record(rms_m: float, nees: float, expect: str = "pass") -> RunRecord:
    """A run of one scenario with one seed."""
    rms = Metric("position_rms", rms_m, "m", 100, limit=1e-3, passed=True)
    return RunRecord("a/b", "", 1, "twin", "measured", expect, True, "", (rms, Metric("nees", nees, "1", 100)))


def test_a_limit_is_loose_beyond_one_and_a_half_times_the_largest_error() -> None:
    (tight,) = limited_errors([[record(1.5e-4, 3.0)], [record(2.01e-4, 12.0)]], limits_of)
    assert not tight.loose
    # 1.5e-4 m at nees 3 is what is stated; at nees 12 half of it is
    assert abs(tight.stated - (1.5e-4 + 1.005e-4) / 2) < 1e-12  # type: ignore[operator]
    assert tight.row() == "| a/b | 2 | 0.15 to 0.201 mm | 0.125 | 1.60 | 0.3 | 1.49 |"
    (loose,) = limited_errors([[record(1.5e-4, 3.0)], [record(1.9e-4, 3.0)]], limits_of)
    assert loose.loose
    assert "**loose**" in loose.row()


def test_controls_and_what_is_not_limited_have_no_row() -> None:
    assert limited_errors([[record(1e-4, 3.0)], [record(1e-4, 3.0)]], lambda _: {}) == []
    assert limited_errors([[record(1e-4, 3.0, "fail")]], limits_of) == []
