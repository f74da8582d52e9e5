"""The charts of one evaluation, as SVG text."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gknet.evaluation.evaluate import PROTOCOL_WORDS, Evaluation, ProtocolRun, keypoint_statistics
from gknet.evaluation.summary import Bin, Statistic
from gknet.report.chart import Axis, Series, bar_chart, curve_chart

_LEAST = {"rmse_px": 0.1, "e_t": 1e-4, "e_q_rad": 1e-3}
"""Where the logarithmic axes of the cumulative charts may start at the earliest."""


def charts(evaluation: Evaluation) -> list[str]:
    """Cumulative errors, errors by keypoint, errors by condition; none that would show a single point or bar."""
    drawn: list[str | None] = [
        _cumulative(evaluation, "rmse_px", "RMSE in px of the 256 crop"),
        _cumulative(evaluation, "e_t", "E_t, fraction of the range"),
        _cumulative(evaluation, "e_q_rad", "E_q in rad"),
        _by_keypoint(evaluation),
    ]
    conditions: list[tuple[str, str, str, Callable[[float], float]]] = [
        ("range_diameters", "range", "range in diameters", lambda value: value),
        ("phase_angle_rad", "phase angle", "phase angle in degrees", lambda value: float(np.degrees(value))),
        ("visible_fraction", "visible keypoints", "fraction of the keypoints that is visible", lambda value: value),
    ]
    for by, words, label, unit in conditions:
        drawn.append(_by_condition(evaluation, by, f"RMSE by {words}", label, "rmse_px", "mean RMSE in px", unit))
        drawn.append(_by_condition(evaluation, by, f"E_q by {words}", label, "e_q_rad", "mean E_q in rad", unit))
    by, words = "attitude_confidence", "attitude confidence"
    drawn.append(_by_condition(evaluation, by, f"E_q by {words}", words, "e_q_rad", "mean E_q in rad", lambda v: v))
    drawn.append(_by_background(evaluation, "RMSE by background", "rmse_px", "mean RMSE in px"))
    drawn.append(_by_background(evaluation, "E_q by background", "e_q_rad", "mean E_q in rad"))
    return [chart for chart in drawn if chart is not None]


def _cumulative(evaluation: Evaluation, metric: str, label: str) -> str | None:
    """Fraction of frames at or below an error; every frame counts, failures lie at the right."""
    series, highest = [], 0.0
    for run in evaluation.runs:
        values = np.sort([v for case in run.cases if (v := getattr(case.errors, metric)) is not None])
        share = np.arange(1, len(values) + 1) / max(1, len(values))
        highest = max(highest, float(values[-1])) if len(values) else highest
        series.append(Series(PROTOCOL_WORDS[run.protocol], np.maximum(values, _LEAST[metric]), share))
    if max(len(each.x) for each in series) < 2:
        return None
    low = min(float(each.x[0]) for each in series if len(each.x))
    across = Axis(label, log=True, low=low, high=max(highest, 2 * low))
    up = Axis("fraction of frames", low=0.0, high=1.0)
    return curve_chart(f"Frames below an error: {label.split()[0].rstrip(',')}", across, up, series)


def _by_condition(
    evaluation: Evaluation, by: str, title: str, label: str, metric: str, value: str, unit: Callable[[float], float]
) -> str | None:
    """Mean with its 95 % interval in each bin that has frames."""
    series = [_binned(run, by, metric, unit) for run in evaluation.runs]
    if max(len(each.x) for each in series) < 2:
        return None
    return curve_chart(title, Axis(label), Axis(_interval_label(value, series), low=0.0), series)


def _interval_label(value: str, series: Sequence[Series]) -> str:
    """Names the interval where one is drawn: a single sequence has none."""
    has_interval = any(each.low is not None and np.isfinite(each.low).any() for each in series)
    return f"{value}, 95 % interval" if has_interval else value


def _binned(run: ProtocolRun, by: str, metric: str, unit: Callable[[float], float]) -> Series:
    bins = [b for b in run.summary.bins if b.by == by and metric in b.metrics]
    places = np.array([unit(_middle(run, b)) for b in bins])
    return _with_intervals(PROTOCOL_WORDS[run.protocol], places, [b.metrics[metric] for b in bins])


def _with_intervals(name: str, places: Float[ndarray, " k"], found: Sequence[Statistic | None]) -> Series:
    """Means and intervals at places; NaN for what is not known."""
    values = [(np.nan,) * 3 if each is None else (each.mean, each.low, each.high) for each in found]
    mean, low, high = np.array(values, dtype=np.float64).reshape(-1, 3).T
    return Series(name, places, mean, low, high)


def _by_background(evaluation: Evaluation, title: str, metric: str, value: str) -> str | None:
    """Black sky beside Earth in view; nothing where frames have only one of them, or it is unknown."""
    series = []
    for run in evaluation.runs:
        found = {
            b.low > 0: b.metrics[metric] for b in run.summary.bins if b.by == "earth_in_view" and metric in b.metrics
        }
        if len(found) < 2:
            return None
        both = [found[earth] for earth in (False, True)]
        series.append(_with_intervals(PROTOCOL_WORDS[run.protocol], np.arange(2.0), both))
    label = _interval_label(value, series)
    return bar_chart(title, Axis(label, low=0.0), ("black sky", "Earth in view"), series)


def _middle(run: ProtocolRun, bin_: Bin) -> float:
    """The median of the frames in the bin: an open bin has no middle."""
    values = [getattr(case.errors, bin_.by) for case in run.cases]
    inside = [v for v in values if v is not None and bin_.low <= v <= bin_.high]
    return float(np.median(inside))


def _by_keypoint(evaluation: Evaluation) -> str | None:
    """The keypoints that are in view in a frame at least."""
    every = range(evaluation.spacecraft.keypoint_count)
    found = [[keypoint_statistics(run, k) for k in every] for run in evaluation.runs]
    shown = [k for k in every if any(each[k].median_px is not None for each in found)]
    if len(shown) < 2:
        return None
    series = []
    for run, each in zip(evaluation.runs, found, strict=True):
        median = np.array([each[k].median_px for k in shown], dtype=np.float64)
        high = np.array([each[k].high_px for k in shown], dtype=np.float64)
        series.append(Series(PROTOCOL_WORDS[run.protocol], np.arange(float(len(shown))), median, median, high))
    names = [evaluation.spacecraft.keypoint_names[k] for k in shown]
    return bar_chart(
        "Error by keypoint", Axis("px of the 256 crop: median, line to the 90th percentile"), names, series
    )
