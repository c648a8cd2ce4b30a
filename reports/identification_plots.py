"""Commands and velocities over time, measured and from an identified model (Mosca paper, figure 9)."""

from collections.abc import Sequence
from dataclasses import dataclass

from mosca.data.arrays import Array
from reports.plot_style import BLUE, DASHED, INK, MUTED, ORANGE, WIDE, Picture, canvas, house_style, svg_text

MOST_SHOWN_S = 20.0
"""Longest part of a take that is drawn, its end: in a longer part, commands of a fraction of a second would merge."""
_ROW_INCH = 1.5


@dataclass(frozen=True, eq=False)
class DrivenTake:
    """Data of the picture: ``time_s`` (n,), ``measured`` with its ``sigma``, and ``modelled``, (n, o) each.

    ``command_s`` (m,) and ``commands`` (m, k), held until the next; names and units of inputs and outputs; ``fits``
    (o) [%].
    """

    time_s: Array
    measured: Array
    sigma: Array
    modelled: Array
    command_s: Array
    commands: Array
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: tuple[str, ...]
    fits: Sequence[float]
    what: str


def driven_picture(take: DrivenTake) -> Picture:
    """Draw the last ``MOST_SHOWN_S`` of a take: its commands, and each output measured and modelled."""
    begin = max(float(take.time_s[0]), float(take.time_s[-1]) - MOST_SHOWN_S)
    rows = take.time_s >= begin
    time = take.time_s[rows]
    with house_style():
        count = 1 + len(take.outputs)
        height = 0.6 + _ROW_INCH * count
        drawing = canvas(WIDE, height)
        for r in range(count):
            bottom = 1 - (0.25 + _ROW_INCH * (r + 1) - 0.25) / height
            axes = drawing.add_axes((0.09, bottom, 0.89, (_ROW_INCH - 0.45) / height))
            axes.set_xlim(begin, float(time[-1]))
            axes.tick_params(labelbottom=r == count - 1)
            if r == 0:
                inside = (take.command_s >= begin - 1) & (take.command_s <= time[-1])
                for j, colour in zip(range(len(take.inputs)), (ORANGE, BLUE, MUTED, INK) * 4, strict=False):
                    axes.step(
                        take.command_s[inside], take.commands[inside, j], where="post", color=colour, linewidth=0.9,
                        label=take.inputs[j],
                    )  # fmt: skip
                axes.legend(loc="upper right", ncols=4, fontsize=6.5)
                axes.set_title("commands", fontsize=7.5, pad=3)
                continue
            k = r - 1
            low, high = (take.measured[rows, k] + s * 2 * take.sigma[rows, k] for s in (-1, 1))
            axes.fill_between(time, low, high, color=BLUE, alpha=0.25, linewidth=0)
            axes.plot(time, take.measured[rows, k], color=BLUE, linewidth=0.9)
            axes.plot(time, take.modelled[rows, k], color=INK, linewidth=0.9, linestyle=DASHED)
            axes.set_title(f"{take.outputs[k]} [{take.units[k]}]: fit {take.fits[k]:.1f} %", fontsize=7.5, pad=3)
        drawing.text(0.5, 0.06 / height, "time [s]", ha="center", color=MUTED)
        fits = ", ".join(f"{name} {fit:.1f} %" for name, fit in zip(take.outputs, take.fits, strict=True))
        alt = f"Measured and modelled velocities of {take.what}: fit {fits}"
        caption = "Measured with a band of two standard deviations to either side; dashed: the model's answer."
        return Picture(
            "identification", "Commands and answer", caption, alt, svg_text(drawing, "identification", alt)
        )
