"""Where the spacecraft is: a box that is given or that the locator finds. An estimator then works in its crop."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Failure, FailureKind
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.inference.decode import decode_locator
from gknet.spacecraft import Spacecraft

Network = Callable[[Float32[ndarray, "b 3 size size"]], Float32[ndarray, "b c *cells"]]


class NetworkOutput(NamedTuple):
    """What a keypoint network answers.

    heatmaps   (b, n, h, w), channel k is keypoint k
    attitude   (b, k) shares of 1: its belief in each class of attitude (attitude.py); None of one that has none
    """

    heatmaps: Float32[ndarray, "b n h w"]
    attitude: Float32[ndarray, "b k"] | None = None


KeypointNetwork = Callable[[Float32[ndarray, "b 3 size size"]], NetworkOutput]

PLAUSIBLE_SIZE = (0.25, 6.0)
"""Projected diameter of the craft over the crop's side: less when it is seen end-on, more when it is cut off."""


@dataclass(frozen=True)
class InferenceSettings:
    """How an image is looked at.

    input_size     side of the input of the network that looks into the crop, in pixels
    locator_size   side of the locator's
    min_located    the locator's peak below which there is no spacecraft
    refine_crop    look once more where the keypoints say that the crop was off ...
    refine_iou     ... which is when the two crops overlap less than this
    tta_rotations  orientations, of 1, 2 or 4, in which a keypoint network sees the crop; it believes their mean
    """

    input_size: int = 256
    locator_size: int = 256
    min_located: float = 0.1
    refine_crop: bool = True
    refine_iou: float = 0.75
    tta_rotations: int = 1

    def __post_init__(self) -> None:
        if self.tta_rotations not in (1, 2, 4):
            raise GknetError(f"tta_rotations: expected 1, 2 or 4 orientations, got {self.tta_rotations}")


def check_image(image: object) -> UInt8[ndarray, "h w 3"]:
    """The image as RGB; grey ones are repeated into three channels."""
    if not isinstance(image, ndarray) or image.dtype != np.uint8:
        kind = image.dtype if isinstance(image, ndarray) else type(image).__name__
        raise GknetError(f"image: expected a uint8 array, got {kind}")
    if image.ndim == 2 and image.size > 0:
        return np.repeat(image[:, :, None], 3, axis=2)
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise GknetError(f"image: expected RGB of shape (h, w, 3) or grey of (h, w), got {image.shape}")
    return image


def network_input(image: UInt8[ndarray, "h w 3"], crop: Crop) -> Float32[ndarray, "1 3 size size"]:
    """The crop as a network sees it: RGB in [0, 1], channels first."""
    cut = crop.cut(image).transpose(2, 0, 1)[None]
    return np.ascontiguousarray(cut, dtype=np.float32) / np.float32(255)


class CropEstimator(ABC):
    """One image in, one `Estimate` out. Subclasses hold these fields and say what is done in the box.

    locator   (b, 3, s, s) -> (b, 5, s / stride, s / stride), see `decode_locator`; None if boxes are given
    """

    spacecraft: Spacecraft
    locator: Network | None
    settings: InferenceSettings

    @abstractmethod
    def estimate_in(self, image: UInt8[ndarray, "h w 3"], camera: Camera, box: Box) -> Estimate:
        """The pose of the spacecraft in the box, some of which is inside the image, or why there is none."""

    def estimate(self, image: UInt8[ndarray, "h w *c"], camera: Camera, box: Box | None = None) -> Estimate:
        """The pose of the spacecraft in an image, or why there is none.

        Args:
            image: (h, w, 3) RGB or (h, w) grey, uint8.
            camera: The camera of the image.
            box: A box in px about all keypoints, hidden ones too; None lets the locator find it.

        Raises:
            GknetError: The image is no such array or not of the camera's size, or there is neither box nor locator.
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
        """The spacecraft's box in pixels of the full image, None when the locator sees none."""
        if self.locator is None:
            raise GknetError("estimator: it has no locator; give a box")
        image = check_image(image)
        height, width = image.shape[:2]
        side = max(width, height)
        whole = Crop((width - side) // 2, (height - side) // 2, side, self.settings.locator_size)
        return self._locate_in(image, whole)

    def contradiction(self, cam_from_body: Pose, camera: Camera, crop: Crop) -> Failure | None:
        """Why a pose cannot belong to the crop that it was found in; None when it can."""
        range_m = np.linalg.norm(cam_from_body.translation_m)
        ratio = float(camera.matrix[0, 0] * self.spacecraft.diameter_m / range_m) / crop.side
        if PLAUSIBLE_SIZE[0] <= ratio <= PLAUSIBLE_SIZE[1]:
            return None
        return Failure(
            FailureKind.IMPLAUSIBLE_SIZE,
            f"the pose makes the spacecraft {ratio:.2g} times as large as its crop, "
            f"expected {PLAUSIBLE_SIZE[0]:g} to {PLAUSIBLE_SIZE[1]:g}",
        )

    def _locate_in(self, image: UInt8[ndarray, "h w 3"], crop: Crop) -> Box | None:
        if self.locator is None:
            return None
        output = self.locator(network_input(image, crop))[0]
        found = decode_locator(output, crop.size / output.shape[2], crop.size, self.settings.min_located)
        if found is None:
            return None
        seen = found[0]
        (x0, y0), (x1, y1) = crop.to_image(np.array([[seen.x0, seen.y0], [seen.x1, seen.y1]]))
        return Box(float(x0), float(y0), float(x1), float(y1)).clipped(image.shape[1], image.shape[0])
