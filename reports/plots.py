"""Plots of errors and of trajectories over time; ``pictures`` collects all figures of a page."""

from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from mosca.data.arrays import Array
from reports.biped_plots import biped_picture
from reports.bones import strips
from reports.evidence import ErrorTable, Evidence, true_positions
from reports.flight_plots import flight_picture
from reports.images import camera_picture
from reports.joint_plots import angles_picture
from reports.plot_style import (
    AXIS_COLOURS,
    BLUE,
    DASHED,
    DOTTED,
    GREEN,
    HALF,
    INK,
    MOST_STEPS,
    MUTED,
    ORANGE,
    VERMILION,
    WIDE,
    Picture,
    broken,
    canvas,
    house_style,
    legend_above,
    per_marker,
    pieces_between_gaps,
    strided,
    svg_text,
)
from reports.record import RunRecord
from reports.recorded import longest_tracks_picture, points_picture, residuals_picture
from reports.scene import scene_picture, volume_picture
from reports.self_orientation_plots import budget_picture, errors_picture
from reports.units import figure as number
from reports.vibration_plots import shapes_picture, spectra_picture
from reports.virtual_plots import objects_picture

MOST_VIEWS = 3
"""Most camera images on a page; each adds some hundred kilobytes."""


def pictures(record: RunRecord, evidence: Evidence) -> tuple[Picture, ...]:
    """Return the figures of a page, in its order, for which ``evidence`` has the data."""
    with house_style():
        return tuple(_pictures(record, evidence))


def _pictures(record: RunRecord, evidence: Evidence) -> Iterator[Picture]:
    yield scene_picture(evidence)
    if evidence.errors is not None and len(evidence.errors.frame):
        yield histogram_picture(record, evidence.errors)
        yield trajectories_picture(evidence)
        yield over_time_picture(record, evidence)
    else:
        if np.isfinite(evidence.tracks.residual_px).any():
            yield residuals_picture(evidence.tracks)
        if len(evidence.tracks):
            yield longest_tracks_picture(evidence.tracks)
            yield points_picture(evidence.tracks)
    if (volume := volume_picture(evidence)) is not None:
        yield volume
    if evidence.errors is not None and len(evidence.truth_names):
        yield completeness_picture(record, evidence)
    if evidence.joints is not None and any(strips(evidence.joints.joints, one) for one in evidence.joints.centre):
        yield biped_picture(evidence.joints, evidence.true_joints, evidence.tracks)
    if evidence.angles is not None and evidence.angles.names and len(evidence.angles):
        yield angles_picture(evidence.angles, evidence.true_angles)
    if evidence.flight is not None:
        yield flight_picture(evidence.flight)
    if evidence.vibration is not None:
        yield spectra_picture(evidence.vibration)
        if len(evidence.vibration.modes_hz):
            yield shapes_picture(evidence.vibration)
    if evidence.self_orientation is not None:
        yield errors_picture(evidence.self_orientation)
        yield budget_picture(evidence.self_orientation)
    if evidence.virtual is not None and len(evidence.virtual.time_s):
        yield objects_picture(evidence.virtual)
    for i, view in enumerate(evidence.views[:MOST_VIEWS]):
        yield camera_picture(view, f"camera{i}")


def histogram_picture(record: RunRecord, errors: ErrorTable) -> Picture:
    """Draw the distribution of 3D errors, with median, rms, 95 % and the limit of position_rms."""
    values = 1e3 * errors.distance_m()
    p50, p95, p99 = np.percentile(values, (50, 95, 99))
    rms = float(np.sqrt(np.mean(values**2)))
    limit = limit_mm(record, "position_rms")
    drawing = canvas(HALF, 3.3)
    axes = drawing.add_axes((0.115, 0.135, 0.865, 0.735))
    wide_spread = values.max() > 4 * p99 or (limit is not None and limit > 8 * rms)
    if wide_spread:
        low = max(float(np.percentile(values, 0.5)), 1e-6)
        high = max(float(values.max()), limit or 0.0) * 1.15
        edges = np.geomspace(low, max(high, 1.01 * low), 48)
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=9))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: number(v)))
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        edges = np.linspace(0.0, 1.05 * max(float(values.max()), limit or 0.0, 1e-9), 48)
    share = 100 * np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0] / len(values)
    axes.stairs(share, edges, fill=True, color=BLUE, alpha=0.35)
    axes.stairs(share, edges, color=BLUE, linewidth=0.9)
    lines = [(p50, f"median {number(p50)}", GREEN, "solid"), (rms, f"rms {number(rms)}", INK, "solid"),
             (p95, f"95 % {number(p95)}", ORANGE, DASHED)]  # fmt: skip
    if limit is not None:
        lines.append((limit, f"limit of rms {number(limit)}", VERMILION, DOTTED))
    for place, label, colour, dashes in lines:
        axes.axvline(place, color=colour, linewidth=1.4, linestyle=dashes, label=label)
    axes.set_xlim(edges[0], edges[-1])
    axes.set_xlabel("3D error [mm]")
    axes.set_ylabel("share of samples [%]")
    axes.grid(axis="x", visible=False)
    legend_above(axes, 2)
    alt = f"Histogram of {len(values)} 3D errors: median {number(p50)} mm, rms {number(rms)} mm, "
    alt += f"95 % below {number(p95)} mm."
    caption = f"{number(len(values))} samples; the largest is {number(float(values.max()))} mm."
    return Picture("histogram", "How large the errors are", caption, alt, svg_text(drawing, "histogram", alt), False)


def trajectories_picture(evidence: Evidence) -> Picture:
    """Draw x, y, z of the best, the median and the worst marker against truth, and their difference below."""
    assert evidence.errors is not None
    assert evidence.truth_time_ns is not None
    assert evidence.truth_xyz is not None
    errors = evidence.errors
    rows = per_marker(evidence.truth_names, errors.marker)
    rms = np.array([np.sqrt(np.mean(errors.distance_m()[r] ** 2)) if len(r) else np.nan for r in rows])
    ranked = np.argsort(rms)[: int(np.isfinite(rms).sum())]
    chosen = {"Worst": ranked[-1], "Median": ranked[len(ranked) // 2], "Best": ranked[0]}
    drawing = canvas(WIDE, 4.3)
    true_time, places = 1e-9 * evidence.truth_time_ns, true_positions(evidence)
    for column, (kind, marker) in enumerate(reversed(chosen.items())):
        left, width = 0.062 + 0.322 * column, 0.272
        above = drawing.add_axes((left, 0.43, width, 0.43))
        below = drawing.add_axes((left, 0.11, width, 0.27), sharex=above)
        mean = np.nanmean(evidence.truth_xyz[:, marker], axis=0)
        mine = rows[marker][np.argsort(errors.time_s[rows[marker]], kind="stable")]
        kept = strided(len(mine), MOST_STEPS)
        pieces = pieces_between_gaps(errors.frame[mine])[kept]
        mine = mine[kept]
        thin = strided(len(true_time), MOST_STEPS)
        for axis, colour in enumerate(AXIS_COLOURS):
            measured = places[mine, axis] + errors.error_xyz_m[mine, axis] - mean[axis]
            true = evidence.truth_xyz[thin, marker, axis] - mean[axis]
            above.plot(true_time[thin], true, color=colour, linewidth=3.4, alpha=0.3, solid_capstyle="butt")
            above.plot(*broken(errors.time_s[mine], measured, pieces), color=colour, linewidth=0.9)
            difference = 1e3 * errors.error_xyz_m[mine, axis]
            below.plot(*broken(errors.time_s[mine], difference, pieces), color=colour, linewidth=0.7)
        name = evidence.truth_names[marker]
        name = name if len(name) <= 22 else name[:21] + "…"
        above.set_title(f"{kind}: {name}, {number(1e3 * rms[marker])} mm rms", pad=8)
        above.tick_params(labelbottom=False)
        below.axhline(0, color=MUTED, linewidth=0.6)
        reach = 1.15 * float(np.abs(1e3 * errors.error_xyz_m[mine]).max()) or 1.0
        below.set_ylim(-reach, reach)
        below.set_xlabel("time [s]")
        if column == 0:
            above.set_ylabel("position from its mean [m]")
            below.set_ylabel("difference [mm]")
    handles = [
        above.plot([], [], color=colour, linewidth=2.5, label="xyz"[i])[0] for i, colour in enumerate(AXIS_COLOURS)
    ]
    drawing.legend(handles=handles, loc="upper right", ncols=3, bbox_to_anchor=(0.996, 1.0), handlelength=1.2)
    alt = "Trajectories against truth: " + ", ".join(
        f"{kind.lower()} marker {evidence.truth_names[m]} {number(1e3 * rms[m])} mm rms" for kind, m in chosen.items()
    ) + "."  # fmt: skip
    caption = (
        "Measured positions (thin lines) on the truth (broad, pale), and measured minus true below, for the markers "
        "with the smallest, the median and the largest rms error. A line ends where there is no sample."
    )
    svg = svg_text(drawing, "trajectories", alt)
    return Picture("trajectories", "Trajectories against the truth", caption, alt, svg)


def over_time_picture(record: RunRecord, evidence: Evidence) -> Picture:
    """Draw rms and largest error over time; ghosts and missed markers in a strip below."""
    assert evidence.errors is not None
    time, values = evidence.errors.time_s, 1e3 * evidence.errors.distance_m()
    instants = _instants(evidence)
    edges = _bin_edges(instants)
    row = np.clip(np.searchsorted(edges, time, side="right") - 1, 0, len(edges) - 2)
    n = np.bincount(row, minlength=len(edges) - 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        rms = np.sqrt(np.bincount(row, values**2, minlength=len(edges) - 1) / n)
    largest = np.full(len(edges) - 1, np.nan)
    np.fmax.at(largest, row, values)
    middle = (edges[1:] + edges[:-1]) / 2
    has_counts = evidence.counts is not None and len(evidence.counts.time_s) > 0
    drawing = canvas(WIDE, 3.3 if has_counts else 2.7)
    axes = drawing.add_axes((0.062, 0.40, 0.928, 0.50) if has_counts else (0.062, 0.16, 0.928, 0.72))
    axes.plot(middle, largest, color=MUTED, linewidth=0.8, label="largest")
    axes.plot(middle, rms, color=BLUE, linewidth=1.4, label="rms")
    alone = np.isfinite(rms) & ~np.isfinite(np.append(rms[1:], np.nan)) & ~np.isfinite(np.append(np.nan, rms[:-1]))
    axes.plot(middle[alone], rms[alone], ".", color=BLUE, markersize=2.5)  # no line is drawn between two gaps
    limit = limit_mm(record, "position_rms")
    top = float(np.nanpercentile(largest, 99.5)) * 1.15
    if limit is not None and limit < 3 * top:
        axes.axhline(limit, color=VERMILION, linewidth=1.2, linestyle=DOTTED, zorder=3, label="limit of rms")
        top = max(top, 1.1 * limit)
    axes.set_ylim(0, top or 1.0)
    axes.set_ylabel("3D error [mm]")
    legend_above(axes)
    lost = ghosts = 0
    if has_counts:
        assert evidence.counts is not None
        lost, ghosts = _draw_counts(drawing, evidence)
        axes.tick_params(labelbottom=False)
    else:
        axes.set_xlabel("time [s]")
    axes.set_xlim(edges[0], edges[-1])
    cut = int((largest > top).sum())
    span, low, high = (number(float(v)) for v in (edges[-1] - edges[0], np.nanmin(rms), np.nanmax(rms)))
    alt = f"3D error over {span} s: rms between {low} and {high} mm."
    caption = "Error of all markers together, " + (
        "frame by frame." if len(instants) == len(middle) else f"in {len(middle)} bins of time."
    )
    caption += f" {number(lost)} samples missed, {number(ghosts)} ghosts." if has_counts else ""
    caption += f" {cut} peaks leave the plot (largest {number(float(values.max()))} mm)." if cut else ""
    return Picture("over_time", "Error over time", caption, alt, svg_text(drawing, "over_time", alt))


def _draw_counts(drawing: Figure, evidence: Evidence) -> tuple[int, int]:
    """Draw missed markers upwards and ghosts downwards over time; return both sums."""
    assert evidence.counts is not None
    counts = evidence.counts
    edges = _bin_edges(np.unique(counts.time_s))
    missed = np.maximum(counts.n_true_seen - counts.n_matched, 0)
    up, _ = np.histogram(counts.time_s, edges, weights=missed)
    down, _ = np.histogram(counts.time_s, edges, weights=counts.n_ghosts)
    axes = drawing.add_axes((0.062, 0.14, 0.928, 0.20))
    axes.stairs(up, edges, fill=True, color=ORANGE, label="missed")
    axes.stairs(-down, edges, fill=True, color=VERMILION, label="ghosts")
    axes.axhline(0, color=MUTED, linewidth=0.6)
    reach = max(1.0, float(up.max()), float(down.max())) * 1.1
    axes.set_ylim(-reach if down.any() else -0.25 * reach, reach if up.any() else 0.25 * reach)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=3, integer=True))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: number(abs(v))))
    axes.set_xlim(edges[0], edges[-1])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("count")
    axes.legend(loc="upper right", ncols=2, handlelength=0.9, borderaxespad=0.0, bbox_to_anchor=(1.0, 1.32))
    return int(missed.sum()), int(counts.n_ghosts.sum())


def completeness_picture(record: RunRecord, evidence: Evidence) -> Picture:
    """Draw the share of the frames that could show a marker in which it was found, for each marker, worst first."""
    assert evidence.errors is not None
    assert evidence.truth_xyz is not None
    matched = np.bincount(evidence.errors.marker, minlength=len(evidence.truth_names))
    if evidence.marker_seen is not None:
        possible, of_what = evidence.marker_seen, "frames in which it could be seen"
    else:
        possible, of_what = np.isfinite(evidence.truth_xyz).all(axis=2).sum(axis=0), "all frames"
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(possible > 0, 100.0 * np.minimum(matched / possible, 1.0), np.nan)
    order = np.argsort(share)
    order = order[: int(np.isfinite(share).sum())]
    ranked, m = share[order], len(order)
    limit = record.metric("completeness")
    lowest = min([float(ranked.min()) if m else 0.0] + ([100 * limit.limit] if limit and limit.limit else []))
    floor = 0.0 if lowest < 80 else (80.0 if lowest < 92 else (95.0 if lowest > 96.5 else 90.0))
    named = m <= 64
    longest = max((len(evidence.truth_names[i]) for i in order), default=0)
    room = min(0.062 * min(longest, 16) + 0.1, 1.1) if named else 0.35
    height = 1.7 + room
    drawing = canvas(WIDE, height)
    axes = drawing.add_axes((0.062, room / height, 0.928, 1.4 / height))
    axes.bar(np.arange(m), 100 - floor, bottom=floor, color=VERMILION, alpha=0.22, width=0.86, linewidth=0)
    axes.bar(np.arange(m), ranked - floor, bottom=floor, color=BLUE, alpha=0.85, width=0.86, linewidth=0)
    if limit is not None and limit.limit is not None:
        axes.axhline(100 * limit.limit, color=VERMILION, linewidth=1.3, linestyle=DOTTED, label="limit of all")
        legend_above(axes)
    axes.set_ylim(floor, 100)
    axes.set_xlim(-0.7, max(m, 1) - 0.3)
    axes.grid(axis="x", visible=False)
    axes.set_ylabel("found [%]" + (f", from {floor:.0f}" if floor else ""))
    axes.tick_params(axis="x", length=0)
    if named:
        names = [evidence.truth_names[i] for i in order]
        names = [n if len(n) <= 16 else n[:15] + "…" for n in names]
        axes.set_xticks(np.arange(m), names, rotation=90, fontsize=7)
    else:
        axes.set_xlabel("markers, worst first")
        axes.set_xticks([])
    worst = f"{evidence.truth_names[order[0]]} with {number(float(ranked[0]))} %" if m else "none"
    complete = int((ranked == 100).sum())
    alt = f"Completeness of {m} markers: worst {worst}; {complete} complete."
    caption = f"Share of {of_what} that have the marker, worst first: {worst}. {complete} of {m} are complete."
    svg = svg_text(drawing, "completeness", alt)
    return Picture("completeness", "Completeness marker by marker", caption, alt, svg)


def _instants(evidence: Evidence) -> Array:
    """Return the instants [s] from the first error to the last, with those that have no sample."""
    assert evidence.errors is not None
    assert evidence.truth_time_ns is not None
    frames = np.unique(evidence.errors.frame)
    step = int(np.median(np.diff(frames))) if len(frames) > 1 else 1
    every = np.union1d(frames, np.arange(frames[0], frames[-1] + 1, max(step, 1)))
    return np.unique(1e-9 * evidence.truth_time_ns[every])


def _bin_edges(instants: Array) -> Array:
    """Return edges of bins of time: one bin for each instant, or MOST_STEPS even bins where there are more."""
    if len(instants) == 1:
        return np.array([instants[0] - 0.5, instants[0] + 0.5])
    if len(instants) <= MOST_STEPS:
        between = (instants[1:] + instants[:-1]) / 2
        return np.concatenate([[2 * instants[0] - between[0]], between, [2 * instants[-1] - between[-1]]])
    return np.linspace(instants[0], np.nextafter(instants[-1], np.inf), MOST_STEPS + 1)


def limit_mm(record: RunRecord, name: str) -> float | None:
    """Return the limit of a metric that is a length [mm]; None where it has none."""
    metric = record.metric(name)
    if metric is None or metric.limit is None or metric.unit != "m":
        return None
    return 1e3 * metric.limit
