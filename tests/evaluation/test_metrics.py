"""Zero on the truth, failures counted, intervals that cover."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError
from gknet.evaluation.metrics import (
    FrameErrors,
    compute_errors,
    nees,
    oracle_crop,
    pose_error_vector,
    pose_errors,
    summarise,
)
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
    metrics = summarise([found]).metrics
    assert "rmse_hidden_px" not in metrics
    assert metrics["rmse_px"].frames == 1


def test_no_truth_is_an_error() -> None:
    with pytest.raises(GknetError, match="no true pose"):
        compute_errors(replace(FRAME, cam_from_body=None), estimate_at(POSE), CRAFT)
    with pytest.raises(GknetError, match="at least one"):
        summarise([])


def many(sequences: int, frames: int, seed: int) -> list[FrameErrors]:
    """Errors that differ more between sequences than within one; every tenth frame fails."""
    generator = np.random.default_rng(seed)
    one = compute_errors(FRAME, estimate_at(POSE), CRAFT)
    found = []
    for s in range(sequences):
        level = generator.normal(10, 2)
        for k in range(frames):
            e_t = 1.0 if k % 10 == 9 else 0.01
            kind = FailureKind.TOO_FEW_INLIERS if k % 10 == 9 else None
            rmse = level + generator.normal(0, 0.5)
            known = replace(one, name=f"{s}/{k}", sequence=str(s), rmse_px=rmse, e_t=e_t, failure=kind)
            confidence = None if kind else 0.3 if s == 0 else 0.9
            found.append(replace(known, earth_in_view=float(s % 3 == 0), attitude_confidence=confidence))
    return found


def test_summary_counts_everything() -> None:
    summary = summarise(many(6, 20, 0))
    assert (summary.frames, summary.sequences, summary.failures) == (120, 6, {FailureKind.TOO_FEW_INLIERS: 12})
    assert summary.metrics["e_t"].mean == pytest.approx(0.1 + 0.9 * 0.01)
    assert summary.metrics["e_t"].median == 0.01
    assert all(statistic.frames == 120 for statistic in summary.metrics.values())
    for by in ("range_diameters", "phase_angle_rad", "visible_fraction", "earth_in_view"):
        assert sum(b.frames for b in summary.bins if b.by == by) == 120
        assert sum(b.failures for b in summary.bins if b.by == by) == 12
    assert [b.frames for b in summary.bins if b.by == "earth_in_view"] == [80, 40]
    assert [(b.low, b.frames) for b in summary.bins if b.by == "attitude_confidence"] == [(0.0, 18), (0.8, 90)]
    assert summary.located_07 == 1.0
    assert summary.coverage_95 == 1.0


def test_interval_resamples_sequences_and_covers() -> None:
    """Frames of a sequence err together: the interval of the mean must be as wide as the sequences make it."""
    covered = [
        s.low <= 10 <= s.high for s in (summarise(many(12, 10, k), resamples=200).metrics["rmse_px"] for k in range(60))
    ]
    assert 0.8 <= np.mean(covered) <= 1.0
    apart = [replace(e, sequence=e.name) for e in many(12, 10, 0)]
    together, alone = summarise(many(12, 10, 0)).metrics["rmse_px"], summarise(apart).metrics["rmse_px"]
    assert together.high - together.low > 1.5 * (alone.high - alone.low)


def test_summary_is_deterministic_and_json() -> None:
    frames = many(4, 10, 0)
    first, second = (json.dumps(summarise(frames, seed=1).to_dict(), allow_nan=False) for _ in range(2))
    assert first == second
    assert json.loads(first)["metrics"]["e_t"]["frames"] == 40


def test_box_off_the_target_has_no_overlap() -> None:
    off = replace(estimate_at(POSE), box=Box(0, 0, 20, 20))
    assert compute_errors(FRAME, off, CRAFT).locator_iou == 0
