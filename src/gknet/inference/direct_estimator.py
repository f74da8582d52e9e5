"""Direct pose regression: a network's row of numbers for a crop becomes a pose, without keypoints."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Failure, FailureKind, Keypoints
from gknet.geometry import Camera
from gknet.inference.attitude import AttitudeBins
from gknet.inference.crop import Crop
from gknet.inference.crop_estimator import CropEstimator, InferenceSettings
from gknet.inference.crop_pose import CropPose, attitude_confidence
from gknet.inference.network_io import Forward, network_input
from gknet.spacecraft import Spacecraft

MAX_LOG_DEPTH = 10.0
"""A logarithm of the depth is clipped to this; the pose is then refused for its size."""


def decode_output(output: Float[ndarray, " c"], bins: AttitudeBins) -> CropPose | None:
    """A direct network's row for one crop.

    Args:
        output: (3 + bins.count,): offset x and y, log_depth, then the probability of each attitude class.
        bins: The attitude classes.

    Returns:
        None when a number is not finite.

    Raises:
        GknetError: The row has another length.
    """
    if output.shape != (3 + bins.count,):
        raise GknetError(f"direct network: expected {3 + bins.count} numbers for a crop, got shape {output.shape}")
    values = output.astype(np.float64)
    if not np.isfinite(values).all():
        return None
    log_depth = float(np.clip(values[2], -MAX_LOG_DEPTH, MAX_LOG_DEPTH))
    return CropPose(values[:2], log_depth, bins.attitude_wxyz(values[3:]))


@dataclass(frozen=True, eq=False)
class DirectEstimator(CropEstimator):
    """A `PoseEstimator` for one known spacecraft by direct pose regression, in one run of the network.

    Attributes:
        network: (b, 3, s, s) -> (b, 3 + bins.count), see `decode_output`.
        spacecraft: The spacecraft whose pose is estimated.
        bins: The attitude classes.
        locator: Finds the box; None if boxes are given.
        settings: How an image is processed.
    """

    network: Forward
    spacecraft: Spacecraft
    bins: AttitudeBins = field(default_factory=AttitudeBins)
    locator: Forward | None = None
    settings: InferenceSettings = field(default_factory=InferenceSettings)

    def estimate_in(self, image: UInt8[ndarray, "h w 3"], camera: Camera, box: Box) -> Estimate:
        """A pose without a covariance. Its keypoints are the projected points of the spacecraft: none was detected."""
        crop = Crop.around(box, self.settings.input_size)
        output = self.network(network_input(image, crop))[0]
        crop_pose = decode_output(output, self.bins)
        if crop_pose is None:
            return Estimate(box=box, failure=Failure(FailureKind.NOT_FINITE, "the network's output is not finite"))
        pose = crop_pose.pose(camera, crop, self.spacecraft.diameter_m)
        if pose is None:
            detail = "the network puts the spacecraft 90 degrees or more from the optical axis"
            return Estimate(box=box, failure=Failure(FailureKind.BEHIND_CAMERA, detail))
        contradiction = self.contradiction(pose, camera, crop)
        if contradiction is not None:
            return Estimate(box=box, failure=contradiction)
        pixels = camera.project(pose.transform(self.spacecraft.points_m))
        count = len(pixels)
        keypoints = Keypoints(pixels, np.ones(count), np.tile(np.eye(2) / crop.scale**2, (count, 1, 1)))
        return Estimate(keypoints, pose, box=box, attitude_confidence=attitude_confidence(pose, output[3:], self.bins))
