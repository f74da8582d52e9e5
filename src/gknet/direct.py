"""Poses that a network tells directly, without keypoints: what it says of a crop, and back to a pose. Numpy alone.

Seen in a crop of `side` px by a camera of focal length f px, the body's origin at depth z (metres) is told by
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
from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from scipy.spatial.transform import Rotation

from gknet.crop import Crop
from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Keypoints
from gknet.geometry import Camera, Pose
from gknet.locate import CropEstimator, Looking, Network, network_input
from gknet.spacecraft import Spacecraft

SOFTNESS = 0.6
"""Standard deviation of a soft label in bins. Less, and what lies between two bins is lost; more, and labels blur."""

CORRECTIONS = 4
"""Steps from the mean of the bins to the attitude whose label has that mean: 0.2 degrees in the mean, then 0.001."""

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
        attitude = Pose(least_turn(pose.translation_m).T @ pose.rotation, np.zeros(3))
        offset = crop.to_input(pixel) / crop.size - 0.5
        return CropPose(offset, math.log(size_m / diameter_m), attitude.quaternion_wxyz)

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
        roll = Rotation.from_rotvec([0.0, 0.0, angle]) * _rotation(self.attitude_wxyz)
        log_depth = self.log_depth + math.log(input_size / (scale * crop_size))
        return CropPose(pixel / input_size - 0.5, log_depth, _wxyz(roll))

    @property
    def vector(self) -> Float[ndarray, "7"]:
        """Offset, log_depth and attitude in one row."""
        return np.concatenate([self.offset, [self.log_depth], self.attitude_wxyz])

    @staticmethod
    def from_vector(row: Float[ndarray, "7"]) -> CropPose:
        return CropPose(row[:2], float(row[2]), row[3:])


def focal_px(camera: Camera) -> float:
    return math.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])


def least_turn(ray: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
    """The rotation by the smallest angle that takes the optical axis to a ray in front of the camera."""
    x, y, z = ray / np.linalg.norm(ray)
    cross = np.array([[0, 0, x], [0, 0, y], [-x, -y, 0]])  # of the axis (-y, x, 0), by the sine of the angle
    return np.eye(3) + cross + cross @ cross / (1 + z)


def _rotation(wxyz: Float[ndarray, "*b 4"]) -> Rotation:
    return Rotation.from_quat(wxyz[..., [1, 2, 3, 0]])


def _wxyz(rotation: Rotation) -> Float[ndarray, "4"]:
    return rotation.as_quat()[[3, 0, 1, 2]]


@dataclass(frozen=True)
class AttitudeBins:
    """Soft classes of attitude: the cells of a grid of Euler angles (z, y, x), `per_turn` to a turn of each.

    y goes over half a turn, so there are per_turn^3 / 2 cells. A label weighs each cell by how near its centre is, as a
    rotation, and by its volume (cos y). Hence angles wrap by themselves, q and -q are one, and the poles, where a cell
    is narrow and z and x turn about one axis, are no special place: many small cells share what one would have.
    """

    per_turn: int = 16

    def __post_init__(self) -> None:
        if self.per_turn < 4 or self.per_turn % 2:
            raise GknetError(f"attitude bins: expected an even number of 4 or more, got {self.per_turn}")

    @property
    def count(self) -> int:
        return self.per_turn**3 // 2

    @cached_property
    def _angles_rad(self) -> Float[ndarray, "k 3"]:
        turn = (np.arange(self.per_turn) + 0.5) * 2 * np.pi / self.per_turn
        half = turn[: self.per_turn // 2] - np.pi / 2
        return np.stack(np.meshgrid(turn, half, turn, indexing="ij"), axis=-1).reshape(-1, 3)

    @cached_property
    def centres_wxyz(self) -> Float[ndarray, "k 4"]:
        return Rotation.from_euler("ZYX", self._angles_rad).as_quat()[:, [3, 0, 1, 2]]

    @cached_property
    def _moments(self) -> Float[ndarray, "k 16"]:
        return (self.centres_wxyz[:, :, None] * self.centres_wxyz[:, None, :]).reshape(-1, 16)

    def soft_label(self, attitude_wxyz: Float[ndarray, "*b 4"]) -> Float[ndarray, "*b k"]:
        """The share of each cell, summing to 1: volume times exp(2 (<q, q_cell>^2 - 1) / sigma^2).

        For a small angle a between the two that is a Gaussian, exp(-a^2 / (2 sigma^2)).
        """
        sigma = SOFTNESS * 2 * np.pi / self.per_turn
        nearness = 2 / sigma**2 * ((attitude_wxyz @ self.centres_wxyz.T) ** 2 - 1)
        label = np.cos(self._angles_rad[:, 1]) * np.exp(nearness)
        return label / label.sum(axis=-1, keepdims=True)

    def attitude_wxyz(self, belief: Float[ndarray, "k"]) -> Float[ndarray, "4"]:
        """The expected attitude; of a soft label, the attitude that it was made of.

        The mean of quaternions is the first eigenvector of sum p q q^T (Markley et al. 2007). Attitudes half a turn
        apart are orthogonal, so the lesser of two such twins does not draw the mean away from the other.
        """
        wanted = self._mean(belief)
        found = wanted
        for _ in range(CORRECTIONS):
            found = wanted * self._mean(self.soft_label(_wxyz(found))).inv() * found
        return _wxyz(found)

    def _mean(self, belief: Float[ndarray, "k"]) -> Rotation:
        return _rotation(np.linalg.eigh((belief @ self._moments).reshape(4, 4))[1][:, -1])


def decode_output(output: Float[ndarray, "c"], bins: AttitudeBins) -> CropPose | None:
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
    looking: Looking = field(default_factory=Looking)

    def estimate_in(self, image: UInt8[ndarray, "h w 3"], camera: Camera, box: Box) -> Estimate:
        """A pose without a covariance. Its keypoints are where it puts the spacecraft's points: none was detected."""
        crop = Crop.around(box, self.looking.input_size)
        seen = decode_output(self.network(network_input(image, crop))[0], self.bins)
        if seen is None:
            return Estimate(box=box, failure="the network's answer is not finite")
        pose = seen.pose(camera, crop, self.spacecraft.diameter_m)
        contradiction = self.contradiction(pose, camera, crop)
        if contradiction is not None:
            return Estimate(box=box, failure=contradiction)
        pixels = camera.project(pose.transform(self.spacecraft.points_m))
        count = len(pixels)
        keypoints = Keypoints(pixels, np.ones(count), np.tile(np.eye(2) / crop.scale**2, (count, 1, 1)))
        return Estimate(keypoints, pose, box=box)
