"""Methods against each other on the same frames: means and paired differences with their intervals.

A `Trial` is one trained network evaluated on the test frames. Intervals are bootstrapped over sequences, the frames of
which are alike, and over seeds, which are few: of n of them n - 1 are drawn with replacement, since n would hide a part
1/n of the variance (Rao and Wu 1988), the same draw for both methods. One seed does not measure the variance between
trainings, and with two or three the interval is still too short: check whether the seeds agree.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from gknet.errors import GknetError
from gknet.evaluation.evaluate import Case, ProtocolRun, confusion

LOW_VISIBILITY = 0.6
"""Share of the keypoints that are visible, below which a frame counts as one of low visibility."""

ATTITUDE_HOLDS_RAD = 0.35
"""E_q (20 degrees) beyond which an attitude is wrong as a whole, as that of a symmetric counterpart is."""


class NothingKnownError(GknetError):
    """No frame of a trial has the metric, as of hidden keypoints where none is hidden."""


@dataclass(frozen=True, eq=False)
class Trial:
    """One network's errors on the test frames.

    Attributes:
        method: What is compared.
        spacecraft: Its name.
        seed: Of the training.
        frames: (m,) names of the frames.
        sequences: (m,) the sequence of each frame.
        values: Metric of `measured` -> (m,), NaN where a frame has no value.
        confusion: (n, n) how often keypoint i was detected at keypoint j.
    """

    method: str
    spacecraft: str
    seed: int
    frames: tuple[str, ...]
    sequences: tuple[str, ...]
    values: Mapping[str, Float[ndarray, " m"]]
    confusion: Int[ndarray, "n n"]

    @staticmethod
    def of(run: ProtocolRun, method: str, spacecraft: str, seed: int) -> Trial:
        """The errors of an evaluation under one protocol.

        Args:
            run: The evaluation.
            method: What is compared.
            spacecraft: Its name.
            seed: Of the training.
        """
        found = [case.errors for case in run.cases]
        rows = [measured(case) for case in run.cases]
        values = {
            metric: np.array([np.nan if (v := row[metric]) is None else v for row in rows], dtype=np.float64)
            for metric in rows[0]
        }
        sequences = tuple(e.sequence for e in found)
        frames = tuple(e.name for e in found)
        return Trial(method, spacecraft, seed, frames, sequences, values, confusion(run))

    def to_dict(self) -> dict[str, object]:
        """Ready for JSON: four digits, null where a frame has no value."""
        values = {
            name: [None if np.isnan(v) else float(f"{v:.4g}") for v in column] for name, column in self.values.items()
        }
        return {
            "method": self.method,
            "spacecraft": self.spacecraft,
            "seed": self.seed,
            "frames": list(self.frames),
            "sequences": list(self.sequences),
            "values": values,
            "confusion": self.confusion.tolist(),
        }

    @staticmethod
    def from_dict(content: Mapping[str, object]) -> Trial:
        """The inverse of `to_dict`.

        Raises:
            GknetError: The content is not that of a trial.
        """
        try:
            values = {
                str(name): np.array([np.nan if v is None else v for v in column], dtype=np.float64)
                for name, column in content["values"].items()  # type: ignore[attr-defined]
            }
            return Trial(
                str(content["method"]),
                str(content["spacecraft"]),
                int(content["seed"]),  # type: ignore[call-overload]
                tuple(content["frames"]),  # type: ignore[arg-type]
                tuple(content["sequences"]),  # type: ignore[arg-type]
                values,
                np.array(content["confusion"], dtype=np.int64),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise GknetError(f"trial: expected the content that a trial writes ({error!r})") from error


def measured(case: Case) -> dict[str, float | None]:
    """What methods are compared by.

    Returns:
        Metric -> value, None where the frame has none: rmse_px, rmse_hidden_px, e_t and e_q_rad as in
        `gknet.evaluation.metrics.FrameErrors`; rmse_low_px, which is rmse_px of a frame of low visibility; swapped, the
        share of the keypoints in view that were detected at another one's position (None where nothing was detected).
    """
    errors = case.errors
    low = errors.visible_fraction is not None and errors.visible_fraction < LOW_VISIBILITY
    elsewhere = (case.taken_for >= 0) & (case.taken_for != np.arange(len(case.taken_for)))
    in_view = int((~np.isnan(case.keypoint_px)).sum())
    return {
        "rmse_px": errors.rmse_px,
        "rmse_hidden_px": errors.rmse_hidden_px,
        "e_t": errors.e_t,
        "e_q_rad": errors.e_q_rad,
        "rmse_low_px": errors.rmse_px if low else None,
        "swapped": elsewhere.sum() / in_view if in_view and case.estimate.keypoints is not None else None,
    }


@dataclass(frozen=True)
class Interval:
    """A mean, or a difference of means, with its 95 % interval.

    Attributes:
        mean: The mean.
        low: Lower end of the interval.
        high: Upper end of the interval.
    """

    mean: float
    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether a difference is significant at 5 %."""
        return self.low > 0 or self.high < 0


def mean_of(trials: Sequence[Trial], metric: str, seed: int = 0, resamples: int = 2000) -> Interval:
    """The mean over frames and seeds of one method on one spacecraft.

    Args:
        trials: One for each seed, on the same frames.
        metric: Of `measured`.
        seed: Of the bootstrap.
        resamples: Of the bootstrap.

    Raises:
        NothingKnownError: No frame has the metric.
        GknetError: There is no trial, the frames differ, or no trial knows the metric.
    """
    table, counts = _by_sequence(trials, metric)
    means = _resampled(table, counts, *_draws(len(trials), counts.shape[1], seed, resamples))
    return Interval(float(table.sum() / counts.sum()), *_ends(means))


def difference(
    first: Sequence[Trial], second: Sequence[Trial], metric: str, seed: int = 0, resamples: int = 2000
) -> Interval:
    """Mean of the first method minus that of the second, on the same frames; negative where the first is better.

    With as many seeds on both sides they are drawn as pairs.

    Args:
        first: Trials of one method, one for each seed.
        second: Trials of the other method.
        metric: Of `measured`.
        seed: Of the bootstrap.
        resamples: Of the bootstrap.

    Raises:
        NothingKnownError: No frame has the metric.
        GknetError: There is no trial, the frames differ, or no trial knows the metric.
    """
    _check_frames(first[0], second[0])
    tables = [_by_sequence(trials, metric) for trials in (first, second)]
    draws = _draws(len(first), tables[0][1].shape[1], seed, resamples)
    seeds = draws[1] if len(second) == len(first) else _draws(len(second), 1, seed + 1, resamples)[1]
    gap = _resampled(*tables[0], *draws) - _resampled(*tables[1], draws[0], seeds)
    means = [table.sum() / counts.sum() for table, counts in tables]
    return Interval(float(means[0] - means[1]), *_ends(gap))


def seed_gaps(first: Sequence[Trial], second: Sequence[Trial], metric: str) -> list[float]:
    """The difference of the means of each seed by itself.

    Args:
        first: Trials of one method, one for each seed.
        second: Trials of the other method, of the same seeds.
        metric: Of `measured`.

    Returns:
        First minus second in the metric's unit, for each seed; NaN where no frame has a value.
    """

    def mean(trial: Trial) -> float:
        known = trial.values[metric][~np.isnan(trial.values[metric])]
        return float(known.mean()) if len(known) else float("nan")

    return [mean(one) - mean(other) for one, other in zip(first, second, strict=True)]


def where_attitudes_hold(first: Sequence[Trial], second: Sequence[Trial]) -> tuple[list[Trial], list[Trial]]:
    """Both methods, seed by seed, on the frames in which both attitudes are within 20 degrees.

    Args:
        first: Trials of one method, one for each seed.
        second: Trials of the other method, of the same seeds.

    Returns:
        The same trials; the values of the other frames are NaN.
    """

    def masked(trial: Trial, known: Bool[ndarray, " m"]) -> Trial:
        return replace(trial, values={name: np.where(known, column, np.nan) for name, column in trial.values.items()})

    pairs = []
    for one, other in zip(first, second, strict=True):
        _check_frames(one, other)
        known = np.maximum(one.values["e_q_rad"], other.values["e_q_rad"]) <= ATTITUDE_HOLDS_RAD
        pairs.append((masked(one, known), masked(other, known)))
    return [one for one, _ in pairs], [other for _, other in pairs]


def _check_frames(one: Trial, other: Trial) -> None:
    if one.frames != other.frames:
        raise GknetError(f"comparison: {one.method} and {other.method} were evaluated on different frames")


def _by_sequence(
    trials: Sequence[Trial], metric: str
) -> tuple[Float[ndarray, "seeds sequences"], Float[ndarray, "seeds sequences"]]:
    """Sums and numbers of the known values of each sequence."""
    if not trials:
        raise GknetError("comparison: expected at least one trial, got none")
    for trial in trials:
        _check_frames(trials[0], trial)
    if any(metric not in trial.values for trial in trials):
        raise GknetError(f"comparison: the trials of {trials[0].method} have no metric {metric}; evaluate them again")
    names = sorted(set(trials[0].sequences))
    place = np.array([names.index(sequence) for sequence in trials[0].sequences])
    sums, counts = np.zeros((len(trials), len(names))), np.zeros((len(trials), len(names)))
    for row, trial in enumerate(trials):
        known = ~np.isnan(trial.values[metric])
        sums[row] = np.bincount(place[known], weights=trial.values[metric][known], minlength=len(names))
        counts[row] = np.bincount(place[known], minlength=len(names))
    if counts.sum() == 0:
        raise NothingKnownError(f"comparison: no frame of {trials[0].method} has the metric {metric}")
    return sums, counts


def _draws(seeds: int, sequences: int, seed: int, resamples: int) -> tuple[ndarray, ndarray]:
    """How often each resample holds each sequence (r, sequences), and each seed (r, seeds)."""
    rng = np.random.default_rng(seed)

    def drawn(count: int) -> ndarray:
        return rng.multinomial(max(count - 1, 1), np.full(count, 1 / count), size=resamples)

    return drawn(sequences), drawn(seeds)


def _resampled(sums: ndarray, counts: ndarray, sequences: ndarray, seeds: ndarray) -> Float[ndarray, " r"]:
    """The mean of each resample; NaN of one in which nothing is known."""
    top = np.einsum("rk,ks,rs->r", seeds, sums, sequences)
    known = np.einsum("rk,ks,rs->r", seeds, counts, sequences)
    return np.divide(top, known, out=np.full(len(top), np.nan), where=known > 0)


def _ends(values: Float[ndarray, " r"]) -> tuple[float, float]:
    low, high = np.nanpercentile(values, (2.5, 97.5))
    return float(low), float(high)
