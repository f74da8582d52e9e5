"""Keypoints to a pose with its covariance: PoseLib's LO-RANSAC, then a robust refinement whitened by covariances, in
which the box that the spacecraft was found in has a say too."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import poselib
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Failure, FailureKind, Keypoints
from gknet.geometry import Camera, Pose

ROBUST_SIGMAS = 3.0
"""Beyond this many of its own sigmas a keypoint loses weight."""

ITERATIONS = 20


@dataclass(frozen=True)
class PnpSettings:
    """When a pose is believed. Pixels here are those of the network's input; `solve_pnp` is told their size.

    min_score        keypoints below are not used
    threshold_px     a keypoint nearer than this to its projection is an inlier; tried in order until a pose comes
    min_inliers      and at least this fraction of the keypoints used
    max_rms_px       of the inliers' reprojection errors
    box_sigma        standard deviation of an edge of the spacecraft's box, as a share of the box's longer side
    max_box_ratio    of the pose's extent to the box's along the box's longer side, either way, for a pose that less
                     than half of the spacecraft's keypoints agree with
    covariance_scale of the pose: keypoints of one picture err alike, more than independent ones; from calibration.py
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
        if not self.threshold_px or min(self.threshold_px) <= 0:
            raise GknetError(f"pnp: expected positive thresholds, got {self.threshold_px}")
        if not self.box_sigma > 0:
            raise GknetError(f"pnp: expected a positive sigma of the box, got {self.box_sigma}")
        if not self.max_box_ratio > 1:
            raise GknetError(f"pnp: expected a ratio to the box above 1, got {self.max_box_ratio}")
        if not self.covariance_scale > 0:
            raise GknetError(f"pnp: expected a positive covariance scale, got {self.covariance_scale}")


@dataclass(frozen=True, eq=False)
class PnpResult:
    """A pose, its (6, 6) covariance as `Estimate` states it, the (n,) inliers and their rms in image pixels."""

    cam_from_body: Pose
    covariance: Float[ndarray, "6 6"]
    inliers: Bool[ndarray, " n"]
    reprojection_rms_px: float


@dataclass(frozen=True, eq=False)
class _Edges:
    """Left, top, right and bottom of the spacecraft's box, and which lie inside the image: the others are cuts."""

    at_px: Float[ndarray, "4"]
    inside: Bool[ndarray, "4"]
    sigma_px: float

    @staticmethod
    def of(box: Box, camera: Camera, sigma: float) -> _Edges:
        at = np.array([box.x0, box.y0, box.x1, box.y1])
        inside = np.array([box.x0 > 1, box.y0 > 1, box.x1 < camera.width - 1, box.y1 < camera.height - 1])
        return _Edges(at, inside, sigma * box.side)


@dataclass(frozen=True, eq=False)
class _Problem:
    """The usable keypoints, measured in (possibly distorted) image pixels, and the box about all points."""

    points_m: Float[ndarray, "n 3"]
    usable: Int[ndarray, " k"]
    pixels: Float[ndarray, "k 2"]
    information: Float[ndarray, "k 2 2"]
    camera: Camera
    edges: _Edges | None

    @property
    def usable_m(self) -> Float[ndarray, "k 3"]:
        return self.points_m[self.usable]


def solve_pnp(
    keypoints: Keypoints,
    camera: Camera,
    points_m: Float[ndarray, "n 3"],
    input_px: float = 1.0,
    settings: PnpSettings | None = None,
    box: Box | None = None,
) -> PnpResult | Failure:
    """The pose that explains the keypoints, or the reason why there is none.

    input_px   size of one pixel of the network's input in image pixels (1 / Crop.scale)
    box        about all keypoints, hidden or not, cut to the image; it tells the range where keypoints leave it open
    The same input gives the same bits: the sampling has a fixed seed.
    """
    settings = settings or PnpSettings()
    if len(points_m) != len(keypoints.score):
        raise GknetError(f"pnp: expected {len(points_m)} keypoints, one for each point, got {len(keypoints.score)}")
    usable = _usable(keypoints, settings.min_score)
    if usable.sum() < 4:
        return Failure(
            FailureKind.TOO_FEW_KEYPOINTS,
            f"only {usable.sum()} keypoints have a score of {settings.min_score:g} or more, a pose needs 4",
        )
    problem = _Problem(
        points_m,
        np.flatnonzero(usable),
        keypoints.pixels[usable],
        np.linalg.inv(keypoints.covariance_px2[usable]),
        camera,
        None if box is None else _Edges.of(box, camera, settings.box_sigma),
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


def _against_box(problem: _Problem, edges: _Edges, result: PnpResult, max_ratio: float) -> PnpResult | Failure:
    """The result, or that so few keypoints are at odds with the box. One whose longer side is cut tells nothing."""
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
    finite = np.isfinite(keypoints.pixels).all(axis=1) & np.isfinite(keypoints.covariance_px2).all(axis=(1, 2))
    return (
        finite
        & (keypoints.score >= min_score)
        & (np.linalg.det(np.where(finite[:, None, None], keypoints.covariance_px2, 0.0)) > 0)
    )


def _solve(
    problem: _Problem, score: Float[ndarray, " k"], threshold_px: float, input_px: float, settings: PnpSettings
) -> PnpResult | Failure:
    """One round: consensus, refinement, then every reason to disbelieve it."""
    start = _consensus(problem, score, threshold_px)
    if start is None:
        return Failure(FailureKind.NO_CONSENSUS, "no pose agrees with enough keypoints")
    near = _residuals_px(problem, start) < 2 * threshold_px
    pose = _refine(problem, start, near)
    error = _residuals_px(problem, pose)
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
    covariance = _covariance(problem, pose, inliers)
    if covariance is None:
        return Failure(FailureKind.DEGENERATE_GEOMETRY, "the keypoints do not determine the pose (they lie on a line)")
    return PnpResult(pose, settings.covariance_scale * covariance, inliers, rms)


def _consensus(problem: _Problem, score: Float[ndarray, " k"], threshold_px: float) -> Pose | None:
    """LO-RANSAC on undistorted pixels, the surest keypoints first."""
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


def _residuals_px(problem: _Problem, pose: Pose) -> Float[ndarray, " k"]:
    """Distance from each keypoint to its projection; infinite behind the camera."""
    distance = np.linalg.norm(problem.camera.project(pose.transform(problem.usable_m)) - problem.pixels, axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def _projected(
    problem: _Problem, pose: Pose
) -> tuple[Float[ndarray, "n 2"], Float[ndarray, "n 2 6"], Float[ndarray, " n"]]:
    """Pixels of all points, their derivative by (dw, dt): exp([dw]x) R, t + dt, and their depth in metres."""
    turned = problem.points_m @ pose.rotation.T
    placed = turned + pose.translation_m
    pixels, by_point = problem.camera.project_with_jacobian(placed)
    x, y, z = turned.T[:, :, None]
    a, b, c = by_point.transpose(2, 0, 1)
    by_turn = np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=2)  # a . (dw x p) = dw . (p x a)
    return pixels, np.concatenate([by_turn, by_point], axis=2), placed[:, 2]


def _edge_errors(
    edges: _Edges, pixels: Float[ndarray, "n 2"], derivative: Float[ndarray, "n 2 6"]
) -> tuple[Float[ndarray, "4"], Float[ndarray, "4 6"]]:
    """Measured minus projected edges in their sigmas, and the derivative of the latter; zeros where one tells nothing.

    An edge is where the outermost point is.
    """
    outermost, axis = np.concatenate([pixels.argmin(axis=0), pixels.argmax(axis=0)]), np.array([0, 1, 0, 1])
    per_px = edges.inside / edges.sigma_px
    return (edges.at_px - pixels[outermost, axis]) * per_px, derivative[outermost, axis] * per_px[:, None]


def _moved(pose: Pose, step: Float[ndarray, "6"]) -> Pose:
    turn, _ = cv2.Rodrigues(step[:3])
    return Pose(turn @ pose.rotation, pose.translation_m + step[3:])


Weigh = Callable[[Float[ndarray, "*k"]], Float[ndarray, "*k"]]
"""Squared error in units of ROBUST_SIGMAS -> weight."""


def _cauchy(ratio: Float[ndarray, "*k"]) -> Float[ndarray, "*k"]:
    return 1 / (1 + ratio)


def _capped(ratio: Float[ndarray, "*k"]) -> Float[ndarray, "*k"]:
    """What is off by more than ROBUST_SIGMAS of its sigmas is held for so unsure that it is off by just that many."""
    return np.minimum(1.0, 1 / np.maximum(ratio, 1e-12))


def _system(
    problem: _Problem, pose: Pose, use: Bool[ndarray, " k"], weigh: Weigh
) -> tuple[float, Float[ndarray, "6 6"], Float[ndarray, "6"]]:
    """Cauchy's cost, the normal matrix and the gradient of the whitened errors of keypoints in `use` and of edges."""
    all_pixels, all_derivatives, depth_m = _projected(problem, pose)
    derivative, residual = all_derivatives[problem.usable], problem.pixels - all_pixels[problem.usable]
    ratio = (residual * (problem.information @ residual[..., None])[..., 0]).sum(axis=1) / ROBUST_SIGMAS**2
    weight = np.where(use, weigh(ratio), 0.0)
    weighted = (problem.information @ derivative * weight[:, None, None]).reshape(-1, 6).T
    cost, normal = np.log1p(ratio[use]).sum(), weighted @ derivative.reshape(-1, 6)
    gradient = weighted @ residual.ravel()
    if problem.edges is not None and (depth_m > 0).all():
        error, by_pose = _edge_errors(problem.edges, all_pixels, all_derivatives)
        ratio = error**2 / ROBUST_SIGMAS**2
        weighted = by_pose.T * weigh(ratio)
        cost, normal, gradient = cost + np.log1p(ratio).sum(), normal + weighted @ by_pose, gradient + weighted @ error
    return float(cost), normal, gradient


def _refine(problem: _Problem, pose: Pose, use: Bool[ndarray, " k"]) -> Pose:
    """Levenberg-Marquardt on Cauchy's loss."""
    cost, normal, gradient = _system(problem, pose, use, _cauchy)
    damping = 1e-4
    for _ in range(ITERATIONS):
        scale = np.sqrt(np.diag(normal)) + 1e-12
        damped = normal / np.outer(scale, scale) + damping * np.eye(6)
        trial = _moved(pose, np.linalg.solve(damped, gradient / scale) / scale)
        if (trial.transform(problem.usable_m)[use, 2] <= 0).any():
            damping *= 10
            continue
        trial_cost, trial_normal, trial_gradient = _system(problem, trial, use, _cauchy)
        if trial_cost > cost:
            damping *= 10
            continue
        settled = cost - trial_cost < 1e-7 * max(cost, 1e-12)
        pose, cost, normal, gradient = trial, trial_cost, trial_normal, trial_gradient
        damping *= 0.1
        if settled:
            break
    return pose


def _covariance(problem: _Problem, pose: Pose, inliers: Bool[ndarray, " k"]) -> Float[ndarray, "6 6"] | None:
    """(J^T W J)^-1 of the inliers and the edges, or None when the inliers alone have no inverse."""
    alone = replace(problem, edges=None)
    for each in (alone,) if problem.edges is None else (alone, problem):
        _, normal, _ = _system(each, pose, inliers, _capped)
        scale = np.sqrt(np.diag(normal))
        if not (np.isfinite(scale).all() and (scale > 0).all()):
            return None
        unit = normal / np.outer(scale, scale)
        if np.linalg.cond(unit) > 1e12:
            return None
    covariance = np.linalg.inv(unit) / np.outer(scale, scale)
    return (covariance + covariance.T) / 2
