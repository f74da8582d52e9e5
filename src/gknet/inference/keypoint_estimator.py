"""One image in, one `Estimate` out, by keypoints: crop, network, decode, pose; and once more in a better crop."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Failure, Keypoints
from gknet.geometry import Camera
from gknet.inference.attitude import AttitudeBins
from gknet.inference.crop import Crop
from gknet.inference.crop_estimator import CropEstimator, InferenceSettings
from gknet.inference.crop_pose import attitude_confidence
from gknet.inference.decode import Decoding, decode_heatmaps, keypoints_to_image
from gknet.inference.network_io import Forward, KeypointForward, network_input
from gknet.inference.pnp import PnpSettings, solve_pnp
from gknet.spacecraft import Spacecraft

CERTAIN_SCORE = 0.3
"""Without a pose, keypoints from this score on decide where a better crop is."""


@dataclass(frozen=True, eq=False)
class KeypointEstimator(CropEstimator):
    """A `PoseEstimator` for one known spacecraft, by its keypoints.

    Attributes:
        keypoint_network: (b, 3, s, s) -> heatmaps (b, n, s / stride, s / stride), channel k is keypoint k, and perhaps
            probabilities of attitude classes.
        spacecraft: The spacecraft whose pose is estimated.
        locator: Finds the box; None if boxes are given.
        settings: How an image is processed.
        decoding: How heatmaps become keypoints with covariances.
        pnp: When a pose is accepted.
        bins: The attitude classes; None for a network without them.
    """

    keypoint_network: KeypointForward
    spacecraft: Spacecraft
    locator: Forward | None = None
    settings: InferenceSettings = field(default_factory=InferenceSettings)
    decoding: Decoding = field(default_factory=Decoding)
    pnp: PnpSettings = field(default_factory=PnpSettings)
    bins: AttitudeBins | None = None

    def estimate_in(self, image: UInt8[ndarray, "h w 3"], camera: Camera, box: Box) -> Estimate:
        """The pose in a box; of two crops, the one whose pose more keypoints support."""
        crop = Crop.around(box, self.settings.input_size)
        keypoints, attitude = self.detect(image, crop)
        first = self.pose_of(keypoints, camera, box, crop, attitude)
        better_crop = self._better_crop(first, camera, crop)
        if better_crop is None:
            return first
        keypoints, attitude = self.detect(image, better_crop)
        second = self.pose_of(keypoints, camera, box, better_crop, attitude, trust_box=False)
        return second if _support(second) >= _support(first) else first

    def detect(self, image: UInt8[ndarray, "h w 3"], crop: Crop) -> tuple[Keypoints, Float32[ndarray, " k"] | None]:
        """Detect the keypoints in a crop.

        Args:
            image: The full image, RGB.
            crop: The part that is the network's input.

        Returns:
            The keypoints in pixels of the full image, and the probabilities (k,) of the attitude classes, None for a
            network without them.

        Raises:
            GknetError: The network has another number of heatmaps or classes than the spacecraft and `bins`.
        """
        heatmaps, attitude = self._averaged_output(network_input(image, crop))
        if len(heatmaps) != self.spacecraft.keypoint_count:
            raise GknetError(
                f"keypoint network: expected {self.spacecraft.keypoint_count} heatmaps for {self.spacecraft.name}, "
                f"got {len(heatmaps)}"
            )
        if attitude is not None and self.bins is not None and len(attitude) != self.bins.count:
            raise GknetError(f"keypoint network: expected {self.bins.count} classes of attitude, got {len(attitude)}")
        keypoints = decode_heatmaps(heatmaps, crop.size / heatmaps.shape[2], self.decoding)
        return keypoints_to_image(keypoints, crop), attitude

    def _averaged_output(
        self, upright: Float32[ndarray, "1 3 s s"]
    ) -> tuple[Float32[ndarray, "n hs ws"], Float32[ndarray, " k"] | None]:
        """Heatmaps: the mean over rotations of the crop, each rotated back. Attitude: that of the upright crop."""
        rotations = range(0, 4, 4 // self.settings.tta_rotations)
        views = np.concatenate([np.rot90(upright, turn, (2, 3)) for turn in rotations])
        output = self.keypoint_network(views)
        upright_maps = [np.rot90(maps, -turn, (1, 2)) for maps, turn in zip(output.heatmaps, rotations, strict=True)]
        return np.mean(upright_maps, axis=0), None if output.attitude is None else output.attitude[0]

    def pose_of(
        self,
        keypoints: Keypoints,
        camera: Camera,
        box: Box,
        crop: Crop,
        attitude: Float32[ndarray, " k"] | None = None,
        trust_box: bool = True,
    ) -> Estimate:
        """The pose that explains keypoints detected in a crop, or why there is none.

        Args:
            keypoints: In pixels of the full image.
            camera: The camera of the full image.
            box: Where the spacecraft was found.
            crop: Where the keypoints were detected.
            attitude: (k,) probabilities of the attitude classes, from that crop.
            trust_box: Whether the box is a measurement of the pose; not one that the keypoints contradicted.
        """
        measured = box if trust_box else None
        result = solve_pnp(keypoints, camera, self.spacecraft.points_m, 1 / crop.scale, self.pnp, measured)
        if isinstance(result, Failure):
            return Estimate(keypoints, box=box, failure=result)
        contradiction = self.contradiction(result.cam_from_body, camera, crop)
        if contradiction is not None:
            return Estimate(keypoints, box=box, failure=contradiction)
        return Estimate(
            keypoints,
            result.cam_from_body,
            result.covariance,
            result.inliers,
            result.reprojection_rms_px,
            box,
            attitude_confidence=attitude_confidence(result.cam_from_body, attitude, self.bins),
        )

    def _better_crop(self, estimate: Estimate, camera: Camera, crop: Crop) -> Crop | None:
        """The crop about the keypoints found, when it overlaps little with the one they were found in."""
        if not self.settings.refine_crop or estimate.keypoints is None:
            return None
        if estimate.cam_from_body is not None:
            pixels = camera.project(estimate.cam_from_body.transform(self.spacecraft.points_m))
        else:
            pixels = estimate.keypoints.pixels[estimate.keypoints.score >= CERTAIN_SCORE]
        if np.isfinite(pixels).all(axis=1).sum() < 4:
            return None
        inside = Box.around(pixels).clipped(camera.width, camera.height)
        if inside is None:
            return None
        better = Crop.around(inside, crop.size)
        return better if better.box.iou(crop.box) < self.settings.refine_iou else None


def _support(estimate: Estimate) -> float:
    """How much evidence a pose has: the scores of the keypoints that agree with it; -1 without a pose."""
    if estimate.keypoints is None or estimate.inliers is None:
        return -1.0
    return float(estimate.keypoints.score[estimate.inliers].sum())
