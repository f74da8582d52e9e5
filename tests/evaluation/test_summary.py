"""Every frame is counted, and intervals cover."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.evaluation.metrics import FrameErrors, compute_errors
from gknet.evaluation.summary import summarise
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
        s.low <= 10 <= s.high for s in (summarise(many(12, 10, k), resamples=200).metrics["rmse_px"] for k in range(60))
    ]
    assert 0.8 <= np.mean(covered) <= 1.0
    apart = [replace(e, sequence=e.name) for e in many(12, 10, 0)]
    together, alone = summarise(many(12, 10, 0)).metrics["rmse_px"], summarise(apart).metrics["rmse_px"]
    assert together.high - together.low > 1.5 * (alone.high - alone.low)


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
