"""The pose solver: exact on the truth, robust, with a covariance that fits its errors, and failures with a kind."""

from __future__ import annotations

import math
from typing import Any

import hypothesis
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gknet.errors import GknetError
from gknet.evaluation.metrics import nees, pose_error_vector
from gknet.frame import Box, Estimate, Failure, FailureKind, Keypoints
from gknet.geometry import Camera, Pose
from gknet.inference.pnp import PnpResult, PnpSettings, _consensus, solve_pnp
from gknet.inference.refine_pose import PnpProblem
from tests.strategies import quaternions

POINTS = np.random.default_rng(0).uniform(-1, 1, (16, 3)) * (3, 1, 1)
CAMERA = Camera.from_focal(1400, 1024, 1024)
DISTORTED = Camera(
    np.array([[1494.3, 0, 480], [0, 1494.2, 300], [0, 0, 1]]), 960, 600, np.array([-0.224, 0.514, -7e-4, -2e-4, -0.131])
)
FISHEYE = Camera(
    np.array([[600.0, 0, 480], [0, 605, 300], [0, 0, 1]]), 960, 600, np.array([0.1, -0.02, 0.003, 0.0004]), "fisheye"
)
POSE = Pose.from_quaternion([0.3, -0.5, 0.7, 0.4], [0.8, -0.5, 15.0])


def detections(pose: Pose, camera: Camera = CAMERA, sigma_px: float = 0.5, points: np.ndarray = POINTS) -> Keypoints:
    pixels = camera.project(pose.transform(points))
    count = len(points)
    return Keypoints(pixels, np.full(count, 0.9), np.tile(sigma_px**2 * np.eye(2), (count, 1, 1)))


def noisy(keypoints: Keypoints, generator: np.random.Generator) -> Keypoints:
    roots = np.linalg.cholesky(keypoints.covariance_px2)
    noise = np.einsum("nij,nj->ni", roots, generator.normal(size=keypoints.pixels.shape))
    return Keypoints(keypoints.pixels + noise, keypoints.score, keypoints.covariance_px2)


def solved(keypoints: Keypoints, camera: Camera = CAMERA, points: np.ndarray = POINTS) -> PnpResult:
    result = solve_pnp(keypoints, camera, points)
    assert isinstance(result, PnpResult), result
    return result


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED, FISHEYE])
@given(quaternion=quaternions())
def test_truth_is_recovered_exactly(camera: Camera, quaternion: np.ndarray) -> None:
    """Half turns included."""
    pose = Pose.from_quaternion(quaternion, [0.3, -0.2, 12.0])
    result = solved(detections(pose, camera), camera)
    assert np.abs(pose_error_vector(pose, result.cam_from_body)).max() < 1e-5
    assert result.reprojection_rms_px < 1e-3
    assert result.inliers.all()


@pytest.mark.parametrize("outliers", [5, 8])
def test_outliers_are_found(outliers: int) -> None:
    generator = np.random.default_rng(outliers)
    for _ in range(30):
        pose = Pose.from_quaternion(generator.normal(size=4), [0.5, 0.3, generator.uniform(8, 25)])
        clean = noisy(detections(pose), generator)
        wrong = generator.permutation(16)[:outliers]
        pixels = clean.pixels.copy()
        angle = generator.uniform(0, 2 * np.pi, outliers)
        pixels[wrong] += generator.uniform(30, 200, outliers)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        result = solved(Keypoints(pixels, clean.score, clean.covariance_px2))
        assert not result.inliers[wrong].any()
        assert result.cam_from_body.angle_to(pose) < 0.03
        assert np.linalg.norm(result.cam_from_body.translation_m - pose.translation_m) < 0.01 * pose.translation_m[2]


def test_covariance_matches_the_scatter() -> None:
    """Monte-Carlo at one pose: the scatter's diagonal and the NEES agree with the stated covariance."""
    generator = np.random.default_rng(1)
    truth = detections(POSE, sigma_px=1.0)
    mixed = Keypoints(truth.pixels, truth.score, truth.covariance_px2 * generator.uniform(0.3, 3, 16)[:, None, None])
    scatter, squared, stated = [], [], []
    for _ in range(400):
        keypoints = noisy(mixed, generator)
        result = solved(keypoints)
        scatter.append(pose_error_vector(POSE, result.cam_from_body))
        stated.append(np.diag(result.covariance))
        estimate = Estimate(keypoints, result.cam_from_body, result.covariance, result.inliers, 0.0)
        value = nees(POSE, estimate)
        assert value is not None
        squared.append(value)
    ratio = np.array(scatter).var(axis=0) / np.mean(stated, axis=0)
    assert (np.abs(ratio - 1) < 0.35).all(), ratio
    assert 5.2 < np.mean(squared) < 7.2


def test_a_sure_keypoint_counts_more() -> None:
    """The one keypoint that is off moves the pose less when its covariance is large."""
    keypoints = detections(POSE)
    pixels = keypoints.pixels.copy()
    pixels[3] += (4, 0)
    unsure = keypoints.covariance_px2.copy()
    unsure[3] *= 100
    off = [
        np.linalg.norm(pose_error_vector(POSE, solved(Keypoints(pixels, keypoints.score, c)).cam_from_body))
        for c in (keypoints.covariance_px2, unsure)
    ]
    assert off[1] < 0.3 * off[0]


def test_same_input_same_bits() -> None:
    keypoints = noisy(detections(POSE), np.random.default_rng(2))
    first, second = solved(keypoints), solved(keypoints)
    assert np.array_equal(first.cam_from_body.rotation, second.cam_from_body.rotation)
    assert np.array_equal(first.covariance, second.covariance)


def test_low_scores_and_bad_points_are_not_used() -> None:
    keypoints = detections(POSE)
    score, pixels = keypoints.score.copy(), keypoints.pixels.copy()
    score[0], pixels[0] = 0.0, (512, 512)
    pixels[1] = np.nan
    result = solved(Keypoints(pixels, score, keypoints.covariance_px2))
    assert not result.inliers[:2].any()
    assert result.inliers[2:].all()


@pytest.mark.parametrize("left", [0, 1, 3])
def test_fewer_than_four_is_a_reason(left: int) -> None:
    keypoints = detections(POSE)
    score = np.where(np.arange(16) < left, 0.9, 0.0)
    reason = solve_pnp(Keypoints(keypoints.pixels, score, keypoints.covariance_px2), CAMERA, POINTS)
    assert isinstance(reason, Failure)
    assert reason.kind == FailureKind.TOO_FEW_KEYPOINTS
    assert f"only {left}" in reason.detail


def test_exactly_four_is_enough() -> None:
    keypoints = detections(POSE)
    score = np.where(np.arange(16) < 4, 0.9, 0.0)
    result = solved(Keypoints(keypoints.pixels, score, keypoints.covariance_px2))
    assert np.abs(pose_error_vector(POSE, result.cam_from_body)).max() < 1e-4


def test_nonsense_is_a_reason() -> None:
    generator = np.random.default_rng(3)
    refused = 0
    for _ in range(20):
        keypoints = detections(POSE)
        anywhere = Keypoints(generator.uniform(200, 800, (16, 2)), keypoints.score, keypoints.covariance_px2)
        refused += isinstance(solve_pnp(anywhere, CAMERA, POINTS), Failure)
    assert refused >= 18


def test_points_on_a_line_are_a_reason() -> None:
    line = np.linspace(-2, 2, 8)[:, None] * np.array([[1.0, 0.2, 0.1]])
    assert isinstance(solve_pnp(detections(POSE, points=line), CAMERA, line), Failure)


def test_all_keypoints_in_one_place_is_a_reason() -> None:
    keypoints = detections(POSE)
    same = Keypoints(np.full((16, 2), 500.0), keypoints.score, keypoints.covariance_px2)
    result = solve_pnp(same, CAMERA, POINTS)
    assert isinstance(result, Failure) or result.cam_from_body.translation_m[2] > 100


def test_thresholds_follow_the_size_of_an_input_pixel() -> None:
    """Four times the image, four times the errors: refused in pixels of the image, accepted in the crop's."""
    generator = np.random.default_rng(4)
    keypoints = noisy(detections(POSE, sigma_px=12.0), generator)
    strict = PnpSettings(threshold_px=(5.0,), min_inlier_fraction=0.8)
    assert isinstance(solve_pnp(keypoints, CAMERA, POINTS, 1.0, strict), Failure)
    assert isinstance(solve_pnp(keypoints, CAMERA, POINTS, 8.0, strict), PnpResult)


def test_consensus_has_the_pixel_convention_of_the_camera() -> None:
    """PoseLib by itself, before any refinement: half a pixel between its convention and ours would show as a shift.

    The centre of the first pixel is (0.5, 0.5) in the pixels and in K alike, so the convention cancels.
    """
    generator = np.random.default_rng(11)
    half = np.array([0.5, 0.5])
    for _ in range(50):
        pose = Pose.from_quaternion(generator.normal(size=4), [0.4, -0.3, generator.uniform(8, 20)])
        shifts = []
        for pixels_by, centre_by in ((0, 0), (half, half), (half, 0)):
            matrix = CAMERA.matrix.copy()
            matrix[:2, 2] += centre_by
            camera = Camera(matrix, CAMERA.width, CAMERA.height)
            given = CAMERA.project(pose.transform(POINTS)) + pixels_by
            problem = PnpProblem(POINTS, np.arange(16), given, np.tile(np.eye(2), (16, 1, 1)), camera, None)
            found = _consensus(problem, np.full(16, 0.9), 5.0)
            assert found is not None
            offset_m = (found.translation_m - pose.translation_m)[:2]
            shifts.append(float(np.linalg.norm(offset_m * 1400 / pose.translation_m[2])))
        assert max(shifts[:2]) < 1e-6
        assert shifts[2] > 0.3  # half a pixel in x and in y, which the rotation takes a part of


@hypothesis.given(
    values=st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=16, max_size=16),
    variance=st.floats(0, 1e300),
)
@hypothesis.settings(max_examples=60, deadline=None)
def test_wild_numbers_end_in_a_pose_or_a_failure(values: list[float], variance: float) -> None:
    pixels = detections(POSE).pixels.copy()
    pixels[:8] = np.array(values).reshape(8, 2)
    keypoints = Keypoints(pixels, np.full(16, 0.9), np.tile(variance * np.eye(2), (16, 1, 1)))
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        assert isinstance(solve_pnp(keypoints, CAMERA, POINTS), PnpResult | Failure)


def test_points_that_are_not_finite_are_an_error() -> None:
    points = POINTS.copy()
    points[3] = np.inf
    with pytest.raises(GknetError, match="finite points"):
        solve_pnp(detections(POSE), CAMERA, points)


def test_wrong_count_is_an_error() -> None:
    with pytest.raises(GknetError, match="16 keypoints"):
        solve_pnp(detections(POSE, points=POINTS[:10]), CAMERA, POINTS)
    with pytest.raises(GknetError, match="thresholds"):
        PnpSettings(threshold_px=())


def test_strong_distortion_is_taken_out_before_the_consensus() -> None:
    wide = Camera(np.array([[500.0, 0, 480], [0, 500.0, 300], [0, 0, 1]]), 960, 600, np.array([-0.28, 0.06, 0, 0, 0]))
    pose = Pose.from_quaternion([0.9, 0.1, 0.2, 0.1], [0.3, -0.2, 4.0])
    result = solve_pnp(
        detections(pose, wide), wide, POINTS, settings=PnpSettings(threshold_px=(0.5,), min_inlier_fraction=1)
    )
    assert isinstance(result, PnpResult), result
    assert np.abs(pose_error_vector(pose, result.cam_from_body)).max() < 1e-5


def test_a_fisheye_keypoint_beside_the_camera_is_left_out_of_the_consensus() -> None:
    keypoints = detections(POSE, FISHEYE)
    pixels = keypoints.pixels.copy()
    pixels[5] = (480 + 600 * np.radians(100), 300)
    result = solved(Keypoints(pixels, keypoints.score, keypoints.covariance_px2), FISHEYE)
    assert np.abs(pose_error_vector(POSE, result.cam_from_body)).max() < 1e-4
    assert np.flatnonzero(~result.inliers).tolist() == [5]


def test_a_keypoint_off_by_many_of_its_sigmas_loses_its_pull() -> None:
    keypoints = detections(POSE)
    pixels = keypoints.pixels.copy()
    pixels[3] += (4, 0)
    off = []
    for sigma in (0.1, 4.0):
        covariance = np.tile(sigma**2 * np.eye(2), (16, 1, 1))
        result = solved(Keypoints(pixels, keypoints.score, covariance))
        off.append(np.linalg.norm(pose_error_vector(POSE, result.cam_from_body)))
    assert off[0] < 0.1 * off[1]


def box_of(pose: Pose, camera: Camera = CAMERA) -> Box:
    """About all keypoints, cut to the image."""
    box = Box.around(camera.project(pose.transform(POINTS))).clipped(camera.width, camera.height)
    assert box is not None
    return box


def with_box(keypoints: Keypoints, box: Box | None) -> PnpResult:
    result = solve_pnp(keypoints, CAMERA, POINTS, box=box)
    assert isinstance(result, PnpResult), result
    return result


def test_the_box_tells_the_range_where_keypoints_leave_it_open() -> None:
    """Ten very unsure keypoints, the others not detected."""
    generator = np.random.default_rng(2)
    errors = []
    for _ in range(30):
        pose = Pose.from_quaternion(generator.normal(size=4), [0.5, 0.3, generator.uniform(10, 20)])
        clean = detections(pose, sigma_px=60)
        vague = noisy(Keypoints(clean.pixels, np.where(np.arange(16) < 10, 0.5, 0.0), clean.covariance_px2), generator)
        settings = PnpSettings(threshold_px=(300.0,), max_rms_px=400)
        for box in (None, box_of(pose)):
            result = solve_pnp(vague, CAMERA, POINTS, 1.0, settings, box)
            assert isinstance(result, PnpResult)
            errors.append(abs(np.log(np.linalg.norm(result.cam_from_body.translation_m) / pose.translation_m[2])))
    without, helped = np.median(np.reshape(errors, (-1, 2)), axis=0)
    assert helped < 0.08
    assert helped < 0.7 * without


def test_a_wrong_box_hardly_moves_a_sure_pose() -> None:
    box = box_of(POSE)
    for wrong in (
        Box(box.x0 - 0.1 * box.side, box.y0 - 0.1 * box.side, box.x1 + 0.1 * box.side, box.y1 + 0.1 * box.side),
        Box(700.0, 100.0, 900.0, 300.0),
    ):
        found = with_box(detections(POSE), wrong).cam_from_body
        assert 0 < np.linalg.norm(found.translation_m - POSE.translation_m) < 2e-3 * POSE.translation_m[2]


def test_an_edge_that_the_image_cuts_tells_nothing() -> None:
    keypoints = noisy(detections(POSE, sigma_px=3), np.random.default_rng(3))
    without = with_box(keypoints, None)
    cut = with_box(keypoints, Box(0.0, 0.0, float(CAMERA.width), float(CAMERA.height)))
    np.testing.assert_array_equal(cut.cam_from_body.rotation, without.cam_from_body.rotation)
    np.testing.assert_array_equal(cut.covariance, without.covariance)
    part = with_box(keypoints, Box(0.0, 0.0, box_of(POSE).x1, float(CAMERA.height)))
    assert not np.array_equal(part.covariance, without.covariance)


def test_a_box_tells_nothing_of_a_spacecraft_that_reaches_behind_the_camera() -> None:
    """What lies behind is projected to a mirrored place, which is no edge."""
    behind = POSE.inverse().transform(np.array([[2.0, 1.0, -0.5]]))
    points = np.concatenate([POINTS, behind])
    clean = detections(POSE, sigma_px=3, points=points)
    keypoints = Keypoints(
        np.where(np.arange(17)[:, None] < 16, clean.pixels, 0.0),
        np.where(np.arange(17) < 16, 0.9, 0.0),
        clean.covariance_px2,
    )
    without, boxed = (solve_pnp(keypoints, CAMERA, points, box=box) for box in (None, box_of(POSE)))
    assert isinstance(without, PnpResult)
    assert isinstance(boxed, PnpResult)
    np.testing.assert_array_equal(boxed.cam_from_body.translation_m, without.cam_from_body.translation_m)
    np.testing.assert_array_equal(boxed.covariance, without.covariance)


def test_covariance_counts_the_box() -> None:
    """Monte-Carlo over noisy keypoints and noisy edges: the NEES is 6 in the mean."""
    generator = np.random.default_rng(4)
    settings = PnpSettings(threshold_px=(60.0,), max_rms_px=100, box_sigma=0.01)
    box, truth = box_of(POSE), detections(POSE, sigma_px=6)
    squared = []
    for _ in range(300):
        keypoints = noisy(truth, generator)
        edges = np.array([box.x0, box.y0, box.x1, box.y1]) + generator.normal(scale=0.01 * box.side, size=4)
        result = solve_pnp(keypoints, CAMERA, POINTS, 1.0, settings, Box(*edges.tolist()))
        assert isinstance(result, PnpResult)
        found = nees(POSE, Estimate(keypoints, result.cam_from_body, result.covariance, result.inliers, 0.0))
        assert found is not None
        squared.append(found)
    assert np.mean(squared) == pytest.approx(6, rel=0.2)
    alone, helped = (solve_pnp(truth, CAMERA, POINTS, 1.0, settings, each) for each in (None, box))
    assert isinstance(alone, PnpResult)
    assert isinstance(helped, PnpResult)
    assert helped.covariance[5, 5] < 0.8 * alone.covariance[5, 5]


def test_a_box_without_a_sigma_is_an_error() -> None:
    with pytest.raises(GknetError, match="sigma of the box"):
        PnpSettings(box_sigma=0)


def test_a_wrong_box_never_costs_the_pose() -> None:
    """True keypoints that hold themselves for very unsure, so that a wrong box drags the pose away from them."""
    generator = np.random.default_rng(5)
    dragged = 0
    for _ in range(30):
        pose = Pose.from_quaternion(generator.normal(size=4), [0.5, 0.3, generator.uniform(10, 20)])
        true = box_of(pose)
        wrong = Box(true.x0, true.y0, true.x0 + 1.5 * true.side, true.y0 + 1.5 * true.side)
        keypoints = detections(pose, sigma_px=90)
        result = solve_pnp(keypoints, CAMERA, POINTS, box=wrong)
        assert isinstance(result, PnpResult), result
        assert result.inliers.sum() > 4
        dragged += np.array_equal(result.covariance, with_box(keypoints, None).covariance)
    assert dragged > 5


def test_few_keypoints_at_odds_with_the_box_are_refused() -> None:
    """A few that are exchanged may agree on half the range or twice; the box knows better."""
    few, many = detections(POSE), detections(POSE)
    few.score[7:], many.score[8:] = 0, 0
    for factor, words in ((0.7, "7 keypoints"), (2.5, "2.5 times")):
        box = box_of(Pose(POSE.rotation, POSE.translation_m * factor))
        settings = PnpSettings(max_box_ratio=1.2 if factor < 1 else 2.0)
        result = solve_pnp(few, CAMERA, POINTS, 1.0, settings, box)
        assert isinstance(result, Failure)
        assert result.kind == FailureKind.BOX_CONTRADICTION
        assert words in result.detail
        assert isinstance(solve_pnp(many, CAMERA, POINTS, 1.0, settings, box), PnpResult)
        assert isinstance(solve_pnp(few, CAMERA, POINTS), PnpResult)
    assert isinstance(solve_pnp(few, CAMERA, POINTS, box=box_of(POSE)), PnpResult)


def test_a_box_that_the_image_cuts_refuses_no_pose() -> None:
    few = detections(POSE)
    few.score[7:] = 0
    assert with_box(few, Box(0.0, 0.0, float(CAMERA.width), 1.0)).inliers.sum() == 7


@pytest.mark.parametrize(
    "wrong",
    [
        {"max_box_ratio": 1.0},
        {"max_box_ratio": math.nan},
        {"threshold_px": ()},
        {"threshold_px": (5.0, math.inf)},
        {"threshold_px": (math.nan,)},
        {"min_score": -0.1},
        {"min_score": math.nan},
        {"min_inliers": 3},
        {"min_inlier_fraction": 1.1},
        {"max_rms_px": math.nan},
        {"box_sigma": 0.0},
        {"covariance_scale": math.inf},
    ],
    ids=str,
)
def test_settings_out_of_range_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(GknetError, match="pnp: expected"):
        PnpSettings(**wrong)
