"""Every frame is counted, and intervals cover."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.evaluation.metrics import FrameErrors, compute_errors
from gknet.evaluation.summary import Statistic, summarise
from gknet.frame import FailureKind
from tests.evaluation.test_metrics import CRAFT, FRAME, POSE, estimate_at


def many(sequences: int, frames: int, seed: int) -> list[FrameErrors]:
    """Errors that differ more between sequences than within one; every tenth frame fails."""
    generator = np.random.default_rng(seed)
    one = compute_errors(FRAME, estimate_at(POSE), CRAFT)
    found = []
    for s in range(sequences):
        level = generator.normal(10, 2)
        for k in range(frames):
            e_t = 1.0 if k % 10 == 9 else 0.01
            kind = FailureKind.TOO_FEW_INLIERS if k % 10 == 9 else None
            rmse = level + generator.normal(0, 0.5)
            known = replace(one, name=f"{s}/{k}", sequence=str(s), rmse_px=rmse, e_t=e_t, failure=kind)
            confidence = None if kind else 0.3 if s == 0 else 0.9
            found.append(replace(known, earth_in_view=float(s % 3 == 0), attitude_confidence=confidence))
    return found


def interval(found: Statistic) -> tuple[float, float]:
    assert found.low is not None
    assert found.high is not None
    return found.low, found.high


def test_everything_is_counted() -> None:
    summary = summarise(many(6, 20, 0))
    assert (summary.frames, summary.sequences, summary.failures) == (120, 6, {FailureKind.TOO_FEW_INLIERS: 12})
    assert summary.metrics["e_t"].mean == pytest.approx(0.1 + 0.9 * 0.01)
    assert summary.metrics["e_t"].median == 0.01
    assert all(statistic.frames == 120 for statistic in summary.metrics.values())
    for by in ("range_diameters", "phase_angle_rad", "visible_fraction", "earth_in_view"):
        assert sum(b.frames for b in summary.bins if b.by == by) == 120
        assert sum(b.failures for b in summary.bins if b.by == by) == 12
    assert [b.frames for b in summary.bins if b.by == "earth_in_view"] == [80, 40]
    assert [(b.low, b.frames) for b in summary.bins if b.by == "attitude_confidence"] == [(0.0, 18), (0.8, 90)]
    assert summary.located_07 == 1.0
    assert summary.coverage_95 == 1.0


def test_interval_resamples_sequences_and_covers() -> None:
    """Frames of a sequence err together: the interval of the mean must be as wide as the sequences make it."""
    covered = [
        low <= 10 <= high
        for low, high in (interval(summarise(many(12, 10, k), resamples=200).metrics["rmse_px"]) for k in range(60))
    ]
    assert 0.8 <= np.mean(covered) <= 1.0
    apart = [replace(e, sequence=e.name) for e in many(12, 10, 0)]
    together, alone = (np.ptp(interval(summarise(e).metrics["rmse_px"])) for e in (many(12, 10, 0), apart))
    assert together > 1.5 * alone


def test_one_sequence_has_no_interval() -> None:
    """Resamples of one sequence are all alike: their spread is no uncertainty."""
    alone = summarise(many(1, 10, 0))
    assert {(s.low, s.high) for s in alone.metrics.values()} == {(None, None)}
    assert json.loads(json.dumps(alone.to_dict()))["metrics"]["e_t"]["low"] is None
    both = [*many(2, 10, 0)]
    both[:10] = [replace(e, nees=None) for e in both[:10]]
    metrics = summarise(both).metrics
    assert metrics["nees"].low is None  # one of the two sequences has it
    assert metrics["e_t"].low is not None


def test_it_is_deterministic_and_json() -> None:
    frames = many(4, 10, 0)
    first, second = (json.dumps(summarise(frames, seed=1).to_dict(), allow_nan=False) for _ in range(2))
    assert first == second
    assert json.loads(first)["metrics"]["e_t"]["frames"] == 40


def test_a_metric_that_no_frame_has_is_absent() -> None:
    metrics = summarise([compute_errors(replace(FRAME, visible=None), estimate_at(POSE), CRAFT)]).metrics
    assert "rmse_hidden_px" not in metrics
    assert metrics["rmse_px"].frames == 1
    with pytest.raises(GknetError, match="at least one"):
        summarise([])
