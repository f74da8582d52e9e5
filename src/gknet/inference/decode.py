"""Heatmaps to keypoints with sub-cell precision, each with a covariance.

A heatmap is the target Gaussian averaged over the positions that the network considers possible: training by squared
error tends to it, training by likelihood states it (decision 0007). If the positions have the covariance C and the peak
is p, then the heatmap's own local covariance M is the target's plus C, and for a round distribution C = M (1 - p). So
the peak's height and width together determine how far the keypoint may be off. Here C = M (1 - p) / p + floor: equal to
it near p = 1, and wider where a low peak means that probability lies elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Keypoints
from gknet.inference.crop import Crop

RADIUS = 2
"""The fit uses the (2 RADIUS + 1)^2 cells about the highest one."""

NO_PEAK = 0.02
"""A heatmap that rises less than this above its median has no peak."""

SPREAD_CELLS = 1.5
"""Standard deviation of a training target: the prior of the fitted width, and the width where the fit finds none."""

WIDTH_PRIOR = 0.1
"""Weight of that prior against the cells, of which the highest has weight 1. It steadies peaks at the border."""


@dataclass(frozen=True)
class Decoding:
    """How a peak's height and width become a covariance. Both numbers are fitted on a validation split (calibration).

    Attributes:
        floor_cells: Standard deviation per axis of a perfect peak, in cells of the heatmap.
        spread_scale: Factor on the covariance that follows from a peak's height and width.
    """

    floor_cells: float = 0.3
    spread_scale: float = 1.0

    def __post_init__(self) -> None:
        if not (0 < self.floor_cells < np.inf and 0 < self.spread_scale < np.inf):
            raise GknetError(
                f"decoding: expected a positive, finite floor and scale, got {self.floor_cells} and {self.spread_scale}"
            )


def decode_heatmaps(heatmaps: Float[ndarray, "n h w"], stride: float, decoding: Decoding | None = None) -> Keypoints:
    """One keypoint per heatmap.

    Args:
        heatmaps: (n, h, w), h and w of 3 or more.
        stride: Pixels of the network's input per cell.
        decoding: How a peak becomes a covariance; None for the uncalibrated default.

    Returns:
        Keypoints in pixels of the network's input. A heatmap without a peak (flat, or not finite) yields score 0, the
        centre of the input and the covariance of a point that may be anywhere in it.

    Raises:
        GknetError: The heatmaps have another shape.
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
    """Keypoints in the image from which a crop was cut.

    Args:
        keypoints: In pixels of the crop's network input.
        crop: The crop.
    """
    return Keypoints(crop.to_image(keypoints.pixels), keypoints.score, keypoints.covariance_px2 / crop.scale**2)


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
    prior = np.array([1e-9, 1e-9, 1e-9, WIDTH_PRIOR, WIDTH_PRIOR, WIDTH_PRIOR])
    products = (basis[:, :, None] * basis[:, None, :]).reshape(len(basis), -1)
    normal = (weight @ products).reshape(-1, 6, 6) + np.diag(prior)
    right = (weight * np.log(values)) @ basis + prior * expected
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
