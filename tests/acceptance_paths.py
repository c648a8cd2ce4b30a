"""How the artefacts of scenarios/library/acceptance are moved: their tables of time and qpos, made anew.

``python -m tests.acceptance_paths`` writes them; test_acceptance_library holds the committed ones against this.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

FOLDER = Path(__file__).resolve().parents[1] / "scenarios" / "library" / "acceptance"
CENTRE = np.array([0.0, 0.0, 0.7])
CORNER = 0.48
"""Coordinate of a ball's centre in a corner of the box of 1 m, from its middle [m]."""
BAR = 1.2
LINES = {
    "diagonal 1": ((-1, -1, -1), (1, 1, 1)),
    "diagonal 2": ((1, -1, -1), (-1, 1, 1)),
    "diagonal 3": ((1, 1, -1), (-1, -1, 1)),
    "diagonal 4": ((-1, 1, -1), (1, -1, 1)),
    "floor": ((-1, -1, -1), (1, 1, 0)),
    "side": ((1, -1, -1), (0, 1, 1)),
    "back": ((-1, 1, 1), (1, 0, -1)),
}
"""Measuring line -> corner where it begins, and direction."""
HOLD_S, GO_S, KNOT_S = 0.4, 0.6, 0.02
PATH_S, REST_S, TURN_S, REACH = 0.64, 0.2, 0.4, 0.3


def eased(share):
    """Return minimum jerk from 0 to 1 (Flash and Hogan 1985)."""
    return share**3 * (10 - 15 * share + 6 * share**2)


class Table:
    """Rows of time and pose, stretch after stretch."""

    def __init__(self, place, turn):
        self.place, self.turn, self.time = np.asarray(place, float), turn, 0.0
        self.rows = [self._row(self.place, turn)]

    def _row(self, place, turn):
        return [self.time, *place, *turn.as_quat()[[3, 0, 1, 2]]]

    def to(self, place, turn, seconds):
        """Go to a pose in so long; return from when to when."""
        begin, steps = self.time, round(seconds / KNOT_S)
        turns = Slerp([0.0, 1.0], Rotation.concatenate([self.turn, turn]))
        for k in range(1, steps + 1):
            share = eased(k / steps)
            self.time = begin + k * KNOT_S
            self.rows.append(self._row(self.place + share * (np.asarray(place) - self.place), turns(share)))
        self.place, self.turn = np.asarray(place, float), turn
        return begin, self.time

    def rest(self, seconds):
        """Stay; return from when to when."""
        return self.to(self.place, self.turn, seconds)

    def text(self):
        """Return it as CSV, of a free joint."""
        head = "time_s,x,y,z,qw,qx,qy,qz"
        return "\n".join([head, *(",".join(f"{v:.9g}" for v in row) for row in self.rows)]) + "\n"


def along(direction):
    """Return the attitude with the bar (its x) along a direction and its z as high as can be."""
    x = np.asarray(direction, float) / np.linalg.norm(direction)
    z = np.array([0.0, 0.0, 1.0]) - x[2] * x
    if np.linalg.norm(z) < 1e-6:
        z = np.array([-1.0, 0.0, 0.0])
    z /= np.linalg.norm(z)
    return Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z]))


def ball_bar():
    """Return the table of the ball bar, and the stretch of each line in which it rests."""
    poses = {}
    for name, (corner, direction) in LINES.items():
        unit = np.asarray(direction, float) / np.linalg.norm(direction)
        poses[name] = CENTRE + CORNER * np.asarray(corner) + BAR / 2 * unit, along(direction)
    table, stretches = None, {}
    for name, pose in poses.items():
        if table is None:
            table = Table(*pose)
        else:
            table.to(*pose, GO_S)
        stretches[name] = table.rest(HOLD_S)
    return table, stretches


def cluster_bar():
    """Return the table of the bar with two clusters, and (path, orientation, motion, stretch) of each part."""
    table, parts = None, []
    for name, direction in (("x", (1, 0, 0)), ("y", (0, 1, 0)), ("z", (0, 0, 1))):
        turn = along(direction)
        for path, way in (("along", np.array([REACH, 0, 0])), ("across", np.array([0, REACH, 0]))):
            begin, end = CENTRE - way, CENTRE + way
            if table is None:
                table = Table(begin, turn)
            else:
                table.to(begin, turn, TURN_S)
            if path == "along":
                parts.append((path, name, "static", table.rest(REST_S)))
            parts.append((path, name, "dynamic", table.to(end, turn, PATH_S)))
    return table, parts


if __name__ == "__main__":
    for made, name in ((ball_bar()[0], "ball_bar.csv"), (cluster_bar()[0], "cluster_bar.csv")):
        (FOLDER / name).write_text(made.text(), encoding="utf-8")
