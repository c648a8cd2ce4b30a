"""TUM trajectories: ``timestamp tx ty tz qx qy qz qw`` a line, seconds and metres, world_from_body.

The format of the TUM RGB-D benchmark (Sturm et al. 2012), read by evo and others; # begins a comment. It holds one
body, no frame numbers and no errors. Time stamps are written to the nanosecond and read exactly.
"""

from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from mosca.data.bodies import BodyPoses
from mosca.data.files.whole_file import whole_file
from mosca.errors import InputError

COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
LARGEST_TIME_S = 9_000_000_000
"""Time stamps in ns fit into 64 bit up to here."""


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
    with whole_file(Path(path)) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_tum(path: Path, body: str = "body") -> BodyPoses:
    """Read a TUM trajectory as poses of ``body``: frames 0, 1, ..., covariance and residual unknown.

    Quaternions are made unit. Raises InputError naming the line, its content and what is expected.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text: {error}") from None
    times: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        cells = line.split("#")[0].split()
        if not cells:
            continue
        if len(cells) != len(COLUMNS):
            raise InputError(
                f"{path}, line {number}: {len(cells)} values given, {len(COLUMNS)} wanted: {' '.join(COLUMNS)}"
            )
        times.append(_time_ns(cells[0], path, number))
        rows.append([_number(cell, path, number, COLUMNS[k]) for k, cell in enumerate(cells[1:], 1)])
        if not 0.9 < np.linalg.norm(rows[-1][3:]) < 1.1:
            raise InputError(f"{path}, line {number}: qx qy qz qw = {' '.join(cells[4:])}; a unit one is wanted")
    if not rows:
        raise InputError(f"{path}: holds no pose; a line '{' '.join(COLUMNS)}' for each is wanted")
    values, n = np.array(rows), len(rows)
    quaternion = values[:, [6, 3, 4, 5]]
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    return BodyPoses(
        frame=np.arange(n),
        time_ns=np.array(times),
        body=np.full(n, body),
        quaternion=np.where(np.abs(length - 1) < 1e-15, quaternion, quaternion / length),
        position=values[:, :3],
        covariance=np.full((n, 6, 6), np.nan),
        n_markers=np.zeros(n),
        residual_m=np.full(n, np.nan),
        status=np.full(n, "measured"),
    )


def _time_ns(cell: str, path: Path, line: int) -> int:
    try:
        value = Decimal(cell)
    except InvalidOperation:
        value = Decimal("nan")
    if not (value.is_finite() and value.adjusted() < 12 and abs(value) < LARGEST_TIME_S):
        raise InputError(
            f"{path}, line {line}: timestamp is {cell[:40]!r}; seconds below {LARGEST_TIME_S:g} are wanted"
        )
    return int((value * 10**9).to_integral_value())


def _number(cell: str, path: Path, line: int, what: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = np.inf
    if not abs(value) < 1e9:
        raise InputError(f"{path}, line {line}: {what} is {cell[:40]!r}; a number is wanted")
    return value
