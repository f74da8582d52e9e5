"""The map between an image and a network's square input, used both ways.

A crop has whole-pixel corners, so cutting it out and resizing it is pure scaling, without a half-pixel shift.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box

CROP_MARGIN = 1.25
"""A crop's side over the longer side of the keypoints' box (HRNet's enlargement, Chen et al. 2019)."""


@dataclass(frozen=True)
class Crop:
    """The square [x0, x0 + side] x [y0, y0 + side] of an image, resized to `size` x `size`.

    It may reach beyond the image; what lies outside is black.

    Attributes:
        x0: Left edge in image pixels.
        y0: Top edge in image pixels.
        side: Side in image pixels.
        size: Side in pixels of the network's input.
    """

    x0: int
    y0: int
    side: int
    size: int

    def __post_init__(self) -> None:
        if self.side < 1 or self.size < 1:
            raise GknetError(f"crop: expected a positive side and size, got {self.side} and {self.size}")

    @staticmethod
    def around(box: Box, size: int, margin: float = CROP_MARGIN) -> Crop:
        """The square about a box.

        Args:
            box: In image pixels.
            size: Side in pixels of the network's input.
            margin: Side of the square over the longer side of the box.
        """
        side = max(8, round(box.side * margin))
        centre_x, centre_y = box.centre
        return Crop(round(centre_x - side / 2), round(centre_y - side / 2), side, size)

    @property
    def box(self) -> Box:
        """The square in image pixels."""
        return Box(self.x0, self.y0, self.x0 + self.side, self.y0 + self.side)

    @property
    def scale(self) -> float:
        """Input pixels per image pixel."""
        return self.size / self.side

    @property
    def input_from_image(self) -> Float[ndarray, "3 3"]:
        """Homogeneous image pixels to pixels of the input."""
        s = self.scale
        return np.array([[s, 0, -s * self.x0], [0, s, -s * self.y0], [0, 0, 1]], dtype=np.float64)

    def to_input(self, pixels: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n 2"]:
        """Image pixels to pixels of the input."""
        return (np.asarray(pixels) - (self.x0, self.y0)) * self.scale

    def to_image(self, pixels: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n 2"]:
        """Pixels of the input to image pixels."""
        return np.asarray(pixels) / self.scale + (self.x0, self.y0)

    def cut(self, image: UInt8[ndarray, "h w c"]) -> UInt8[ndarray, "size size c"]:
        """The crop of an image: area-averaged when it shrinks, linear when it grows, black outside.

        Where the crop reaches beyond the image, the longer axis of the part inside is shrunk before the other one is
        padded. So the memory is a small multiple of the image's, however long and thin it is.
        """
        height, width, channels = image.shape
        x0, y0 = max(self.x0, 0), max(self.y0, 0)
        x1, y1 = min(self.x0 + self.side, width), min(self.y0 + self.side, height)
        if x1 <= x0 or y1 <= y0:
            return np.zeros((self.size, self.size, channels), dtype=np.uint8)
        inside = image[y0:y1, x0:x1]
        rows = (y0 - self.y0, self.y0 + self.side - y1)
        columns = (x0 - self.x0, self.x0 + self.side - x1)
        if not (any(rows) or any(columns)) or self.side <= self.size:
            return self._resized(_padded(inside, rows, columns), self.size, self.size)
        if x1 - x0 >= y1 - y0:
            shrunk = self._resized(_padded(inside, (0, 0), columns), self.size, y1 - y0)
            return self._resized(_padded(shrunk, rows, (0, 0)), self.size, self.size)
        shrunk = self._resized(_padded(inside, rows, (0, 0)), x1 - x0, self.size)
        return self._resized(_padded(shrunk, (0, 0), columns), self.size, self.size)

    def _resized(self, image: UInt8[ndarray, "h w c"], width: int, height: int) -> UInt8[ndarray, "height width c"]:
        method = cv2.INTER_AREA if self.side > self.size else cv2.INTER_LINEAR
        return cv2.resize(image, (width, height), interpolation=method).reshape(height, width, -1)


def _padded(image: UInt8[ndarray, "h w c"], rows: tuple[int, int], columns: tuple[int, int]) -> UInt8[ndarray, "*hwc"]:
    """With black rows above and below, and black columns left and right."""
    if not (any(rows) or any(columns)):
        return image
    return cv2.copyMakeBorder(image, *rows, *columns, cv2.BORDER_CONSTANT).reshape(
        image.shape[0] + sum(rows), image.shape[1] + sum(columns), -1
    )
