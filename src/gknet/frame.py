"""What flows through gknet: a `Frame` goes in, an `Estimate` comes out."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.geometry import Camera, Pose
from gknet.spacecraft import Spacecraft


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in pixels of an image: [x0, x1] x [y0, y1].

    Attributes:
        x0: Left side in px.
        y0: Top side in px.
        x1: Right side in px, greater than x0.
        y1: Bottom side in px, greater than y0.

    Raises:
        GknetError: A side is not finite, or the box is empty.
    """

    x0: float
    y0: float
    x1: float
    y1: float

    def __post_init__(self) -> None:
        if not (np.isfinite([self.x0, self.y0, self.x1, self.y1]).all() and self.x1 > self.x0 and self.y1 > self.y0):
            raise GknetError(f"box: expected x0 < x1 and y0 < y1, got {self.x0}, {self.y0}, {self.x1}, {self.y1}")

    @staticmethod
    def around(pixels: Float[ndarray, "n 2"]) -> Box:
        """The bounding box of the finite points, at least one pixel wide and high.

        Args:
            pixels: (n, 2) points in px; NaN rows are left out.

        Raises:
            GknetError: No point is finite.
        """
        finite = pixels[np.isfinite(pixels).all(axis=1)]
        if len(finite) == 0:
            raise GknetError("box: no finite point to bound")
        low, high = finite.min(axis=0), finite.max(axis=0)
        grow = np.maximum(0, 1 - (high - low)) / 2
        (x0, y0), (x1, y1) = low - grow, high + grow
        return Box(float(x0), float(y0), float(x1), float(y1))

    @property
    def centre(self) -> tuple[float, float]:
        """x and y of the centre in px."""
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    @property
    def side(self) -> float:
        """Length of the longer side in px."""
        return max(self.x1 - self.x0, self.y1 - self.y0)

    @property
    def area(self) -> float:
        """Area in px^2."""
        return (self.x1 - self.x0) * (self.y1 - self.y0)

    def clipped(self, width: int, height: int) -> Box | None:
        """The part inside an image of width x height px, or None when the box lies outside."""
        x0, y0 = max(self.x0, 0.0), max(self.y0, 0.0)
        x1, y1 = min(self.x1, float(width)), min(self.y1, float(height))
        return Box(x0, y0, x1, y1) if x1 > x0 and y1 > y0 else None

    def iou(self, other: Box) -> float:
        """Intersection over union, 0 to 1."""
        width = min(self.x1, other.x1) - max(self.x0, other.x0)
        height = min(self.y1, other.y1) - max(self.y0, other.y0)
        if width <= 0 or height <= 0:
            return 0.0
        shared = width * height
        return shared / (self.area + other.area - shared)


@dataclass(frozen=True, eq=False)
class Frame:
    """One image and what is known of it.

    Attributes:
        name: Name of the image, for messages and files.
        image: (h, w, 3) uint8 RGB; None where only the labels were read.
        camera: The camera of this image.
        cam_from_body: The true pose; None when unknown.
        visible: (n,) bool for each keypoint: in view and not hidden by the spacecraft; None when unknown.
        sun_direction: (3,) unit vector to the sun in the camera frame; None when unknown.
        time_s: Time in s since the start of the sequence or video; None when unknown.
        earth_in_view: Whether a part of the Earth is in the image; None when unknown.
    """

    name: str
    image: UInt8[ndarray, "h w 3"] | None
    camera: Camera
    cam_from_body: Pose | None = None
    visible: Bool[ndarray, " n"] | None = None
    sun_direction: Float[ndarray, "3"] | None = None
    time_s: float | None = None
    earth_in_view: bool | None = None

    def keypoints_px(self, points_m: Float[ndarray, "n 3"]) -> Float[ndarray, "n 2"]:
        """The true keypoints in pixels, projected from the true pose.

        Args:
            points_m: (n, 3) keypoints in the body frame in m.

        Returns:
            (n, 2) in px of this image; NaN for a point behind the camera.

        Raises:
            GknetError: The frame has no true pose.
        """
        if self.cam_from_body is None:
            raise GknetError(f"frame {self.name}: it has no true pose")
        return self.camera.project(self.cam_from_body.transform(points_m))

    def true_box(self, points_m: Float[ndarray, "n 3"]) -> Box | None:
        """The part of the true keypoints' box that is inside the image, from which the oracle crop is cut.

        Args:
            points_m: (n, 3) keypoints in the body frame in m.

        Returns:
            The box in px, or None when no keypoint is inside the image.

        Raises:
            GknetError: The frame has no true pose.
        """
        pixels = self.keypoints_px(points_m)
        if not self.camera.contains(pixels).any():
            return None
        return Box.around(pixels).clipped(self.camera.width, self.camera.height)

    @property
    def range_m(self) -> float | None:
        """True distance from the camera to the body's origin in m; None without a true pose."""
        return None if self.cam_from_body is None else float(np.linalg.norm(self.cam_from_body.translation_m))

    @property
    def phase_angle_rad(self) -> float | None:
        """Angle at the spacecraft between the sun and the camera in rad, from 0 (lit from behind the camera) to pi."""
        if self.cam_from_body is None or self.sun_direction is None:
            return None
        to_camera = -self.cam_from_body.translation_m / np.linalg.norm(self.cam_from_body.translation_m)
        return float(np.arccos(np.clip(to_camera @ self.sun_direction, -1, 1)))


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Detected keypoints in pixels of the full image. Row k is keypoint k of the spacecraft, always.

    Attributes:
        pixels: (n, 2) x and y in px.
        score: (n,) height of the heatmap's peak, 0 (no peak) to 1.
        covariance_px2: (n, 2, 2) covariance of x and y in px^2.
    """

    pixels: Float[ndarray, "n 2"]
    score: Float[ndarray, " n"]
    covariance_px2: Float[ndarray, "n 2 2"]


class FailureKind(StrEnum):
    """Why there is no pose, as a word that a program can branch on. Files and tables hold the word.

    The first group comes from the input and the locator, the second from the pose solver, the third from the checks of
    a pose that was found.
    """

    UNREADABLE_IMAGE = "unreadable_image"
    """The image cannot be read."""
    CAMERA_MISMATCH = "camera_mismatch"
    """The camera is for images of another size."""
    NO_SPACECRAFT = "no_spacecraft"
    """The locator finds no spacecraft in the image."""
    NO_KEYPOINT_IN_VIEW = "no_keypoint_in_view"
    """By its labels, the image shows no keypoint."""
    BOX_OUTSIDE_IMAGE = "box_outside_image"
    """The box given has no part in the image."""
    NOT_FINITE = "not_finite"
    """The network's output is not finite."""

    TOO_FEW_KEYPOINTS = "too_few_keypoints"
    """Fewer keypoints than a pose needs have a sufficient score."""
    NO_CONSENSUS = "no_consensus"
    """No pose agrees with four keypoints."""
    NO_SOLUTION = "no_solution"
    """A solver without outlier rejection returned no pose."""

    TOO_FEW_INLIERS = "too_few_inliers"
    """A pose was found, but too few keypoints agree with it."""
    BEHIND_CAMERA = "behind_camera"
    """The pose puts the spacecraft behind the camera."""
    REPROJECTION_ERROR = "reprojection_error"
    """The keypoints lie too far from where the pose projects them."""
    DEGENERATE_GEOMETRY = "degenerate_geometry"
    """The keypoints that agree do not determine the pose, as when they lie on a line."""
    BOX_CONTRADICTION = "box_contradiction"
    """The pose, which few keypoints support, makes the spacecraft much larger or smaller than its box."""
    IMPLAUSIBLE_SIZE = "implausible_size"
    """The pose makes the spacecraft far larger or smaller than the crop it was found in."""

    @property
    def label(self) -> str:
        """The word as it is shown to people, with spaces instead of underscores."""
        return self.value.replace("_", " ")


@dataclass(frozen=True)
class Failure:
    """Why there is no pose. `str(failure)` is its detail.

    Attributes:
        kind: What a program branches on; the same cause always has the same kind.
        detail: One line for people, with the numbers of this image. Its wording may change between versions.
    """

    kind: FailureKind
    detail: str

    def __str__(self) -> str:
        return self.detail

    def to_dict(self) -> dict[str, str]:
        """Ready for JSON: `{"kind": ..., "detail": ...}`."""
        return {"kind": self.kind.value, "detail": self.detail}


AMBIGUOUS_BELOW = 0.5
"""An attitude confidence below this makes a pose ambiguous."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """The answer for one image: a pose, or the reason why there is none.

    Attributes:
        keypoints: As detected; of direct pose regression, which detects none, the projected model points. None when
            the spacecraft was not located.
        cam_from_body: The pose: p_cam = R p_body + t. None when there is none.
        covariance: (6, 6) of (rotation vector in rad, translation in m), both in the camera frame:
            R_true = exp([dw]x) R, t_true = t + dt. None without a pose, and of direct pose regression.
        inliers: (n,) bool: keypoints that the pose agrees with.
        reprojection_rms_px: Over the inliers, in px of the image.
        box: Where the spacecraft was searched for, in px of the image.
        failure: Why there is no pose; None exactly when there is one.
        attitude_confidence: 0 to 1: the probability that the network gives to attitudes within 60 degrees of the
            pose's. Below a half the pose may be that of a symmetric counterpart, whatever the covariance is. None when
            the network estimates no attitude distribution.
    """

    keypoints: Keypoints | None = None
    cam_from_body: Pose | None = None
    covariance: Float[ndarray, "6 6"] | None = None
    inliers: Bool[ndarray, " n"] | None = None
    reprojection_rms_px: float | None = None
    box: Box | None = None
    failure: Failure | None = None
    attitude_confidence: float | None = None

    def __post_init__(self) -> None:
        if (self.cam_from_body is None) != (self.failure is not None):
            raise GknetError("estimate: expected either a pose or the reason why there is none")

    @property
    def is_ambiguous(self) -> bool:
        """Whether the network gives a higher probability to other attitudes than to the pose's."""
        return self.attitude_confidence is not None and self.attitude_confidence < AMBIGUOUS_BELOW


class PoseEstimator(Protocol):
    """What estimates poses of one known spacecraft: by keypoints, by direct pose regression, or a class of your own.

    `gknet.load_estimator` returns one; prediction and evaluation take any.
    """

    @property
    def spacecraft(self) -> Spacecraft:
        """The spacecraft whose pose is estimated."""
        ...

    @property
    def has_locator(self) -> bool:
        """Whether `estimate` works without a box."""
        ...

    def estimate(self, image: UInt8[ndarray, "h w *c"], camera: Camera, box: Box | None = None) -> Estimate:
        """Estimate the pose of the spacecraft in an image.

        Args:
            image: uint8, RGB of shape (h, w, 3) or grey of shape (h, w).
            camera: The camera of the image; its width and height are the image's.
            box: Where the spacecraft is, in px of the image: about all keypoints, hidden ones too. None lets the
                locator find it.

        Returns:
            The pose, or an `Estimate` whose `failure` states why there is none.

        Raises:
            GknetError: The image is of another kind or size, or there is neither a box nor a locator.
        """
        ...


@dataclass(frozen=True)
class Unreadable:
    """An image that is listed but cannot be used, and why.

    Attributes:
        name: The image's name, as that of a `Frame`.
        failure: Why it cannot be used; its kind is `unreadable_image` unless there is a better one.
    """

    name: str
    failure: Failure

    @staticmethod
    def because(name: str, reason: object) -> Unreadable:
        """An image that cannot be read.

        Args:
            name: The image's name.
            reason: An error or a sentence; its text becomes the failure's detail.
        """
        return Unreadable(name, Failure(FailureKind.UNREADABLE_IMAGE, str(reason)))
