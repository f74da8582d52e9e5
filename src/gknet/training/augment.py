"""Augmentation: one 3x3 matrix warps image, points and K together, then exposure and sensor change."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray


@dataclass(frozen=True)
class Augmentation:
    """Ranges of the random changes.

    Attributes:
        margin: The input's side over the keypoints' box (deployed: 1.25 around the detected box).
        shift: Of the box's centre on each axis, as a share of the box's side.
        rotate: Whether the image is rotated in its plane, by any angle.
        gamma: Largest logarithm of the exponent.
        gain: Factor of the brightness.
        offset: Largest change of the brightness, of 255.
        colour: Largest change of a channel's factor.
        noise: Standard deviation, of 255.
        blur: Standard deviation in pixels.
        probability: Of each photometric change that does not always happen.
        occlusion: Probability of a rectangle in front of the spacecraft.
    """

    margin: tuple[float, float] = (1.05, 1.55)
    shift: float = 0.08
    rotate: bool = True
    gamma: float = 0.35
    gain: tuple[float, float] = (0.6, 1.6)
    offset: float = 8.0
    colour: float = 0.12
    noise: tuple[float, float] = (0.0, 7.0)
    blur: tuple[float, float] = (0.4, 1.4)
    probability: float = 0.25
    occlusion: float = 0.08


@dataclass(frozen=True)
class PictureAugmentation:
    """Ranges for whole images (the locator), which are also rotated by quarter turns.

    Attributes:
        zoom: Factor of the size.
        shift: On each axis, as a share of the image's side.
    """

    zoom: tuple[float, float] = (0.75, 1.4)
    shift: float = 0.15


def translation(x: float, y: float) -> Float[ndarray, "3 3"]:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1]], dtype=np.float64)


def scaling(s: float) -> Float[ndarray, "3 3"]:
    return np.diag([s, s, 1.0])


def rotation(angle_rad: float) -> Float[ndarray, "3 3"]:
    """Rotation from x towards y: clockwise on the screen."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def warp_points(matrix: Float[ndarray, "3 3"], points: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n 2"]:
    """An affine map of pixels. A camera follows it by K' = matrix @ K."""
    return points @ matrix[:2, :2].T + matrix[:2, 2]


def warp_image(image: UInt8[ndarray, "h w 3"], matrix: Float[ndarray, "3 3"], size: int) -> UInt8[ndarray, "s s 3"]:
    """The image under input_from_image, black outside; averaged first when it shrinks a lot."""
    shrink = math.sqrt(abs(np.linalg.det(matrix[:2, :2])))
    while shrink < 0.6 and min(image.shape[:2]) >= 2:
        height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
        image = cv2.resize(image[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
        matrix = matrix @ scaling(2.0)
        shrink *= 2
    # OpenCV counts from the centre of the top-left pixel, we count from its corner.
    from_centres = translation(-0.5, -0.5) @ matrix @ translation(0.5, 0.5)
    return cv2.warpAffine(image, from_centres[:2], (size, size), flags=cv2.INTER_LINEAR)


def craft_warp(
    rng: np.random.Generator,
    points: Float[ndarray, "n 2"],
    in_view: Bool[ndarray, " n"],
    size: int,
    ranges: Augmentation,
) -> Float[ndarray, "3 3"]:
    """input_from_cache: any rotation, then a crop as a jittered detection would make it."""
    rotated_from_cache = rotation(rng.uniform(-math.pi, math.pi) if ranges.rotate else 0.0)
    rotated = warp_points(rotated_from_cache, points[in_view])
    low, high = rotated.min(axis=0), rotated.max(axis=0)
    side = max(8.0, float((high - low).max()))
    centre = (low + high) / 2 + rng.uniform(-ranges.shift, ranges.shift, 2) * side
    margin = math.exp(rng.uniform(*np.log(ranges.margin)))
    scale = size / (side * margin)
    return translation(size / 2, size / 2) @ scaling(scale) @ translation(-centre[0], -centre[1]) @ rotated_from_cache


def picture_warp(
    rng: np.random.Generator, cache_size: int, size: int, ranges: PictureAugmentation
) -> Float[ndarray, "3 3"]:
    """input_from_cache: a rotation by quarter turns about the centre, zoom and shift."""
    half = cache_size / 2
    scale = size / cache_size * math.exp(rng.uniform(*np.log(ranges.zoom)))
    shift = size / 2 + rng.uniform(-ranges.shift, ranges.shift, 2) * size
    quarter = np.rint(rotation(rng.integers(4) * math.pi / 2))
    return translation(shift[0], shift[1]) @ scaling(scale) @ quarter @ translation(-half, -half)


@lru_cache(maxsize=32)
def _noise_pool(quarters: int) -> ndarray:
    """Noise of standard deviation quarters / 4, made once: drawing it anew would cost more than the warp."""
    values = np.random.default_rng(quarters).normal(0, quarters / 4, 1 << 20)
    return np.clip(np.rint(values), -127, 127).astype(np.int8)


def _add_noise(rng: np.random.Generator, image: UInt8[ndarray, "s s 3"], sigma: float) -> UInt8[ndarray, "s s 3"]:
    pool = _noise_pool(round(4 * sigma))
    start = int(rng.integers(0, max(1, len(pool) - image.size)))
    noise = np.resize(pool[start : start + image.size], image.shape)
    return cv2.add(image, noise, dtype=cv2.CV_8U)


def _tone(rng: np.random.Generator, ranges: Augmentation) -> UInt8[ndarray, "256"]:
    """Gamma, gain and offset as one table."""
    gamma = math.exp(rng.uniform(-ranges.gamma, ranges.gamma))
    gain = math.exp(rng.uniform(*np.log(ranges.gain)))
    values = 255 * gain * (np.arange(256) / 255) ** gamma + rng.uniform(-ranges.offset, ranges.offset)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _colours(rng: np.random.Generator, ranges: Augmentation) -> Float[ndarray, "3 3"]:
    """A change of white balance and of saturation; sometimes grey, as many space cameras are."""
    grey = np.full((3, 3), 1 / 3)
    saturation = 0.0 if rng.random() < ranges.probability / 2 else rng.uniform(0.6, 1.3)
    balance = np.diag(rng.uniform(1 - ranges.colour, 1 + ranges.colour, 3))
    return balance @ (saturation * np.eye(3) + (1 - saturation) * grey)


def _occlude(rng: np.random.Generator, image: UInt8[ndarray, "s s 3"]) -> None:
    """A dark or bright rectangle, in place."""
    size = image.shape[0]
    width, height = (rng.uniform(0.08, 0.3, 2) * size).astype(int)
    x, y = (int(rng.integers(0, max(1, size - side))) for side in (width, height))
    value = 0 if rng.random() < 0.6 else int(rng.integers(0, 256))
    image[y : y + height, x : x + width] = value


def photometric(
    rng: np.random.Generator, image: UInt8[ndarray, "s s 3"], ranges: Augmentation
) -> UInt8[ndarray, "s s 3"]:
    """Another exposure and another sensor; the geometry stays."""
    if rng.random() < ranges.probability:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(*ranges.blur))
    if rng.random() < 2 * ranges.probability:
        image = cv2.transform(image, _colours(rng, ranges))
    image = cv2.LUT(image, _tone(rng, ranges))
    if rng.random() < 2 * ranges.probability:
        image = _add_noise(rng, image, rng.uniform(*ranges.noise))
    if rng.random() < ranges.occlusion:
        _occlude(rng, image)
    return image
