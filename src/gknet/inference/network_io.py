"""What goes into a network and what comes out of it: the input made from an image, and the types of the callables."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.inference.crop import Crop


class NetworkOutput(NamedTuple):
    """What a keypoint network returns for a batch of crops.

    Attributes:
        heatmaps: (b, n, h, w), channel k is keypoint k.
        attitude: (b, k) probabilities of the attitude classes (`gknet.inference.attitude.AttitudeBins`), summing to 1;
            None for a network that has none.
    """

    heatmaps: Float32[ndarray, "b n h w"]
    attitude: Float32[ndarray, "b k"] | None = None


Forward = Callable[[Float32[ndarray, "b 3 size size"]], Float32[ndarray, "b c *cells"]]
"""A locator (maps) or a direct network (one row for each crop), whatever runs it."""

KeypointForward = Callable[[Float32[ndarray, "b 3 size size"]], NetworkOutput]
"""A keypoint network, whatever runs it."""


def check_image(image: object) -> UInt8[ndarray, "h w 3"]:
    """The image as RGB.

    Args:
        image: uint8, RGB of shape (h, w, 3) or grey of shape (h, w), which is repeated into three channels.

    Raises:
        GknetError: Anything else.
    """
    if not isinstance(image, ndarray) or image.dtype != np.uint8:
        kind = image.dtype if isinstance(image, ndarray) else type(image).__name__
        raise GknetError(f"image: expected a uint8 array, got {kind}")
    if image.ndim == 2 and image.size > 0:
        return np.repeat(image[:, :, None], 3, axis=2)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise GknetError(f"image: expected RGB of shape (h, w, 3) or grey of (h, w), got {image.shape}")
    return image


def network_input(image: UInt8[ndarray, "h w 3"], crop: Crop) -> Float32[ndarray, "1 3 size size"]:
    """The crop as a batch of one: RGB in [0, 1], channels first.

    Args:
        image: The full image, RGB.
        crop: The part to cut out and resize.
    """
    cut = crop.cut(image).transpose(2, 0, 1)[None]
    return np.ascontiguousarray(cut, dtype=np.float32) / np.float32(255)
