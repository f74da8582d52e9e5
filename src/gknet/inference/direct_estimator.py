"""Poses that a network tells directly, without keypoints: what it says of a crop, and back to a pose. Numpy alone.

NetworkOutput in a crop of `side` px by a camera of focal length f px, the body's origin at depth z (metres) is told by
    offset     (its pixel - the crop's centre) / side: where it is in the picture's plane
    log_depth  log(z side / (f diameter)): 0 where the spacecraft's diameter, face on, fills the crop
    attitude   R_ray^T R: the rotation as the line of sight to the origin sees it (allocentric), where R_ray is the
               least turn of the optical axis onto that line
None of the three changes when the same view is found elsewhere in the picture, nearer or farther. A turn of the picture
by an angle a is a roll of the camera about its optical axis, R_z(a): it takes the attitude A to R_z(a) A, exactly, if
pixels are square and the lens is symmetric about its axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Failure, FailureKind, Keypoints
from gknet.geometry import Camera, Pose
from gknet.inference.attitude import AttitudeBins, rotation_of, wxyz_of
from gknet.inference.crop import Crop
from gknet.inference.locate import CropEstimator, InferenceSettings, Network, network_input
from gknet.spacecraft import Spacecraft

SQUARE = 0.01
"""How far fx / fy may be from 1 where pictures are turned."""

NEAR_RAD = math.radians(60)
"""Attitudes nearer than this are alike; twins are half or a quarter of a turn apart."""

FARTHEST = 10.0
"""A logarithm of the depth beyond this is no answer; it is cut off, and the pose is refused for its size."""


@dataclass(frozen=True, eq=False)
class CropPose:
    """A pose as a crop shows it (see above).

    offset         (2,) in sides of the crop, x to the right and y down
    attitude_wxyz  (4,) unit quaternion, any sign
    """

    offset: Float[ndarray, "2"]
    log_depth: float
    attitude_wxyz: Float[ndarray, "4"]

    @staticmethod
    def of(pose: Pose, camera: Camera, crop: Crop, diameter_m: float) -> CropPose | None:
        """How a crop shows a pose; None when the body's origin is not in front of the camera."""
        pixel = camera.project(pose.translation_m[None])[0]
        if not np.isfinite(pixel).all():
            return None
        size_m = pose.translation_m[2] * crop.side / focal_px(camera)  # of what fills the crop at that depth
        offset = crop.to_input(pixel) / crop.size - 0.5
        return CropPose(offset, math.log(size_m / diameter_m), attitude_seen(pose))

    def pose(self, camera: Camera, crop: Crop, diameter_m: float) -> Pose:
        """The pose that the crop shows: the inverse of `of`."""
        pixel = camera.undistort(crop.to_image((self.offset + 0.5) * crop.size)[None])[0]
        depth_m = math.exp(self.log_depth) * diameter_m * focal_px(camera) / crop.side
        ray = np.linalg.solve(camera.matrix, np.append(pixel, 1.0))
        attitude = Pose.from_quaternion(self.attitude_wxyz, np.zeros(3))
        return Pose(least_turn(ray) @ attitude.rotation, depth_m * ray)

    def warped(self, input_from_crop: Float[ndarray, "3 3"], crop_size: int, input_size: int) -> CropPose:
        """In another square, after a turn, a scaling and a shift of the crop's pixels."""
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
        return CropPose(row[:2], float(row[2]), row[3:])


def focal_px(camera: Camera) -> float:
    return math.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])


def has_square_pixels(camera: Camera) -> bool:
    """Whether a turned picture is one of a rolled camera."""
    return bool(abs(camera.matrix[0, 0] / camera.matrix[1, 1] - 1) <= SQUARE)


def least_turn(ray: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
    """The rotation by the smallest angle that takes the optical axis to a ray in front of the camera."""
    x, y, z = ray / np.linalg.norm(ray)
    cross = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])  # of the axis (-y, x, 0), by the sine of the angle
    return np.eye(3) + cross + cross @ cross / (1 + z)


def attitude_seen(pose: Pose) -> Float[ndarray, "4"]:
    """R_ray^T R of a pose in front of the camera, as a quaternion (w, x, y, z)."""
    return Pose(least_turn(pose.translation_m).T @ pose.rotation, np.zeros(3)).quaternion_wxyz


def confidence_in(pose: Pose, belief: Float[ndarray, " k"] | None, bins: AttitudeBins | None) -> float | None:
    """How much of a belief in the attitude lies about a pose's; None without either."""
    if belief is None or bins is None:
        return None
    return bins.share_near(belief, attitude_seen(pose), NEAR_RAD)


def decode_output(output: Float[ndarray, " c"], bins: AttitudeBins) -> CropPose | None:
    """A direct network's row: offset x and y, log_depth, then the belief in each cell. None when it is not finite."""
    if output.shape != (3 + bins.count,):
        raise GknetError(f"direct network: expected {3 + bins.count} numbers for a crop, got shape {output.shape}")
    values = output.astype(np.float64)
    if not np.isfinite(values).all():
        return None
    log_depth = float(np.clip(values[2], -FARTHEST, FARTHEST))
    return CropPose(values[:2], log_depth, bins.attitude_wxyz(values[3:]))


@dataclass(frozen=True, eq=False)
class DirectEstimator(CropEstimator):
    """Finds one known spacecraft from what a direct network says of the crop, looked at once.

    network   (b, 3, s, s) -> (b, 3 + bins.count), see `decode_output`
    """

    network: Network
    spacecraft: Spacecraft
    bins: AttitudeBins = field(default_factory=AttitudeBins)
    locator: Network | None = None
    settings: InferenceSettings = field(default_factory=InferenceSettings)

    def estimate_in(self, image: UInt8[ndarray, "h w 3"], camera: Camera, box: Box) -> Estimate:
        """A pose without a covariance. Its keypoints are where it puts the spacecraft's points: none was detected."""
        crop = Crop.around(box, self.settings.input_size)
        output = self.network(network_input(image, crop))[0]
        seen = decode_output(output, self.bins)
        if seen is None:
            return Estimate(box=box, failure=Failure(FailureKind.NOT_FINITE, "the network's output is not finite"))
        pose = seen.pose(camera, crop, self.spacecraft.diameter_m)
        contradiction = self.contradiction(pose, camera, crop)
        if contradiction is not None:
            return Estimate(box=box, failure=contradiction)
        pixels = camera.project(pose.transform(self.spacecraft.points_m))
        count = len(pixels)
        keypoints = Keypoints(pixels, np.ones(count), np.tile(np.eye(2) / crop.scale**2, (count, 1, 1)))
        return Estimate(keypoints, pose, box=box, attitude_confidence=confidence_in(pose, output[3:], self.bins))
