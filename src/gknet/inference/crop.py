"""The map between an image and a network's square input, used both ways.

A crop has whole-pixel corners, so cutting it out and resizing it is pure scaling: no half-pixel shift can creep in.
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
        x0: Left side in whole px of the image.
        y0: Top side in whole px of the image.
        side: Length of a side in px of the image.
        size: Length of a side in px of the network's input.
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
        """The square about `box`, its side `margin` times the longer side of the box, for an input of `size` px."""
        side = max(8, round(box.side * margin))
        centre_x, centre_y = box.centre
        return Crop(round(centre_x - side / 2), round(centre_y - side / 2), side, size)

    @property
    def scale(self) -> float:
        """Input pixels per image pixel."""
        return self.size / self.side

    @property
    def input_from_image(self) -> Float[ndarray, "3 3"]:
        """(3, 3) affine map from pixels of the image to pixels of the input."""
        s = self.scale
        return np.array([[s, 0, -s * self.x0], [0, s, -s * self.y0], [0, 0, 1]], dtype=np.float64)

    def to_input(self, pixels: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n 2"]:
        """(..., 2) pixels of the image, in pixels of the input."""
        return (np.asarray(pixels) - (self.x0, self.y0)) * self.scale

    def to_image(self, pixels: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n 2"]:
        """(..., 2) pixels of the input, in pixels of the image."""
        return np.asarray(pixels) / self.scale + (self.x0, self.y0)

    def cut(self, image: UInt8[ndarray, "h w c"]) -> UInt8[ndarray, "size size c"]:
        """The (size, size, c) crop of an (h, w, c) image: area-averaged when it shrinks, linear when it grows."""
        height, width = image.shape[:2]
        x0, y0 = max(self.x0, 0), max(self.y0, 0)
        x1, y1 = min(self.x0 + self.side, width), min(self.y0 + self.side, height)
        if x1 <= x0 or y1 <= y0:
            return np.zeros((self.size, self.size, image.shape[2]), dtype=np.uint8)
        inside = image[y0:y1, x0:x1]
        if inside.shape[:2] != (self.side, self.side):
            left, top = x0 - self.x0, y0 - self.y0
            right, bottom = self.x0 + self.side - x1, self.y0 + self.side - y1
            inside = cv2.copyMakeBorder(inside, top, bottom, left, right, cv2.BORDER_CONSTANT)
        method = cv2.INTER_AREA if self.side > self.size else cv2.INTER_LINEAR
        return cv2.resize(inside, (self.size, self.size), interpolation=method).reshape(self.size, self.size, -1)
