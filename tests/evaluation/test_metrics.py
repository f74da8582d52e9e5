"""Zero on the truth, failures counted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError
from gknet.evaluation.metrics import compute_errors, nees, oracle_crop, pose_error_vector, pose_errors
from gknet.frame import Box, Estimate, Failure, FailureKind, Frame, Keypoints
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.spacecraft import Spacecraft
from tests.strategies import poses, quaternions

POINTS = np.random.default_rng(7).uniform(-1, 1, (12, 3)) * (3, 1, 1)
CRAFT = Spacecraft("probe", tuple(f"k{i}" for i in range(12)), POINTS, ((0, 1),), 6.0)
CAMERA = Camera.from_focal(1000, 800, 640)
POSE = Pose.from_quaternion([0.3, -0.5, 0.7, 0.4], [0.3, -0.2, 12.0])
VISIBLE = np.arange(12) % 3 > 0
FRAME = Frame("f", None, CAMERA, POSE, VISIBLE, np.array([0.0, 0.0, -1.0]))


def estimate_at(pose: Pose, shift_px: float = 0.0, frame: Frame = FRAME) -> Estimate:
    pixels = frame.keypoints_px(POINTS) + (shift_px, 0)
    keypoints = Keypoints(pixels, np.full(12, 0.9), np.tile(np.eye(2), (12, 1, 1)))
    return Estimate(keypoints, pose, np.eye(6) * 1e-4, np.ones(12, dtype=bool), 0.0, frame.true_box(POINTS))


def test_truth_has_no_error() -> None:
    found = compute_errors(FRAME, estimate_at(POSE), CRAFT)
    assert found.rmse_px == found.rmse_hidden_px == 0
    assert found.pck_2 == found.pck_5 == found.pck_10 == found.locator_iou == found.add_below_tenth == 1
    assert max(found.e_t, found.e_q_rad, found.speed_score, found.add, found.add_s, found.nees or 0) < 1e-6
    assert found.visible_fraction == pytest.approx(8 / 12)
    assert found.range_m == pytest.approx(np.linalg.norm(POSE.translation_m))
    assert found.phase_angle_rad is not None
    assert found.phase_angle_rad < 0.05


def test_keypoint_error_is_in_pixels_of_the_oracle_crop() -> None:
    """The same detection scores the same whatever crop it was found in; a crop of double scale doubles it."""
    scale = oracle_crop(FRAME, CRAFT).scale
    found = compute_errors(FRAME, estimate_at(POSE, 3.0), CRAFT)
    assert found.rmse_px == pytest.approx(3 * scale)
    assert found.rmse_hidden_px == pytest.approx(3 * scale)
    assert compute_errors(FRAME, estimate_at(POSE, 3.0), CRAFT, Crop(0, 0, 128, 256)).rmse_px == pytest.approx(6)
    assert compute_errors(FRAME, estimate_at(POSE, 3.0), CRAFT, Crop(0, 0, 128, 256)).pck_5 == 0
    assert compute_errors(FRAME, estimate_at(POSE, 3.0), CRAFT, Crop(0, 0, 128, 256)).pck_10 == 1


def test_equation_6_is_the_root_of_the_mean_square() -> None:
    estimate = estimate_at(POSE)
    assert estimate.keypoints is not None
    estimate.keypoints.pixels[0] += (3, 4)
    found = compute_errors(FRAME, estimate, CRAFT, Crop(0, 0, 256, 256))
    assert found.rmse_px == pytest.approx(np.sqrt(25 / 12))
    assert found.rmse_hidden_px == pytest.approx(np.sqrt(25 / 4))


def test_keypoints_out_of_view_are_masked() -> None:
    pose = Pose(POSE.rotation, np.array([4.5, 0.0, 12.0]))
    frame = replace(FRAME, cam_from_body=pose)
    outside = ~CAMERA.contains(frame.keypoints_px(POINTS))
    assert 0 < outside.sum() < 12
    estimate = estimate_at(pose, frame=frame)
    assert estimate.keypoints is not None
    estimate.keypoints.pixels[outside] += 500
    assert compute_errors(frame, estimate, CRAFT).rmse_px == 0


@given(truth=poses(), quaternion=quaternions())
def test_q_and_minus_q_are_one_rotation(truth: Pose, quaternion: np.ndarray) -> None:
    if np.linalg.norm(truth.translation_m) < 1e-3:
        return
    plus, minus = (Pose.from_quaternion(sign * quaternion, truth.translation_m) for sign in (1, -1))
    assert pose_errors(truth, plus)[1] == pytest.approx(pose_errors(truth, minus)[1], abs=1e-6)
    assert 0 <= pose_errors(truth, plus)[1] <= np.pi + 1e-9
    assert pose_errors(plus, plus) == pytest.approx((0, 0), abs=1e-6)


def test_half_a_turn_is_pi() -> None:
    turned = Pose(Rotation.from_rotvec([np.pi, 0, 0]).as_matrix() @ POSE.rotation, POSE.translation_m)
    assert pose_errors(POSE, turned)[1] == pytest.approx(np.pi)
    assert pose_errors(POSE, Pose(POSE.rotation, POSE.translation_m * 1.1))[0] == pytest.approx(0.1)


@given(truth=poses(), found=poses())
def test_error_vector_takes_the_estimate_to_the_truth(truth: Pose, found: Pose) -> None:
    vector = pose_error_vector(truth, found)
    rotation = Rotation.from_rotvec(vector[:3]).as_matrix() @ found.rotation
    np.testing.assert_allclose(rotation, truth.rotation, atol=1e-7)
    np.testing.assert_allclose(found.translation_m + vector[3:], truth.translation_m, atol=1e-9)


def test_nees_of_drawn_errors_is_six() -> None:
    generator = np.random.default_rng(0)
    root = generator.normal(size=(6, 6)) * np.array([1e-3] * 3 + [1e-2, 1e-2, 0.1])[:, None]
    covariance = root @ root.T
    squared = []
    for _ in range(500):
        error = root @ generator.normal(size=6)
        rotation = Rotation.from_rotvec(-error[:3]).as_matrix() @ POSE.rotation
        found = Pose(rotation, POSE.translation_m - error[3:])
        value = nees(POSE, Estimate(cam_from_body=found, covariance=covariance))
        assert value is not None
        squared.append(value)
    assert np.mean(squared) == pytest.approx(6, abs=0.5)


def test_a_failure_counts() -> None:
    seen = estimate_at(POSE, 2.0).keypoints
    found = compute_errors(
        FRAME, Estimate(seen, box=FRAME.true_box(POINTS), failure=Failure(FailureKind.NO_CONSENSUS, "no pose")), CRAFT
    )
    assert (found.e_t, found.add, found.add_below_tenth, found.nees) == (1, 1, 0, None)
    assert found.e_q_rad == pytest.approx(np.pi)
    assert found.rmse_px == pytest.approx(2 * oracle_crop(FRAME, CRAFT).scale)
    blind = compute_errors(FRAME, Estimate(failure=Failure(FailureKind.NO_SPACECRAFT, "nothing found")), CRAFT)
    assert blind.rmse_px == pytest.approx(256 * np.sqrt(2))
    assert blind.pck_10 == blind.locator_iou == 0


def test_unknown_visibility_is_none_not_zero() -> None:
    found = compute_errors(replace(FRAME, visible=None, sun_direction=None), estimate_at(POSE), CRAFT)
    assert found.rmse_hidden_px is found.visible_fraction is found.phase_angle_rad is found.earth_in_view is None


def test_no_truth_is_an_error() -> None:
    with pytest.raises(GknetError, match="no true pose"):
        compute_errors(replace(FRAME, cam_from_body=None), estimate_at(POSE), CRAFT)


def test_box_off_the_target_has_no_overlap() -> None:
    off = replace(estimate_at(POSE), box=Box(0, 0, 20, 20))
    assert compute_errors(FRAME, off, CRAFT).locator_iou == 0
