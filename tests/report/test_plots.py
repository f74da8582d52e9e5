"""The charts of an evaluation: no point or bar alone, no interval where there is none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gknet.dataset.skd import open_dataset
from gknet.evaluation.evaluate import Evaluation, ProtocolRun, evaluate
from gknet.report.page import Section, page
from gknet.report.plots import charts
from gknet.report.table import interval_text, mean_heading
from tests.cli.toy import ToyEstimator, toy_spacecraft, write_toy_dataset


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Evaluation:
    """Of one sequence, with ambiguous poses."""
    root = write_toy_dataset(tmp_path_factory.mktemp("plots") / "set", sequences=1, frames=6)
    dataset = open_dataset(Path(root), toy_spacecraft(), None, 1)
    return evaluate(dataset, ToyEstimator(error=1.0, ambiguous=frozenset({1, 2})), data="toys")


def titles(evaluation: Evaluation) -> list[str]:
    return [chart.split('aria-label="')[1].split('"')[0] for chart in charts(evaluation)]


def with_earth(evaluation: Evaluation, earth: list[float]) -> Evaluation:
    runs = []
    for run in evaluation.runs:
        cases = zip(run.cases, earth, strict=True)
        moved = (replace(case, errors=replace(case.errors, earth_in_view=value)) for case, value in cases)
        runs.append(ProtocolRun(run.protocol, tuple(moved)))
    return replace(evaluation, runs=tuple(runs))


def test_one_sequence_has_means_alone(alone: Evaluation) -> None:
    run = alone.runs[0]
    assert mean_heading(run) == "mean"
    assert interval_text(run.summary.metrics["e_t"], 4) == f"{run.summary.metrics['e_t'].mean:.4f}"
    drawn = page("t", [Section(alone)])
    assert "6 frames of 1 sequence<" in drawn
    assert "95 % interval" not in drawn
    assert "E_q by attitude confidence" in drawn


def test_two_sequences_have_intervals(alone: Evaluation) -> None:
    cases = alone.runs[0].cases
    moved = [replace(c, errors=replace(c.errors, sequence=str(c.index % 2))) for c in cases]
    run = ProtocolRun("oracle", tuple(moved))
    assert mean_heading(run) == "mean [95 %]"
    assert "[" in interval_text(run.summary.metrics["e_t"], 4)
    assert "95 % interval" in "".join(charts(replace(alone, runs=(run,))))


def test_a_condition_with_one_value_has_no_chart(alone: Evaluation) -> None:
    assert "E_q by background" not in titles(alone)
    assert "E_q by background" not in titles(with_earth(alone, [1.0] * 6))
    assert "E_q by background" in titles(with_earth(alone, [1.0, 0.0] * 3))
    frame = replace(alone, runs=tuple(ProtocolRun(run.protocol, run.cases[:1]) for run in alone.runs))
    assert titles(frame) == ["Error by keypoint"]


def test_a_keypoint_that_is_never_in_view_has_no_bar(alone: Evaluation) -> None:
    name = alone.spacecraft.keypoint_names[3]
    assert any(f">{name}<" in chart for chart in charts(alone))
    out_of_view = np.arange(alone.spacecraft.keypoint_count) == 3
    runs = [
        ProtocolRun(
            run.protocol, tuple(replace(c, keypoint_px=np.where(out_of_view, np.nan, c.keypoint_px)) for c in run.cases)
        )
        for run in alone.runs
    ]
    assert not any(f">{name}<" in chart for chart in charts(replace(alone, runs=tuple(runs))))


def test_the_errors_axis_is_marked_as_logarithmic(alone: Evaluation) -> None:
    assert "E_q in rad (log scale)" in charts(alone)[2]
