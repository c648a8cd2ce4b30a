"""A flight in closed loop: reference, true and estimated position of the drone; the age of its poses."""

import numpy as np

from reports.flight_evidence import FlightEvidence
from reports.plot_style import BLUE, DASHED, INK, MUTED, ORANGE, WIDE, Picture, canvas, house_style, svg_text

_ROWS = (
    "x, y, z: where it should be, and was [m]",
    "true minus wanted [mm]",
    "predicted minus true [mm]",
    "age [ms]",
)
_ROW_INCH = 1.35
_COLOURS = (ORANGE, BLUE, INK)


def flight_picture(one: FlightEvidence) -> Picture:
    """Draw path, control error, prediction error, and the age of the newest pose over time."""
    time = one.time_s
    shown = (time >= 0) & (time < one.crashed_s)
    error, ahead = 1e3 * (one.position - one.wanted), 1e3 * (one.estimated - one.position)
    with house_style():
        height = 0.5 + _ROW_INCH * len(_ROWS)
        drawing = canvas(WIDE, height)
        for row, title in enumerate(_ROWS):
            bottom = (0.4 + _ROW_INCH * (len(_ROWS) - 1 - row)) / height
            axes = drawing.add_axes((0.08, bottom, 0.90, (_ROW_INCH - 0.35) / height))
            axes.set_title(title, fontsize=7.5, pad=3)
            axes.set_xlim(0, float(time[-1]))
            axes.tick_params(labelbottom=row == len(_ROWS) - 1)
            axes.axvspan(0, one.scored_from_s, color=MUTED, alpha=0.12, linewidth=0)
            if np.isfinite(one.crashed_s):
                axes.axvline(one.crashed_s, color=ORANGE)
            if row == 3:
                age = np.where(np.isfinite(one.pose_age_s), 1e3 * one.pose_age_s, np.nan)
                axes.plot(time[shown], age[shown], color=BLUE, linewidth=0.7)
                continue
            for k, colour in enumerate(_COLOURS):
                if row == 0:
                    axes.plot(time[shown], one.wanted[shown, k], color=colour, linestyle=DASHED, linewidth=0.8)
                values = (one.position, error, ahead)[row]
                axes.plot(time[shown], values[shown, k], color=colour, linewidth=0.8)
        drawing.text(0.5, 0.06 / height, "time [s]", ha="center", color=MUTED)
        end = f" It {one.crash} at {one.crashed_s:.2f} s." if one.crash else ""
        caption = (
            "Orange x, blue y, black z; dashed: as wanted. Shaded: not scored. The predictor believed in a delay of "
            f"{1e3 * one.believed_delay_s:.1f} ms; from the flight's log: {one.delay_words}.{end}"
        )
        rms = np.sqrt((error[shown] ** 2).sum(axis=1).mean()) if shown.any() else np.nan
        alt = (
            f"Path, errors and age of the poses over {time[-1]:.3g} s of flight; rms off the path {rms:.3g} mm.{end}"
        )
        return Picture("flight", "Flight in closed loop", caption, alt, svg_text(drawing, "flight", alt))
