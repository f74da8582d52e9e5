"""Boxes, frames and estimates."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Failure, FailureKind, Frame, Unreadable
from gknet.geometry import Camera, Pose
from tests.strategies import boxes

CAMERA = Camera.from_focal(1400, 1024, 1024)
POINTS_M = np.array([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])


def frame(pose: Pose | None, sun: tuple[float, float, float] | None = None) -> Frame:
    return Frame("f", None, CAMERA, pose, sun_direction=None if sun is None else np.array(sun))


@given(boxes(), boxes())
def test_iou_is_symmetric_and_bounded(a: Box, b: Box) -> None:
    assert 0 <= a.iou(b) <= 1
    assert a.iou(b) == pytest.approx(b.iou(a))
    assert a.iou(a) == pytest.approx(1)


@given(boxes(), boxes(), st.floats(-100, 100), st.floats(-100, 100), st.floats(0.1, 8))
def test_iou_does_not_change_under_shift_and_scale(a: Box, b: Box, dx: float, dy: float, scale: float) -> None:
    def moved(box: Box) -> Box:
        return Box(box.x0 * scale + dx, box.y0 * scale + dy, box.x1 * scale + dx, box.y1 * scale + dy)

    assert moved(a).iou(moved(b)) == pytest.approx(a.iou(b), abs=1e-6)


@given(boxes())
def test_iou_with_a_half_is_a_half(box: Box) -> None:
    half = Box(box.x0, box.y0, box.centre[0], box.y1)
    assert box.iou(half) == pytest.approx(0.5, abs=1e-6)
    assert box.iou(Box(box.x1, box.y0, box.x1 + 5, box.y1)) == 0


@given(boxes())
def test_clipping_keeps_what_is_inside(box: Box) -> None:
    clipped = box.clipped(1024, 1024)
    if clipped is None:
        assert box.x1 <= 0 or box.y1 <= 0 or box.x0 >= 1024 or box.y0 >= 1024
    else:
        assert 0 <= clipped.x0 < clipped.x1 <= 1024
        assert 0 <= clipped.y0 < clipped.y1 <= 1024
        assert clipped.area <= box.area
        assert clipped.clipped(1024, 1024) == clipped


def test_box_around_points_skips_nan_and_has_a_size() -> None:
    assert Box.around(np.array([[1.0, 2], [np.nan, 0], [5, 9]])) == Box(1.0, 2.0, 5.0, 9.0)
    assert Box.around(np.array([[3.0, 4]])) == Box(2.5, 3.5, 3.5, 4.5)
    with pytest.raises(GknetError, match="no finite point"):
        Box.around(np.full((2, 2), np.nan))


@pytest.mark.parametrize("sides", [(0, 0, 0, 5), (5, 0, 1, 5), (0, 0, np.nan, 5), (0, 0, np.inf, 5)])
def test_bad_box_is_refused(sides: tuple[float, float, float, float]) -> None:
    with pytest.raises(GknetError, match="box"):
        Box(*sides)


def test_true_keypoints_follow_from_the_pose() -> None:
    pixels = frame(Pose(np.eye(3), np.array([0.0, 0, 14]))).keypoints_px(POINTS_M)
    np.testing.assert_allclose(pixels, [[612, 512], [412, 512], [512, 612], [512, 412], [512, 512]])


def test_true_box_is_the_part_in_the_image() -> None:
    inside = frame(Pose(np.eye(3), np.array([0.0, 0, 14]))).true_box(POINTS_M)
    assert inside is not None
    np.testing.assert_allclose((inside.x0, inside.y0, inside.x1, inside.y1), (412, 412, 612, 612))
    cut = frame(Pose(np.eye(3), np.array([5.12, 0, 14]))).true_box(POINTS_M)
    assert cut is not None
    assert cut.x1 == 1024
    assert frame(Pose(np.eye(3), np.array([50.0, 0, 14]))).true_box(POINTS_M) is None
    corners = np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]])  # all about the image, none in it
    assert frame(Pose(np.eye(3), np.array([0.0, 0, 14]))).true_box(corners) is None


def test_frame_without_a_pose_has_no_truth() -> None:
    with pytest.raises(GknetError, match="frame f"):
        frame(None).keypoints_px(POINTS_M)
    assert frame(None).range_m is None
    assert frame(None, (0.0, 0.0, 1.0)).phase_angle_rad is None


@pytest.mark.parametrize(
    ("sun", "angle"), [((0.0, 0.0, -1.0), 0.0), ((1.0, 0.0, 0.0), np.pi / 2), ((0.0, 0.0, 1.0), np.pi)]
)
def test_phase_angle(sun: tuple[float, float, float], angle: float) -> None:
    """The sun behind the camera is phase 0, the sun behind the spacecraft is phase pi."""
    far = frame(Pose(np.eye(3), np.array([0.0, 0, 30])), sun)
    assert far.phase_angle_rad == pytest.approx(angle)
    assert far.range_m == pytest.approx(30)


def test_estimate_is_a_pose_or_a_reason() -> None:
    Estimate(failure=Failure(FailureKind.NO_CONSENSUS, "dark"))
    Estimate(cam_from_body=Pose.identity())
    with pytest.raises(GknetError, match="reason"):
        Estimate()
    with pytest.raises(GknetError, match="reason"):
        Estimate(cam_from_body=Pose.identity(), failure=Failure(FailureKind.NO_CONSENSUS, "dark"))


def test_a_pose_is_ambiguous_when_other_attitudes_are_more_probable() -> None:
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 5.0]))
    ambiguous = [
        Estimate(cam_from_body=pose, attitude_confidence=confidence).is_ambiguous
        for confidence in (None, 0.0, 0.49, 0.5, 1.0)
    ]
    assert ambiguous == [False, True, True, False, False]
    assert not Estimate(failure=Failure(FailureKind.NO_CONSENSUS, "dark")).is_ambiguous


def test_a_failure_is_a_word_for_programs_and_a_line_for_people() -> None:
    failure = Failure(FailureKind.TOO_FEW_INLIERS, "only 3 of 11 keypoints agree")
    assert str(failure) == failure.detail
    assert failure.to_dict() == {"kind": "too_few_inliers", "detail": failure.detail}
    assert failure.kind == "too_few_inliers"
    assert failure.kind.label == "too few inliers"
    assert json.loads(json.dumps({failure.kind: failure.kind})) == {"too_few_inliers": "too_few_inliers"}
    unreadable = Unreadable.because("a.jpg", GknetError("a.jpg: truncated"))
    assert unreadable.failure == Failure(FailureKind.UNREADABLE_IMAGE, "a.jpg: truncated")
