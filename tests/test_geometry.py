"""Laws of poses and cameras."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gknet.errors import GknetError
from gknet.geometry import Camera, Pose
from tests.strategies import cameras, coordinates, poses, quaternions

DISTORTION = np.array([-0.22383, 0.51410, -0.000665, -0.000214, -0.13124])
DISTORTED = Camera(np.array([[2988.58, 0, 960], [0, 2988.34, 600], [0, 0, 1]]), 1920, 1200, DISTORTION)


def same(a: Pose, b: Pose, tolerance: float = 1e-9) -> bool:
    return np.allclose(a.rotation, b.rotation, atol=tolerance) and np.allclose(
        a.translation_m, b.translation_m, atol=tolerance * 100
    )


@given(poses())
def test_inverse_undoes(pose: Pose) -> None:
    assert same(pose @ pose.inverse(), Pose.identity())
    assert same(pose.inverse() @ pose, Pose.identity())


@given(poses())
def test_identity_changes_nothing(pose: Pose) -> None:
    assert same(pose @ Pose.identity(), pose)
    assert same(Pose.identity() @ pose, pose)


@given(poses(), poses(), poses())
def test_composition_is_associative(a: Pose, b: Pose, c: Pose) -> None:
    assert same((a @ b) @ c, a @ (b @ c))


@given(poses(), poses(), st.lists(st.tuples(coordinates, coordinates, coordinates), min_size=1, max_size=5))
def test_composition_is_transformation_in_turn(a: Pose, b: Pose, points: list[tuple[float, ...]]) -> None:
    array = np.array(points, dtype=np.float64)
    np.testing.assert_allclose((a @ b).transform(array), a.transform(b.transform(array)), atol=1e-9)
    np.testing.assert_allclose(a.inverse().transform(a.transform(array)), array, atol=1e-9)


@given(quaternions())
def test_quaternion_round_trip(quaternion: np.ndarray) -> None:
    back = Pose.from_quaternion(quaternion, np.zeros(3)).quaternion_wxyz
    assert back[0] >= 0
    assert np.linalg.norm(back) == pytest.approx(1)
    assert min(np.abs(back - quaternion).max(), np.abs(back + quaternion).max()) < 1e-9


@given(quaternions())
def test_opposite_quaternions_are_one_rotation(quaternion: np.ndarray) -> None:
    pose, twin = (Pose.from_quaternion(q, np.zeros(3)) for q in (quaternion, -quaternion))
    np.testing.assert_allclose(pose.rotation, twin.rotation, atol=1e-12)
    assert pose.angle_to(twin) < 1e-7


def test_quaternion_is_hamilton_and_scalar_first() -> None:
    """A quarter turn about z takes x to y."""
    pose = Pose.from_quaternion((np.sqrt(0.5), 0, 0, np.sqrt(0.5)), np.zeros(3))
    np.testing.assert_allclose(pose.transform(np.array([[1.0, 0, 0]])), [[0, 1, 0]], atol=1e-12)


@given(quaternions())
def test_rotation_vector_round_trip(quaternion: np.ndarray) -> None:
    pose = Pose.from_quaternion(quaternion, np.ones(3))
    assert same(Pose.from_rotation_vector(pose.rotation_vector_rad, np.ones(3)), pose)


@given(poses(), poses(), poses())
def test_angle_is_a_bi_invariant_metric(a: Pose, b: Pose, c: Pose) -> None:
    angle = a.angle_to(b)
    assert 0 <= angle <= np.pi + 1e-9
    assert a.angle_to(a) < 1e-7
    assert angle == pytest.approx(b.angle_to(a), abs=1e-7)
    assert angle == pytest.approx((c @ a).angle_to(c @ b), abs=1e-7)
    assert angle <= a.angle_to(c) + c.angle_to(b) + 1e-7


@given(quaternions(), quaternions())
def test_angle_is_that_of_the_quaternions(q: np.ndarray, p: np.ndarray) -> None:
    """Eq. 8: 2 arccos |<q, p>|, less exact near zero."""
    angle = Pose.from_quaternion(q, np.zeros(3)).angle_to(Pose.from_quaternion(p, np.zeros(3)))
    assert angle == pytest.approx(2 * np.arccos(np.clip(abs(q @ p), 0, 1)), abs=1e-6)


@pytest.mark.parametrize(
    ("rotation", "translation", "word"),
    [
        (np.eye(4), np.zeros(3), "shape"),
        (np.eye(3) * 2, np.zeros(3), "rotation"),
        (np.diag([1, 1, -1]), np.zeros(3), "rotation"),
        (np.full((3, 3), np.nan), np.zeros(3), "finite"),
        (np.eye(3), [0, 0, np.inf], "translation_m"),
        (np.eye(3), [0, 0], "translation_m"),
        (np.eye(3), ["a", 0, 0], "translation_m"),
    ],
)
def test_bad_pose_is_refused(rotation: object, translation: object, word: str) -> None:
    with pytest.raises(GknetError, match=word):
        Pose(rotation, translation)  # type: ignore[arg-type]


@pytest.mark.parametrize("quaternion", [(0, 0, 0, 0), (1, 0, 0), (np.nan, 0, 0, 1)])
def test_bad_quaternion_is_refused(quaternion: object) -> None:
    with pytest.raises(GknetError, match="quaternion"):
        Pose.from_quaternion(quaternion, np.zeros(3))


def test_poses_are_values() -> None:
    rotation = np.eye(3)
    pose = Pose(rotation, np.zeros(3))
    rotation[0, 0] = 5
    assert pose.rotation[0, 0] == 1
    with pytest.raises(ValueError, match="read-only"):
        pose.translation_m[0] = 1


def test_pixel_convention() -> None:
    """The optical axis of a centred camera meets the image in its middle, (W/2, H/2)."""
    camera = Camera.from_focal(1400, 1024, 768)
    np.testing.assert_allclose(camera.project(np.array([[0, 0, 5.0]])), [[512, 384]])
    np.testing.assert_allclose(camera.project(np.array([[1, 0, 10.0], [0, 1, 10]])), [[652, 384], [512, 524]])


def test_behind_the_camera_is_nan_in_its_own_row() -> None:
    pixels = DISTORTED.project(np.array([[0, 0, 5.0], [0, 0, -5], [1, 1, 0], [0.1, 0, 5]]))
    assert np.isnan(pixels).all(axis=1).tolist() == [False, True, True, False]
    assert DISTORTED.contains(pixels).tolist() == [True, False, False, True]


def test_no_points_no_pixels() -> None:
    assert DISTORTED.project(np.zeros((0, 3))).shape == (0, 2)
    assert DISTORTED.undistort(np.zeros((0, 2))).shape == (0, 2)


@given(st.floats(20, 1900), st.floats(20, 1180), st.floats(0.5, 500))
def test_undistort_inverts_the_distortion(x: float, y: float, depth_m: float) -> None:
    ideal = Camera(DISTORTED.matrix, DISTORTED.width, DISTORTED.height)
    ray = np.linalg.solve(DISTORTED.matrix, (x, y, 1.0))[None] * depth_m
    distorted = DISTORTED.project(ray)
    assert np.abs(distorted - (x, y)).max() < 60
    np.testing.assert_allclose(DISTORTED.undistort(distorted), ideal.project(ray), atol=1e-4)


def test_undistort_leaves_an_ideal_camera_alone() -> None:
    pixels = np.array([[3.25, 700.5], [1000, -3]])
    np.testing.assert_array_equal(Camera.from_focal(1400, 1024, 1024).undistort(pixels), pixels)


@given(poses(), st.floats(0.1, 4), st.floats(0.1, 4), st.floats(-500, 500), st.floats(-500, 500))
def test_warped_camera_sees_the_warped_picture(pose: Pose, sx: float, sy: float, dx: float, dy: float) -> None:
    camera = Camera.from_focal(1400, 1024, 1024)
    warp = np.array([[sx, 0, dx], [0, sy, dy], [0, 0, 1]])
    points = pose.transform(np.random.default_rng(0).normal(size=(8, 3)))
    points[:, 2] = np.abs(points[:, 2]) + 5
    expected = np.c_[camera.project(points), np.ones(8)] @ warp.T
    np.testing.assert_allclose(camera.warped(warp, 256, 256).project(points), expected[:, :2], atol=1e-6)


@pytest.mark.parametrize("warp", [[[1, 0.1, 0], [0, 1, 0]], [[0.8, -0.6, 0], [0.6, 0.8, 0]], [[-1, 0, 0], [0, 1, 0]]])
def test_no_camera_is_sheared_turned_or_mirrored(warp: list[list[float]]) -> None:
    """Solvers know fx, fy, cx and cy alone, so another matrix would be read wrongly without a word."""
    with pytest.raises(GknetError, match="camera matrix"):
        Camera.from_focal(1400, 1024, 1024).warped(np.array([*warp, [0, 0, 1]], dtype=np.float64), 256, 256)


def test_distorted_camera_cannot_be_warped() -> None:
    with pytest.raises(GknetError, match="undistort"):
        DISTORTED.warped(np.eye(3), 256, 256)


@pytest.mark.parametrize(
    ("matrix", "size", "word"),
    [
        (np.eye(4), (10, 10), "shape"),
        (np.full((3, 3), np.nan), (10, 10), "finite"),
        (np.diag([-5, 5, 1]), (10, 10), "fx"),
        (np.diag([5, 5, 2]), (10, 10), "fx"),
        (np.eye(3), (0, 10), "size"),
        (np.array([[5, 0, 2.0**31], [0, 5, 2], [0, 0, 1]]), (10, 10), "up to 1e"),
        ([[10**400, 0, 1], [0, 1, 1], [0, 0, 1]], (10, 10), "camera matrix: expected numbers"),
    ],
)
def test_bad_camera_is_refused(matrix: np.ndarray, size: tuple[int, int], word: str) -> None:
    with pytest.raises(GknetError, match=word):
        Camera(matrix, *size)


def test_bad_distortion_is_refused() -> None:
    with pytest.raises(GknetError, match="distortion: a pinhole has 4, 5, 8, 12, 14 coefficients, got 3"):
        Camera(np.eye(3), 10, 10, np.zeros(3))
    with pytest.raises(GknetError, match="distortion: a fisheye has 4 coefficients, got 5"):
        Camera(np.eye(3), 10, 10, np.zeros(5), "fisheye")
    with pytest.raises(GknetError, match="distortion: expected finite"):
        Camera(np.eye(3), 10, 10, np.array([0, 0, np.inf, 0]))
    with pytest.raises(GknetError, match="model: expected pinhole or fisheye, got 'omni'"):
        Camera(np.eye(3), 10, 10, np.zeros(4), "omni")  # type: ignore[arg-type]


def rays(camera: Camera, count: int, angle_rad: float, seed: int) -> np.ndarray:
    """Points whose rays are within an angle of the optical axis, at 0.5 to 50 m."""
    rng = np.random.default_rng(seed)
    angle, turn, depth = rng.uniform(0, angle_rad, count), rng.uniform(0, 2 * np.pi, count), rng.uniform(0.5, 50, count)
    return (
        np.stack([np.tan(angle) * np.cos(turn), np.tan(angle) * np.sin(turn), np.ones(count)], axis=1) * depth[:, None]
    )


@given(cameras(), st.integers(0, 2**31))
def test_project_with_jacobian_is_project_and_its_differences(camera: Camera, seed: int) -> None:
    points = np.concatenate([rays(camera, 6, 0.6, seed), [[0, 0, 3.0]]])
    pixels, derivative = camera.project_with_jacobian(points)
    np.testing.assert_allclose(pixels, camera.project(points), atol=1e-9)
    step_m = 1e-6
    for axis in range(3):
        ahead, behind = points.copy(), points.copy()
        ahead[:, axis] += step_m
        behind[:, axis] -= step_m
        expected = (camera.project(ahead) - camera.project(behind)) / (2 * step_m)
        np.testing.assert_allclose(derivative[:, :, axis], expected, atol=1e-4 * camera.matrix[0, 0])


def test_jacobian_is_finite_behind_the_camera_and_of_no_point() -> None:
    behind = np.array([[0.1, 0.2, -5.0]])
    for camera in (DISTORTED, FISHEYE):
        pixels, derivative = camera.project_with_jacobian(behind)
        assert np.isfinite(pixels).all()
        assert np.isfinite(derivative).all()
        assert camera.project_with_jacobian(np.zeros((0, 3)))[1].shape == (0, 2, 3)


@given(cameras(), st.integers(0, 2**31))
def test_undistort_inverts_every_lens(camera: Camera, seed: int) -> None:
    """Within 35 degrees of the axis, where the drawn lenses are one to one."""
    points = rays(camera, 20, 0.6, seed)
    ideal = Camera(camera.matrix, camera.width, camera.height).project(points)
    np.testing.assert_allclose(camera.undistort(camera.project(points)), ideal, atol=2e-3)


FISHEYE = Camera(np.array([[500.0, 0, 640], [0, 510, 400], [0, 0, 1]]), 1280, 800, np.zeros(4), "fisheye")


def test_a_fisheye_without_coefficients_is_equidistant() -> None:
    """A quarter of a right angle is a quarter of the pixels that a right angle has."""
    angles = np.radians([0, 22.5, 45, 89])
    points = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
    pixels = FISHEYE.project(points)
    np.testing.assert_allclose(pixels, np.stack([640 + 500 * angles, 0 * angles + 400], axis=1), atol=1e-9)
    assert FISHEYE.distorted
    np.testing.assert_allclose(FISHEYE.undistort(pixels)[:, 0], 640 + 500 * np.tan(angles), rtol=1e-9)


def test_a_fisheye_to_80_degrees_is_undone() -> None:
    """OpenCV's own inverse clips the distorted angle and is wrong here."""
    camera = Camera(FISHEYE.matrix, 1280, 800, np.array([0.1, -0.02, 0.003, 0.0004]), "fisheye")
    points = rays(camera, 200, np.radians(85), 1)
    ideal = Camera(camera.matrix, 1280, 800).project(points)
    np.testing.assert_allclose(camera.undistort(camera.project(points)), ideal, rtol=1e-6)


def test_a_ray_that_no_pinhole_camera_has_is_nan() -> None:
    beyond = np.array([[640 + 500 * np.radians(100), 400.0], [640.0, 400.0]])
    assert np.isnan(FISHEYE.undistort(beyond)).all(axis=1).tolist() == [True, False]


@given(cameras(), st.integers(1, 8), st.integers(0, 2**31))
def test_scaled_camera_sees_the_scaled_picture(camera: Camera, factor: int, seed: int) -> None:
    width, height = camera.width * factor // 4, camera.height * factor // 4
    points = rays(camera, 10, 0.5, seed)
    small = camera.scaled(width, height)
    expected = camera.project(points) * (width / camera.width, height / camera.height)
    np.testing.assert_allclose(small.project(points), expected, atol=1e-8)
    assert (small.width, small.height, small.model) == (width, height, camera.model)
    back = small.scaled(camera.width, camera.height)
    np.testing.assert_allclose(back.matrix, camera.matrix, rtol=1e-12)


def test_a_camera_is_scaled_by_whole_pixels_but_not_cut() -> None:
    camera = Camera.from_focal(1000, 1920, 1200)
    assert camera.scaled(853, 533).height == 533
    for size in ((1920, 1080), (1024, 1024), (1200, 1920)):
        with pytest.raises(GknetError, match=f"{size[0]} x {size[1]} pixels are not 1920 x 1200 resized"):
            camera.scaled(*size)
    with pytest.raises(GknetError, match="size"):
        camera.scaled(0, 5)
