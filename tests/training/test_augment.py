"""One matrix moves image, points and camera alike."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

pytest.importorskip("torch")

from gknet.geometry import Camera, Pose
from gknet.training.augment import (
    Augmentation,
    PictureAugmentation,
    craft_warp,
    photometric,
    picture_warp,
    rotation,
    scaling,
    translation,
    warp_image,
    warp_points,
)


def spot(size: int, centre: tuple[float, float], sigma: float = 4.0) -> np.ndarray:
    """A Gaussian spot about a sub-pixel centre."""
    y, x = np.mgrid[:size, :size] + 0.5
    value = 250 * np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * sigma**2))
    return np.repeat(np.rint(value).astype(np.uint8)[:, :, None], 3, axis=2)


def centroid(image: np.ndarray) -> np.ndarray:
    weight = image[:, :, 0].astype(float)
    y, x = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()


@pytest.mark.parametrize(
    ("matrix", "size"),
    [
        (scaling(0.8), 256),
        (scaling(0.4), 128),
        (scaling(0.2), 64),
        (scaling(1.5) @ translation(-80, -70), 256),
        (translation(128, 128) @ rotation(0.7) @ translation(-160, -150), 256),
        (translation(64, 64) @ scaling(0.35) @ rotation(-2.5) @ translation(-160, -160), 128),
    ],
)
def test_a_spot_lands_where_its_point_does(matrix: np.ndarray, size: int) -> None:
    point = np.array([150.3, 170.8])
    warped = warp_image(spot(320, (150.3, 170.8)), matrix, size)
    np.testing.assert_allclose(centroid(warped), warp_points(matrix, point[None])[0], atol=0.06)


def test_the_camera_follows_the_points() -> None:
    camera = Camera.from_focal(400, 320, 320)
    pose = Pose.from_rotation_vector([0.3, -0.5, 1.0], [0.2, 0.1, 6.0])
    body = np.random.default_rng(0).normal(size=(10, 3))
    matrix = translation(128, 128) @ scaling(0.7) @ rotation(1.1) @ translation(-160, -160)
    pixels = camera.project(pose.transform(body))
    through_k = pose.transform(body) @ (matrix @ camera.matrix).T
    np.testing.assert_allclose(warp_points(matrix, pixels), through_k[:, :2] / through_k[:, 2:], atol=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_a_crop_keeps_the_craft_in_view_and_its_handedness(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(80, 240, (9, 2))
    in_view = np.ones(9, dtype=bool)
    ranges = Augmentation(margin=(1.2, 1.6), shift=0.05)
    matrix = craft_warp(rng, points, in_view, 256, ranges)
    warped = warp_points(matrix, points)
    assert (warped > 0).all()
    assert (warped < 256).all()
    assert np.linalg.det(matrix[:2, :2]) > 0
    side = (warped.max(axis=0) - warped.min(axis=0)).max()
    assert 1.2 - 1e-6 < 256 / side < 1.6 + 1e-6


@pytest.mark.parametrize("seed", range(8))
def test_boxes_stay_boxes_in_whole_pictures(seed: int) -> None:
    matrix = picture_warp(np.random.default_rng(seed), 256, 128, PictureAugmentation())
    assert (np.abs(matrix[:2, :2]) > 1e-9).sum() == 2
    assert np.linalg.det(matrix[:2, :2]) > 0


def test_light_changes_no_geometry_and_repeats_with_its_seed() -> None:
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8), (0, 0), 3)
    original = image.copy()
    for seed in range(20):
        first = photometric(np.random.default_rng(seed), image, Augmentation())
        again = photometric(np.random.default_rng(seed), image, Augmentation())
        assert first.shape == image.shape
        assert first.dtype == np.uint8
        np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(image, original)
