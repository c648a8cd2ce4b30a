"""A commented scenario to start from: the template, for a subject, a number of cameras and a claim."""

import re
from dataclasses import dataclass
from pathlib import Path

from mosca.data.files.toml import check, parse_toml
from mosca.errors import InputError
from scenarios.spec.scenario import Scenario

TEMPLATE = Path(__file__).with_name("template.toml.txt")
SCHEMA = "scenario.schema.json"
"""Name of the schema beside a new file, by which editors complete and check."""


@dataclass(frozen=True)
class StartingPoint:
    """A subject with a working space and cameras that see all of it; lengths in metres."""

    words: str
    """Words for the title."""
    scene: str
    """The table ``[scene]`` without its first line."""
    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    radius_m: float
    heights_m: tuple[float, float]
    """Heights of the cameras, in turn."""
    c_mm: float


SUBJECTS = {
    "cloud": StartingPoint(
        "a cloud of points",
        'kind = "cloud"\nmarkers = 40\nmarker_diameter_m = 0.02\nspeed_mps = 0.5\n',
        (0.0, 0.0, 1.0), (2.0, 2.0, 2.0), 4.0, (1.2, 2.4), 7.5,
    ),
    "actor": StartingPoint(
        "a walking person",
        'kind = "actor"\naction = "walk"         # or "run" | "boxing" | "dance" | "jump" | "range_of_motion"\n'
        "markers = 50\nmarker_diameter_m = 0.016\n"
        'skin = "moderate"       # markers slide on the skin: "off" | "moderate" | "strong"\n',
        (0.0, 0.0, 1.25), (2.5, 2.5, 2.5), 4.0, (0.8, 2.6), 8.0,
    ),
    "drone": StartingPoint(
        "a flying drone",
        'kind = "drone"\npath = "figure_eight"   # or "circle" | "waypoints" | "hover"\nspeed_mps = 0.5\n',
        (0.0, 0.0, 1.25), (2.5, 2.5, 2.5), 4.0, (0.8, 2.6), 8.0,
    ),
    "robot": StartingPoint(
        "a driven robot", 'kind = "robot"\n', (0.0, 0.0, 0.5), (3.0, 3.0, 1.0), 3.0, (2.4, 2.8), 6.0
    ),
}  # fmt: skip


def new_scenario(subject: str, cameras: int, claim: str) -> str:
    """Return the text of a scenario.

    Parameters
    ----------
    subject
        One of ``SUBJECTS``.
    cameras
        Number of cameras on a ring, two or more.
    claim
        Largest rms error: a length ("1 mm") or a share of the working space ("0.05 %").

    Raises
    ------
    InputError
        Where the claim is neither.
    """
    start = SUBJECTS[subject]
    share = claim.strip().endswith("%")
    heights = [start.heights_m[k % 2] for k in range(cameras)]
    edge = max(start.size_m)
    text = TEMPLATE.read_text(encoding="utf-8")
    for pattern, new in (
        (r'(?m)^title = ".*"$', f'title = "My rig measures {start.words} to {claim} in a {edge:g} m working space"'),
        (r"(?m)^center_m = .*$", f"center_m = {list(start.center_m)}"),
        (r"(?m)^size_m = .*$", f"size_m = {list(start.size_m)}"),
        (r"(?ms)^\[scene\]\n.*?\n\n", f"[scene]\n{start.scene}\n"),
        (r"(?m)^count = .*$", f"count = {cameras}"),
        (r"(?m)^radius_m = .*$", f"radius_m = {start.radius_m}"),
        (r"(?m)^height_m = .*$", f"height_m = {heights}          # one height a camera, or one for all"),
        (r"(?m)^c_mm = .*$", f"c_mm = {start.c_mm}              # principal distance"),
        (r"(?m)^position_rms = .*$", f'{"relative_accuracy" if share else "position_rms"} = "{claim}"'),
    ):
        text, found = re.subn(pattern, lambda _, new=new: new, text, count=1)  # type: ignore[misc]
        assert found, pattern
    try:
        check(Scenario, parse_toml(text), Path("claim"))
    except (InputError, ValueError) as error:
        raise InputError(
            f"--claim '{claim}': a length as '1 mm' or a share of the working space as '0.05 %' is wanted"
        ) from error
    return f"#:schema ./{SCHEMA}\n{text}"
