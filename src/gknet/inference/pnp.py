"""Keypoints to a pose with its covariance: PoseLib's LO-RANSAC, then a robust refinement whitened by covariances.

The box in which the spacecraft was found is a measurement too: it fixes the range where keypoints leave it open.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import poselib
from jaxtyping import Bool, Float
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Failure, FailureKind, Keypoints
from gknet.geometry import LARGEST_PX, Camera, Pose
from gknet.inference.refine_pose import BoxEdges, PnpProblem, covariance_of, refine, residuals_px


@dataclass(frozen=True)
class PnpSettings:
    """When a pose is accepted. Pixels here are those of the network's input; `solve_pnp` is given their size.

    Attributes:
        min_score: Keypoints with a lower score are not used.
        threshold_px: A keypoint nearer than this to its projection is an inlier; tried in order until a pose is found.
        min_inliers: The fewest inliers of a pose,
        min_inlier_fraction: And the smallest part of the keypoints used that they are.
        max_rms_px: Of the inliers' reprojection errors.
        box_sigma: Standard deviation of a side of the spacecraft's box, in parts of the box's longer side.
        max_box_ratio: Of the pose's extent to the box's along the box's longer side, either way, for a pose that less
            than half of the spacecraft's keypoints agree with.
        covariance_scale: Factor on the pose's covariance: keypoints of one image err alike, more than independent
            ones. From the calibration on a validation split.

    Raises:
        GknetError: A number is out of its range.
    """

    min_score: float = 0.15
    threshold_px: tuple[float, ...] = (5.0, 12.0)
    min_inliers: int = 5
    min_inlier_fraction: float = 0.3
    max_rms_px: float = 10.0
    box_sigma: float = 0.1
    max_box_ratio: float = 2.0
    covariance_scale: float = 1.0

    def __post_init__(self) -> None:
        if not self.threshold_px or not all(0 < threshold < np.inf for threshold in self.threshold_px):
            raise GknetError(f"pnp: expected positive thresholds, got {self.threshold_px}")
        if not 0 <= self.min_score <= 1:
            raise GknetError(f"pnp: expected a least score of 0 to 1, got {self.min_score}")
        if not (self.min_inliers >= 4 and 0 <= self.min_inlier_fraction <= 1):
            raise GknetError(
                "pnp: expected 4 inliers or more and a fraction of 0 to 1, "
                f"got {self.min_inliers} and {self.min_inlier_fraction}"
            )
        if not self.max_rms_px > 0:
            raise GknetError(f"pnp: expected a positive limit of the rms, got {self.max_rms_px}")
        if not 0 < self.box_sigma < np.inf:
            raise GknetError(f"pnp: expected a positive sigma of the box, got {self.box_sigma}")
        if not self.max_box_ratio > 1:
            raise GknetError(f"pnp: expected a ratio to the box above 1, got {self.max_box_ratio}")
        if not 0 < self.covariance_scale < np.inf:
            raise GknetError(f"pnp: expected a positive covariance scale, got {self.covariance_scale}")


@dataclass(frozen=True, eq=False)
class PnpResult:
    """A pose that was accepted.

    Attributes:
        cam_from_body: The pose.
        covariance: (6, 6) of (rotation vector in rad, translation in m), as `Estimate.covariance`.
        inliers: (n,) bool: keypoints that the pose agrees with.
        reprojection_rms_px: Over the inliers, in image pixels.
    """

    cam_from_body: Pose
    covariance: Float[ndarray, "6 6"]
    inliers: Bool[ndarray, " n"]
    reprojection_rms_px: float


def solve_pnp(
    keypoints: Keypoints,
    camera: Camera,
    points_m: Float[ndarray, "n 3"],
    input_px: float = 1.0,
    settings: PnpSettings | None = None,
    box: Box | None = None,
) -> PnpResult | Failure:
    """The pose that explains the keypoints, or why there is none.

    The same input gives the same bits: the sampling has a fixed seed.

    Args:
        keypoints: Detected, in pixels of the image; row k belongs to point k.
        camera: The camera of the image.
        points_m: (n, 3) in the body frame, in metres.
        input_px: Size of one pixel of the network's input in image pixels (1 / `Crop.scale`).
        settings: When a pose is accepted; None for the defaults.
        box: About all keypoints, hidden or not, clipped to the image: it determines the range where keypoints leave it
            open. None where no box was measured.

    Raises:
        GknetError: There is not one keypoint for each point, or a point is not finite.
    """
    settings = settings or PnpSettings()
    if len(points_m) != len(keypoints.score):
        raise GknetError(f"pnp: expected {len(points_m)} keypoints, one for each point, got {len(keypoints.score)}")
    if not np.isfinite(points_m).all():
        raise GknetError("pnp: expected finite points, got NaN or infinity")
    usable = _usable(keypoints, settings.min_score)
    if usable.sum() < 4:
        return Failure(
            FailureKind.TOO_FEW_KEYPOINTS,
            f"only {usable.sum()} keypoints have a score of {settings.min_score:g} or more, a pose needs 4",
        )
    problem = PnpProblem(
        points_m,
        np.flatnonzero(usable),
        keypoints.pixels[usable],
        np.linalg.inv(keypoints.covariance_px2[usable]),
        camera,
        None if box is None else BoxEdges.of(box, camera, settings.box_sigma),
    )
    result: PnpResult | Failure = Failure(FailureKind.NO_CONSENSUS, "no keypoint threshold was tried")
    alone = replace(problem, edges=None)  # a wrong box must not cost the pose
    for each in (alone,) if box is None else (problem, alone):
        for threshold in settings.threshold_px:
            result = _solve(each, keypoints.score[usable], threshold * input_px, input_px, settings)
            if isinstance(result, PnpResult) and problem.edges is not None:
                result = _against_box(problem, problem.edges, result, settings.max_box_ratio)
            if isinstance(result, PnpResult):
                inliers = np.zeros(len(usable), dtype=bool)
                inliers[usable] = result.inliers
                return PnpResult(result.cam_from_body, result.covariance, inliers, result.reprojection_rms_px)
    return result


def _against_box(problem: PnpProblem, edges: BoxEdges, result: PnpResult, max_ratio: float) -> PnpResult | Failure:
    """The result, or a failure when few keypoints support it and its size differs from the box's.

    A box whose longer side is cut by the image's border measures no size.
    """
    if 2 * result.inliers.sum() >= len(problem.points_m):
        return result
    low, high = edges.at_px[:2], edges.at_px[2:]
    axis = int((high - low).argmax())
    pixels = problem.camera.project(result.cam_from_body.transform(problem.points_m))[:, axis]
    if not (edges.inside[axis] and edges.inside[axis + 2] and np.isfinite(pixels).all()):
        return result
    ratio = np.ptp(pixels) / (high - low)[axis]
    if 1 / max_ratio <= ratio <= max_ratio:
        return result
    return Failure(
        FailureKind.BOX_CONTRADICTION,
        f"the pose of only {result.inliers.sum()} keypoints makes the spacecraft {ratio:.2g} times as large as its box",
    )


def _usable(keypoints: Keypoints, min_score: float) -> Bool[ndarray, " n"]:
    """Keypoints with a sufficient score whose position and covariance are numbers that an image can have."""
    covariance = keypoints.covariance_px2
    known = (np.abs(keypoints.pixels) <= LARGEST_PX).all(axis=1) & (np.abs(covariance) <= LARGEST_PX**2).all(
        axis=(1, 2)
    )
    known[known] = np.linalg.det(covariance[known]) > 0
    return known & (keypoints.score >= min_score)


def _solve(
    problem: PnpProblem, score: Float[ndarray, " k"], threshold_px: float, input_px: float, settings: PnpSettings
) -> PnpResult | Failure:
    """One round: consensus, refinement, then the checks of the pose."""
    start = _consensus(problem, score, threshold_px)
    if start is None:
        return Failure(FailureKind.NO_CONSENSUS, "no pose agrees with enough keypoints")
    near = residuals_px(problem, start) < 2 * threshold_px
    pose = refine(problem, start, near)
    error = residuals_px(problem, pose)
    inliers = error < threshold_px
    needed = max(min(settings.min_inliers, len(score)), int(np.ceil(settings.min_inlier_fraction * len(score))))
    if inliers.sum() < needed:
        return Failure(
            FailureKind.TOO_FEW_INLIERS,
            f"only {inliers.sum()} of {len(score)} keypoints agree with one pose, expected {needed}",
        )
    if (pose.transform(problem.usable_m)[inliers, 2] <= 0).any():
        return Failure(FailureKind.BEHIND_CAMERA, "the pose puts the spacecraft behind the camera")
    rms = float(np.sqrt((error[inliers] ** 2).mean()))
    if rms > settings.max_rms_px * input_px:
        limit = settings.max_rms_px * input_px
        return Failure(
            FailureKind.REPROJECTION_ERROR,
            f"the keypoints lie {rms:.1f} px rms from where the pose projects them, expected at most {limit:.1f}",
        )
    covariance = covariance_of(problem, pose, inliers)
    if covariance is None:
        return Failure(FailureKind.DEGENERATE_GEOMETRY, "the keypoints do not determine the pose (they lie on a line)")
    return PnpResult(pose, settings.covariance_scale * covariance, inliers, rms)


def _consensus(problem: PnpProblem, score: Float[ndarray, " k"], threshold_px: float) -> Pose | None:
    """LO-RANSAC on undistorted pixels, the keypoints of the highest score first."""
    matrix = problem.camera.matrix
    ideal = problem.camera.undistort(problem.pixels)
    order = np.argsort(-score, kind="stable")
    order = order[np.isfinite(ideal[order]).all(axis=1)]  # a fisheye sees rays that no pinhole camera has
    if len(order) < 4:
        return None
    found, report = poselib.estimate_absolute_pose(
        ideal[order],
        problem.usable_m[order],
        {
            "model": "PINHOLE",
            "width": problem.camera.width,
            "height": problem.camera.height,
            "params": [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]],
        },
        {"max_reproj_error": threshold_px, "max_iterations": 1000, "min_iterations": 50, "seed": 0},
        {"loss_type": "CAUCHY", "loss_scale": threshold_px / 3},
    )
    if report["num_inliers"] < 4 or not np.isfinite(found.t).all() or not np.isfinite(found.R).all():
        return None
    return Pose(found.R, found.t)
