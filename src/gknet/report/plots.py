"""The charts of one evaluation, as SVG text."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gknet.evaluation.evaluate import PROTOCOL_WORDS, Evaluation, ProtocolRun, keypoint_statistics
from gknet.evaluation.summary import Bin
from gknet.report.chart import Axis, Series, bar_chart, curve_chart

_LEAST = {"rmse_px": 0.1, "e_t": 1e-4, "e_q_rad": 1e-3}
"""Where the logarithmic axes of the cumulative charts may start at the earliest."""


def charts(evaluation: Evaluation) -> list[str]:
    """Cumulative errors, errors by keypoint, errors by condition."""
    drawn = [
        _cumulative(evaluation, "rmse_px", "RMSE in px of the 256 crop"),
        _cumulative(evaluation, "e_t", "E_t, part of the range"),
        _cumulative(evaluation, "e_q_rad", "E_q in rad"),
        _by_keypoint(evaluation),
    ]
    conditions: list[tuple[str, str, str, Callable[[float], float]]] = [
        ("range_diameters", "range", "range in diameters", lambda value: value),
        ("phase_angle_rad", "phase angle", "phase angle in degrees", lambda value: float(np.degrees(value))),
        ("visible_fraction", "visible keypoints", "share of the keypoints that is visible", lambda value: value),
    ]
    for by, words, label, unit in conditions:
        drawn.append(_by_condition(evaluation, by, f"RMSE by {words}", label, "rmse_px", "mean RMSE in px", unit))
        drawn.append(_by_condition(evaluation, by, f"E_q by {words}", label, "e_q_rad", "mean E_q in rad", unit))
    if any(b.by == "attitude_confidence" for run in evaluation.runs for b in run.summary.bins):
        by, words, label = (
            "attitude_confidence",
            "E_q by attitude confidence",
            "attitude confidence",
        )
        drawn.append(_by_condition(evaluation, by, words, label, "e_q_rad", "mean E_q in rad", lambda value: value))
    drawn.append(_by_background(evaluation, "RMSE by background", "rmse_px", "mean RMSE in px"))
    drawn.append(_by_background(evaluation, "E_q by background", "e_q_rad", "mean E_q in rad"))
    return drawn


def _cumulative(evaluation: Evaluation, metric: str, label: str) -> str:
    """Share of frames at or below an error; every frame counts, failures lie at the right."""
    series, highest = [], 0.0
    for run in evaluation.runs:
        values = np.sort([v for case in run.cases if (v := getattr(case.errors, metric)) is not None])
        share = np.arange(1, len(values) + 1) / max(1, len(values))
        highest = max(highest, float(values[-1])) if len(values) else highest
        series.append(Series(PROTOCOL_WORDS[run.protocol], np.maximum(values, _LEAST[metric]), share))
    low = min((float(s.x[0]) for s in series if len(s.x)), default=_LEAST[metric])
    across = Axis(label, log=True, low=low, high=max(highest, 2 * low))
    return curve_chart(f"Share of frames below an error: {label.split()[0].rstrip(',')}", across, _share(), series)


def _share() -> Axis:
    return Axis("share of frames", low=0.0, high=1.0)


def _by_condition(
    evaluation: Evaluation, by: str, title: str, label: str, metric: str, value: str, unit: Callable[[float], float]
) -> str:
    """Mean with its 95 % interval in each bin that has frames."""
    series = [_binned(run, by, metric, unit) for run in evaluation.runs]
    return curve_chart(title, Axis(label), Axis(f"{value}, 95 % interval", low=0.0), series)


def _binned(run: ProtocolRun, by: str, metric: str, unit: Callable[[float], float]) -> Series:
    bins = [b for b in run.summary.bins if b.by == by and metric in b.metrics]
    found = [b.metrics[metric] for b in bins]
    return Series(
        PROTOCOL_WORDS[run.protocol],
        np.array([unit(_middle(run, b)) for b in bins]),
        np.array([statistic.mean for statistic in found]),
        np.array([statistic.low for statistic in found]),
        np.array([statistic.high for statistic in found]),
    )


def _by_background(evaluation: Evaluation, title: str, metric: str, value: str) -> str:
    """Black sky beside Earth in view; empty where it is unknown."""
    series = []
    for run in evaluation.runs:
        found = {b.low > 0: b.metrics[metric] for b in run.summary.bins if b.by == "earth_in_view"}
        both = [found.get(earth) for earth in (False, True)]
        mean, low, high = (
            np.array([np.nan if statistic is None else getattr(statistic, name) for statistic in both])
            for name in ("mean", "low", "high")
        )
        series.append(Series(PROTOCOL_WORDS[run.protocol], np.arange(2.0), mean, low, high))
    return bar_chart(title, Axis(f"{value}, 95 % interval", low=0.0), ("black sky", "Earth in view"), series)


def _middle(run: ProtocolRun, bin_: Bin) -> float:
    """The median of the frames in the bin: an open bin has no middle."""
    values = [getattr(case.errors, bin_.by) for case in run.cases]
    inside = [v for v in values if v is not None and bin_.low <= v <= bin_.high]
    return float(np.median(inside))


def _by_keypoint(evaluation: Evaluation) -> str:
    names = evaluation.spacecraft.keypoint_names
    series = []
    for run in evaluation.runs:
        found = [keypoint_statistics(run, k) for k in range(len(names))]
        median = np.array([np.nan if f.median_px is None else f.median_px for f in found])
        high = np.array([np.nan if f.high_px is None else f.high_px for f in found])
        series.append(Series(PROTOCOL_WORDS[run.protocol], np.arange(len(names), dtype=float), median, median, high))
    return bar_chart(
        "Error by keypoint", Axis("px of the 256 crop: median, line to the 90th percentile"), names, series
    )
