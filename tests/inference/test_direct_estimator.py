"""What a direct network says of a crop is a pose: encoding and decoding are inverse, turns are rolls."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError
from gknet.evaluation.metrics import compute_errors
from gknet.frame import FailureKind, Frame
from gknet.geometry import Camera, Pose
from gknet.inference.attitude import AttitudeBins
from gknet.inference.crop import Crop
from gknet.inference.crop_estimator import InferenceSettings
from gknet.inference.crop_pose import CropPose, focal_px, smallest_rotation_to
from gknet.inference.direct_estimator import DirectEstimator, decode_output
from gknet.spacecraft import Spacecraft
from tests.strategies import quaternions

POINTS = np.random.default_rng(7).uniform(-1, 1, (14, 3)) * (3, 1, 1)
CRAFT = Spacecraft("probe", tuple(f"k{i}" for i in range(14)), POINTS, ((0, 1),), 6.5)
CAMERA = Camera.from_focal(1000, 800, 640)
BINS = AttitudeBins(16)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """Off-centre, pixels not square, half of them with a lens that distorts."""
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    fx, cx, cy = rng.uniform(400, 3000), rng.uniform(300, 700), rng.uniform(300, 700)
    matrix = np.array([[fx, 0, cx], [0, fx * rng.uniform(0.8, 1.25), cy], [0, 0, 1]])
    lens = np.array([-0.2, 0.1, 1e-3, -5e-4, -0.02]) if draw(st.booleans()) else np.zeros(5)
    return Camera(matrix, 1000, 1000, lens)


@st.composite
def crops(draw: st.DrawFn) -> Crop:
    corner = st.integers(-200, 900)
    return Crop(draw(corner), draw(corner), draw(st.integers(20, 1200)), draw(st.sampled_from([64, 192, 256])))


@st.composite
def poses_in_view(draw: st.DrawFn, camera: Camera) -> Pose:
    """Any rotation, the origin in front of the camera and at or near the picture."""
    pixel = np.array([draw(st.floats(-100, 1100)), draw(st.floats(-100, 1100))])
    ray = np.linalg.solve(camera.matrix, np.append(pixel, 1.0))
    ray[:2] *= min(1.0, 0.6 / max(np.linalg.norm(ray[:2]), 1e-9))  # within the angle that the lens model is made for
    return Pose.from_quaternion(draw(quaternions()), draw(st.floats(2, 300)) * ray)


def same(first: Pose, second: Pose, relative: float = 1e-6) -> None:
    assert first.angle_to(second) < 1e-6
    np.testing.assert_allclose(
        first.translation_m, second.translation_m, atol=relative * np.linalg.norm(second.translation_m)
    )


@given(st.data(), cameras(), crops())
def test_a_crop_shows_a_pose_and_the_pose_is_read_from_it(data: st.DataObject, camera: Camera, crop: Crop) -> None:
    pose = data.draw(poses_in_view(camera))
    shown = CropPose.of(pose, camera, crop, 5.0)
    assert shown is not None
    same(shown.pose(camera, crop, 5.0), pose)
    same(CropPose.from_vector(shown.vector).pose(camera, crop, 5.0), pose)


def test_the_numbers_are_what_they_are_said_to_be() -> None:
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 10.0]))
    shown = CropPose.of(pose, CAMERA, Crop(300, 220, 400, 256), 4.0)  # the axis at (400, 320)
    assert shown is not None
    np.testing.assert_allclose(shown.offset, [-0.25, -0.25])
    assert shown.log_depth == pytest.approx(0)  # 4 m at 10 m are 400 px
    np.testing.assert_allclose(np.abs(shown.attitude_wxyz), [1, 0, 0, 0], atol=1e-12)
    assert CropPose.of(Pose(np.eye(3), np.array([0, 0, -1.0])), CAMERA, Crop(0, 0, 9, 9), 4.0) is None


def test_a_far_corner_of_the_picture_shows_the_same_view() -> None:
    """NetworkOutput under the same line of sight, a craft has the same attitude and log_depth wherever it is."""
    middle = Pose.from_quaternion([0.3, -0.5, 0.7, 0.4], [0, 0, 20.0])
    turn = smallest_rotation_to(np.array([0.3, -0.2, 1.0]))
    aside = Pose(turn @ middle.rotation, turn @ middle.translation_m)
    aside = Pose(aside.rotation, aside.translation_m * 20 / aside.translation_m[2])
    first, second = (CropPose.of(pose, CAMERA, Crop(0, 0, 300, 128), 4.0) for pose in (middle, aside))
    assert first is not None
    assert second is not None
    np.testing.assert_allclose(first.vector[2:], second.vector[2:], atol=1e-12)


@given(quaternions())
def test_the_least_turn(quaternion: np.ndarray) -> None:
    ray = quaternion[1:] + np.array([0, 0, 2.0])
    turn = smallest_rotation_to(ray)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(turn[:, 2], ray / np.linalg.norm(ray), atol=1e-12)
    angle = math.atan2(np.hypot(ray[0], ray[1]), ray[2])
    assert Pose(turn, np.zeros(3)).angle_to(Pose.identity()) == pytest.approx(angle, abs=1e-9)


@given(st.data(), st.floats(-math.pi, math.pi), st.floats(0.2, 3), crops())
def test_a_turned_picture_shows_the_pose_of_a_rolled_camera(
    data: st.DataObject, angle: float, scale: float, crop: Crop
) -> None:
    """Through any turn, scaling and shift the model's points, put by the told pose, lie where the pixels went."""
    camera = Camera(np.array([[900.0, 0, 520], [0, 900, 470], [0, 0, 1]]), 1000, 1000)
    pose = data.draw(poses_in_view(camera))
    c, s = scale * math.cos(angle), scale * math.sin(angle)
    matrix = np.array([[c, -s, data.draw(st.floats(-200, 200))], [s, c, data.draw(st.floats(-200, 200))], [0, 0, 1]])
    shown = CropPose.of(pose, camera, crop, 5.0)
    assert shown is not None
    told = shown.warped(matrix, crop.size, 128)
    whole = matrix @ crop.input_from_image @ camera.matrix  # the input's K, with the roll still in it
    roll = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    rolled = Camera(whole @ roll.T, 128, 128)
    found = told.pose(rolled, Crop(0, 0, 128, 128), 5.0)
    same(found, Pose(roll @ pose.rotation, roll @ pose.translation_m))
    near = 0.02 * POINTS
    pixels = camera.project(pose.transform(near))
    moved = crop.to_input(pixels) @ matrix[:2, :2].T + matrix[:2, 2]
    np.testing.assert_allclose(rolled.project(found.transform(near)), moved, atol=1e-5 * np.abs(moved).max())


def output_of(shown: CropPose) -> np.ndarray:
    """What a perfect network says."""
    row = np.concatenate([shown.offset, [shown.log_depth], BINS.soft_label(shown.attitude_wxyz)])
    return row.astype(np.float32)


def test_image_to_pose_with_a_perfect_network() -> None:
    pose = Pose.from_quaternion([0.3, -0.5, 0.7, 0.4], [1.3, -0.9, 14.0])
    frame = Frame("one", np.zeros((640, 800, 3), np.uint8), CAMERA, pose)
    box = frame.true_box(POINTS)
    assert box is not None
    shown = CropPose.of(pose, CAMERA, Crop.around(box, 192), CRAFT.diameter_m)
    assert shown is not None
    estimator = DirectEstimator(
        lambda images: output_of(shown)[None], CRAFT, BINS, settings=InferenceSettings(input_size=192)
    )
    estimate = estimator.estimate(frame.image, CAMERA, box)
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


def test_bad_use_is_refused() -> None:
    with pytest.raises(GknetError, match="2051 numbers"):
        decode_output(np.zeros(7, np.float32), BINS)
    with pytest.raises(GknetError, match="give a box"):
        DirectEstimator(lambda images: images, CRAFT).estimate(np.zeros((640, 800, 3), np.uint8), CAMERA)
    assert focal_px(CAMERA) == pytest.approx(1000)
