"""A pose as a crop shows it: what a direct network regresses, and the way back to a pose. Numpy alone.

The camera has the focal length f px, the crop a side of `side` px, and the body's origin the depth z (metres):

    offset     (its pixel - the crop's centre) / side: where it is in the image's plane
    log_depth  log(z side / (f diameter)): 0 where the spacecraft's diameter, face on, fills the crop
    attitude   R_ray^T R: the rotation relative to the line of sight to the origin (allocentric), where R_ray is the
               smallest rotation of the optical axis onto that line

None of the three changes when the same view is found elsewhere in the image, nearer or farther. A rotation of the
image by an angle a is a roll of the camera about its optical axis, R_z(a): it takes the attitude A to R_z(a) A,
exactly, if pixels are square and the lens is symmetric about its axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from gknet.geometry import Camera, Pose
from gknet.inference.attitude import AttitudeBins, rotation_of, wxyz_of
from gknet.inference.crop import Crop

SQUARE_TOLERANCE = 0.01
"""How far fx / fy may be from 1 where images are rotated."""

NEAR_RAD = math.radians(60)
"""Attitudes nearer than this count as alike; symmetric counterparts are half or a quarter of a turn apart."""


@dataclass(frozen=True, eq=False)
class CropPose:
    """A pose as a crop shows it (see the module).

    Attributes:
        offset: (2,) in sides of the crop, x to the right and y down.
        log_depth: Natural logarithm of the depth in the crop's unit.
        attitude_wxyz: (4,) unit quaternion of R_ray^T R, scalar first, any sign.
    """

    offset: Float[ndarray, "2"]
    log_depth: float
    attitude_wxyz: Float[ndarray, "4"]

    @staticmethod
    def of(pose: Pose, camera: Camera, crop: Crop, diameter_m: float) -> CropPose | None:
        """How a crop shows a pose.

        Args:
            pose: Cam_from_body.
            camera: The camera of the full image.
            crop: The crop of the image.
            diameter_m: Of the spacecraft.

        Returns:
            None when the body's origin is not in front of the camera.
        """
        pixel = camera.project(pose.translation_m[None])[0]
        if not np.isfinite(pixel).all():
            return None
        size_m = pose.translation_m[2] * crop.side / focal_px(camera)  # of what fills the crop at that depth
        offset = crop.to_input(pixel) / crop.size - 0.5
        return CropPose(offset, math.log(size_m / diameter_m), allocentric_wxyz(pose))

    def pose(self, camera: Camera, crop: Crop, diameter_m: float) -> Pose | None:
        """The pose cam_from_body that the crop shows: the inverse of `of`.

        Args:
            camera: The camera of the full image.
            crop: The crop of the image.
            diameter_m: Of the spacecraft.

        Returns:
            None when no ray in front of the camera reaches the origin's pixel, as at the rim of a fisheye's image.
        """
        pixel = camera.undistort(crop.to_image((self.offset + 0.5) * crop.size)[None])[0]
        if not np.isfinite(pixel).all():
            return None
        depth_m = math.exp(self.log_depth) * diameter_m * focal_px(camera) / crop.side
        ray = np.linalg.solve(camera.matrix, np.append(pixel, 1.0))
        attitude = Pose.from_quaternion(self.attitude_wxyz, np.zeros(3))
        return Pose(smallest_rotation_to(ray) @ attitude.rotation, depth_m * ray)

    def warped(self, input_from_crop: Float[ndarray, "3 3"], crop_size: int, input_size: int) -> CropPose:
        """In another square, after a rotation, a scaling and a shift of the crop's pixels.

        Args:
            input_from_crop: (3, 3) similarity, pixels of the crop to pixels of the other square.
            crop_size: Side of the crop's pixels.
            input_size: Side of the other square's.
        """
        linear = input_from_crop[:2, :2]
        pixel = linear @ ((self.offset + 0.5) * crop_size) + input_from_crop[:2, 2]
        scale, angle = math.sqrt(np.linalg.det(linear)), math.atan2(linear[1, 0], linear[0, 0])
        roll = Rotation.from_rotvec([0.0, 0.0, angle]) * rotation_of(self.attitude_wxyz)
        log_depth = self.log_depth + math.log(input_size / (scale * crop_size))
        return CropPose(pixel / input_size - 0.5, log_depth, wxyz_of(roll))

    @property
    def vector(self) -> Float[ndarray, "7"]:
        """Offset, log_depth and attitude in one row."""
        return np.concatenate([self.offset, [self.log_depth], self.attitude_wxyz])

    @staticmethod
    def from_vector(row: Float[ndarray, "7"]) -> CropPose:
        """The inverse of `vector`."""
        return CropPose(row[:2], float(row[2]), row[3:])


def focal_px(camera: Camera) -> float:
    """The geometric mean of both focal lengths."""
    return math.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])


def has_square_pixels(camera: Camera) -> bool:
    """Whether a rotated image is one of a rolled camera."""
    return bool(abs(camera.matrix[0, 0] / camera.matrix[1, 1] - 1) <= SQUARE_TOLERANCE)


def smallest_rotation_to(ray: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
    """R_ray: the rotation by the smallest angle that takes the optical axis to a ray in front of the camera."""
    x, y, z = ray / np.linalg.norm(ray)
    cross = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])  # of the axis (-y, x, 0), by the sine of the angle
    return np.eye(3) + cross + cross @ cross / (1 + z)


def allocentric_wxyz(pose: Pose) -> Float[ndarray, "4"]:
    """R_ray^T R of a pose in front of the camera, as a unit quaternion, scalar first."""
    return Pose(smallest_rotation_to(pose.translation_m).T @ pose.rotation, np.zeros(3)).quaternion_wxyz


def attitude_confidence(
    pose: Pose, probability: Float[ndarray, " k"] | None, bins: AttitudeBins | None
) -> float | None:
    """The probability of the attitudes within `NEAR_RAD` of a pose's.

    Args:
        pose: Cam_from_body.
        probability: (k,) of each attitude class, summing to 1.
        bins: The classes.

    Returns:
        0 to 1; None without probabilities or classes.
    """
    if probability is None or bins is None:
        return None
    return bins.probability_near(probability, allocentric_wxyz(pose), NEAR_RAD)
