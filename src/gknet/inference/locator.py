"""The locator: from the full image to the spacecraft's box."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box
from gknet.inference.crop import Crop
from gknet.inference.network_io import Forward, network_input


def locate(image: UInt8[ndarray, "h w 3"], network: Forward, input_size: int, min_score: float) -> Box | None:
    """Find the spacecraft in an image.

    Args:
        image: The full image, RGB. The network's input is this image scaled, in the middle of a black square.
        network: (b, 3, s, s) -> (b, 5, s / stride, s / stride), see `decode_locator`.
        input_size: Side of the network's input in pixels.
        min_score: Height of the centre's peak below which there is no spacecraft.

    Returns:
        The part of the box inside the image, in its pixels, or None when no spacecraft is found.
    """
    height, width = image.shape[:2]
    side = max(width, height)
    whole = Crop((width - side) // 2, (height - side) // 2, side, input_size)
    output = network(network_input(image, whole))[0]
    found = decode_locator(output, input_size / output.shape[2], input_size, min_score)
    if found is None:
        return None
    box, _ = found
    (x0, y0), (x1, y1) = whole.to_image(np.array([[box.x0, box.y0], [box.x1, box.y1]]))
    return Box(float(x0), float(y0), float(x1), float(y1)).clipped(width, height)


def decode_locator(
    output: Float[ndarray, "5 h w"], stride: float, input_size: int, min_score: float = 0.1
) -> tuple[Box, float] | None:
    """A locator's maps as a box.

    Args:
        output: Channel 0 is the heatmap of the box's centre; channels 1 to 4 are the distances from a cell's centre to
            the left, top, right and bottom side, in units of the input's size. The sides are averaged over the cells
            about the peak.
        stride: Input pixels per cell.
        input_size: Side of the network's input in pixels.
        min_score: Height of the peak below which there is no spacecraft.

    Returns:
        The box in pixels of the network's input, and the height of its peak (0 to 1); None when no peak is high enough,
        the box is empty, or the output is not finite.

    Raises:
        GknetError: The output has another shape.
    """
    if output.ndim != 3 or output.shape[0] != 5:
        raise GknetError(f"locator output: expected shape (5, h, w), got {output.shape}")
    if not np.isfinite(output).all():
        return None
    heat = np.maximum(output[0], 0)
    row, column = np.unravel_index(int(heat.argmax()), heat.shape)
    score = float(min(heat[row, column], 1.0))
    if score < min_score:
        return None
    window = np.s_[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    y, x = (np.mgrid[: heat.shape[0], : heat.shape[1]] + 0.5)[(slice(None), *window)] * stride
    weight = heat[window] / heat[window].sum()
    left, top, right, bottom = np.maximum(output[1:][(slice(None), *window)], 0) * input_size
    x0, y0 = float((weight * (x - left)).sum()), float((weight * (y - top)).sum())
    x1, y1 = float((weight * (x + right)).sum()), float((weight * (y + bottom)).sum())
    if x1 - x0 < 1e-3 or y1 - y0 < 1e-3:
        return None
    return Box(x0, y0, x1, y1), score
