"""Poses and cameras: OpenCV axes (x right, y down, z forward), metres, radians, pixels.

The centre of the top-left pixel is (0.5, 0.5), so an image spans [0, W] x [0, H] and resizing is pure scaling.
"""

from __future__ import annotations

import reprlib
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError

LensModel = Literal["pinhole", "fisheye"]

COEFFICIENTS = {"pinhole": (4, 5, 8, 12, 14), "fisheye": (4,)}
"""How many numbers a distortion may have."""

LARGEST_PX = 1e9
"""Beyond this a focal length or a principal point is a mistake, and OpenCV's arithmetic ends."""

NEWTON_STEPS = 20


def _finite(name: str, value: object, shape: tuple[int, ...]) -> ndarray:
    """`value` as a read-only float64 array of `shape`, or a GknetError that names it."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise GknetError(f"{name}: expected numbers of shape {shape}, got {reprlib.repr(value)}") from error
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
    """A camera with a lens: p = K d(x / z, y / z), where d is the distortion.

    The pinhole model is OpenCV's: `distortion` holds its first 4, 5, 8, 12 or 14 coefficients (k1, k2, p1, p2, k3, k4,
    k5, k6, s1 to s4, tau_x, tau_y). The fisheye model is OpenCV's too, from Kannala and Brandt, "A generic camera model
    and calibration method", PAMI 2006: the pixel's distance from the principal point, in focal lengths, is
    theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8), with theta the ray's angle to the optical axis.

    Attributes:
        matrix: (3, 3) K in pixels; the centre of the top-left pixel is (0.5, 0.5).
        width: Of the image, in pixels.
        height: Of the image, in pixels.
        distortion: (4,), (5,), (8,), (12,) or (14,) coefficients; (4,) of a fisheye.
        model: "pinhole" or "fisheye".

    Raises:
        GknetError: A value has another shape, is not finite, or K has a shear.
    """

    matrix: Float[ndarray, "3 3"]
    width: int
    height: int
    distortion: Float[ndarray, " k"] = field(default_factory=lambda: np.zeros(5))
    model: LensModel = "pinhole"

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _finite("camera matrix", self.matrix, (3, 3)))
        object.__setattr__(self, "distortion", self._coefficients())
        if self.width <= 0 or self.height <= 0:
            raise GknetError(f"camera size: expected positive numbers, got {self.width} x {self.height}")
        fx, fy = self.matrix[0, 0], self.matrix[1, 1]
        plain = np.array([[fx, 0, self.matrix[0, 2]], [0, fy, self.matrix[1, 2]], [0, 0, 1]])
        if fx <= 0 or fy <= 0 or not np.allclose(self.matrix, plain):
            raise GknetError("camera matrix: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with positive fx and fy")
        if np.abs(self.matrix).max() > LARGEST_PX:
            raise GknetError(f"camera matrix: expected numbers up to {LARGEST_PX:g} px, got {self.matrix.max():g}")

    def _coefficients(self) -> Float[ndarray, " k"]:
        """The distortion, checked against the model."""
        if self.model not in COEFFICIENTS:
            raise GknetError(f"camera model: expected {' or '.join(COEFFICIENTS)}, got {str(self.model)[:80]!r}")
        counts, count = COEFFICIENTS[self.model], np.size(self.distortion)
        if count not in counts:
            expected = ", ".join(map(str, counts))
            raise GknetError(f"camera distortion: a {self.model} has {expected} coefficients, got {count}")
        return _finite("camera distortion", self.distortion, (count,))

    @staticmethod
    def from_focal(focal_px: float, width: int, height: int) -> Camera:
        """A camera with square pixels and no distortion whose axis meets the image in its middle.

        Args:
            focal_px: Focal length in pixels.
            width: Of the image, in pixels.
            height: Of the image, in pixels.
        """
        matrix = np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]], dtype=np.float64)
        return Camera(matrix, width, height)

    @property
    def distorted(self) -> bool:
        """Whether straight lines may be curved in the image."""
        return self.model == "fisheye" or bool(np.any(self.distortion))

    def project(self, points_cam_m: Float[ndarray, "n 3"]) -> Float[ndarray, "n 2"]:
        """Pixels of points in the camera frame; NaN for a point at or behind the camera's plane.

        Args:
            points_cam_m: (n, 3) in the camera frame (x right, y down, z forward), in metres.

        Returns:
            (n, 2) pixels.
        """
        points = np.asarray(points_cam_m, dtype=np.float64)
        in_front = points[:, 2] > 1e-9
        pixels = np.full((len(points), 2), np.nan)
        if in_front.any():
            pixels[in_front] = self._projected(points[in_front])[0]
        return pixels

    def project_with_jacobian(
        self, points_cam_m: Float[ndarray, "n 3"]
    ) -> tuple[Float[ndarray, "n 2"], Float[ndarray, "n 2 3"]]:
        """Pixels of points in the camera frame, and their derivative by the points.

        A solver needs finite numbers for every row, so points behind the camera are not marked: their pixels are those
        of the mirrored point. Check the depth.

        Args:
            points_cam_m: (n, 3) in the camera frame, in metres.

        Returns:
            (n, 2) pixels and (n, 2, 3) their derivative in pixels per metre.
        """
        points = np.asarray(points_cam_m, dtype=np.float64)
        if len(points) == 0:
            return np.zeros((0, 2)), np.zeros((0, 2, 3))
        pixels, derivatives = self._projected(points)
        first = 8 if self.model == "fisheye" else 0  # OpenCV's fisheye has the intrinsics before the motion
        return pixels, derivatives[:, first + 3 : first + 6].reshape(-1, 2, 3)

    def _projected(self, points: Float[ndarray, "n 3"]) -> tuple[Float[ndarray, "n 2"], Float[ndarray, "m c"]]:
        """OpenCV's pixels and its derivatives by rotation, translation, intrinsics."""
        project = cv2.fisheye.projectPoints if self.model == "fisheye" else cv2.projectPoints
        pixels, derivatives = project(points[:, None], np.zeros(3), np.zeros(3), self.matrix, self.distortion)
        return pixels.reshape(-1, 2), derivatives

    def undistort(self, pixels: Float[ndarray, "n 2"]) -> Float[ndarray, "n 2"]:
        """Where the same rays would fall without distortion.

        Args:
            pixels: (n, 2) in the image.

        Returns:
            (n, 2) pixels of the pinhole camera with the same matrix; NaN for a fisheye's ray at 90 degrees or more.
        """
        if not self.distorted or len(pixels) == 0:
            return np.asarray(pixels, dtype=np.float64)
        source = np.asarray(pixels, dtype=np.float64)
        if self.model == "fisheye":
            return self._undistorted_fisheye(source)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)
        ideal = cv2.undistortPoints(
            source[:, None], self.matrix, self.distortion, R=np.eye(3), P=self.matrix, criteria=criteria
        )
        return ideal[:, 0]

    def _undistorted_fisheye(self, pixels: Float[ndarray, "n 2"]) -> Float[ndarray, "n 2"]:
        """Newton's method for the angle; OpenCV's own clips a distorted angle at 90 degrees, before it is undone."""
        focal, centre = self.matrix[[0, 1], [0, 1]], self.matrix[:2, 2]
        plane = (pixels - centre) / focal
        radius = np.linalg.norm(plane, axis=1)
        powers = np.r_[1.0, self.distortion]
        polynomial = np.polynomial.Polynomial(np.stack([np.zeros(5), powers], axis=1).ravel())
        slope, theta = polynomial.deriv(), np.minimum(radius, np.pi / 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            for _ in range(NEWTON_STEPS):
                theta = np.clip(theta - (polynomial(theta) - radius) / slope(theta), 0, np.pi)
            solved = (np.abs(polynomial(theta) - radius) < 1e-9) & (theta < np.pi / 2)
            stretch = np.where(radius < 1e-12, 1.0, np.tan(theta) / radius)
        return np.where(solved[:, None], plane * stretch[:, None] * focal + centre, np.nan)

    def contains(self, pixels: Float[ndarray, "n 2"]) -> ndarray:
        """Boolean (n,): inside [0, W] x [0, H]; NaN is outside."""
        return (pixels[:, 0] >= 0) & (pixels[:, 0] <= self.width) & (pixels[:, 1] >= 0) & (pixels[:, 1] <= self.height)

    def scaled(self, width: int, height: int) -> Camera:
        """The same lens at another resolution: of an image that was resized to `width` x `height` pixels.

        Args:
            width: Of the other image, in pixels.
            height: Of the other image, in pixels.

        Raises:
            GknetError: The other image has another aspect ratio (by a pixel or more), so it was not resized alone.
        """
        if width <= 0 or height <= 0:
            raise GknetError(f"camera size: expected positive numbers, got {width} x {height}")
        if abs(width * self.height / self.width - height) >= 1 and abs(height * self.width / self.height - width) >= 1:
            raise GknetError(
                f"camera: {width} x {height} pixels are not {self.width} x {self.height} resized: the aspect ratio "
                "differs, so the image was cut; give the camera of the image itself"
            )
        stretch = np.diag([width / self.width, height / self.height, 1])
        return Camera(stretch @ self.matrix, width, height, self.distortion, self.model)

    def warped(self, out_from_image: Float[ndarray, "3 3"], width: int, height: int) -> Camera:
        """The camera of an image scaled and shifted by `out_from_image`; only an undistorted camera can follow.

        Args:
            out_from_image: (3, 3) homogeneous map of pixels.
            width: Of the other image, in pixels.
            height: Of the other image, in pixels.

        Raises:
            GknetError: The camera is distorted, or the map also turns or shears the image: no such camera exists.
        """
        if self.distorted:
            raise GknetError("camera: a warp of a distorted camera is no camera; undistort the image first")
        return Camera(out_from_image @ self.matrix, width, height)
