"""Overlays: they are drawn where the estimate says, leave the input alone, and bear odd input."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.frame import Estimate, Failure, FailureKind, Frame, Keypoints
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.report.canvas import Canvas
from gknet.report.overlay import confidence, describe, draw_overlay, zoomed
from gknet.report.palette import SKY, score_colour
from tests.cli.toy import CAMERA, ToyEstimator, toy_picture, toy_pose, toy_spacecraft

TOY = toy_spacecraft()


def toy_frame(number: int = 1, size: int = 1024) -> Frame:
    camera = Camera.from_focal(CAMERA.matrix[0, 0] * size / 256, size, size)
    visible = np.arange(TOY.keypoint_count) % 3 > 0
    return Frame(f"toy/{number}", toy_picture(number, size), camera, toy_pose(number), visible)


def toy_estimate(frame: Frame) -> Estimate:
    return ToyEstimator().estimate(image_of(frame), frame.camera)


def image_of(frame: Frame) -> np.ndarray:
    assert frame.image is not None
    return frame.image


def keypoints_of(estimate: Estimate) -> Keypoints:
    assert estimate.keypoints is not None
    return estimate.keypoints


DARK = Estimate(failure=Failure(FailureKind.NO_CONSENSUS, "dark"))


def near(image: np.ndarray, colour: tuple[int, int, int], pixel: np.ndarray, reach: int = 3) -> bool:
    """Whether a colour is found within `reach` pixels of a point."""
    x, y = (int(v) for v in pixel)
    window = image[y - reach : y + reach + 1, x - reach : x + reach + 1].astype(int)
    return bool((np.abs(window - colour).max(axis=2) < 40).any())


def test_marks_lie_where_the_estimate_says() -> None:
    frame = toy_frame()
    estimate = toy_estimate(frame)
    picture = draw_overlay(frame, TOY, estimate, lines=(), truth=False, legend=False)
    assert picture.shape == image_of(frame).shape
    pixels = keypoints_of(estimate).pixels
    for k in range(TOY.keypoint_count):
        assert near(picture, score_colour(float(keypoints_of(estimate).score[k])), pixels[k], reach=8)
    i, j = TOY.edges[0]
    assert near(picture, SKY, (0.4 * pixels[i] + 0.6 * pixels[j]), reach=6)


def test_hidden_keypoints_are_hollow() -> None:
    frame = toy_frame()
    assert frame.visible is not None
    estimate = toy_estimate(frame)
    alone = Estimate(estimate.keypoints, box=estimate.box, failure=Failure(FailureKind.NO_SOLUTION, "not estimated"))
    picture = draw_overlay(frame, TOY, alone, lines=(), truth=False, legend=False)
    for k in np.flatnonzero(keypoints_of(estimate).score > 0.4):
        colour = score_colour(float(keypoints_of(estimate).score[k]))
        assert near(picture, colour, keypoints_of(estimate).pixels[k], reach=0) == bool(frame.visible[k])


def test_input_is_left_alone_and_result_repeats() -> None:
    frame = toy_frame()
    before = image_of(frame).copy()
    first = draw_overlay(frame, TOY, toy_estimate(frame))
    assert np.array_equal(image_of(frame), before)
    assert np.array_equal(first, draw_overlay(frame, TOY, toy_estimate(frame)))


@pytest.mark.parametrize(("size", "factor"), [(64, 12), (256, 3), (1024, 1), (1400, 1)])
def test_small_pictures_are_enlarged_by_whole_factors(size: int, factor: int) -> None:
    frame = toy_frame(size=size)
    assert draw_overlay(frame, TOY, DARK).shape == (
        size * factor,
        size * factor,
        3,
    )


def test_odd_estimates_are_borne() -> None:
    frame = toy_frame()
    count = TOY.keypoint_count
    wild = Keypoints(np.full((count, 2), np.nan), np.linspace(0, 2, count), np.tile(np.eye(2), (count, 1, 1)))
    behind = Pose(np.eye(3), np.array([0.0, 0.0, -5.0]))
    inside = Pose(np.eye(3), np.array([0.0, 0.0, 0.9]))
    for pose in (behind, inside):
        draw_overlay(frame, TOY, Estimate(wild, pose, np.eye(6), np.ones(count, dtype=bool)))
    with pytest.raises(GknetError, match="needs its image"):
        draw_overlay(Frame("x", None, frame.camera), TOY, DARK)


def test_zoom_moves_marks_with_the_picture() -> None:
    frame = toy_frame()
    estimate = toy_estimate(frame)
    crop = Crop(200, 150, 500, 800)
    closer, moved = zoomed(frame, estimate, crop)
    assert image_of(closer).shape == (800, 800, 3)
    assert np.allclose(keypoints_of(moved).pixels, crop.to_input(keypoints_of(estimate).pixels))
    assert np.allclose(keypoints_of(moved).pixels, closer.keypoints_px(TOY.points_m), atol=1e-6)
    assert moved.box is not None
    assert estimate.box is not None
    assert moved.box.iou(estimate.box) < 1


def test_words() -> None:
    frame = toy_frame()
    estimate = toy_estimate(frame)
    words = describe(frame, estimate)
    assert words[1] == f"range {frame.range_m:.2f} m ± 0.05 m"
    assert words[2].endswith("13 of 13 keypoints")
    assert confidence(estimate) == pytest.approx(keypoints_of(estimate).score.mean())
    assert describe(frame, DARK) == ["toy/1", "no pose: dark"]
    assert confidence(DARK) is None
    for value, line in ((0.97, "attitude confidence 0.97"), (0.31, "attitude confidence 0.31, ambiguous")):
        assert describe(frame, replace(estimate, attitude_confidence=value))[3] == line


@pytest.mark.parametrize("name", [os.fsdecode(b"caf\xe9"), "\ud800", "a\x1b\0\n", "z" * 300, "衛星", ""])
def test_names_that_opencv_cannot_draw(name: str) -> None:
    frame = replace(toy_frame(size=256), name=name)
    draw_overlay(frame, TOY, toy_estimate(frame))
    assert len(describe(frame, DARK)[0]) <= 60


def test_score_colours_grow_lighter() -> None:
    lightness = [np.dot(score_colour(score), (0.3, 0.6, 0.1)) for score in np.linspace(0, 1, 11)]
    assert np.all(np.diff(lightness) > 0)
    assert score_colour(-1) == score_colour(0) == score_colour(float("nan"))


def test_a_line_passes_through_its_ends() -> None:
    image = np.zeros((100, 100, 3), dtype=np.uint8)
    Canvas(image).line(np.array([10.5, 20.5]), np.array([80.5, 20.5]), (255, 0, 0), 1)
    assert image[20, 10:81, 0].min() > 120
    assert image[26].max() == 0
