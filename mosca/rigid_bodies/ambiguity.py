"""Rejection of rigid bodies whose markers are ambiguous: nearly symmetric under a rotation, or like another body's.

The difference of two arrangements of markers is the largest distance that remains between paired markers after the
best proper rotation and translation (Kabsch 1976). Mirror images differ, since no rigid motion maps one to the other.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from mosca.data.arrays import Array
from mosca.data.bodies import RigidBody
from mosca.data.rotations import aligning_rotation
from mosca.errors import InputError

ALIKE_M = 0.005
"""Arrangements that differ by less [m] are ambiguous: ten times the usual error of a marker's position."""
MOST_ARRANGEMENTS = 20000


def check_bodies(bodies: Sequence[RigidBody], alike_m: float = ALIKE_M) -> None:
    """Raise InputError for duplicate names, and for bodies ambiguous under rotation or with each other.

    The message names the body, the markers that can be confused, their difference [mm], and what to move.
    """
    names = [body.name for body in bodies]
    markers = [marker for body in bodies for marker in body.markers]
    for what, every in (("body", names), ("marker", markers)):
        for name in every:
            if every.count(name) > 1:
                raise InputError(f"{what} '{name}' stands twice; give each {what} a name of its own")
    for k, body in enumerate(bodies):
        _check_near(body, alike_m)
        for other in bodies[: k + 1]:
            _check_pair(other, body, alike_m)


def arrangements(some: Array, onto: Array, tolerance_m: float, skip_identity: bool) -> Iterator[tuple[int, ...]]:
    """Yield every way to lay points ``some`` (k, 3) on distinct ones of ``onto`` (m, 3), as indices (k) into it.

    All distances must agree to twice ``tolerance_m``. Every arrangement that differs by less than ``tolerance_m``
    fulfils this. ``skip_identity``: leave out (0, 1, ..., k - 1).
    """
    one = np.linalg.norm(some[:, None] - some, axis=2)
    two = np.linalg.norm(onto[:, None] - onto, axis=2)
    chosen: list[int] = []

    def deeper() -> Iterator[tuple[int, ...]]:
        i = len(chosen)
        if i == len(some):
            if not (skip_identity and chosen == list(range(i))):
                yield tuple(chosen)
            return
        for k in range(len(onto)):
            if k not in chosen and (np.abs(two[k, chosen] - one[i, :i]) < 2 * tolerance_m).all():
                chosen.append(k)
                yield from deeper()
                chosen.pop()

    yield from deeper()


def difference_m(some: Array, onto: Array) -> float:
    """Return the largest distance [m] between paired points (k, 3) after the best proper rotation and shift."""
    p, q = some - some.mean(axis=0), onto - onto.mean(axis=0)
    return float(np.linalg.norm(p @ aligning_rotation(some, onto).T - q, axis=1).max())


def nearest(one: RigidBody, other: RigidBody, tolerance_m: float) -> tuple[float, tuple[int, ...]] | None:
    """Return the difference [m] between ``one`` and the most similar arrangement in ``other``, and that arrangement.

    The arrangement is given as indices into the markers of ``other``, one for each marker of ``one``. Where both are
    the same body, the identity is left out. None where no arrangement differs by less than ``tolerance_m``.
    """
    best: tuple[float, tuple[int, ...]] | None = None
    same = one is other
    for count, order in enumerate(arrangements(one.positions, other.positions, tolerance_m, same)):
        away = difference_m(one.positions, other.positions[list(order)])
        if away < tolerance_m and (best is None or away < best[0]):
            best = away, order
        if count > MOST_ARRANGEMENTS:
            break  # with so many arrangements the body is refused anyway
    return best


def _check_near(body: RigidBody, alike_m: float) -> None:
    distances = body.distances() + np.diag(np.full(len(body.markers), np.inf))
    i, j = divmod(int(distances.argmin()), len(body.markers))
    if distances[i, j] < 2 * alike_m:
        raise InputError(
            f"body '{body.name}': markers '{body.markers[i]}' and '{body.markers[j]}' are "
            f"{1e3 * distances[i, j]:.1f} mm apart; move one of them: {2e3 * alike_m:g} mm or "
            "more are wanted (are the places in metres?)"
        )


def _check_pair(one: RigidBody, body: RigidBody, alike_m: float) -> None:
    small, large = (one, body) if len(one.markers) <= len(body.markers) else (body, one)
    found = nearest(small, large, alike_m)
    if found is None:
        return
    away, order = found
    moved = [k for k, other in enumerate(order) if small is not large or k != other]
    these = ", ".join(small.markers[k] for k in moved)
    those = ", ".join(large.markers[order[k]] for k in moved)
    what = (
        f"body '{body.name}' looks like itself turned: markers {these} can be taken for {those}"
        if small is large
        else f"body '{small.name}' looks like body '{large.name}': markers {these} can be taken for {those}"
    )
    raise InputError(
        f"{what}: they differ by {1e3 * away:.1f} mm, {1e3 * alike_m:g} mm or more are wanted; "
        f"{_advice(body, one, alike_m)}"
    )


def _advice(body: RigidBody, other: RigidBody, alike_m: float) -> str:
    """Return the advice which marker of ``body`` to move, and how far, to resolve the ambiguity."""
    for steps in (2, 4, 8, 16):
        best: tuple[float, str] = (alike_m, "")
        for k, marker in enumerate(body.markers):
            for axis in range(6):
                step = steps * alike_m * (-1.0) ** axis
                places = body.positions.copy()
                places[k, axis // 2] += step
                try:
                    changed = RigidBody(body.name, body.markers, places)
                    _check_near(changed, alike_m)
                except (ValueError, InputError):
                    continue
                apart = _unlike(changed, changed if other is body else other, 2 * steps * alike_m)
                if apart > best[0]:
                    along = f"{'-' if axis % 2 else '+'}{'xyz'[axis // 2]}"
                    far = f"{1e3 * abs(step):g} mm along its {along}"
                    best = apart, f"move marker '{marker}' of body '{body.name}' by {far}"
        if best[1]:
            return best[1]
    return "place its markers anew, all distances unlike"


def _unlike(body: RigidBody, other: RigidBody, beyond_m: float) -> float:
    """Return the smaller difference [m] of ``body`` from itself rotated and from ``other``, at most ``beyond_m``."""
    small, large = (body, other) if len(body.markers) <= len(other.markers) else (other, body)
    found = [nearest(a, b, beyond_m) for a, b in {(body, body), (small, large)}]
    return min((f[0] for f in found if f is not None), default=beyond_m)
