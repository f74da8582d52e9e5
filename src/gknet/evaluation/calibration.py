"""Covariances of keypoints and poses, fitted to the errors on a validation split.

Two steps. A keypoint's covariance is a floor and a factor times the spread that follows from its peak; both are fitted
to the keypoints' errors. Then the pose's covariance gets one factor, since keypoints of one image err alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.optimize import minimize, minimize_scalar
from scipy.stats import chi2

from gknet.errors import GknetError
from gknet.evaluation.metrics import nees
from gknet.frame import Box, Estimate, Frame, Keypoints
from gknet.inference.crop import Crop
from gknet.inference.decode import Decoding
from gknet.inference.keypoint_estimator import KeypointEstimator
from gknet.inference.network_io import check_image

STUDENT_DOF = 4.0
"""Degrees of freedom of the fitted Student distribution: its tails leave room for keypoint swaps."""

MIN_SAMPLES = 30
"""The fewest keypoints, and the fewest poses, to fit to."""

UNCALIBRATED = Decoding(floor_cells=1e-3, spread_scale=1.0)
"""A decoding whose covariance is the spread that follows from a peak, and no more."""


@dataclass(frozen=True, eq=False)
class CalibrationSample:
    """What a network detected in a frame's oracle crop.

    Attributes:
        frame: The frame with its true pose, without its image.
        box: The true box, from which the crop was made.
        crop: The oracle crop.
        keypoints: In pixels of the image, their covariance `UNCALIBRATED`.
        cells_per_px: Cells of the heatmap per image pixel.
    """

    frame: Frame
    box: Box
    crop: Crop
    keypoints: Keypoints
    cells_per_px: float

    def decoded(self, decoding: Decoding) -> Keypoints:
        """The keypoints with the covariance of another decoding."""
        floor = (decoding.floor_cells / self.cells_per_px) ** 2 * np.eye(2)
        return replace(self.keypoints, covariance_px2=decoding.spread_scale * self.keypoints.covariance_px2 + floor)

    def estimate(self, estimator: KeypointEstimator) -> Estimate:
        """The pose, without running the network again."""
        return estimator.pose_of(self.decoded(estimator.decoding), self.frame.camera, self.box, self.crop)


def collect_sample(frame: Frame, uncalibrated: KeypointEstimator, stride: float) -> CalibrationSample:
    """Detect the keypoints in a frame's oracle crop.

    Args:
        frame: With its image and true pose.
        uncalibrated: An estimator whose decoding is `UNCALIBRATED`.
        stride: Input pixels per cell of its network.

    Raises:
        GknetError: No keypoint is in view, or the frame has no image.
    """
    box = frame.true_box(uncalibrated.spacecraft.points_m)
    if box is None:
        raise GknetError(f"frame {frame.name}: no keypoint is in view, so there is nothing to calibrate on")
    crop = Crop.around(box, uncalibrated.settings.input_size)
    keypoints, _ = uncalibrated.detect(check_image(frame.image), crop)
    return CalibrationSample(replace(frame, image=None), box, crop, keypoints, crop.scale / stride)


def calibrated(estimator: KeypointEstimator, samples: Sequence[CalibrationSample]) -> KeypointEstimator:
    """The estimator with a decoding and a covariance scale that fit its errors.

    Args:
        estimator: Whose network made the samples.
        samples: From frames of a validation split.

    Returns:
        The calibrated estimator. The pose's covariance is left alone where there are fewer than 30 poses.

    Raises:
        GknetError: There are fewer than 30 detected keypoints in view.
    """
    points_m = estimator.spacecraft.points_m
    errors, spreads = [], []
    for sample in samples:
        true_px = sample.frame.keypoints_px(points_m)
        use = sample.frame.camera.contains(true_px) & (sample.keypoints.score >= estimator.pnp.min_score)
        errors.append((sample.keypoints.pixels - true_px)[use] * sample.cells_per_px)
        spreads.append(sample.keypoints.covariance_px2[use] * sample.cells_per_px**2)
    if sum(len(error) for error in errors) < MIN_SAMPLES:
        raise GknetError(f"calibration: expected at least {MIN_SAMPLES} detected keypoints in view")
    decoding = fit_decoding(np.concatenate(errors), np.concatenate(spreads))
    estimator = replace(estimator, decoding=decoding, pnp=replace(estimator.pnp, covariance_scale=1.0))
    squared = [
        found
        for sample in samples
        if sample.frame.cam_from_body is not None
        and (found := nees(sample.frame.cam_from_body, sample.estimate(estimator))) is not None
    ]
    if len(squared) < MIN_SAMPLES:
        return estimator
    scale = float(np.median(squared) / chi2.ppf(0.5, 6))
    return replace(estimator, pnp=replace(estimator.pnp, covariance_scale=scale))


def fit_decoding(error_cells: Float[ndarray, "k 2"], spread_cells2: Float[ndarray, "k 2 2"]) -> Decoding:
    """The floor and the factor on the spread under which the errors are most likely.

    A Student distribution is fitted, then scaled so that errors without outliers would give back their covariance.

    Args:
        error_cells: (k, 2) detected minus true positions, in cells of the heatmap.
        spread_cells2: (k, 2, 2) the uncalibrated covariances.
    """

    def cost(log_parameters: Float[ndarray, "2"]) -> float:
        floor2, scale = np.exp(log_parameters)
        covariance = scale * spread_cells2 + floor2 * np.eye(2)
        squared = np.einsum("ki,kij,kj->k", error_cells, np.linalg.inv(covariance), error_cells)
        return float((np.log(np.linalg.det(covariance)) / 2 + _student(squared)).mean())

    start = np.log([np.median((error_cells**2).sum(axis=1)) / chi2.ppf(0.5, 2) + 1e-4, 0.5])
    bounds = [(np.log(1e-4), np.log(1e2)), (np.log(1e-3), np.log(1e2))]
    floor2, scale = np.exp(minimize(cost, start, method="L-BFGS-B", bounds=bounds).x) / _student_of_gaussian()
    return Decoding(floor_cells=float(np.sqrt(floor2)), spread_scale=float(scale))


def _student(squared: Float[ndarray, " k"]) -> Float[ndarray, " k"]:
    """Negative logarithm of the Student density of two dimensions, of squared Mahalanobis distances."""
    return (STUDENT_DOF + 2) / 2 * np.log1p(squared / STUDENT_DOF)


@cache
def _student_of_gaussian() -> float:
    """The factor on its covariance that the Student fit gives to a Gaussian sample: 0.73."""
    squared = chi2.ppf((np.arange(4000) + 0.5) / 4000, 2)
    return float(minimize_scalar(lambda s: np.log(s) + _student(squared / s).mean(), (0.5, 1.0)).x)
