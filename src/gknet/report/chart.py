"""Small charts as inline SVG: no plotting library, no script, colours from the page's style (light and dark)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gknet.errors import GknetError
from gknet.report.markup import escaped

_WIDTH, _HEIGHT = 560, 340
_LEFT, _RIGHT, _TOP, _BOTTOM = 66, 14, 34, 50
_CHARACTER = 6.6
"""Mean width of a character of the charts' small text, in SVG units."""


@dataclass(frozen=True, eq=False)
class Series:
    """One curve, or one colour of bars.

    Attributes:
        name: In the legend; an empty one is left out.
        x: (k,) values across; bars leave them out of account.
        y: (k,) values up, or lengths of the bars; what is not finite is not drawn.
        low: (k,) lower ends of whiskers, NaN where there is none; None for none at all.
        high: (k,) upper ends of whiskers, likewise.
    """

    name: str
    x: Float[ndarray, " k"]
    y: Float[ndarray, " k"]
    low: Float[ndarray, " k"] | None = None
    high: Float[ndarray, " k"] | None = None


@dataclass(frozen=True)
class Axis:
    """An axis of a chart.

    Attributes:
        label: With the unit.
        log: Logarithmic; the label states it.
        low: The first value; None takes it from the data.
        high: The last value; None takes it from the data.
    """

    label: str
    log: bool = False
    low: float | None = None
    high: float | None = None

    @property
    def words(self) -> str:
        """The label as it is drawn."""
        return f"{self.label} (log scale)" if self.log else self.label


@dataclass(frozen=True)
class _Scale:
    """Data to SVG units along one axis."""

    axis: Axis
    low: float
    high: float
    start: float
    end: float

    def __call__(self, value: float) -> float:
        if self.axis.log:
            low, high, value = np.log10(self.low), np.log10(self.high), np.log10(max(value, 1e-300))
        else:
            low, high = self.low, self.high
        part = float(np.clip((value - low) / (high - low), -0.02, 1.02))
        return self.start + part * (self.end - self.start)

    def minor_ticks(self) -> list[float]:
        """Between the ticks of a logarithmic axis: the multiples of each power of ten."""
        return _multiples(self.low, self.high, range(1, 10)) if self.axis.log else []

    def ticks(self) -> list[float]:
        return _log_ticks(self.low, self.high) if self.axis.log else _linear_ticks(self.low, self.high)


def curve_chart(title: str, x: Axis, y: Axis, series: Sequence[Series]) -> str:
    """A chart of curves; those with whiskers show their points too.

    Args:
        title: Above the chart.
        x: The axis across.
        y: The axis up.
        series: The curves.

    Returns:
        An <svg> element, with a note where there is nothing to draw.

    Raises:
        GknetError: A logarithmic axis starts at 0 or below.
    """
    shown = [s for s in series if np.isfinite(s.y).any()]
    if not shown:
        return empty_chart(title, "no data")
    across = _scale(x, [s.x for s in shown], _LEFT, _WIDTH - _RIGHT)
    values = [v for s in shown for v in (s.y, s.low, s.high) if v is not None]
    up = _scale(y, values, _HEIGHT - _BOTTOM, _TOP)
    parts = [_frame(across, up), _legend([s.name for s in series])]
    parts += [_curve(k, s, across, up) for k, s in enumerate(series)]
    return _svg(title, "".join(parts), _HEIGHT)


def bar_chart(title: str, value: Axis, names: Sequence[str], series: Sequence[Series]) -> str:
    """A chart of horizontal bars.

    Args:
        title: Above the chart.
        value: The axis across.
        names: One for each group of bars.
        series: One for each bar of a group; whiskers run from `low` to `high`.

    Returns:
        An <svg> element, with a note where there is nothing to draw.
    """
    if not names:
        return empty_chart(title, "no data")
    left = min(220.0, 24 + _CHARACTER * max(len(name) for name in names))
    thick = 9.0 if len(series) > 1 else 12.0
    group = thick * len(series) + 7
    height = round(_TOP + group * len(names) + _BOTTOM)
    values = [v for s in series for v in (s.y, s.high) if v is not None] + [np.zeros(1)]
    across = _scale(Axis(value.label, value.log, value.low or 0.0, value.high), values, left, _WIDTH - _RIGHT)
    parts = [_vertical_grid(across, _TOP, height - _BOTTOM), _legend([s.name for s in series])]
    for row, name in enumerate(names):
        top = _TOP + group * row + 4
        middle = top + thick * len(series) / 2 + 4
        parts.append(f'<text x="{left - 7:.1f}" y="{middle:.1f}" text-anchor="end">{escaped(name)}</text>')
        parts += [_bar(k, s, row, across, top + k * thick, thick - 1.5) for k, s in enumerate(series)]
    return _svg(title, "".join(parts), height)


def standalone(chart: str) -> str:
    """A chart as an SVG file of its own, with the page's style in it."""
    opening, content = chart.split(">", 1)
    opening = opening.replace("<svg", f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}"', 1)
    return f"{opening}><style>{page_style()}</style>{content}\n"


def page_style() -> str:
    """The style sheet of page and charts."""
    return (resources.files("gknet.report") / "page.css").read_text(encoding="utf-8")


def empty_chart(title: str, note: str) -> str:
    """A chart with a note instead of data."""
    middle = f'<text x="{_WIDTH / 2}" y="90" text-anchor="middle" class="quiet">{escaped(note)}</text>'
    return _svg(title, middle, 150)


def _svg(title: str, content: str, height: int) -> str:
    heading = f'<text x="{_LEFT - 52}" y="18" class="heading">{escaped(title)}</text>'
    return (
        f'<svg class="chart" viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="{escaped(title)}">'
        f"{heading}{content}</svg>"
    )


def _scale(axis: Axis, values: Sequence[Float[ndarray, "*k"]], start: float, end: float) -> _Scale:
    """The axis' own limits, else those of the data with a little room."""
    every = np.concatenate([np.ravel(v) for v in values])
    every = every[np.isfinite(every) & (every > 0)] if axis.log else every[np.isfinite(every)]
    low = axis.low if axis.low is not None else (float(every.min()) if every.size else 0.1)
    high = axis.high if axis.high is not None else (float(every.max()) if every.size else 1.0)
    if axis.log and low <= 0:
        raise GknetError(f"axis '{axis.label}': a logarithmic axis starts above 0, got {low}")
    if high <= low:
        low, high = (low / 2, low * 2) if axis.log else (low - 0.5, low + 0.5)
    room = 1.15 if axis.log else 0.05 * (high - low)
    if axis.high is None:
        high = high * room if axis.log else high + room
    if axis.low is None:
        low = low / room if axis.log else low - room
    return _Scale(axis, low, high, start, end)


def _linear_ticks(low: float, high: float) -> list[float]:
    rough = (high - low) / 5
    power = 10.0 ** np.floor(np.log10(rough))
    step = power * next(m for m in (1, 2, 2.5, 5, 10) if m * power >= rough)
    first = np.ceil(low / step - 1e-9)
    return [float(k * step) + 0.0 for k in np.arange(first, np.floor(high / step + 1e-9) + 1)]


def _log_ticks(low: float, high: float) -> list[float]:
    decades = np.log10(high / low)
    steps = (1.0,) if decades > 3 else (1.0, 2.0, 5.0) if decades > 0.7 else (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
    return _multiples(low, high, steps)


def _multiples(low: float, high: float, steps: Sequence[float]) -> list[float]:
    """The multiples of powers of ten from `low` to `high`."""
    powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
    return [m * 10.0**p for p in powers for m in steps if low * 0.999 <= m * 10.0**p <= high * 1.001]


def _tick_text(value: float) -> str:
    return f"{value:.3g}" if abs(value) >= 1e-4 or value == 0 else f"{value:.0e}"


def _frame(across: _Scale, up: _Scale) -> str:
    parts = [_vertical_grid(across, _TOP, _HEIGHT - _BOTTOM)]
    for tick in up.minor_ticks():
        y = up(tick)
        parts.append(f'<line class="axis" x1="{_LEFT}" x2="{_LEFT + 4}" y1="{y:.1f}" y2="{y:.1f}"/>')
    for tick in up.ticks():
        y = up(tick)
        parts.append(f'<line class="grid" x1="{_LEFT}" x2="{_WIDTH - _RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text x="{_LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{_tick_text(tick)}</text>')
    middle = (_TOP + _HEIGHT - _BOTTOM) / 2
    turn = f'transform="rotate(-90 16 {middle})"'
    parts.append(f'<text x="16" y="{middle}" text-anchor="middle" {turn}>{escaped(up.axis.words)}</text>')
    return "".join(parts)


def _vertical_grid(across: _Scale, top: float, bottom: float) -> str:
    parts = []
    for tick in across.minor_ticks():
        x = across(tick)
        parts.append(f'<line class="axis" x1="{x:.1f}" x2="{x:.1f}" y1="{bottom - 4}" y2="{bottom}"/>')
    for tick in across.ticks():
        x = across(tick)
        parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{top}" y2="{bottom}"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{_tick_text(tick)}</text>')
    parts.append(f'<line class="axis" x1="{across.start:.1f}" x2="{across.end:.1f}" y1="{bottom}" y2="{bottom}"/>')
    middle = (across.start + across.end) / 2
    parts.append(f'<text x="{middle:.1f}" y="{bottom + 36}" text-anchor="middle">{escaped(across.axis.words)}</text>')
    return "".join(parts)


def _legend(names: Sequence[str]) -> str:
    """Right-aligned in the title's line; one unnamed series needs none."""
    parts: list[str] = []
    x = float(_WIDTH - _RIGHT)
    for k in reversed(range(len(names))):
        if not names[k]:
            continue
        parts.append(f'<text x="{x:.1f}" y="18" text-anchor="end">{escaped(names[k])}</text>')
        x -= _CHARACTER * len(names[k]) + 8
        parts.append(f'<rect class="fill s{k}" x="{x - 12:.1f}" y="9" width="12" height="9" rx="2"/>')
        x -= 26
    return "".join(parts)


def _curve(k: int, series: Series, across: _Scale, up: _Scale) -> str:
    known = np.isfinite(series.x) & np.isfinite(series.y)
    shift = 0.0 if series.low is None else (k - 0.5) * 5
    points = [(across(x) + shift, up(y)) for x, y in zip(series.x[known], series.y[known], strict=True)]
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dashes = "" if k == 0 else ' stroke-dasharray="7 3"'
    parts = [f'<polyline class="line s{k}" points="{path}"{dashes}/>']
    if series.low is None or series.high is None:
        return "".join(parts)
    for (x, y), low, high in zip(points, series.low[known], series.high[known], strict=True):
        if np.isfinite(low) and np.isfinite(high):
            parts.append(f'<line class="line s{k}" x1="{x:.1f}" x2="{x:.1f}" y1="{up(low):.1f}" y2="{up(high):.1f}"/>')
        parts.append(f'<circle class="fill s{k}" cx="{x:.1f}" cy="{y:.1f}" r="3.6"/>')
    return "".join(parts)


def _bar(k: int, series: Series, row: int, across: _Scale, top: float, thick: float) -> str:
    value = series.y[row]
    if not np.isfinite(value):
        return ""
    width = max(0.5, across(value) - across.start)
    place = f'x="{across.start:.1f}" y="{top:.1f}" width="{width:.1f}" height="{thick:.1f}"'
    bar = f'<rect class="fill s{k}" {place} rx="2"/>'
    if series.low is None or series.high is None or not np.isfinite([series.low[row], series.high[row]]).all():
        return bar
    middle, low, high = top + thick / 2, across(series.low[row]), across(series.high[row])
    return bar + f'<line class="whisker" x1="{low:.1f}" x2="{high:.1f}" y1="{middle:.1f}" y2="{middle:.1f}"/>'
