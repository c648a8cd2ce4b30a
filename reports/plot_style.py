"""Shared plot style: palette, type, and conversion of figures to inline SVG.

Colours are drawn as fixed hex values and written as CSS variables, so that one picture serves light, dark
and print. They are Okabe and Ito's (2008), distinct for colour-blind readers; the dark set is lighter.
"""

import io
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from mosca.data.arrays import Array

INK, MUTED, GRID, PAPER = "#1c2127", "#5d6673", "#dde1e6", "#fdfdfe"
BLUE, ORANGE, GREEN, VERMILION, SKY = "#0072b2", "#c98a00", "#00805e", "#c44e00", "#4aa3d9"
COLOUR_VARIABLES = {
    INK: "--ink",
    MUTED: "--muted",
    GRID: "--grid",
    PAPER: "--card",
    BLUE: "--blue",
    ORANGE: "--orange",
    GREEN: "--green",
    VERMILION: "--vermilion",
    SKY: "--sky",
}
AXIS_COLOURS = (BLUE, ORANGE, GREEN)
"""Colours of x, y and z in every figure."""

WIDE, HALF = 9.4, 4.6
"""Widths of figures [inch]: across the page, and two beside each other."""

DASHED: Any = (0, (4, 2))
DOTTED: Any = (0, (1, 1.2))
"""Line style of percentiles, and of limits."""

MOST_STEPS = 400
"""Most points of a curve over time; more are collected in bins, or thinned."""

HEAT = ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.12, 1.0, 256)), name="heat")
"""Small to large; perceptually even, readable in grey."""

_STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "mosca",
    "text.parse_math": False,
    "font.size": 8.5,
    "font.family": ["DejaVu Sans"],
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "axes.facecolor": "none",
    "axes.edgecolor": MUTED,
    "axes.labelcolor": MUTED,
    "axes.titlesize": 9.0,
    "axes.titlecolor": INK,
    "axes.titlelocation": "left",
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "text.color": INK,
    "lines.linewidth": 1.1,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "legend.labelcolor": INK,
    "path.simplify": True,
    "path.simplify_threshold": 0.3,
}


@dataclass(frozen=True)
class Picture:
    """A figure of a page."""

    name: str
    title: str
    caption: str
    alt: str
    """Main result of the picture in words."""
    svg: str
    """Inline SVG."""
    wide: bool = True


@contextmanager
def house_style() -> Iterator[None]:
    """Use the shared style in a ``with`` block; matplotlib's own settings are restored at its end."""
    with matplotlib.rc_context(_STYLE), warnings.catch_warnings():
        # The browser's fonts draw the text: glyphs that matplotlib's own font lacks are not missing.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        yield


def canvas(width: float, height: float) -> Figure:
    """Return an empty figure of ``width`` x ``height`` [inch] that only writes SVG."""
    figure = Figure(figsize=(width, height))
    FigureCanvasSVG(figure)
    return figure


def svg_text(figure: Figure, name: str, alt: str) -> str:
    """Return ``figure`` as an inline <svg>: same bytes for the same figure, ids of its own, CSS colours.

    ``name``: prefix of its ids, unique on the page. ``alt``: description for screen readers.
    """
    stream = io.StringIO()
    figure.savefig(stream, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type")))
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>\s*|<style[^>]*>.*?</style>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"<[^>]+>", lambda tag: _for_the_page(tag[0], name), text)
    start = re.sub(r'\s(width|height|xmlns(:\w+)?)="[^"]*"', "", text[: text.index(">")])
    start = start.replace("<svg", f'<svg role="img" aria-label="{_attribute(alt)}"', 1)
    return (start + text[text.index(">") :]).strip()


def svg_file(picture: Picture) -> str:
    """Return a picture as the text of an .svg file, with the light colours on paper, since no page gives them."""
    text = picture.svg.replace("<svg", '<svg xmlns="http://www.w3.org/2000/svg"', 1)
    for colour, variable in COLOUR_VARIABLES.items():
        text = text.replace(f"var({variable})", colour)
    return text.replace(">", f'><rect width="100%" height="100%" fill="{PAPER}"/>', 1) + "\n"


def _for_the_page(tag: str, name: str) -> str:
    """Return one tag of a figure with ids of its own (``name`` first) and colours as CSS variables."""
    tag = tag.replace("xlink:href=", "href=")
    tag = tag.replace(' id="', f' id="{name}-').replace('href="#', f'href="#{name}-')
    tag = tag.replace("url(#", f"url(#{name}-")
    for colour, variable in COLOUR_VARIABLES.items():
        tag = tag.replace(colour, f"var({variable})")
    return tag


def _attribute(text: str) -> str:
    return text.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;").replace(">", "&gt;")


def legend_above(axes: Axes, columns: int = 6) -> None:
    """Place the legend in one row above the axes, where it covers nothing."""
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=columns,
        borderaxespad=0.1,
        handlelength=1.4,
        columnspacing=1.2,
        handletextpad=0.5,
    )


def colour_bar(drawing: Figure, low: float, high: float, unit: str) -> None:
    """Draw the scale of HEAT at the right edge of a figure WIDE."""
    bar = drawing.add_axes((0.945, 0.2, 0.012, 0.6))
    bar.imshow(
        HEAT(np.linspace(0, 1, 64))[:, None], extent=(0, 1, low, high), origin="lower", aspect="auto",
        interpolation="none",
    )  # fmt: skip
    bar.grid(False)
    bar.set_xticks([])
    bar.yaxis.tick_right()
    bar.set_title(unit, loc="left", fontsize=8, color=MUTED)


def strided(n: int, most: int) -> slice:
    """Return the slice that keeps at most about ``most`` of ``n`` items, evenly spaced."""
    return slice(None, None, max(1, -(-n // most)))


def pieces_between_gaps(frames: Array) -> Array:
    """Return the piece number (k,) of each of ``frames`` (k,), ascending; a missing frame begins a new piece."""
    steps = np.diff(frames)
    usual = np.median(steps) if len(steps) else 1
    return np.concatenate([np.zeros(min(len(frames), 1), int), np.cumsum(steps > 1.5 * usual)])


def broken(time_s: Array, values: Array, pieces: Array) -> tuple[Array, Array]:
    """Return a curve (k,) with a NaN wherever its piece changes, so that no line is drawn across a gap."""
    cuts = np.flatnonzero(np.diff(pieces)) + 1
    return np.insert(np.asarray(time_s, float), cuts, np.nan), np.insert(np.asarray(values, float), cuts, np.nan)


def nice_step(span: float, parts: int = 5) -> float:
    """Return the step 1, 2 or 5 x 10^k that divides ``span`` into about ``parts``."""
    if not span > 0:
        return 1.0
    rough = span / parts
    power = 10.0 ** np.floor(np.log10(rough))
    return float(power * min((1, 2, 5, 10), key=lambda m: abs(np.log(m * power / rough))))


def per_marker(names: Sequence[str], index: Array) -> list[Array]:
    """Return for each name the rows at which ``index`` (k,) equals its number."""
    order = np.argsort(index, kind="stable")
    cuts = np.searchsorted(index[order], np.arange(1, len(names)))
    return np.split(order, cuts) if len(names) else []
