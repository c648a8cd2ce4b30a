"""A metric over the results of a history, with its limit as a line, as inline SVG."""

from collections.abc import Sequence

from markupsafe import escape

from reports.record import Metric
from reports.suite.history import PastResult
from reports.units import figure, shown

SMALL, LARGE = (124.0, 34.0), (560.0, 150.0)


def sparkline(metric: Metric, past: Sequence[PastResult], large: bool = False) -> str:
    """Return a drawing of the values of ``metric`` in ``past``, oldest first, one step each; "" without values.

    Dashed lines are the limit, or both ends of a range; values outside are red. A point names its commit, day and
    value.
    """
    past = [one for one in past if metric.name in one.values]
    if not past:
        return ""
    values = [one.values[metric.name] for one in past]
    bounds = metric.within or (() if metric.limit is None else (metric.limit,))
    low, high = min(*values, *bounds, values[0]), max(*values, *bounds, values[0])
    pad = 0.08 * (high - low) or 1.0
    low, high = low - pad, high + pad
    width, height = LARGE if large else SMALL
    left, right, top, bottom = (64.0, 12.0, 10.0, 22.0) if large else (4.0, 5.0, 4.0, 4.0)

    def y(value: float) -> float:
        return top + (height - top - bottom) * (high - value) / (high - low)

    step = (width - left - right) / max(len(past) - 1, 1)
    at = [(left + k * step if len(past) > 1 else (left + width - right) / 2, y(v)) for k, v in enumerate(values)]
    parts = [
        f'<path d="M{left:g} {y(bound):.1f}H{width - right:g}" stroke="var(--vermilion)" stroke-dasharray="4 3"/>'
        for bound in bounds
    ]
    parts.append(
        f'<path d="M{"L".join(f"{px:.1f} {py:.1f}" for px, py in at)}" stroke="var(--blue)" stroke-width="1.6"/>'
    )
    for k, ((px, py), one, value) in enumerate(zip(at, past, values, strict=True)):
        colour = "blue" if metric.allows(value) else "vermilion"
        radius = 3.4 if k == len(past) - 1 or large else 1.8
        title = escape(f"{one.commit}, {one.time[:16].replace('T', ' ')}: {_text(metric, value)}")
        parts.append(
            f'<circle cx="{px:.1f}" cy="{py:.1f}" r="{radius}" fill="var(--{colour})"><title>{title}</title></circle>'
        )
    if large:
        parts += [_label(left - 6, y(bound) + 4, _text(metric, bound), "end") for bound in bounds]
        if not any(abs(y(values[-1]) - y(bound)) < 14 for bound in bounds):
            parts.append(_label(left - 6, y(values[-1]) + 4, _text(metric, values[-1]), "end"))
        parts.append(_label(at[0][0], height - 5, past[0].commit[:8], "middle" if len(past) == 1 else "start"))
        if len(past) > 1:
            parts.append(_label(at[-1][0], height - 5, past[-1].commit[:8], "end"))
    limit = f", limit {' to '.join(_text(metric, bound) for bound in bounds)}" if bounds else ""
    results = f"{len(past)} result{'' if len(past) == 1 else 's'}"
    alt = escape(f"{metric.name} in {results}, last {_text(metric, values[-1])}{limit}")
    return f'<svg role="img" aria-label="{alt}" viewBox="0 0 {width:g} {height:g}" fill="none">{"".join(parts)}</svg>'


def _text(metric: Metric, value: float) -> str:
    (number,), unit = shown((value,), metric.unit, metric.name)
    return f"{figure(number)} {unit}".rstrip()


def _label(x: float, y: float, text: str, anchor: str) -> str:
    place = f'x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"'
    return f'<text {place} font-size="11" fill="var(--muted)">{escape(text)}</text>'
