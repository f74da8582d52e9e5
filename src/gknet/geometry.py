"""Poses and cameras: OpenCV axes (x right, y down, z forward), metres, radians, pixels.

The centre of the top-left pixel is (0.5, 0.5), so an image spans [0, W] x [0, H] and resizing is pure scaling.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError


def _finite(name: str, value: object, shape: tuple[int, ...]) -> ndarray:
    """`value` as a read-only float64 array of `shape`, or a GknetError that names it."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise GknetError(f"{name}: expected numbers of shape {shape}, got {value!r}") from error
    if array.shape != shape:
        raise GknetError(f"{name}: expected shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        raise GknetError(f"{name}: expected finite numbers, got NaN or infinity")
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid motion `a_from_b`: p_a = rotation @ p_b + translation_m.

    Attributes:
        rotation: (3, 3) rotation matrix, read-only.
        translation_m: (3,) in m, in frame a, read-only.

    Raises:
        GknetError: A shape is wrong, a number is not finite, or `rotation` is no proper rotation.
    """

    rotation: Float[ndarray, "3 3"]
    translation_m: Float[ndarray, "3"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", _finite("rotation", self.rotation, (3, 3)))
        object.__setattr__(self, "translation_m", _finite("translation_m", self.translation_m, (3,)))
        error = np.abs(self.rotation @ self.rotation.T - np.eye(3)).max()
        if error > 1e-5 or np.linalg.det(self.rotation) < 0:
            raise GknetError(f"rotation: expected a proper rotation matrix, got one off by {error:.1e}")

    @staticmethod
    def identity() -> Pose:
        """The motion that moves nothing."""
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def from_quaternion(wxyz: object, translation_m: object) -> Pose:
        """A pose from a quaternion.

        Args:
            wxyz: Four numbers, Hamilton's convention, scalar first; they are normalised.
            translation_m: Three numbers in m.

        Raises:
            GknetError: The quaternion is zero, or a number is not finite.
        """
        quaternion = _finite("quaternion wxyz", wxyz, (4,))
        if np.linalg.norm(quaternion) < 1e-9:
            raise GknetError("quaternion wxyz: expected a unit quaternion, got zero")
        rotation = Rotation.from_quat(quaternion[[1, 2, 3, 0]]).as_matrix()
        return Pose(rotation, _finite("translation_m", translation_m, (3,)))

    @staticmethod
    def from_rotation_vector(rotation_vector_rad: object, translation_m: object) -> Pose:
        """A pose from a rotation vector (axis times angle in rad) and a translation in m."""
        vector = _finite("rotation vector", rotation_vector_rad, (3,))
        return Pose(Rotation.from_rotvec(vector.copy()).as_matrix(), _finite("translation_m", translation_m, (3,)))

    @property
    def quaternion_wxyz(self) -> Float[ndarray, "4"]:
        """(4,) unit quaternion, Hamilton's convention, scalar first, w >= 0."""
        xyzw = Rotation.from_matrix(self.rotation).as_quat()
        wxyz = xyzw[[3, 0, 1, 2]]
        return -wxyz if wxyz[0] < 0 else wxyz

    @property
    def rotation_vector_rad(self) -> Float[ndarray, "3"]:
        """(3,) axis times angle in rad."""
        return Rotation.from_matrix(self.rotation).as_rotvec()

    def inverse(self) -> Pose:
        """b_from_a."""
        return Pose(self.rotation.T, -self.rotation.T @ self.translation_m)

    def __matmul__(self, other: Pose) -> Pose:
        """a_from_c = a_from_b @ b_from_c."""
        rotation = self.rotation @ other.rotation
        return Pose(rotation, self.rotation @ other.translation_m + self.translation_m)

    def transform(self, points_m: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
        """(..., 3) points of frame b, in frame a; both in m."""
        return points_m @ self.rotation.T + self.translation_m

    def angle_to(self, other: Pose) -> float:
        """Geodesic angle between the two rotations in rad, 0 to pi (eq. 8; q and -q are the same)."""
        return float(Rotation.from_matrix(self.rotation.T @ other.rotation).magnitude())


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with OpenCV's distortion.

    Attributes:
        matrix: (3, 3) K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in px, for pixel coordinates in which the centre of the
            top-left pixel is (0.5, 0.5). Add 0.5 to OpenCV's cx and cy.
        width: Image width in px.
        height: Image height in px.
        distortion: (5,) k1, k2, p1, p2, k3; zero by default.

    Raises:
        GknetError: A shape is wrong, a number is not finite, or the matrix is not of that form.
    """

    matrix: Float[ndarray, "3 3"]
    width: int
    height: int
    distortion: Float[ndarray, "5"] = field(default_factory=lambda: np.zeros(5))

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _finite("camera matrix", self.matrix, (3, 3)))
        object.__setattr__(self, "distortion", _finite("camera distortion", self.distortion, (5,)))
        if self.width <= 0 or self.height <= 0:
            raise GknetError(f"camera size: expected positive numbers, got {self.width} x {self.height}")
        fx, fy = self.matrix[0, 0], self.matrix[1, 1]
        plain = np.array([[fx, 0, self.matrix[0, 2]], [0, fy, self.matrix[1, 2]], [0, 0, 1]])
        if fx <= 0 or fy <= 0 or not np.allclose(self.matrix, plain):
            raise GknetError("camera matrix: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy")

    @staticmethod
    def from_focal(focal_px: float, width: int, height: int) -> Camera:
        """A camera with square pixels and its principal point in the centre of the image; all in px."""
        matrix = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]], dtype=np.float64)
        return Camera(matrix, width, height)

    @property
    def distorted(self) -> bool:
        """Whether any distortion coefficient is not zero."""
        return bool(np.any(self.distortion))

    def project(self, points_cam_m: Float[ndarray, "n 3"]) -> Float[ndarray, "n 2"]:
        """Project points, with distortion.

        Args:
            points_cam_m: (n, 3) in the camera frame in m.

        Returns:
            (n, 2) in px; NaN for a point at or behind the camera's plane.
        """
        points = np.asarray(points_cam_m, dtype=np.float64)
        in_front = points[:, 2] > 1e-9
        pixels = np.full((len(points), 2), np.nan)
        if in_front.any():
            projected, _ = cv2.projectPoints(
                points[in_front], np.zeros(3), np.zeros(3), self.matrix, np.asarray(self.distortion)
            )
            pixels[in_front] = projected[:, 0]
        return pixels

    def undistort(self, pixels: Float[ndarray, "n 2"]) -> Float[ndarray, "n 2"]:
        """(n, 2) pixels, where the rays of the given (n, 2) pixels would fall without distortion."""
        if not self.distorted or len(pixels) == 0:
            return np.asarray(pixels, dtype=np.float64)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)
        source = np.asarray(pixels, dtype=np.float64)[:, None]
        ideal = cv2.undistortPoints(source, self.matrix, self.distortion, R=np.eye(3), P=self.matrix, criteria=criteria)
        return ideal[:, 0]

    def contains(self, pixels: Float[ndarray, "n 2"]) -> ndarray:
        """(n,) bool: whether each of (n, 2) pixels is inside [0, W] x [0, H]; NaN is outside."""
        return (pixels[:, 0] >= 0) & (pixels[:, 0] <= self.width) & (pixels[:, 1] >= 0) & (pixels[:, 1] <= self.height)

    def warped(self, out_from_image: Float[ndarray, "3 3"], width: int, height: int) -> Camera:
        """The camera of a scaled and shifted image.

        Args:
            out_from_image: (3, 3) affine map of pixels, without rotation or shear.
            width: Width of the new image in px.
            height: Height of the new image in px.

        Raises:
            GknetError: The camera has distortion, or the map rotates or shears.
        """
        if self.distorted:
            raise GknetError("camera: a warp of a distorted camera is no camera; undistort the image first")
        return Camera(out_from_image @ self.matrix, width, height)
