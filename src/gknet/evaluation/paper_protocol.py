"""The paper's way from heatmaps to a pose, for its tables: the highest cell of 32x32 (eq. 5), then plain PnP.

Whole cells, no covariance, no outlier rejection, and a crop made of the true keypoints. `KeypointEstimator` is more
accurate.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Failure, FailureKind, Keypoints
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.inference.network_io import KeypointForward, check_image, network_input
from gknet.spacecraft import Spacecraft

CELLS = 32
"""On a side of the paper's heatmaps; finer ones are averaged down to it, coarser ones are read as they are."""


@dataclass(frozen=True, eq=False)
class PaperEstimator:
    """A `PoseEstimator` by the paper's protocol. A box must be given: the paper's crops come from the annotations.

    Attributes:
        keypoint_network: (b, 3, s, s) -> heatmaps (b, n, s / stride, s / stride).
        spacecraft: The spacecraft whose pose is estimated.
        input_size: Side of the network's input in pixels.
    """

    keypoint_network: KeypointForward
    spacecraft: Spacecraft
    input_size: int = 256

    @property
    def has_locator(self) -> bool:
        """Never: the crops are made of the annotations."""
        return False

    def estimate(self, image: UInt8[ndarray, "h w *c"], camera: Camera, box: Box | None = None) -> Estimate:
        """The pose without a covariance. Any pose that the solver returns counts, as in the paper.

        Args:
            image: uint8, RGB or grey.
            camera: The camera of the image.
            box: About the true keypoints, in px of the image.

        Raises:
            GknetError: No box is given, or the image is of another kind.
        """
        if box is None:
            raise GknetError("the paper's protocol: expected the box of the true keypoints, got none")
        crop = Crop.around(box, self.input_size)
        heatmaps = self.keypoint_network(network_input(check_image(image), crop)).heatmaps[0]
        pixels = crop.to_image(highest_cells(heatmaps, self.input_size))
        count = len(pixels)
        keypoints = Keypoints(pixels, np.ones(count), np.tile(np.eye(2) / crop.scale**2, (count, 1, 1)))
        pose = plain_pnp(pixels, camera, self.spacecraft.points_m)
        if pose is None:
            return Estimate(keypoints, box=box, failure=Failure(FailureKind.NO_SOLUTION, "the solver found no pose"))
        inliers = np.ones(count, dtype=bool)
        off = camera.project(pose.transform(self.spacecraft.points_m)) - pixels
        return Estimate(keypoints, pose, None, inliers, float(np.sqrt((off**2).sum(axis=1).mean())), box)


def highest_cells(heatmaps: Float[ndarray, "n h w"], input_size: int) -> Float[ndarray, "n 2"]:
    """Eq. 5: the centre of the highest of 32 x 32 cells.

    Args:
        heatmaps: (n, h, h), h a multiple of 32, or less than 32.
        input_size: Side of the network's input in pixels.

    Returns:
        (n, 2) in pixels of the network's input.

    Raises:
        GknetError: h is another number.
    """
    count, side, _ = heatmaps.shape
    cells = min(CELLS, side)
    if side % cells:
        raise GknetError(f"the paper's protocol: expected heatmaps of {cells} cells or a multiple, got {side}")
    pooled = heatmaps.reshape(count, cells, side // cells, cells, side // cells).mean(axis=(2, 4))
    row, column = np.divmod(pooled.reshape(count, -1).argmax(axis=1), cells)
    return (np.stack([column, row], axis=1) + 0.5) * input_size / cells


def plain_pnp(pixels: Float[ndarray, "n 2"], camera: Camera, points_m: Float[ndarray, "n 3"]) -> Pose | None:
    """EPnP and Levenberg-Marquardt over all keypoints, outliers included.

    Args:
        pixels: (n, 2) in the image.
        camera: The camera of the image. Of a distorted one the pixels are undistorted first.
        points_m: (n, 3) in the body frame.

    Returns:
        cam_from_body, or None when OpenCV's solver finds none.
    """
    ideal = camera.undistort(pixels)
    finite = np.isfinite(ideal).all(axis=1)  # a fisheye has rays that no pinhole camera has
    ideal, points_m = ideal[finite], points_m[finite]
    try:
        found, turn, shift = cv2.solvePnP(points_m, ideal, camera.matrix, None, flags=cv2.SOLVEPNP_EPNP)
        if not found:
            return None
        turn, shift = cv2.solvePnPRefineLM(points_m, ideal, camera.matrix, None, turn, shift)
    except cv2.error:
        return None
    if not (np.isfinite(turn).all() and np.isfinite(shift).all()):
        return None
    rotation, _ = cv2.Rodrigues(turn)
    return Pose(rotation, shift.ravel())
