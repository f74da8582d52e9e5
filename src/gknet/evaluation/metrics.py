"""The errors of one estimate against its frame's truth.

Keypoint errors are in pixels of the 256 oracle crop: image pixels times that crop's scale, whatever crop the estimate
came from, so the oracle's and the detected crop's runs share one unit. Failures count: E_t = 1, E_q = pi, ADD = 1
diameter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError
from gknet.frame import Estimate, FailureKind, Frame, Keypoints
from gknet.geometry import Pose
from gknet.inference.crop import Crop
from gknet.spacecraft import Spacecraft

ORACLE_SIZE = 256

FAILED_E_T = 1.0
FAILED_E_Q = float(np.pi)
FAILED_ADD = 1.0


@dataclass(frozen=True)
class FrameErrors:
    """What one frame adds to the summaries; None where the frame has no such value.

    Attributes:
        name: Of the frame.
        sequence: Frames of one sequence are resampled together.
        failure: The kind of failure; None with a pose.
        rmse_px: Eq. 6 over the keypoints in view.
        rmse_hidden_px: The same over those of them that the spacecraft hides.
        pck_2: Part of the keypoints in view that are nearer than 2 px.
        pck_5: Nearer than 5 px.
        pck_10: Nearer than 10 px.
        e_t: Eq. 7, relative.
        e_q_rad: Eq. 8.
        speed_score: The sum of both.
        add: Mean distance between the keypoints of both poses, in diameters.
        add_s: Mean distance to the nearest keypoint of the other pose, in diameters.
        add_below_tenth: 1 with an `add` below a tenth, else 0.
        locator_iou: Intersection over union of the estimate's box and the true one.
        nees: Squared pose error over the covariance: 6 in the mean when the covariance is right.
        range_m: True distance.
        range_diameters: True distance in diameters.
        phase_angle_rad: `Frame.phase_angle_rad`.
        visible_fraction: Keypoints in view and not hidden, over all.
        earth_in_view: 1 with a part of the Earth in the image, 0 without.
        attitude_confidence: Of the estimate; None without a pose, or of a network that has none.
    """

    name: str
    sequence: str
    failure: FailureKind | None
    rmse_px: float | None
    rmse_hidden_px: float | None
    pck_2: float | None
    pck_5: float | None
    pck_10: float | None
    e_t: float
    e_q_rad: float
    speed_score: float
    add: float
    add_s: float
    add_below_tenth: float
    locator_iou: float | None
    nees: float | None
    range_m: float
    range_diameters: float
    phase_angle_rad: float | None
    visible_fraction: float | None
    earth_in_view: float | None
    attitude_confidence: float | None


def oracle_crop(frame: Frame, spacecraft: Spacecraft, size: int = ORACLE_SIZE) -> Crop:
    """The crop about the true keypoints: the paper's protocol, and the unit of the keypoint errors.

    Args:
        frame: With its true pose.
        spacecraft: Whose keypoints they are.
        size: Side of the crop in pixels of the network's input.

    Raises:
        GknetError: No keypoint is in view, or the frame has no true pose.
    """
    box = frame.true_box(spacecraft.points_m)
    if box is None:
        raise GknetError(f"frame {frame.name}: no keypoint is in view, so there is no oracle crop")
    return Crop.around(box, size)


def compute_errors(
    frame: Frame, estimate: Estimate, spacecraft: Spacecraft, crop: Crop | None = None, sequence: str | None = None
) -> FrameErrors:
    """Compare an estimate with the frame's truth.

    Args:
        frame: With its true pose.
        estimate: Of the frame.
        spacecraft: Whose pose it is.
        crop: The 256 oracle crop, whose scale is the unit of the keypoint errors; made here when None.
        sequence: Frames of one sequence are resampled together; None makes the frame a sequence of its own.

    Raises:
        GknetError: The frame has no true pose, or shows no keypoint.
    """
    truth = frame.cam_from_body
    if truth is None:
        raise GknetError(f"frame {frame.name}: it has no true pose to compare with")
    crop = crop or oracle_crop(frame, spacecraft)
    true_px = frame.keypoints_px(spacecraft.points_m)
    in_view = frame.camera.contains(true_px)
    distance = keypoint_errors_px(estimate.keypoints, true_px, crop)
    hidden = None if frame.visible is None else in_view & ~frame.visible
    e_t, e_q = pose_errors(truth, estimate.cam_from_body)
    add, add_s = _add(truth, estimate.cam_from_body, spacecraft)
    true_box = frame.true_box(spacecraft.points_m)
    distance_m = float(np.linalg.norm(truth.translation_m))
    return FrameErrors(
        name=frame.name,
        sequence=frame.name if sequence is None else sequence,
        failure=None if estimate.failure is None else estimate.failure.kind,
        rmse_px=_rms(distance[in_view]),
        rmse_hidden_px=None if hidden is None else _rms(distance[hidden]),
        pck_2=_part_below(distance[in_view], 2),
        pck_5=_part_below(distance[in_view], 5),
        pck_10=_part_below(distance[in_view], 10),
        e_t=e_t,
        e_q_rad=e_q,
        speed_score=e_t + e_q,
        add=add,
        add_s=add_s,
        add_below_tenth=float(estimate.failure is None and add < 0.1),
        locator_iou=None if true_box is None else (estimate.box.iou(true_box) if estimate.box else 0.0),
        nees=nees(truth, estimate),
        range_m=distance_m,
        range_diameters=distance_m / spacecraft.diameter_m,
        phase_angle_rad=frame.phase_angle_rad,
        visible_fraction=None if frame.visible is None else float((frame.visible & in_view).mean()),
        earth_in_view=None if frame.earth_in_view is None else float(frame.earth_in_view),
        attitude_confidence=estimate.attitude_confidence,
    )


def keypoint_errors_px(keypoints: Keypoints | None, true_px: Float[ndarray, "n 2"], crop: Crop) -> Float[ndarray, " n"]:
    """Distances from the true keypoints, (n,) in pixels of the oracle crop.

    Where nothing was detected, as in an image without a box, every keypoint is off by the crop's diagonal. One whose
    heatmap has no peak (score 0) counts at the centre of the input, where `decode_heatmaps` puts it.

    Args:
        keypoints: As detected, in image pixels; None without a detection.
        true_px: (n, 2) true keypoints in image pixels.
        crop: The 256 oracle crop.
    """
    missing = crop.size * np.sqrt(2)
    if keypoints is None:
        return np.full(len(true_px), missing)
    distance = np.linalg.norm(keypoints.pixels - true_px, axis=1) * crop.scale
    return np.where(np.isfinite(distance), distance, missing)


def pose_errors(truth: Pose, found: Pose | None) -> tuple[float, float]:
    """The paper's errors of a pose.

    Args:
        truth: The true cam_from_body.
        found: The estimated one; None for a failure.

    Returns:
        E_t (eq. 7, relative) and E_q in rad (eq. 8); a failure counts as 1 and pi.
    """
    if found is None:
        return FAILED_E_T, FAILED_E_Q
    off = np.linalg.norm(truth.translation_m - found.translation_m)
    return float(off / np.linalg.norm(truth.translation_m)), truth.angle_to(found)


def pose_error_vector(truth: Pose, found: Pose) -> Float[ndarray, "6"]:
    """The error whose covariance an `Estimate` states.

    Args:
        truth: The true cam_from_body.
        found: The estimated one.

    Returns:
        (dw, dt) in rad and m, with R_true = exp([dw]x) R and t_true = t + dt.
    """
    turn = Rotation.from_matrix(truth.rotation @ found.rotation.T).as_rotvec()
    return np.concatenate([turn, truth.translation_m - found.translation_m])


def nees(truth: Pose, estimate: Estimate) -> float | None:
    """Normalised estimation error squared (NEES): chi-squared with 6 degrees of freedom when the covariance is right.

    Args:
        truth: The true cam_from_body.
        estimate: The estimate.

    Returns:
        None without a pose and its covariance.
    """
    if estimate.cam_from_body is None or estimate.covariance is None:
        return None
    error = pose_error_vector(truth, estimate.cam_from_body)
    scale = np.sqrt(np.diag(estimate.covariance))
    unit = estimate.covariance / np.outer(scale, scale)
    return float((error / scale) @ np.linalg.solve(unit, error / scale))


def _rms(distance: Float[ndarray, " k"]) -> float | None:
    return float(np.sqrt((distance**2).mean())) if len(distance) else None


def _part_below(distance: Float[ndarray, " k"], limit_px: float) -> float | None:
    return float((distance < limit_px).mean()) if len(distance) else None


def _add(truth: Pose, found: Pose | None, spacecraft: Spacecraft) -> tuple[float, float]:
    """ADD and ADD-S over the keypoints, in diameters."""
    if found is None:
        return FAILED_ADD, FAILED_ADD
    true_m, found_m = truth.transform(spacecraft.points_m), found.transform(spacecraft.points_m)
    nearest, _ = KDTree(found_m).query(true_m)
    add = np.linalg.norm(true_m - found_m, axis=1).mean()
    return float(add / spacecraft.diameter_m), float(nearest.mean() / spacecraft.diameter_m)
