"""Plots of several runs, with one panel for each run and the same axes in all panels of a plot."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mosca.data.arrays import Array
from reports.content import content
from reports.margins import share_used
from reports.plot_style import BLUE, DOTTED, INK, VERMILION, WIDE, Picture, canvas, house_style, svg_text
from reports.record import Metric, RunRecord

MOST_PANELS = 6
"""Most runs that are drawn: the first ones."""
COLUMNS = 3
MOST_USED = 1.5
"""Share of a limit up to which the axis reaches; larger shares are drawn at its end."""


def comparison_pictures(records: Sequence[RunRecord], labels: Sequence[str]) -> tuple[Picture, ...]:
    """Return the plots of a comparison for which a run has the data."""
    with house_style():
        return tuple(_pictures(records[:MOST_PANELS], labels[:MOST_PANELS]))


def _pictures(records: Sequence[RunRecord], labels: Sequence[str]) -> Iterator[Picture]:
    if any(_error_mm(record) is not None for record in records):
        yield errors_over_time(records, labels)
    if any(share_used(metric) is not None for record in records for metric in record.metrics):
        yield limits_used(records, labels)
    if any("residual_px" in camera for record in records for camera in record.cameras.values()):
        yield camera_residuals(records, labels)


def errors_over_time(records: Sequence[RunRecord], labels: Sequence[str]) -> Picture:
    """Draw the rms position error of each block of time, one panel for each run."""
    found = [_error_mm(record) for record in records]
    drawing, panels = side_by_side(len(records), 2.1)
    for axes, record, label, one in zip(panels, records, labels, found, strict=True):
        axes.set_title(_short(label))
        axes.set_xlabel("time [s]")
        if one is None:
            axes.text(0.5, 0.5, "no position error", ha="center", transform=axes.transAxes)
            continue
        axes.stairs(one[1], one[0], color=BLUE, linewidth=1.3, baseline=None)
        metric = record.metric("position_rms")
        assert metric is not None
        axes.axhline(1e3 * metric.value, color=INK, linewidth=0.8)
        if metric.limit is not None:
            axes.axhline(1e3 * metric.limit, color=VERMILION, linestyle=DOTTED)
    known = [one for one in found if one is not None]
    limits = [1e3 * m.limit for r in records if (m := r.metric("position_rms")) and m.limit is not None]
    top = 1.08 * max(*(float(np.nanmax(one[1])) for one in known), *limits, 1e-9)
    _same_axes(panels, (0, max(float(one[0][-1]) for one in known)), (0, top))
    panels[0].set_ylabel("error, rms [mm]")
    means = ", ".join(
        f"{label} up to {np.nanmax(one[1]):.3g} mm" for label, one in zip(labels, found, strict=True) if one
    )
    text = "Rms position error of each block of time. Horizontal line: of the whole run; dotted: its limit."
    alt = f"Position error over time by run: {means}."
    return Picture("errors", "Position error over time", text, alt, svg_text(drawing, "errors", alt))


def limits_used(records: Sequence[RunRecord], labels: Sequence[str]) -> Picture:
    """Draw the used share of each limit, with the 95 % interval, one panel for each run."""
    names = list(dict.fromkeys(m.name for r in records for m in r.metrics if share_used(m) is not None))
    drawing, panels = side_by_side(len(records), 0.9 + 0.2 * len(names), left=0.16)
    for axes, record, label in zip(panels, records, labels, strict=True):
        for row, name in enumerate(names):
            metric = record.metric(name)
            share = None if metric is None else share_used(metric)
            if metric is None or share is None:
                continue
            good = metric.as_it_must is not False
            ends = sorted(_at_end(metric, end) for end in metric.ci95 or ())
            axes.plot([100 * min(end, MOST_USED) for end in ends], [row] * len(ends), color=BLUE, linewidth=1.2)
            axes.plot(100 * min(share, MOST_USED), row, "o", color=BLUE if good else VERMILION, markersize=4.5)
        axes.axvline(100, color=VERMILION, linestyle=DOTTED)
        axes.set_title(_short(label))
        axes.set_xlabel("used [%]")
    _same_axes(panels, (0, 100 * MOST_USED), (len(names) - 0.5, -0.5))
    for axes in panels:
        axes.set_yticks(range(len(names)), names)
    text = "How much of what its limit allows each figure uses, with its 95 % interval; of a range, the way from its "
    text += "middle to the nearer end. Right of the dotted line: outside; beyond 150 % at the edge."
    alt = f"Share of its limit that each of {len(names)} figures uses, a panel a run."
    return Picture("used", "Limits used", text, alt, svg_text(drawing, "used", alt))


def camera_residuals(records: Sequence[RunRecord], labels: Sequence[str]) -> Picture:
    """Draw the reprojection residual of each camera, one panel for each run."""
    names = list(dict.fromkeys(name for r in records for name, one in r.cameras.items() if "residual_px" in one))
    drawing, panels = side_by_side(len(records), 1.9)
    top = 0.0
    for axes, record, label in zip(panels, records, labels, strict=True):
        values = np.array([record.cameras.get(name, {}).get("residual_px") or np.nan for name in names], float)
        axes.bar(range(len(names)), values, color=BLUE, width=0.6)
        axes.set_title(_short(label))
        axes.grid(axis="x", visible=False)
        top = max(top, float(np.nanmax(values, initial=0.0)))
    _same_axes(panels, (-0.6, len(names) - 0.4), (0, 1.1 * top or 1.0))
    for axes in panels:
        axes.set_xticks(range(len(names)), names, rotation=45 if len(names) > 4 else 0)
    panels[0].set_ylabel("residual, rms [px]")
    alt = f"Reprojection residual of {len(names)} cameras by run, at most {top:.3g} px."
    text = "Reprojection residual of each camera, rms an axis. It is no error in space."
    return Picture("residuals", "Residuals by camera", text, alt, svg_text(drawing, "residuals", alt))


def _error_mm(record: RunRecord) -> tuple[Array, Array] | None:
    """Return edges (b + 1,) [s] and rms errors (b,) [mm] of the blocks of time; a block without samples is NaN."""
    metric = record.metric("position_rms")
    if metric is None or metric.blocks is None:
        return None
    sums, weights = np.array(metric.blocks.sums), np.array(metric.blocks.weights)
    seconds = content(record).get("capture.duration_s")
    with np.errstate(invalid="ignore", divide="ignore"):
        error = 1e3 * np.sqrt(np.where(weights > 0, sums / weights, np.nan))
    if not np.isfinite(error).any():
        return None
    return np.linspace(0, float(seconds or len(sums)), len(sums) + 1), error


def _at_end(metric: Metric, value: float) -> float:
    return share_used(replace(metric, value=value)) or 0.0


def side_by_side(n: int, height: float, left: float = 0.07) -> tuple[Figure, list[Axes]]:
    """Return a figure of ``n`` panels of ``height`` [inch] side by side, ``COLUMNS`` in a row."""
    columns = min(n, COLUMNS)
    rows = -(-n // columns)
    drawing = canvas(WIDE, height * rows + 0.35 * (rows - 1))
    grid = drawing.add_gridspec(
        rows, columns, left=left, right=0.985, top=1 - 0.3 / (height * rows), bottom=0.48 / (height * rows),
        wspace=0.12, hspace=0.6,
    )  # fmt: skip
    return drawing, [drawing.add_subplot(grid[k // columns, k % columns]) for k in range(n)]


def _same_axes(panels: Sequence[Axes], x: tuple[float, float], y: tuple[float, float]) -> None:
    for k, axes in enumerate(panels):
        axes.set_xlim(*x)
        axes.set_ylim(*y)
        if k % COLUMNS:
            axes.tick_params(labelleft=False)


def _short(label: str) -> str:
    return label if len(label) <= 34 else f"…{label[-33:]}"
