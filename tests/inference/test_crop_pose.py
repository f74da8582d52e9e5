"""A pose as a crop shows it: encoding and decoding are inverse, rotations of the image are rolls of the camera."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.inference.crop_pose import CropPose, focal_px, smallest_rotation_to
from tests.strategies import quaternions

POINTS = np.random.default_rng(7).uniform(-1, 1, (14, 3)) * (3, 1, 1)
CAMERA = Camera.from_focal(1000, 800, 640)


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
    """Any rotation, the origin in front of the camera and at or near the image."""
    pixel = np.array([draw(st.floats(-100, 1100)), draw(st.floats(-100, 1100))])
    ray = np.linalg.solve(camera.matrix, np.append(pixel, 1.0))
    slope = float(np.linalg.norm(ray[:2]))
    ray[:2] *= min(1.0, 0.6 / max(slope, 1e-9))  # within the angle that the lens model is made for
    return Pose.from_quaternion(draw(quaternions()), draw(st.floats(2, 300)) * ray)


def same(first: Pose | None, second: Pose, relative: float = 1e-6) -> None:
    assert first is not None
    assert first.angle_to(second) < 1e-6
    np.testing.assert_allclose(
        first.translation_m, second.translation_m, atol=relative * float(np.linalg.norm(second.translation_m))
    )


@given(st.data(), cameras(), crops())
def test_a_pose_and_back(data: st.DataObject, camera: Camera, crop: Crop) -> None:
    pose = data.draw(poses_in_view(camera))
    shown = CropPose.of(pose, camera, crop, 5.0)
    assert shown is not None
    same(shown.pose(camera, crop, 5.0), pose)
    same(CropPose.from_vector(shown.vector).pose(camera, crop, 5.0), pose)


def test_a_pixel_that_no_ray_in_front_reaches_has_no_pose() -> None:
    fisheye = Camera(np.array([[200.0, 0, 400], [0, 200, 400], [0, 0, 1]]), 800, 800, np.zeros(4), "fisheye")
    crop = Crop(300, 300, 200, 256)
    ahead = CropPose(np.array([0.5, 0.0]), 0.0, np.array([1.0, 0, 0, 0]))
    aside = CropPose(np.array([1.7, 0.0]), 0.0, np.array([1.0, 0, 0, 0]))  # 340 px of 200 px per radian: 97 degrees
    assert ahead.pose(fisheye, crop, 5.0) is not None
    assert aside.pose(fisheye, crop, 5.0) is None


def test_the_numbers_mean_what_the_module_states() -> None:
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 10.0]))
    shown = CropPose.of(pose, CAMERA, Crop(300, 220, 400, 256), 4.0)  # the axis at (400, 320)
    assert shown is not None
    np.testing.assert_allclose(shown.offset, [-0.25, -0.25])
    assert shown.log_depth == pytest.approx(0)  # 4 m at 10 m are 400 px
    np.testing.assert_allclose(np.abs(shown.attitude_wxyz), [1, 0, 0, 0], atol=1e-12)
    assert CropPose.of(Pose(np.eye(3), np.array([0, 0, -1.0])), CAMERA, Crop(0, 0, 9, 9), 4.0) is None


def test_a_far_corner_of_the_picture_shows_the_same_view() -> None:
    """Under the same line of sight, a craft has the same attitude and log_depth wherever it is."""
    middle = Pose.from_quaternion([0.3, -0.5, 0.7, 0.4], [0, 0, 20.0])
    turn = smallest_rotation_to(np.array([0.3, -0.2, 1.0]))
    aside = Pose(turn @ middle.rotation, turn @ middle.translation_m)
    aside = Pose(aside.rotation, aside.translation_m * 20 / aside.translation_m[2])
    first, second = (CropPose.of(pose, CAMERA, Crop(0, 0, 300, 128), 4.0) for pose in (middle, aside))
    assert first is not None
    assert second is not None
    np.testing.assert_allclose(first.vector[2:], second.vector[2:], atol=1e-12)


@given(quaternions())
def test_the_smallest_rotation(quaternion: np.ndarray) -> None:
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
    """Through any turn, scaling and shift the model's points, put by the warped pose, lie where the pixels went."""
    camera = Camera(np.array([[900.0, 0, 520], [0, 900, 470], [0, 0, 1]]), 1000, 1000)
    pose = data.draw(poses_in_view(camera))
    c, s = scale * math.cos(angle), scale * math.sin(angle)
    matrix = np.array([[c, -s, data.draw(st.floats(-200, 200))], [s, c, data.draw(st.floats(-200, 200))], [0, 0, 1]])
    shown = CropPose.of(pose, camera, crop, 5.0)
    assert shown is not None
    warped = shown.warped(matrix, crop.size, 128)
    whole = matrix @ crop.input_from_image @ camera.matrix  # the input's K, with the roll still in it
    roll = Rotation.from_rotvec([0, 0, angle]).as_matrix()
    rolled = Camera(whole @ roll.T, 128, 128)
    found = warped.pose(rolled, Crop(0, 0, 128, 128), 5.0)
    assert found is not None
    same(found, Pose(roll @ pose.rotation, roll @ pose.translation_m))
    near = 0.02 * POINTS
    pixels = camera.project(pose.transform(near))
    moved = crop.to_input(pixels) @ matrix[:2, :2].T + matrix[:2, 2]
    np.testing.assert_allclose(rolled.project(found.transform(near)), moved, atol=1e-5 * np.abs(moved).max())


def test_focal_length_is_the_geometric_mean() -> None:
    assert focal_px(Camera(np.array([[500.0, 0, 400], [0, 2000, 320], [0, 0, 1]]), 800, 640)) == pytest.approx(1000)
