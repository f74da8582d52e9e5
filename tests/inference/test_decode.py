"""Decoding is unbiased below the cell, and never invents a point."""

from __future__ import annotations

import time

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.inference.crop import Crop
from gknet.inference.decode import Decoding, decode_heatmaps, keypoints_to_image

STRIDE = 4.0


def gaussians(cells: np.ndarray, sigma: float = 1.5, size: int = 64) -> np.ndarray:
    """Heatmaps with a peak of 1 at each (x, y) in cells, whose centres are at halves."""
    y, x = np.mgrid[:size, :size] + 0.5
    squared = (x - cells[:, 0, None, None]) ** 2 + (y - cells[:, 1, None, None]) ** 2
    return np.exp(-squared / (2 * sigma**2)).astype(np.float32)


@pytest.mark.parametrize(("low", "high"), [(8, 56), (0, 2), (62, 64)])
def test_clean_gaussian_is_unbiased_at_every_phase(low: float, high: float) -> None:
    cells = np.random.default_rng(0).uniform(low, high, (400, 2))
    keypoints = decode_heatmaps(gaussians(cells), STRIDE)
    assert np.abs(keypoints.pixels / STRIDE - cells).max() < 0.01
    assert keypoints.score.min() > 0.99


@pytest.mark.parametrize("sigma", [1.0, 2.0, 2.5])
def test_other_widths_are_unbiased_away_from_the_border(sigma: float) -> None:
    cells = np.random.default_rng(1).uniform(8, 56, (200, 2))
    assert np.abs(decode_heatmaps(gaussians(cells, sigma), STRIDE).pixels / STRIDE - cells).max() < 0.05


def test_noise_and_background_cost_little() -> None:
    generator = np.random.default_rng(2)
    cells = generator.uniform(5, 59, (300, 2))
    noisy = gaussians(cells) + 0.03 + generator.normal(0, 0.02, (300, 64, 64))
    error = decode_heatmaps(noisy.astype(np.float32), STRIDE).pixels / STRIDE - cells
    assert np.sqrt((error**2).mean()) < 0.04
    assert np.abs(error.mean(axis=0)).max() < 0.01


def test_identity_stays_with_the_channel() -> None:
    cells = np.random.default_rng(3).uniform(5, 59, (7, 2))
    order = np.array([3, 0, 6, 1, 5, 2, 4])
    straight, shuffled = decode_heatmaps(gaussians(cells), STRIDE), decode_heatmaps(gaussians(cells[order]), STRIDE)
    np.testing.assert_allclose(shuffled.pixels, straight.pixels[order])


@pytest.mark.parametrize("value", [0.0, 0.5, -1.0, np.nan, np.inf, -np.inf])
def test_no_peak_is_said_and_never_the_corner(value: float) -> None:
    heatmaps = gaussians(np.array([[20.0, 30.0], [40.0, 10.0]]))
    heatmaps[0] = value
    keypoints = decode_heatmaps(heatmaps, STRIDE)
    assert keypoints.score[0] == 0
    np.testing.assert_allclose(keypoints.pixels[0], 128)
    assert np.linalg.eigvalsh(keypoints.covariance_px2[0]).min() >= 256**2
    np.testing.assert_allclose(keypoints.pixels[1], (160, 40), atol=0.01)
    assert np.isfinite(keypoints.covariance_px2).all()


def test_a_few_bad_cells_do_not_hide_a_peak() -> None:
    heatmaps = gaussians(np.array([[20.3, 30.7]]))
    heatmaps[0, 3, 4] = np.nan
    np.testing.assert_allclose(decode_heatmaps(heatmaps, 1.0).pixels[0], (20.3, 30.7), atol=0.01)


def test_covariance_of_a_spread_heatmap_follows_the_spread() -> None:
    """A heatmap averaged over possible positions shows how far apart they are, and along which axis."""
    generator = np.random.default_rng(4)
    spread = np.array([[1.2, 0.5], [0.5, 0.5]])
    places = generator.multivariate_normal((32.3, 30.7), spread, 3000)
    heatmap = gaussians(places).mean(axis=0, keepdims=True)
    keypoints = decode_heatmaps(heatmap, 1.0, Decoding(floor_cells=0.15))
    covariance = keypoints.covariance_px2[0]
    assert 0.6 < np.sqrt(np.linalg.det(covariance) / np.linalg.det(spread)) < 1.8
    assert covariance[0, 0] > 1.2 * covariance[1, 1]
    assert covariance[0, 1] > 0
    np.testing.assert_allclose(keypoints.pixels[0], (32.3, 30.7), atol=0.1)


def test_covariance_grows_as_the_score_drops() -> None:
    one = gaussians(np.array([[20.2, 30.1]]))
    sizes = [np.linalg.det(decode_heatmaps(one * height, 1.0).covariance_px2[0]) for height in (1.0, 0.8, 0.5, 0.2)]
    assert sizes == sorted(sizes)
    assert sizes[-1] > 100 * sizes[0]


def test_floor_and_spread_scale() -> None:
    one = gaussians(np.array([[20.2, 30.1]]))
    sure = decode_heatmaps(one, STRIDE, Decoding(floor_cells=0.2)).covariance_px2[0]
    np.testing.assert_allclose(sure, (0.2 * STRIDE) ** 2 * np.eye(2), atol=1e-3)
    floor = 0.2**2 * np.eye(2)
    once, thrice = (decode_heatmaps(0.6 * one, 1.0, Decoding(0.2, scale)).covariance_px2[0] for scale in (1, 3))
    assert np.linalg.eigvalsh(once).min() > 0.5
    np.testing.assert_allclose(thrice - floor, 3 * (once - floor))
    with pytest.raises(GknetError, match="positive"):
        Decoding(spread_scale=0)


def test_covariance_is_positive_definite_on_noise() -> None:
    heatmaps = np.random.default_rng(5).normal(0, 1, (100, 16, 16)).astype(np.float32)
    keypoints = decode_heatmaps(heatmaps, STRIDE)
    assert np.linalg.eigvalsh(keypoints.covariance_px2).min() > 0
    assert np.isfinite(keypoints.pixels).all()
    assert ((keypoints.score >= 0) & (keypoints.score <= 1)).all()


def test_to_image_and_back() -> None:
    crop = Crop(-30, 55, 512, 256)
    keypoints = decode_heatmaps(gaussians(np.array([[20.2, 30.1], [3.0, 50.0]])), STRIDE)
    placed = keypoints_to_image(keypoints, crop)
    np.testing.assert_allclose(crop.to_input(placed.pixels), keypoints.pixels)
    np.testing.assert_allclose(placed.covariance_px2, keypoints.covariance_px2 * 4)


def test_bad_shape_is_refused() -> None:
    with pytest.raises(GknetError, match="shape"):
        decode_heatmaps(np.zeros((3, 2, 2), dtype=np.float32), STRIDE)


@pytest.mark.slow
def test_decoding_takes_about_a_millisecond() -> None:
    heatmaps = gaussians(np.random.default_rng(6).uniform(5, 59, (24, 2)))
    times = []
    for _ in range(50):
        start = time.process_time()
        decode_heatmaps(heatmaps, STRIDE)
        times.append(time.process_time() - start)
    assert np.median(times) < 5e-3
