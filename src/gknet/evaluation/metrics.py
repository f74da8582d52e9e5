"""(Frame, Estimate) to errors, and errors to summaries with confidence intervals.

Keypoint errors are in pixels of the 256 oracle crop: image pixels times that crop's scale, whatever crop the estimate
came from, so the oracle's and the detected crop's runs share one unit. Nothing is left out of a mean in silence: every
mean states how many frames it is over, and failures count (E_t = 1, E_q = pi, ADD = 1 diameter).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from gknet.errors import GknetError
from gknet.frame import Estimate, FailureKind, Frame, Keypoints
from gknet.geometry import Pose
from gknet.inference.crop import Crop
from gknet.spacecraft import Spacecraft

ORACLE_SIZE = 256

FAILED_E_T = 1.0
FAILED_E_Q = float(np.pi)
FAILED_ADD = 1.0

RANGE_EDGES_DIAMETERS = (0.0, 1.5, 2.5, 4.0, 7.0, 12.0, np.inf)
PHASE_EDGES_DEG = (0.0, 30.0, 60.0, 90.0, 120.0, 180.0)
VISIBLE_EDGES = (0.0, 0.3, 0.5, 0.7, 0.9, 1.0)
EARTH_EDGES = (0.0, 0.5, 1.0)
CONFIDENCE_EDGES = (0.0, 0.5, 0.8, 0.95, 1.0)


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
        earth_in_view: 1 with a part of the Earth in the picture, 0 without.
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

    Where nothing was detected, as in a picture without a box, every keypoint is off by the crop's diagonal. One whose
    heatmap has no peak (score 0) counts at the centre of the input, where `decode_heatmaps` puts it.
    """
    missing = crop.size * np.sqrt(2)
    if keypoints is None:
        return np.full(len(true_px), missing)
    distance = np.linalg.norm(keypoints.pixels - true_px, axis=1) * crop.scale
    return np.where(np.isfinite(distance), distance, missing)


def pose_errors(truth: Pose, found: Pose | None) -> tuple[float, float]:
    """E_t (eq. 7) and E_q in rad (eq. 8); a failure counts as 1 and pi."""
    if found is None:
        return FAILED_E_T, FAILED_E_Q
    off = np.linalg.norm(truth.translation_m - found.translation_m)
    return float(off / np.linalg.norm(truth.translation_m)), truth.angle_to(found)


def pose_error_vector(truth: Pose, found: Pose) -> Float[ndarray, "6"]:
    """(dw, dt) with R_true = exp([dw]x) R and t_true = t + dt, as the covariance of an `Estimate` is stated."""
    turn = Rotation.from_matrix(truth.rotation @ found.rotation.T).as_rotvec()
    return np.concatenate([turn, truth.translation_m - found.translation_m])


def nees(truth: Pose, estimate: Estimate) -> float | None:
    """Normalised estimation error squared; None without a pose and its covariance."""
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


METRICS = (
    "rmse_px",
    "rmse_hidden_px",
    "pck_2",
    "pck_5",
    "pck_10",
    "e_t",
    "e_q_rad",
    "speed_score",
    "add",
    "add_s",
    "add_below_tenth",
    "locator_iou",
    "nees",
)


@dataclass(frozen=True)
class Statistic:
    """One metric over many frames.

    Attributes:
        mean: The mean.
        low: Lower end of its 95 % interval (bootstrap over sequences).
        high: Upper end of it.
        median: The median.
        frames: How many frames have the metric.
    """

    mean: float
    low: float
    high: float
    median: float
    frames: int


@dataclass(frozen=True)
class Bin:
    """The frames whose value of one attribute lies in a range.

    Attributes:
        by: Name of the attribute of `FrameErrors`.
        low: Lower end, included.
        high: Upper end, excluded, but included in the last bin.
        frames: How many frames.
        failures: How many of them have no pose.
        metrics: Over these frames.
    """

    by: str
    low: float
    high: float
    frames: int
    failures: int
    metrics: dict[str, Statistic]


@dataclass(frozen=True)
class Summary:
    """The metrics over many frames.

    Attributes:
        frames: How many frames.
        sequences: How many sequences.
        failures: Frames without a pose for each kind of failure, the most frequent first.
        metrics: Metric -> statistic; a metric that no frame has is absent.
        located_07: Part of the frames whose box overlaps the true one by an IoU of 0.7 or more.
        coverage_68: Part of the poses whose error lies in the 68 % ellipsoid of their 6x6 covariance.
        coverage_95: The same of the 95 % ellipsoid.
        bins: By range, phase angle, visibility, the Earth and attitude confidence.
    """

    frames: int
    sequences: int
    failures: dict[FailureKind, int]
    metrics: dict[str, Statistic]
    located_07: float | None
    coverage_68: float | None
    coverage_95: float | None
    bins: tuple[Bin, ...] = field(default=())

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON: no NaN, no infinity (an open end of a bin is null)."""
        return {key: _plain(value) for key, value in asdict(self).items()}


def summarise(frame_errors: Sequence[FrameErrors], seed: int = 0, resamples: int = 1000) -> Summary:
    """Means, medians and 95 % intervals of every metric, overall and in bins.

    Args:
        frame_errors: One for each frame.
        seed: Of the bootstrap.
        resamples: Of the bootstrap.

    Raises:
        GknetError: There is no frame.
    """
    if not frame_errors:
        raise GknetError("summary: expected at least one frame, got none")
    squared = np.array([e.nees for e in frame_errors if e.nees is not None])
    ious = [e.locator_iou for e in frame_errors if e.locator_iou is not None]
    return Summary(
        frames=len(frame_errors),
        sequences=len({e.sequence for e in frame_errors}),
        failures=dict(Counter(e.failure for e in frame_errors if e.failure is not None).most_common()),
        metrics=_statistics(frame_errors, seed, resamples),
        located_07=float(np.mean(np.array(ious) >= 0.7)) if ious else None,
        coverage_68=_coverage(squared, 0.68),
        coverage_95=_coverage(squared, 0.95),
        bins=tuple(_bins(frame_errors, seed, resamples)),
    )


def _coverage(squared: Float[ndarray, " k"], part: float) -> float | None:
    """The part of the true poses inside the ellipsoid that should hold `part` of them."""
    return float((squared <= chi2.ppf(part, 6)).mean()) if len(squared) else None


def _statistics(frame_errors: Sequence[FrameErrors], seed: int, resamples: int) -> dict[str, Statistic]:
    """Each metric over the frames that have it; a metric that no frame has is absent."""
    names = sorted({e.sequence for e in frame_errors})
    index = {name: k for k, name in enumerate(names)}
    sequence = np.array([index[e.sequence] for e in frame_errors])
    drawn = np.random.default_rng(seed).multinomial(len(names), np.full(len(names), 1 / len(names)), size=resamples)
    found = {}
    for metric in METRICS:
        values = np.array([np.nan if (v := getattr(e, metric)) is None else v for e in frame_errors], dtype=np.float64)
        known = ~np.isnan(values)
        if known.any():
            found[metric] = _statistic(values[known], sequence[known], drawn)
    return found


def _statistic(values: Float[ndarray, " k"], sequence: ndarray, drawn: ndarray) -> Statistic:
    """`drawn` (resamples, sequences): how often each resample holds each sequence."""
    sums = np.bincount(sequence, weights=values, minlength=drawn.shape[1])
    counts = np.bincount(sequence, minlength=drawn.shape[1])
    frames = drawn @ counts
    means = (drawn @ sums)[frames > 0] / frames[frames > 0]
    low, high = np.percentile(means, (2.5, 97.5)) if len(means) else (values.mean(), values.mean())
    return Statistic(float(values.mean()), float(low), float(high), float(np.median(values)), len(values))


def _bins(frame_errors: Sequence[FrameErrors], seed: int, resamples: int) -> list[Bin]:
    phase = tuple(float(edge) for edge in np.deg2rad(PHASE_EDGES_DEG))
    bins = []
    for by, edges in (
        ("range_diameters", RANGE_EDGES_DIAMETERS),
        ("phase_angle_rad", phase),
        ("visible_fraction", VISIBLE_EDGES),
        ("earth_in_view", EARTH_EDGES),
        ("attitude_confidence", CONFIDENCE_EDGES),
    ):
        values = np.array([np.nan if (v := getattr(e, by)) is None else v for e in frame_errors], dtype=np.float64)
        for low, high in pairwise(edges):
            inside = _within(values, low, high, last=high == edges[-1])
            chosen = [e for e, here in zip(frame_errors, inside, strict=True) if here]
            if chosen:
                failures = sum(e.failure is not None for e in chosen)
                bins.append(Bin(by, low, high, len(chosen), failures, _statistics(chosen, seed, resamples)))
    return bins


def _within(values: Float[ndarray, " k"], low: float, high: float, last: bool) -> Bool[ndarray, " k"]:
    return (values >= low) & ((values <= high) if last else (values < high))


def _plain(value: object) -> object:
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
