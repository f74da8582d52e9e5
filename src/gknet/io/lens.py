"""Where the camera of an image comes from: a calibration of its size, of another size, or the field of view alone."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gknet.errors import GknetError
from gknet.geometry import Camera, LensModel

FARTHEST_CENTRE = 0.1
"""A principal point further than this share of the image's side from its middle belongs to another image size."""


@dataclass(frozen=True, eq=False)
class MatrixOnly:
    """A calibration whose image size is not known from its file.

    Attributes:
        matrix: (3, 3) K in pixels.
        source: the file it came from, which errors name.
        distortion: as `Camera.distortion`.
        model: as `Camera.model`.

    Raises:
        GknetError: the numbers are no camera.
    """

    matrix: Float[ndarray, "3 3"]
    source: str
    distortion: Float[ndarray, " k"] = field(default_factory=lambda: np.zeros(5))
    model: LensModel = "pinhole"

    def __post_init__(self) -> None:
        self.of_size(1, 1)

    def of_size(self, width: int, height: int) -> Camera:
        """The camera, when the calibration is known to be for images of `width` x `height` pixels."""
        try:
            return Camera(self.matrix, width, height, self.distortion, self.model)
        except GknetError as error:
            raise GknetError(f"{self.source}: {error}") from error

    def camera(self, width: int, height: int) -> Camera:
        """The camera of an image.

        Raises:
            GknetError: the principal point is so far from the image's middle that the calibration is of another size.
        """
        x, y = self.matrix[:2, 2]
        if abs(x / width - 0.5) <= FARTHEST_CENTRE and abs(y / height - 0.5) <= FARTHEST_CENTRE:
            return self.of_size(width, height)
        fits = f"{2 * x:.0f}x{2 * y:.0f}"
        raise GknetError(
            f"{self.source}: its principal point ({x:g}, {y:g}) is that of an image of about {fits} pixels, the image "
            f"has {width}x{height}; give the calibration's size, --camera-size {fits}, with --scale-camera if the "
            f"image was resized, or --camera-size {width}x{height} if the matrix is right as it is"
        )


@dataclass(frozen=True)
class FieldOfView:
    """A camera with square pixels and no distortion whose axis meets the image in its middle.

    Attributes:
        focal_px: the focal length in pixels; either this is given, or
        horizontal_rad: the horizontal field of view in radians.
    """

    focal_px: float | None = None
    horizontal_rad: float | None = None

    def __post_init__(self) -> None:
        if (self.focal_px is None) == (self.horizontal_rad is None):
            raise GknetError("camera: give either a focal length in pixels or a horizontal field of view")
        if self.focal_px is not None and not (math.isfinite(self.focal_px) and self.focal_px > 0):
            raise GknetError(f"focal length: expected a positive number of pixels, got {self.focal_px}")
        if self.horizontal_rad is not None and not 0 < self.horizontal_rad < math.pi:
            degrees = math.degrees(self.horizontal_rad)
            raise GknetError(f"field of view: expected between 0 and 180 degrees, got {degrees:g}")

    def camera(self, width: int, height: int) -> Camera:
        """The camera of an image of `width` x `height` pixels."""
        focal = self.focal_px or width / 2 / math.tan((self.horizontal_rad or 0.0) / 2)
        return Camera.from_focal(focal, width, height)


@dataclass(frozen=True)
class ScaledCamera:
    """A calibration whose images were resized after they were taken.

    Attributes:
        calibrated: the camera at the size it was calibrated at.
    """

    calibrated: Camera

    def camera(self, width: int, height: int) -> Camera:
        """The camera of an image of `width` x `height` pixels, see `Camera.scaled`."""
        return self.calibrated.scaled(width, height)


Lens = Camera | MatrixOnly | FieldOfView | ScaledCamera
"""What gives an image its camera. All but a `Camera` learn the image size from the image."""


def camera_for(lens: Lens, width: int, height: int, scale: bool = False) -> Camera:
    """The camera of an image.

    Args:
        lens: where the camera comes from.
        width: of the image, in pixels.
        height: of the image, in pixels.
        scale: scale a camera that was calibrated at another size, for images that were resized.

    Raises:
        GknetError: the camera was made for another size, and `scale` is not set or the aspect ratio differs.
    """
    if not isinstance(lens, Camera):
        return lens.camera(width, height)
    if (lens.width, lens.height) == (width, height):
        return lens
    if scale:
        return lens.scaled(width, height)
    raise GknetError(
        f"camera: it is for {lens.width} x {lens.height} pixels, the image has {width} x {height}; "
        "give --scale-camera if the image was resized"
    )


def has_fixed_focal_length(lens: Lens) -> bool:
    """Whether images of any size get the same focal length in pixels, which is right for one size alone."""
    return isinstance(lens, MatrixOnly) or (isinstance(lens, FieldOfView) and lens.focal_px is not None)


def sized_lens(lens: Lens, size: tuple[int, int] | None, scale: bool) -> Lens:
    """A lens as the options --camera-size and --scale-camera change it.

    Args:
        lens: what a camera file gave.
        size: width and height that the calibration is for, where its file does not state them.
        scale: the images were resized, so the camera follows their size.

    Raises:
        GknetError: the file states another size, or an option is missing or has nothing to work on.
    """
    if size is not None:
        if isinstance(lens, MatrixOnly):
            lens = lens.of_size(*size)
        elif not isinstance(lens, Camera) or (lens.width, lens.height) != size:
            states = f"it is for {lens.width}x{lens.height}" if isinstance(lens, Camera) else "it fits every size"
            raise GknetError(f"--camera-size {size[0]}x{size[1]}: the camera states its own size, {states}")
    if not scale:
        return lens
    if isinstance(lens, MatrixOnly):
        raise GknetError(f"{lens.source}: --scale-camera needs the size of the calibration: give --camera-size WxH")
    return ScaledCamera(lens) if isinstance(lens, Camera) else lens
