"""What estimators share that work in a crop: the box, given or located, and the check of a pose against the crop."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Failure, FailureKind
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.inference.locator import locate
from gknet.inference.network_io import Forward, check_image
from gknet.spacecraft import Spacecraft

MAX_INPUT_SIZE = 4096
"""Side of the largest input of a network in pixels."""

PLAUSIBLE_SIZE = (0.25, 6.0)
"""Projected diameter of the spacecraft over the crop's side: small for a view end-on, large when cut off."""


@dataclass(frozen=True)
class InferenceSettings:
    """How an estimator processes an image.

    Attributes:
        input_size: Side in pixels of the network's input, into which the crop is resized.
        locator_size: Side in pixels of the locator's input.
        min_located: Height of the locator's peak below which there is no spacecraft, 0 to 1.
        refine_crop: Run the network again in a better crop, where the keypoints show that the first one was off.
        refine_iou: Intersection over union of the two crops below which the first one counts as off.
        tta_rotations: Rotations of the crop, 1, 2 or 4, whose heatmaps a keypoint network averages (rotation test-time
            augmentation).

    Raises:
        GknetError: A number is out of its range.
    """

    input_size: int = 256
    locator_size: int = 256
    min_located: float = 0.1
    refine_crop: bool = True
    refine_iou: float = 0.75
    tta_rotations: int = 1

    def __post_init__(self) -> None:
        if self.tta_rotations not in (1, 2, 4):
            raise GknetError(f"tta_rotations: expected 1, 2 or 4 rotations, got {self.tta_rotations}")
        for name in ("input_size", "locator_size"):
            if not 1 <= getattr(self, name) <= MAX_INPUT_SIZE:
                raise GknetError(f"{name}: expected 1 to {MAX_INPUT_SIZE} px, got {getattr(self, name)}")
        for name in ("min_located", "refine_iou"):
            if not 0 <= getattr(self, name) <= 1:
                raise GknetError(f"{name}: expected 0 to 1, got {getattr(self, name)}")


class CropEstimator(ABC):
    """One image in, one `Estimate` out: the base of the `PoseEstimator`s that work in a crop about the spacecraft.

    Subclasses are dataclasses with these fields, and implement `estimate_in`.

    Attributes:
        spacecraft: The spacecraft whose pose is estimated.
        locator: (b, 3, s, s) -> (b, 5, s / stride, s / stride), see `gknet.inference.locator`; None if boxes are given.
        settings: How an image is processed.
    """

    spacecraft: Spacecraft
    locator: Forward | None
    settings: InferenceSettings

    @property
    def has_locator(self) -> bool:
        """Whether `estimate` works without a box."""
        return self.locator is not None

    @abstractmethod
    def estimate_in(self, image: UInt8[ndarray, "h w 3"], camera: Camera, box: Box) -> Estimate:
        """The pose of the spacecraft in a box inside the image, or why there is none.

        Args:
            image: The full image, RGB.
            camera: The camera of the image.
            box: Where the spacecraft is, clipped to the image.
        """

    def estimate(self, image: UInt8[ndarray, "h w *c"], camera: Camera, box: Box | None = None) -> Estimate:
        """Estimate the pose of the spacecraft in an image.

        Args:
            image: uint8, RGB of shape (h, w, 3) or grey of shape (h, w).
            camera: The camera of the image; its width and height are the image's.
            box: Where the spacecraft is, in pixels of the image; None lets the locator find it.

        Returns:
            The pose, or an `Estimate` whose `failure` states why there is none.

        Raises:
            GknetError: The image is of another kind or size, or there is neither a box nor a locator.
        """
        image = check_image(image)
        if image.shape[:2] != (camera.height, camera.width):
            raise GknetError(
                f"image: expected the camera's {camera.width} x {camera.height} pixels, "
                f"got {image.shape[1]} x {image.shape[0]}"
            )
        box = box or self.locate(image)
        if box is None:
            return Estimate(failure=Failure(FailureKind.NO_SPACECRAFT, "the locator finds no spacecraft"))
        inside = box.clipped(camera.width, camera.height)
        if inside is None:
            return Estimate(box=box, failure=Failure(FailureKind.BOX_OUTSIDE_IMAGE, "the box lies outside the image"))
        return self.estimate_in(image, camera, inside)

    def locate(self, image: UInt8[ndarray, "h w *c"]) -> Box | None:
        """Find the spacecraft.

        Args:
            image: uint8, RGB or grey.

        Returns:
            The box in pixels of the image, None when the locator finds no spacecraft.

        Raises:
            GknetError: The image is of another kind, or there is no locator.
        """
        if self.locator is None:
            raise GknetError("estimator: it has no locator; give a box")
        return locate(check_image(image), self.locator, self.settings.locator_size, self.settings.min_located)

    def contradiction(self, cam_from_body: Pose, camera: Camera, crop: Crop) -> Failure | None:
        """Why a pose cannot belong to the crop in which it was found; None when it can.

        Args:
            cam_from_body: The pose.
            camera: The camera of the full image.
            crop: Where it was found.
        """
        range_m = np.linalg.norm(cam_from_body.translation_m)
        ratio = float(camera.matrix[0, 0] * self.spacecraft.diameter_m / range_m) / crop.side
        if PLAUSIBLE_SIZE[0] <= ratio <= PLAUSIBLE_SIZE[1]:
            return None
        return Failure(
            FailureKind.IMPLAUSIBLE_SIZE,
            f"the pose makes the spacecraft {ratio:.2g} times as large as its crop, "
            f"expected {PLAUSIBLE_SIZE[0]:g} to {PLAUSIBLE_SIZE[1]:g}",
        )
