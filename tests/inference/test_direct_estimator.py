"""A direct network's row for a crop becomes a pose, or a failure with its kind."""

from __future__ import annotations

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.evaluation.metrics import compute_errors
from gknet.frame import Box, FailureKind, Frame
from gknet.geometry import Camera, Pose
from gknet.inference.attitude import AttitudeBins
from gknet.inference.crop import Crop
from gknet.inference.crop_estimator import InferenceSettings
from gknet.inference.crop_pose import CropPose
from gknet.inference.direct_estimator import DirectEstimator, decode_output
from gknet.spacecraft import Spacecraft

POINTS = np.random.default_rng(7).uniform(-1, 1, (14, 3)) * (3, 1, 1)
CRAFT = Spacecraft("probe", tuple(f"k{i}" for i in range(14)), POINTS, ((0, 1),), 6.5)
CAMERA = Camera.from_focal(1000, 800, 640)
BINS = AttitudeBins(16)


def output_of(shown: CropPose) -> np.ndarray:
    """The row of a perfect network."""
    row = np.concatenate([shown.offset, [shown.log_depth], BINS.soft_label(shown.attitude_wxyz)])
    return row.astype(np.float32)


def test_image_to_pose_with_a_perfect_network() -> None:
    pose = Pose.from_quaternion([0.3, -0.5, 0.7, 0.4], [1.3, -0.9, 14.0])
    image = np.zeros((640, 800, 3), np.uint8)
    frame = Frame("one", image, CAMERA, pose)
    box = frame.true_box(POINTS)
    assert box is not None
    shown = CropPose.of(pose, CAMERA, Crop.around(box, 192), CRAFT.diameter_m)
    assert shown is not None
    estimator = DirectEstimator(
        lambda images: output_of(shown)[None], CRAFT, BINS, settings=InferenceSettings(input_size=192)
    )
    estimate = estimator.estimate(image, CAMERA, box)
    assert estimate.failure is None
    assert (estimate.covariance, estimate.inliers, estimate.box) == (None, None, box)
    found = compute_errors(frame, estimate, CRAFT)
    assert found.e_t < 1e-5
    assert found.e_q_rad < 1e-3
    assert found.rmse_px is not None
    assert found.rmse_px < 0.1
    assert found.nees is None


@pytest.mark.parametrize(
    ("place", "value", "kind"),
    [
        (0, np.nan, FailureKind.NOT_FINITE),
        (9, np.inf, FailureKind.NOT_FINITE),
        (2, 3.0, FailureKind.IMPLAUSIBLE_SIZE),
        (2, 9e9, FailureKind.IMPLAUSIBLE_SIZE),
    ],
)
def test_answers_that_cannot_be_are_failures(place: int, value: float, kind: FailureKind) -> None:
    pose = Pose.from_quaternion([0.3, -0.5, 0.7, 0.4], [0, 0, 14.0])
    box = Frame("one", None, CAMERA, pose).true_box(POINTS)
    assert box is not None
    shown = CropPose.of(pose, CAMERA, Crop.around(box, 256), CRAFT.diameter_m)
    assert shown is not None
    output = output_of(shown)
    output[place] = value
    estimate = DirectEstimator(lambda images: output[None], CRAFT, BINS).estimate(
        np.zeros((640, 800, 3), np.uint8), CAMERA, box
    )
    assert estimate.cam_from_body is None
    assert estimate.failure is not None
    assert estimate.failure.kind == kind


def test_a_place_that_no_ray_in_front_reaches_is_a_failure() -> None:
    """At the rim of a fisheye's image."""
    camera = Camera(np.array([[200.0, 0, 400], [0, 200, 400], [0, 0, 1]]), 800, 800, np.zeros(4), "fisheye")
    output = output_of(CropPose(np.array([0.4, 0.0]), 0.0, np.array([1.0, 0, 0, 0])))
    estimate = DirectEstimator(lambda images: output[None], CRAFT, BINS).estimate(
        np.zeros((800, 800, 3), np.uint8), camera, Box(600, 300, 790, 500)
    )
    assert estimate.cam_from_body is None
    assert estimate.failure is not None
    assert estimate.failure.kind == FailureKind.BEHIND_CAMERA


def test_bad_use_is_refused() -> None:
    with pytest.raises(GknetError, match="2051 numbers"):
        decode_output(np.zeros(7, np.float32), BINS)
    with pytest.raises(GknetError, match="give a box"):
        DirectEstimator(lambda images: images, CRAFT).estimate(np.zeros((640, 800, 3), np.uint8), CAMERA)
