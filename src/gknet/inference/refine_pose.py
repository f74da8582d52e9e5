"""The pose that keypoints and the box agree on best: robust least squares whitened by covariances, and its covariance.

Errors are those of (dw, dt): R_true = exp([dw]x) R, t_true = t + dt, both in the camera frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from gknet.frame import Box
from gknet.geometry import Camera, Pose

ROBUST_SIGMAS = 3.0
"""Beyond this many of its own sigmas a keypoint loses weight."""

ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class BoxEdges:
    """The sides of the spacecraft's box as measurements; those at the image's border are cuts and measure nothing.

    Attributes:
        at_px: (4,) left, top, right and bottom, in image pixels.
        inside: (4,) bool: which of them lie inside the image.
        sigma_px: Standard deviation of each.
    """

    at_px: Float[ndarray, "4"]
    inside: Bool[ndarray, "4"]
    sigma_px: float

    @staticmethod
    def of(box: Box, camera: Camera, sigma: float) -> BoxEdges:
        """The sides of a box; `sigma` is in parts of its longer side."""
        at = np.array([box.x0, box.y0, box.x1, box.y1])
        inside = np.array([box.x0 > 1, box.y0 > 1, box.x1 < camera.width - 1, box.y1 < camera.height - 1])
        return BoxEdges(at, inside, sigma * box.side)


@dataclass(frozen=True, eq=False)
class PnpProblem:
    """What is measured: the usable keypoints, and the box about all points.

    Attributes:
        points_m: (n, 3) all keypoints in the body frame.
        usable: (k,) indices of those that are used.
        pixels: (k, 2) where they were detected, in (possibly distorted) image pixels.
        information: (k, 2, 2) the inverse of their covariance.
        camera: The camera of the image.
        edges: The box's sides; None where the box is not used.
    """

    points_m: Float[ndarray, "n 3"]
    usable: Int[ndarray, " k"]
    pixels: Float[ndarray, "k 2"]
    information: Float[ndarray, "k 2 2"]
    camera: Camera
    edges: BoxEdges | None

    @property
    def usable_m(self) -> Float[ndarray, "k 3"]:
        """(k, 3) the usable points in the body frame."""
        return self.points_m[self.usable]


def residuals_px(problem: PnpProblem, pose: Pose) -> Float[ndarray, " k"]:
    """Distance from each keypoint to its projection.

    Args:
        problem: The measurements.
        pose: cam_from_body.

    Returns:
        (k,) in image pixels; infinite behind the camera.
    """
    distance = np.linalg.norm(problem.camera.project(pose.transform(problem.usable_m)) - problem.pixels, axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def _projected(
    problem: PnpProblem, pose: Pose
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
    edges: BoxEdges, pixels: Float[ndarray, "n 2"], derivative: Float[ndarray, "n 2 6"]
) -> tuple[Float[ndarray, "4"], Float[ndarray, "4 6"]]:
    """Measured minus projected edges in their sigmas, and the derivative of the latter; zeros for an edge that is cut.

    A projected edge is where the outermost point is.
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
    """An error beyond ROBUST_SIGMAS counts as if its sigma were so large that it is off by just ROBUST_SIGMAS."""
    return np.minimum(1.0, 1 / np.maximum(ratio, 1e-12))


def _system(
    problem: PnpProblem, pose: Pose, use: Bool[ndarray, " k"], weigh: Weigh
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


def refine(problem: PnpProblem, pose: Pose, use: Bool[ndarray, " k"]) -> Pose:
    """The pose that minimises Cauchy's loss of the whitened errors, by Levenberg-Marquardt from `pose`.

    Args:
        problem: The measurements.
        pose: The start, cam_from_body.
        use: (k,) bool: which usable keypoints take part. The box's edges always do.
    """
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


def covariance_of(problem: PnpProblem, pose: Pose, inliers: Bool[ndarray, " k"]) -> Float[ndarray, "6 6"] | None:
    """(J^T W J)^-1 of the inliers and the box's edges.

    Args:
        problem: The measurements.
        pose: The refined cam_from_body.
        inliers: (k,) bool: which usable keypoints count.

    Returns:
        (6, 6) as in `Estimate`; None when the inliers alone do not determine the pose.
    """
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
