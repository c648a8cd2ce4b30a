"""Rejects keys that have no effect in their context: a disturbance without effect proves nothing."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from mosca.data.files.toml import Table
from mosca.errors import InputError
from scenarios.spec.cameras import DeliverySpec, MountSpec, TimingSpec

Words = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Rule:
    """``keys`` of ``table`` have an effect only where ``works`` holds for a camera's keys; ``wants``: its name."""

    table: str
    keys: tuple[str, ...]
    works: Callable[[Words], bool]
    wants: str


DEFAULTS: Mapping[str, Table] = {"timing": TimingSpec(), "mount": MountSpec(), "delivery": DeliverySpec()}
RULES = (
    Rule(
        "timing",
        ("offset_s", "drift_ppm"),
        lambda w: w["timing"]["rate_hz"] is not None,
        "timing.rate_hz: only a free-running camera has it",
    ),
    Rule(
        "timing",
        ("skew_s",),
        lambda w: w["timing"]["rate_hz"] is None,
        "a camera without timing.rate_hz: a free-running one has offset_s",
    ),
    Rule(
        "timing",
        ("clock_offset_s", "clock_drift_ppm"),
        lambda w: w["timing"]["clock"] != "session",
        "timing.clock = 'device' or 'host': the session's clock is right by definition",
    ),
    Rule("timing", ("stamp_jitter_s",), lambda w: w["timing"]["clock"] == "host", "timing.clock = 'host'"),
    Rule(
        "timing",
        ("strobe_delay_s", "strobe"),
        lambda w: w["timing"]["strobe_s"] is not None,
        "timing.strobe_s: without it the light is always on",
    ),
    Rule("mount", ("bump_px", "bump_m"), lambda w: w["mount"]["bump_s"] is not None, "mount.bump_s, its instant"),
    Rule(
        "mount",
        ("bump_s",),
        lambda w: any(w["mount"]["bump_px"]) or any(w["mount"]["bump_m"]),
        "mount.bump_px or mount.bump_m, how far it goes",
    ),
    Rule(
        "delivery",
        ("returns_s",),
        lambda w: w["delivery"]["dies_s"] is not None and w["delivery"]["dies_s"] < w["delivery"]["returns_s"],
        "an earlier delivery.dies_s",
    ),
)


def check_no_unused_keys(camera: str, words: Words) -> None:
    """Raise InputError where one of a camera's ``words`` (table -> key -> value, all merged) has no effect."""
    for rule in RULES:
        for key in rule.keys:
            value = words[rule.table][key]
            if value != getattr(DEFAULTS[rule.table], key) and not rule.works(words):
                raise InputError(
                    f"camera '{camera}': {rule.table}.{key} = {value!r} given, which does nothing without "
                    f"{rule.wants}; give that or leave the key out"
                )
