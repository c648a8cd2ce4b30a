"""TUM trajectories: ``timestamp tx ty tz qx qy qz qw`` a line, seconds and metres, world_from_body.

The format of the TUM RGB-D benchmark (Sturm et al. 2012), read by evo and others; # begins a comment. It holds one
body, no frame numbers and no covariances. Time stamps are written to the nanosecond.
"""

from pathlib import Path

from mosca.data.bodies import BodyPoses
from mosca.data.files.whole_file import write_text
from mosca.errors import InputError

COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


def write_tum(poses: BodyPoses, path: Path, body: str | None = None) -> None:
    """Write the measured poses of ``body`` (None: of the only one), whole or not at all.

    Raises InputError where there are several bodies and none is named, or the one named has no measured pose.
    """
    measured = poses.select(poses.status == "measured")
    names = list(dict.fromkeys(measured.body.tolist()))
    if body is None and len(names) == 1:
        body = names[0]
    if body is None or body not in names:
        given = "no body" if body is None else f"body '{body}'"
        raise InputError(
            f"{path}: {given} given; a TUM file holds one of those with poses: {', '.join(names) or 'there are none'}"
        )
    mine = measured.of(body)
    lines = [f"# {' '.join(COLUMNS)}"]
    for time_ns, xyz, q in zip(mine.time_ns.tolist(), mine.position.tolist(), mine.quaternion.tolist(), strict=True):
        sign, (seconds, rest) = "-" if time_ns < 0 else "", divmod(abs(time_ns), 10**9)
        numbers = " ".join(repr(value) for value in (*xyz, q[1], q[2], q[3], q[0]))
        lines.append(f"{sign}{seconds}.{rest:09d} {numbers}")
    write_text(Path(path), "\n".join(lines) + "\n")
