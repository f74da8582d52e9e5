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
from gknet.report.legend import Entry, draw_legend
from gknet.report.overlay import _legend_entries, describe, draw_overlay, mean_score, zoomed
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
    assert words[1] == f"range {frame.range_m:.3f} ± 0.050 m"
    score = keypoints_of(estimate).score.mean()
    assert words[2] == f"13 of 13 inliers, mean keypoint score {score:.2f}"
    assert mean_score(estimate) == pytest.approx(score)
    assert describe(frame, DARK) == ["toy/1", "no pose: dark"]
    assert mean_score(DARK) is None
    for value, line in ((0.97, "attitude confidence 0.97"), (0.31, "attitude confidence 0.31, ambiguous")):
        assert describe(frame, replace(estimate, attitude_confidence=value))[3] == line


@pytest.mark.parametrize(
    ("sigma_m", "words"),
    [(3.21, "range 14.3 ± 3.2 m"), (0.1, "range 14.28 ± 0.10 m"), (0.0123, "range 14.278 ± 0.012 m"),
     (40.0, "range 14 ± 40 m"), (0.0, "range 14.2778 ± 0.0000 m")],
)  # fmt: skip
def test_range_and_its_deviation_have_the_same_decimals(sigma_m: float, words: str) -> None:
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 14.27784]))
    assert describe(toy_frame(), Estimate(cam_from_body=pose, covariance=np.eye(6) * sigma_m**2))[1] == words
    assert describe(toy_frame(), Estimate(cam_from_body=pose))[1] == "range 14.28 m"


def legend_words(frame: Frame, estimate: Estimate, with_truth: bool) -> list[str]:
    return [entry.text for entry in _legend_entries(frame, estimate, with_truth)]


def test_the_legend_names_the_marks_that_are_drawn() -> None:
    frame = toy_frame()
    lines, marks = ["estimate", "body axes", "truth", "box"], ["visible", "hidden", "outlier", "keypoint score, 0 to 1"]
    assert legend_words(frame, toy_estimate(frame), True) == lines + marks
    assert legend_words(frame, DARK, True) == ["truth"]
    assert legend_words(frame, DARK, False) == []
    unlabelled = legend_words(replace(frame, visible=None), toy_estimate(frame), False)
    assert "visibility unknown" in unlabelled
    assert not {"truth", "visible", "hidden"} & set(unlabelled)


def test_without_labels_no_keypoint_is_drawn_as_visible() -> None:
    """A square has corners, which a disc lacks."""
    frame = toy_frame()
    estimate = toy_estimate(frame)
    pictures = [
        draw_overlay(each, TOY, estimate, lines=(), truth=False, legend=False)
        for each in (replace(frame, visible=np.ones(TOY.keypoint_count, dtype=bool)), replace(frame, visible=None))
    ]
    for k in range(TOY.keypoint_count):
        colour = score_colour(float(keypoints_of(estimate).score[k]))
        corner = keypoints_of(estimate).pixels[k] + 4
        if not near(pictures[0], colour, corner, reach=0):
            break
    else:
        pytest.fail("every disc fills its corner")
    assert near(pictures[1], colour, corner, reach=0)


@pytest.mark.parametrize("width", [300, 700, 2000])
def test_a_legend_stays_inside_of_the_picture(width: int) -> None:
    canvas = Canvas(np.full((1024, width, 3), 128, dtype=np.uint8))
    drawn: list[np.ndarray] = []
    entries = [Entry(f"entry {k}", lambda _, left, right: drawn.extend((left, right))) for k in range(9)]
    draw_legend(canvas, entries)
    assert len(drawn) == 18
    assert max(x for x, _ in drawn) < width
    assert all(0 < y < 1024 for _, y in drawn)
    assert len({y for _, y in drawn}) == {300: 5, 700: 2, 2000: 1}[width]


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
