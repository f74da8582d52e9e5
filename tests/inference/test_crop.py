"""The crop's affine map, and that the pixels it cuts agree with it."""

from __future__ import annotations

import resource

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gknet.errors import GknetError
from gknet.frame import Box
from gknet.geometry import Camera
from gknet.inference.crop import CROP_MARGIN, Crop
from tests.strategies import boxes

crops = st.builds(
    Crop,
    x0=st.integers(-500, 900),
    y0=st.integers(-500, 900),
    side=st.integers(8, 1500),
    size=st.sampled_from([64, 256]),
)
points = st.lists(st.tuples(st.floats(-2000, 3000), st.floats(-2000, 3000)), min_size=1, max_size=6).map(np.array)


@given(crops, points)
def test_to_image_inverts_to_input(crop: Crop, pixels: np.ndarray) -> None:
    np.testing.assert_allclose(crop.to_image(crop.to_input(pixels)), pixels, atol=1e-8)


@given(crops, points)
def test_matrix_is_the_map(crop: Crop, pixels: np.ndarray) -> None:
    mapped = np.c_[pixels, np.ones(len(pixels))] @ crop.input_from_image.T
    np.testing.assert_allclose(mapped[:, :2], crop.to_input(pixels), atol=1e-8)


@given(crops)
def test_corners_map_to_corners(crop: Crop) -> None:
    corners = np.array([[crop.x0, crop.y0], [crop.x0 + crop.side, crop.y0 + crop.side]], dtype=np.float64)
    np.testing.assert_allclose(crop.to_input(corners), [[0, 0], [crop.size, crop.size]], atol=1e-9)


@given(boxes())
def test_crop_around_a_box_holds_it_with_the_margin(box: Box) -> None:
    crop = Crop.around(box, 256)
    assert abs(crop.side - box.side * CROP_MARGIN) <= 0.5 or crop.side == 8
    assert abs(crop.x0 + crop.side / 2 - box.centre[0]) <= 1
    assert abs(crop.y0 + crop.side / 2 - box.centre[1]) <= 1


def blob_image(x: float, y: float, sigma: float, width: int = 640, height: int = 480) -> np.ndarray:
    """A Gaussian whose centre is at (x, y), pixel centres at half-integers."""
    column, row = np.arange(width) + 0.5, np.arange(height) + 0.5
    blob = np.exp(-((column[None] - x) ** 2 + (row[:, None] - y) ** 2) / (2 * sigma**2))
    return np.repeat(np.round(255 * blob)[..., None], 3, axis=2).astype(np.uint8)


def centroid(image: np.ndarray) -> np.ndarray:
    weight = image[..., 0].astype(np.float64)
    column, row = np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5
    return np.array([(weight.sum(axis=0) * column).sum(), (weight.sum(axis=1) * row).sum()]) / weight.sum()


@pytest.mark.parametrize(
    "crop",
    [
        Crop(150, 100, 256, 256),
        Crop(100, 80, 400, 256),
        Crop(151, 97, 331, 256),
        Crop(200, 150, 100, 256),
        Crop(211, 143, 77, 256),
        Crop(-60, -150, 513, 256),
        Crop(150, 100, 700, 256),
        Crop(0, 0, 640, 64),
    ],
    ids=["native", "shrink", "shrink odd", "grow", "grow odd", "beyond the left", "beyond the right", "letterbox"],
)
@pytest.mark.parametrize("centre", [(240.0, 190.0), (247.3, 181.8), (233.5, 195.5)])
def test_cut_pixels_agree_with_the_map(crop: Crop, centre: tuple[float, float]) -> None:
    sigma = 4 * max(1.0, 1 / crop.scale)
    found = centroid(crop.cut(blob_image(*centre, min(sigma, 8))))
    np.testing.assert_allclose(found, crop.to_input(np.array([centre]))[0], atol=0.05)


def test_outside_is_black() -> None:
    image = np.full((100, 100, 3), 200, dtype=np.uint8)
    cut = Crop(-50, -50, 100, 100).cut(image)
    assert (cut[50:, 50:] == 200).all()
    assert cut[:50].max() == 0
    assert cut[:, :50].max() == 0
    assert Crop(500, 500, 20, 32).cut(image).max() == 0


@given(crops)
def test_cut_has_the_size_and_leaves_the_image_alone(crop: Crop) -> None:
    image = np.full((60, 80, 3), 77, dtype=np.uint8)
    cut = crop.cut(image)
    assert cut.shape == (crop.size, crop.size, 3)
    assert cut.dtype == np.uint8
    assert (image == 77).all()


def padded_first(crop: Crop, image: np.ndarray) -> np.ndarray:
    """The plain way: the whole square, black where the image ends, then one resize. Too large for thin images."""
    square = np.zeros((crop.side, crop.side, 3), dtype=np.uint8)
    y0, x0 = max(crop.y0, 0), max(crop.x0, 0)
    inside = image[y0 : max(crop.y0 + crop.side, 0), x0 : max(crop.x0 + crop.side, 0)]
    top, left = y0 - crop.y0, x0 - crop.x0
    square[top : top + inside.shape[0], left : left + inside.shape[1]] = inside
    method = cv2.INTER_AREA if crop.side > crop.size else cv2.INTER_LINEAR
    return cv2.resize(square, (crop.size, crop.size), interpolation=method)


@given(crops, st.sampled_from([(60, 800), (700, 90), (480, 640)]))
@settings(max_examples=60, deadline=None)
def test_cut_is_the_padded_square_within_a_level(crop: Crop, shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    difference = np.abs(crop.cut(image).astype(int) - padded_first(crop, image))
    assert difference.max() <= 1


@pytest.mark.parametrize("shape", [(20, 100_000, 3), (100_000, 20, 3)])
def test_memory_of_a_long_thin_image_is_bounded(shape: tuple[int, int, int]) -> None:
    """The padded square would be 30 GB."""
    image, side = np.full(shape, 200, dtype=np.uint8), max(shape)
    whole = Crop((shape[1] - side) // 2, (shape[0] - side) // 2, side, 256)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    cut = whole.cut(image)
    grown_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown_kib < 500 * 1024
    assert cut.max() > 0
    assert cut.any(axis=(0, 2)).sum() == (256 if shape[1] == side else 2)


def test_camera_of_the_crop_projects_into_the_crop() -> None:
    camera, crop = Camera.from_focal(1400, 1024, 1024), Crop(300, -20, 333, 256)
    body = np.random.default_rng(1).normal(size=(10, 3)) + (0, 0, 20)
    inside = camera.warped(crop.input_from_image, crop.size, crop.size)
    np.testing.assert_allclose(inside.project(body), crop.to_input(camera.project(body)), atol=1e-9)


@pytest.mark.parametrize(("side", "size"), [(0, 256), (-5, 256), (10, 0)])
def test_bad_crop_is_refused(side: int, size: int) -> None:
    with pytest.raises(GknetError, match="crop"):
        Crop(0, 0, side, size)
