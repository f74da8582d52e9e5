"""The errors of many frames as means, medians and confidence intervals, overall and in bins.

Every mean states how many frames it is over; failures are in all of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.stats import chi2

from gknet.errors import GknetError
from gknet.evaluation.metrics import FrameErrors
from gknet.frame import FailureKind

RANGE_EDGES_DIAMETERS = (0.0, 1.5, 2.5, 4.0, 7.0, 12.0, np.inf)
PHASE_EDGES_DEG = (0.0, 30.0, 60.0, 90.0, 120.0, 180.0)
VISIBLE_EDGES = (0.0, 0.3, 0.5, 0.7, 0.9, 1.0)
EARTH_EDGES = (0.0, 0.5, 1.0)
CONFIDENCE_EDGES = (0.0, 0.5, 0.8, 0.95, 1.0)

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
        low: Lower end of its 95 % interval (bootstrap over sequences); None where one sequence alone has the metric.
        high: Upper end of it; None with `low`.
        median: The median.
        frames: How many frames have the metric.
    """

    mean: float
    low: float | None
    high: float | None
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
        located_07: Fraction of the frames whose box overlaps the true one by an IoU of 0.7 or more.
        coverage_68: Fraction of the poses whose error lies in the 68 % ellipsoid of their 6x6 covariance.
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
    """The fraction of the true poses inside the ellipsoid that should hold `part` of them."""
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
    mean, median = float(values.mean()), float(np.median(values))
    if len(np.unique(sequence)) < 2:  # resamples of one sequence are all alike
        return Statistic(mean, None, None, median, len(values))
    sums = np.bincount(sequence, weights=values, minlength=drawn.shape[1])
    counts = np.bincount(sequence, minlength=drawn.shape[1])
    frames = drawn @ counts
    means = (drawn @ sums)[frames > 0] / frames[frames > 0]
    low, high = np.percentile(means, (2.5, 97.5))
    return Statistic(mean, float(low), float(high), median, len(values))


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
