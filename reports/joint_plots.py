"""Joint angles over time or over the gait cycle, left beside right, with bands of two standard deviations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes

from mosca.data.arrays import Array
from mosca.data.joint_angles import JointAngles
from reports.plot_style import (
    BLUE,
    DASHED,
    INK,
    MOST_STEPS,
    MUTED,
    ORANGE,
    WIDE,
    Picture,
    canvas,
    house_style,
    strided,
    svg_text,
)
from reports.units import figure as number

CYCLE_PERCENT = np.linspace(0.0, 100.0, 101)
"""Points of a gait cycle that are drawn: whole percent, as in gait laboratories."""
_ROW_INCH = 1.2


@dataclass(frozen=True)
class _Curve:
    """Curve of a panel [deg]: ``x``, ``mean`` and ``sigma`` (k,), and each of c cycles (c, k)."""

    x: Array
    mean: Array
    sigma: Array
    cycles: Array


def angles_picture(
    angles: JointAngles, truth: JointAngles | None = None, strikes: Mapping[str, Array] | None = None
) -> Picture:
    """Draw the known ``angles``: one row for each joint, its angles side by side, each with left beside right.

    Parameters
    ----------
    angles
        Angles with the names of ``mosca.skeleton.isb_angles``: ``l_hip_flexion``, ``pelvis_tilt``.
    truth
        Drawn dashed where it has an angle of the same name.
    strikes
        Instants (k,) [ns] of the heel strikes of "l" and "r". Angles are then drawn over the gait cycle of their side
        (for the middle of the body, that of the right side): each cycle thin, with the mean above.
    """
    known = [name for k, name in enumerate(angles.names) if np.isfinite(angles.angles[:, k]).any()]
    rows = _rows(known or angles.names)
    if not rows or not len(angles):
        raise ValueError("joint angles: none to draw")
    with house_style():
        height = 0.75 + _ROW_INCH * len(rows)
        drawing = canvas(WIDE, height)
        cells = max(sum(len(pair) for pair in row) for row in rows)
        most_cycles = 0
        for r, row in enumerate(rows):
            column = 0
            for pair in row:
                first: Axes | None = None
                for name in pair:
                    left = 0.05 + 0.95 * column / cells
                    bottom = 1 - (0.4 + _ROW_INCH * (r + 1) - 0.42) / height
                    size = (0.95 / cells - 0.035, (_ROW_INCH - 0.5) / height)
                    axes = drawing.add_axes((left, bottom, *size), sharey=first)
                    curve = _curve(angles, name, strikes, int(angles.time_ns[0]))
                    true = None
                    if truth is not None and name in truth.names:
                        true = _curve(truth, name, strikes, int(angles.time_ns[0]))
                    _draw(axes, curve, true, _colour(name))
                    axes.set_title(_words(name), fontsize=7.0, pad=3)
                    axes.set_xlim(*((0, 100) if strikes else (curve.x[0], max(curve.x[-1], curve.x[0] + 1e-9))))
                    axes.tick_params(labelleft=first is None, labelbottom=r == len(rows) - 1)
                    most_cycles = max(most_cycles, len(curve.cycles))
                    first, column = first or axes, column + 1
        drawing.text(0.5, 0.06 / height, "gait cycle [%]" if strikes else "time [s]", ha="center", color=MUTED)
        drawing.text(0.004, 1 - 0.12 / height, "angle [deg]", va="top", color=MUTED)
        alt, caption = _text(angles, truth, most_cycles if strikes else None)
        return Picture("joint_angles", "Joint angles", caption, alt, svg_text(drawing, "joint_angles", alt))


def _rows(names: Sequence[str]) -> list[list[tuple[str, ...]]]:
    """Return for each joint its angles, each as the names of its sides, left first."""
    joints: dict[str, dict[str, list[str]]] = {}
    for name in names:
        plain = name[2:] if name[:2] in ("l_", "r_") else name
        joints.setdefault(plain.split("_", 1)[0], {}).setdefault(plain, []).append(name)
    return [[tuple(sorted(sides)) for sides in joint.values()] for joint in joints.values()]


def _words(name: str) -> str:
    side = {"l_": "left ", "r_": "right "}.get(name[:2], "")
    return side + (name[2:] if side else name).replace("_", " ")


def _colour(name: str) -> str:
    return {"l_": ORANGE, "r_": BLUE}.get(name[:2], MUTED)


def _curve(angles: JointAngles, name: str, strikes: Mapping[str, Array] | None, start_ns: int) -> _Curve:
    """Return one angle over time from ``start_ns``, or over the cycles of its side."""
    k = angles.names.index(name)
    values, sigma = np.rad2deg(angles.angles[:, k]), np.rad2deg(angles.sigma[:, k])
    # float64 resolves instants since 1970 to 256 ns only
    time = 1e-9 * (angles.time_ns - start_ns)
    if strikes is None:
        thin = strided(len(values), MOST_STEPS)
        return _Curve(time[thin], values[thin], sigma[thin], np.empty((0, 0)))
    own = strikes.get(name[0] if name[1] == "_" else "r", np.empty(0, dtype=np.int64))
    own = 1e-9 * (own - start_ns)
    own = own[(own >= time[0]) & (own <= time[-1])]
    cycles, deviations = (np.empty((max(len(own) - 1, 0), len(CYCLE_PERCENT))) for _ in range(2))
    for c, (begin, end) in enumerate(pairwise(own)):
        at = begin + (end - begin) * CYCLE_PERCENT / 100
        cycles[c], deviations[c] = np.interp(at, time, values), np.interp(at, time, sigma)
    if not len(cycles):
        unknown = np.full(len(CYCLE_PERCENT), np.nan)
        return _Curve(CYCLE_PERCENT, unknown, unknown, cycles)
    return _Curve(CYCLE_PERCENT, cycles.mean(axis=0), np.sqrt(np.mean(deviations**2, axis=0)), cycles)


def _draw(axes: Axes, curve: _Curve, true: _Curve | None, colour: str) -> None:
    for cycle in curve.cycles:
        axes.plot(curve.x, cycle, color=colour, linewidth=0.4, alpha=0.5)
    low, high = curve.mean - 2 * curve.sigma, curve.mean + 2 * curve.sigma
    axes.fill_between(curve.x, low, high, color=colour, alpha=0.25, linewidth=0)
    axes.plot(curve.x, curve.mean, color=colour, linewidth=1.2)
    if true is not None:
        axes.plot(true.x, true.mean, color=INK, linewidth=0.9, linestyle=DASHED)


def _text(angles: JointAngles, truth: JointAngles | None, cycles: int | None) -> tuple[str, str]:
    """Return the main result in words, and the caption."""
    span = number(1e-9 * float(angles.time_ns[-1] - angles.time_ns[0]))
    known = int(np.isfinite(angles.angles).any(axis=0).sum())
    alt = f"{known} joint angles over {span} s"
    if cycles is None:
        caption = "Bands are two standard deviations to either side."
    else:
        alt += f", {cycles} gait cycles"
        caption = (
            "From one heel strike to the next of the same foot: each cycle thin, their mean thick; bands are two "
            "standard deviations of one measured cycle to either side."
        )
    if truth is not None:
        _, mine, theirs = np.intersect1d(angles.frame, truth.frame, return_indices=True)
        common = [name for name in angles.names if name in truth.names]
        ours = angles.angles[mine][:, [angles.names.index(name) for name in common]]
        apart = ours - truth.angles[theirs][:, [truth.names.index(name) for name in common]]
        # equal angles may differ by whole turns
        apart = np.angle(np.exp(1j * apart[np.isfinite(apart)]))
        if len(apart):
            alt += f"; {number(float(np.rad2deg(np.sqrt(np.mean(apart**2)))))} deg rms from the truth"
        caption += " Dashed: the truth."
    return alt + ".", caption
