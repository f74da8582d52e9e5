"""Anti-aliased drawing on an RGB image with sub-pixel coordinates and a thin dark outline about everything."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from gknet.io.text import printable
from gknet.report.palette import INK, RGB, WHITE

_SHIFT = 4
_FAR_PX = 1e5
_LEAST_SIDE_PX = 768


def enlarged(image: UInt8[ndarray, "h w 3"]) -> tuple[UInt8[ndarray, "h2 w2 3"], int]:
    """A copy fit to draw on.

    Args:
        image: (h, w, 3) RGB, which is left as it is.

    Returns:
        The copy, and the whole factor by which a small image was enlarged.
    """
    factor = max(1, round(_LEAST_SIDE_PX / max(image.shape[:2])))
    if factor == 1:
        return np.ascontiguousarray(image).copy(), 1
    return cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC), factor


@dataclass
class Canvas:
    """Draws in place on `image`.

    Coordinates are in px of the image before it was enlarged; its top-left pixel has its centre at (0.5, 0.5). Widths
    and sizes are in units of 1/1024 of the image's longer side, times `weight`.

    Attributes:
        image: (h, w, 3) RGB.
        factor: By which the image was enlarged.
        weight: Of lines, marks and text.
    """

    image: UInt8[ndarray, "h w 3"]
    factor: int = 1
    weight: float = 1.0
    _font: cv2.FontFace = field(default_factory=lambda: cv2.FontFace("sans"))

    @property
    def unit(self) -> float:
        return self.weight * max(self.image.shape[:2]) / 1024

    def _fixed(self, point: Float[ndarray, "2"]) -> tuple[int, int]:
        x, y = (np.asarray(point) * self.factor - 0.5) * (1 << _SHIFT)
        return round(float(x)), round(float(y))

    def _drawable(self, *points: Float[ndarray, "2"]) -> bool:
        return all(bool(np.isfinite(point).all()) and float(np.abs(point).max()) < _FAR_PX for point in points)

    def _width(self, width: float) -> int:
        return max(1, round(width * self.unit))

    def _raw_line(self, a: Float[ndarray, "2"], b: Float[ndarray, "2"], colour: RGB, width: int) -> None:
        cv2.line(self.image, self._fixed(a), self._fixed(b), colour, width, cv2.LINE_AA, _SHIFT)

    def line(
        self, a: Float[ndarray, "2"], b: Float[ndarray, "2"], colour: RGB, width: float = 2.0, outlined: bool = True
    ) -> None:
        """A segment from `a` to `b`, each (2,) in px; nothing when an end is not finite or far away."""
        if not self._drawable(a, b):
            return
        inner = self._width(width)
        if outlined:
            self._raw_line(a, b, INK, inner + 2 * self._width(1))
        self._raw_line(a, b, colour, inner)

    def dashes(self, a: Float[ndarray, "2"], b: Float[ndarray, "2"], colour: RGB, width: float = 1.2) -> None:
        """A dashed segment of whole dashes, so that both ends are drawn."""
        if not self._drawable(a, b):
            return
        a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
        length = float(np.linalg.norm(b - a)) * self.factor
        pieces = 2 * int(np.clip(length / (20 * self.unit), 0, 200)) + 1
        ends = a + (b - a) * np.linspace(0, 1, pieces + 1)[:, None]
        for k in range(0, pieces, 2):
            self._raw_line(ends[k], ends[k + 1], INK, self._width(width) + self._width(1))
        for k in range(0, pieces, 2):
            self._raw_line(ends[k], ends[k + 1], colour, self._width(width))

    def arrow(self, a: Float[ndarray, "2"], b: Float[ndarray, "2"], colour: RGB, width: float = 3.0) -> None:
        """A segment with a head at `b`."""
        if not self._drawable(a, b):
            return
        a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
        length = float(np.linalg.norm(b - a)) * self.factor
        if length < 2:
            return
        along = (b - a) / np.linalg.norm(b - a)
        head = min(14 * self.unit, 0.4 * length) / self.factor
        base, side = b - along * head, np.array([-along[1], along[0]]) * head * 0.45
        self.line(a, base, colour, width)
        corners = np.array([self._fixed(p) for p in (b, base + side, base - side)], dtype=np.int32)
        outline = self._width(1) * 2
        cv2.polylines(self.image, [corners], True, INK, outline, cv2.LINE_AA, _SHIFT)
        cv2.fillConvexPoly(self.image, corners, colour, cv2.LINE_AA, _SHIFT)

    def disc(self, centre: Float[ndarray, "2"], colour: RGB, radius: float = 5.5) -> None:
        """A filled circle."""
        if not self._drawable(centre):
            return
        size = radius * self.unit * (1 << _SHIFT)
        outline = 1.3 * self.unit * (1 << _SHIFT)
        cv2.circle(self.image, self._fixed(centre), round(size + outline), INK, cv2.FILLED, cv2.LINE_AA, _SHIFT)
        cv2.circle(self.image, self._fixed(centre), round(size), colour, cv2.FILLED, cv2.LINE_AA, _SHIFT)

    def ring(self, centre: Float[ndarray, "2"], colour: RGB, radius: float = 5.5, width: float = 1.7) -> None:
        """An open circle."""
        if not self._drawable(centre):
            return
        size, inner = round(radius * self.unit * (1 << _SHIFT)), self._width(width)
        dark = inner + 2 * self._width(1)
        cv2.circle(self.image, self._fixed(centre), size, INK, dark, cv2.LINE_AA, _SHIFT)
        cv2.circle(self.image, self._fixed(centre), size, colour, inner, cv2.LINE_AA, _SHIFT)

    def square(self, centre: Float[ndarray, "2"], colour: RGB, radius: float = 5.0) -> None:
        """A filled square; `radius` is half of its side."""
        if not self._drawable(centre):
            return
        for reach, fill in ((radius + 1.3, INK), (radius, colour)):
            offset = np.full(2, reach * self.unit / self.factor)
            low, high = self._fixed(centre - offset), self._fixed(centre + offset)
            corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])], dtype=np.int32)
            cv2.fillConvexPoly(self.image, corners, fill, cv2.LINE_AA, _SHIFT)

    def cross(self, centre: Float[ndarray, "2"], colour: RGB, radius: float = 5.5) -> None:
        """Two diagonal segments."""
        reach = radius * self.unit / self.factor
        for dx, dy in ((reach, reach), (reach, -reach)):
            offset = np.array([dx, dy])
            self.line(centre - offset, centre + offset, colour, 2.0)

    def text_width(self, text: str, size: float, weight: int = 500) -> float:
        """Width of a line of text, in px of the enlarged image."""
        pixels = round(size * self.unit)
        return cv2.getTextSize((0, 0), printable(text), (0, 0), self._font, pixels, weight)[2]

    def text(
        self, text: str, corner: Float[ndarray, "2"], colour: RGB = WHITE, size: float = 20, weight: int = 500
    ) -> None:
        """A line of text with its baseline's left end at `corner`, in px of the enlarged image."""
        origin = (round(float(corner[0])), round(float(corner[1])))
        cv2.putText(self.image, printable(text), origin, colour, self._font, round(size * self.unit), weight)

    def label(self, text: str, centre: Float[ndarray, "2"], colour: RGB, size: float = 20) -> None:
        """Short outlined text centred on a point of the image, (2,) in px."""
        if not self._drawable(centre):
            return
        half = self.text_width(text, size, 700) / 2
        x, y = np.asarray(centre) * self.factor + (-half, 0.36 * size * self.unit)
        reach = max(1, round(1.2 * self.unit))
        for dx in (-reach, 0, reach):
            for dy in (-reach, 0, reach):
                self.text(text, np.array([x + dx, y + dy]), INK, size, 700)
        self.text(text, np.array([x, y]), colour, size, 700)

    def shade(self, x0: float, y0: float, x1: float, y1: float, strength: float = 0.62) -> None:
        """Darken a rectangle, in px of the enlarged image, so that text on it can be read; `strength` is 0 to 1."""
        rows = slice(max(0, round(y0)), max(0, round(y1)))
        columns = slice(max(0, round(x0)), max(0, round(x1)))
        patch = self.image[rows, columns].astype(np.float32)
        self.image[rows, columns] = (patch * (1 - strength) + np.array(INK) * strength).astype(np.uint8)
