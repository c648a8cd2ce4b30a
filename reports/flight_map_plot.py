"""Crashes and position error of flights over latency and dropout."""

from dataclasses import dataclass

import numpy as np

from mosca.data.arrays import Array
from reports.plot_style import INK, MUTED, ORANGE, WIDE, Picture, canvas, house_style, svg_text


@dataclass(frozen=True, eq=False)
class FlightMap:
    """Data of the map: latencies (l,) [s], dropouts (d,), and for both (l, d) crash share, rms [m] and age [s]."""

    latency_s: Array
    dropout: Array
    crashed: Array
    rms_m: Array
    age_s: Array
    margin_s: float


def map_picture(one: FlightMap) -> Picture:
    """Draw a table of the cells, shaded by the share that crashed, and the rms against the age of the poses."""
    with house_style():
        drawing = canvas(WIDE, 2.9)
        axes = drawing.add_axes((0.08, 0.17, 0.46, 0.72))
        axes.imshow(one.crashed, cmap="Oranges", vmin=0, vmax=1, aspect="auto", origin="lower")
        for i in range(len(one.latency_s)):
            for k in range(len(one.dropout)):
                rms = one.rms_m[i, k]
                text = f"{1e3 * rms:.1f}" if np.isfinite(rms) else ""
                share = one.crashed[i, k]
                axes.text(
                    k, i, f"{text}\n{100 * share:.0f} %" if share else text, ha="center", va="center", fontsize=6
                )
        axes.set_xticks(range(len(one.dropout)), [f"{100 * value:.0f}" for value in one.dropout])
        axes.set_yticks(range(len(one.latency_s)), [f"{1e3 * value:.0f}" for value in one.latency_s])
        axes.set_xlabel("dropout [%]")
        axes.set_ylabel("latency [ms]")
        axes.set_title("rms off the path [mm], share that crashed", fontsize=7.5, pad=3)
        beside = drawing.add_axes((0.63, 0.17, 0.35, 0.72))
        beside.plot(1e3 * one.age_s.ravel(), 1e3 * one.rms_m.ravel(), "o", color=INK, markersize=3)
        crashed = one.crashed.ravel() > 0
        beside.plot(
            1e3 * one.age_s.ravel()[crashed], 1e3 * one.rms_m.ravel()[crashed], "o", color=ORANGE, markersize=3
        )
        if np.isfinite(one.margin_s):
            axes.axhline(np.interp(one.margin_s, one.latency_s, range(len(one.latency_s))), color=MUTED)
        beside.set_xlabel("mean age of the pose acted on [ms]")
        beside.set_title("rms [mm]", fontsize=7.5, pad=3)
        caption = (
            "Numbers: rms off the path of the flights that did not crash [mm]; shade and percent: share that "
            "crashed; line: latency from which on the linear loop is unstable, where the filter does not know of it. "
            "Right: the same against the mean age of the pose; orange: some crashed."
        )
        alt = f"Map of flights over {len(one.latency_s)} latencies and {len(one.dropout)} dropouts."
        return Picture("flight_map", "Latency and dropout", caption, alt, svg_text(drawing, "flight_map", alt))
