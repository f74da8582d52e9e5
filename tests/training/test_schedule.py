"""Stages, learning rate and budget are functions of progress."""

from __future__ import annotations

import pytest

pytest.importorskip("torch")

from gknet.errors import GknetError
from gknet.network.build import NETWORKS
from gknet.network.spec import Stage
from gknet.training.schedule import Budget, learning_rate, parse_stages, stage_at


def test_stages_follow_their_shares() -> None:
    stages = parse_stages("0.5:128:64,0.5:256:32")
    assert stages == (Stage(0.5, 128, 64), Stage(0.5, 256, 32))
    sizes = [stage_at(stages, progress).input_size for progress in (0, 0.49, 0.5, 0.99, 1.0)]
    assert sizes == [128, 128, 256, 256, 256]


@pytest.mark.parametrize(
    "text", ["", "1:256", "0.5:256:32", "1:100:32", "1:256:0", "1:32:1", "a:b:c", "0.5:128:8,0.6:256:8"]
)
def test_bad_stages_are_refused(text: str) -> None:
    with pytest.raises(GknetError, match="stage"):
        parse_stages(text)


def test_every_network_has_stages_that_fill_the_budget() -> None:
    for spec in NETWORKS.values():
        assert sum(stage.share for stage in spec.stages) == pytest.approx(1)
        assert spec.stages[-1].input_size == 256


def test_the_rate_rises_then_falls_to_zero() -> None:
    rates = [learning_rate(1.0, k / 100, 0.1) for k in range(101)]
    assert rates[10] == pytest.approx(1)
    assert rates[:11] == sorted(rates[:11])
    assert rates[10:] == sorted(rates[10:], reverse=True)
    assert rates[-1] == pytest.approx(0, abs=1e-12)


def test_budgets_by_clock_and_by_samples() -> None:
    assert Budget(minutes=2).progress(10**9, 60) == pytest.approx(0.5)
    assert Budget(samples=1000).progress(250, 1e9) == pytest.approx(0.25)
    assert Budget(samples=10).progress(25, 0) == 1
    for minutes, samples in ((None, None), (1, 1), (0, None), (None, -1)):
        with pytest.raises(GknetError, match="budget"):
            Budget(minutes, samples)


def test_warm_restarts() -> None:
    rates = [learning_rate(1.0, k / 100, 0.0, cycles=5) for k in range(101)]
    assert [k for k in range(100) if rates[k] > 0.999] == [0, 20, 40, 60, 80]
    assert rates[100] == pytest.approx(0)
    assert rates[30] == pytest.approx(0.5)
    assert max(rates[15:20]) < 0.2
