"""What the marks of an overlay mean, along its lower edge."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from gknet.report.canvas import Canvas
from gknet.report.palette import WHITE

_TEXT, _ROW, _EDGE, _GAP = 15.0, 24.0, 14.0, 18.0
"""Size of the text, height of a row, room at the edges and between entries, in the canvas's units."""

Icon = Callable[[Canvas, Float[ndarray, "2"], Float[ndarray, "2"]], None]
"""Draws a mark between its left and right ends, each (2,) in px of the image before it was enlarged."""


@dataclass(frozen=True)
class Entry:
    """One mark and its meaning.

    Attributes:
        text: The meaning.
        icon: Draws the mark.
        width: Of the mark, in the canvas's units.
    """

    text: str
    icon: Icon
    width: float = 24.0

    def room(self, canvas: Canvas) -> float:
        """Width of mark, text and the gap after it, in px of the enlarged image."""
        return canvas.text_width(self.text, _TEXT) + (self.width + 8 + _GAP) * canvas.unit


def draw_legend(canvas: Canvas, entries: Sequence[Entry]) -> None:
    """Draw the entries from the lower left corner, in as many rows as the width needs."""
    if not entries:
        return
    unit, (height, width) = canvas.unit, canvas.image.shape[:2]
    rows = _rows(canvas, entries, width - _EDGE * unit)
    widest = max(sum(entry.room(canvas) for entry in row) for row in rows)
    canvas.shade(0, height - (_ROW * len(rows) + _EDGE) * unit, _EDGE * unit + widest, height)
    for number, row in enumerate(rows):
        x, y = _EDGE * unit, height - (_EDGE + _ROW * (len(rows) - 1 - number)) * unit
        for entry in row:
            left = np.array([x, y - 5 * unit])
            right = left + (entry.width * unit, 0)
            entry.icon(canvas, left / canvas.factor, right / canvas.factor)
            canvas.text(entry.text, np.array([right[0] + 8 * unit, y]), WHITE, _TEXT, 400)
            x += entry.room(canvas)


def legend_strip(width_px: int, entries: Sequence[Entry], weight: float) -> UInt8[ndarray, "h w 3"]:
    """A legend as an image of its own, as high as its rows need.

    Args:
        width_px: Of the strip.
        entries: In their order.
        weight: Of marks and text, see `Canvas`.

    Returns:
        (h, width_px, 3) RGB.
    """
    canvas = Canvas(np.zeros((1, width_px, 3), dtype=np.uint8), weight=weight)
    rows = len(_rows(canvas, entries, width_px - _EDGE * canvas.unit))
    canvas.image = np.zeros((round((_ROW * rows + _EDGE) * canvas.unit), width_px, 3), dtype=np.uint8)
    draw_legend(canvas, entries)
    return canvas.image


def _rows(canvas: Canvas, entries: Sequence[Entry], width: float) -> list[list[Entry]]:
    rows: list[list[Entry]] = [[]]
    for entry in entries:
        if rows[-1] and sum(each.room(canvas) for each in [*rows[-1], entry]) > width:
            rows.append([])
        rows[-1].append(entry)
    return rows
