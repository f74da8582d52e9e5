"""Heatmaps to keypoints, below the cell, each with a covariance; and the locator's maps to a box.

A heatmap is the target Gaussian averaged over what the network deems possible: training by squared error tends to it,
training by likelihood says it outright (decision 0007).
If that spread has covariance C and the peak value is p, then the heatmap's own local covariance M is the target's
plus C, and for a round spread C = M (1 - p). So peak and width together tell how far the keypoint may be off. Here
C = M (1 - p) / p + floor: equal to it near p = 1, and wider where a low peak says that mass sits elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Keypoints
from gknet.inference.crop import Crop

RADIUS = 2
"""The fit sees the (2 RADIUS + 1)^2 cells about the highest one."""

NO_PEAK = 0.02
"""A heatmap that rises less than this above its median has no peak."""

SPREAD_CELLS = 1.5
"""The width of a training target: the fit leans to it, and takes it where it finds no width of its own."""

LEANING = 0.1
"""Weight of that width against the cells, of which the highest has weight 1. It steadies peaks at the border."""


@dataclass(frozen=True)
class Decoding:
    """How sure a peak is believed to be.

    floor_cells   standard deviation per axis of a perfect peak
    spread_scale  multiplies the covariance that a peak's height and width tell
    Both are fitted on a validation split (calibration.py).
    """

    floor_cells: float = 0.3
    spread_scale: float = 1.0

    def __post_init__(self) -> None:
        if not (self.floor_cells > 0 and self.spread_scale > 0):
            raise GknetError(
                f"decoding: expected a positive floor and scale, got {self.floor_cells} and {self.spread_scale}"
            )


def decode_heatmaps(heatmaps: Float[ndarray, "n h w"], stride: float, decoding: Decoding | None = None) -> Keypoints:
    """One keypoint per heatmap, in pixels of the network's input.

    A heatmap without a peak (flat, or not finite) yields score 0, the centre of the input and the covariance of a
    point that may be anywhere in it.
    """
    decoding = decoding or Decoding()
    if heatmaps.ndim != 3 or heatmaps.shape[1] < 3 or heatmaps.shape[2] < 3:
        raise GknetError(f"heatmaps: expected shape (n, h, w) with h and w of 3 or more, got {heatmaps.shape}")
    heights = np.where(np.isfinite(heatmaps), heatmaps, -np.inf).astype(np.float64)
    rows, columns, top = _highest(heights)
    rise = top - _median(heatmaps)
    found = np.isfinite(top) & (rise > NO_PEAK) & (top > NO_PEAK)
    offset, moments, peak = _fit(heights, rows, columns, top)

    score = np.where(found, np.clip(peak, 0.0, 1.0), 0.0)
    cells = np.stack([columns, rows], axis=1) + 0.5 + offset
    inflation = (1 - score) / np.maximum(score, NO_PEAK)
    spread = moments * inflation[:, None, None]
    covariance = decoding.spread_scale * spread + decoding.floor_cells**2 * np.eye(2)

    height, width = heatmaps.shape[1:]
    cells[~found] = width / 2, height / 2
    covariance[~found] = max(height, width) ** 2 * np.eye(2)
    return Keypoints(cells * stride, score, covariance * stride**2)


def keypoints_to_image(keypoints: Keypoints, crop: Crop) -> Keypoints:
    """From pixels of a crop's network input to pixels of the image it was cut from."""
    return Keypoints(crop.to_image(keypoints.pixels), keypoints.score, keypoints.covariance_px2 / crop.scale**2)


def decode_locator(
    output: Float[ndarray, "5 h w"], stride: float, input_size: int, min_score: float = 0.1
) -> tuple[Box, float] | None:
    """The locator's box in pixels of its input, with the score of its peak; None when it sees no spacecraft.

    Channel 0 is the heatmap of the box's centre, channels 1 to 4 the distances from a cell's centre to the left,
    top, right and bottom side, in units of the input's size. The sides are averaged over the cells about the peak.
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


def _median(heatmaps: Float[ndarray, "n h w"]) -> Float[ndarray, " n"]:
    """The background of each heatmap, from every third cell: it need not be exact."""
    return np.nan_to_num(np.median(heatmaps[:, ::3, ::3], axis=(1, 2)), nan=0.0, posinf=0.0, neginf=0.0)


def _highest(heights: Float[ndarray, "n h w"]) -> tuple[Int[ndarray, " n"], Int[ndarray, " n"], Float[ndarray, " n"]]:
    """Row, column and value of each heatmap's highest cell."""
    count, _, width = heights.shape
    flat = heights.reshape(count, -1)
    index = flat.argmax(axis=1)
    return index // width, index % width, flat[np.arange(count), index]


def _fit(
    heights: Float[ndarray, "n h w"], rows: Int[ndarray, " n"], columns: Int[ndarray, " n"], top: Float[ndarray, " n"]
) -> tuple[Float[ndarray, "n 2"], Float[ndarray, "n 2 2"], Float[ndarray, " n"]]:
    """A Gaussian through the cells about each peak: offset (x, y) from the cell's centre, covariance, peak value.

    The logarithm of a Gaussian is a paraboloid, fitted by least squares with the squared value as the weight. Cells
    beyond the border have no weight, so a peak at the border is as unbiased as any other.
    """
    step = np.arange(-RADIUS, RADIUS + 1)
    dy, dx = (grid.ravel() for grid in np.meshgrid(step, step, indexing="ij"))
    y, x = rows[:, None] + dy, columns[:, None] + dx
    height, width = heights.shape[1:]
    inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    values = heights[np.arange(len(heights))[:, None], y.clip(0, height - 1), x.clip(0, width - 1)]
    positive = inside & (values > 0.05 * np.maximum(top, NO_PEAK)[:, None])
    values = np.where(positive, values, 1.0)

    basis = np.stack([np.ones(len(dx)), dx, dy, dx * dx / 2, dx * dy, dy * dy / 2], axis=1)
    weight = np.where(positive, values / np.maximum(top, NO_PEAK)[:, None], 0.0) ** 2
    expected = np.array([0, 0, 0, -1, 0, -1]) / SPREAD_CELLS**2
    leaning = np.array([1e-9, 1e-9, 1e-9, LEANING, LEANING, LEANING])
    products = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1)
    normal = (weight @ products).reshape(-1, 6, 6) + np.diag(leaning)
    right = (weight * np.log(values)) @ basis + leaning * expected
    coefficients = np.linalg.solve(normal, right[..., None])[..., 0]
    return _summit(coefficients, top, weight @ np.stack([dx, dy], axis=1) / np.maximum(weight.sum(1), 1e-9)[:, None])


def _summit(
    coefficients: Float[ndarray, "n 6"], top: Float[ndarray, " n"], centroid: Float[ndarray, "n 2"]
) -> tuple[Float[ndarray, "n 2"], Float[ndarray, "n 2 2"], Float[ndarray, " n"]]:
    """Where the paraboloid peaks; the weighted centroid where it is no hill or peaks far from the highest cell."""
    level, gradient = coefficients[:, 0], coefficients[:, 1:3]
    curvature = -coefficients[:, [3, 4, 4, 5]].reshape(-1, 2, 2)
    steepness = np.linalg.eigvalsh(curvature)[:, 0]
    hill = np.isfinite(top) & (steepness > 0.02)
    curvature = np.where(hill[:, None, None], curvature, np.eye(2) / SPREAD_CELLS**2)
    moments = np.linalg.inv(curvature)
    offset = np.einsum("nij,nj->ni", moments, gradient)
    hill &= np.abs(offset).max(axis=1) <= 1.5
    peak = np.exp(np.minimum(level + np.einsum("ni,ni->n", gradient, offset) / 2, 1.0))
    peak = np.where(hill, np.clip(peak, top, 1.3 * top), top)
    return np.where(hill[:, None], offset, centroid), moments, peak
