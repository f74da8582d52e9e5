"""Intervals that know which frames are alike, and differences that know which frames are the same."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.evaluation.comparison import (
    LOW_VISIBILITY,
    Trial,
    _draws,
    difference,
    mean_of,
    seed_gaps,
    where_attitudes_hold,
)
from gknet.evaluation.evaluate import evaluate
from tests.cli.toy import ToyEstimator, write_toy_dataset


def trial(method: str, values: np.ndarray, seed: int = 0, per_sequence: int = 10) -> Trial:
    frames = tuple(f"{k:04d}" for k in range(len(values)))
    sequences = tuple(f"s{k // per_sequence}" for k in range(len(values)))
    return Trial(method, "toy", seed, frames, sequences, {"rmse_px": values}, np.eye(3, dtype=np.int64))


def test_the_mean_is_over_known_frames_and_its_interval_holds_it() -> None:
    values = np.arange(40.0)
    values[3] = np.nan
    found = mean_of([trial("a", values)], "rmse_px")
    assert found.mean == pytest.approx(np.nanmean(values))
    assert found.low < found.mean < found.high


def test_frames_of_one_sequence_do_not_count_as_many() -> None:
    rng = np.random.default_rng(0)
    alike = np.repeat(rng.normal(size=8), 50) + 0.01 * rng.normal(size=400)
    together = mean_of([trial("a", alike, per_sequence=50)], "rmse_px")
    apart = mean_of([trial("a", alike, per_sequence=1)], "rmse_px")
    assert together.high - together.low > 4 * (apart.high - apart.low)


def test_a_difference_is_paired() -> None:
    rng = np.random.default_rng(1)
    base = rng.normal(20, 10, 200)
    worse = base + rng.normal(1, 0.5, 200)
    gap = difference([trial("a", base)], [trial("b", worse)], "rmse_px")
    assert gap.mean == pytest.approx((base - worse).mean())
    assert gap.excludes_zero
    assert gap.high < 0
    alone = mean_of([trial("a", base)], "rmse_px")
    assert gap.high - gap.low < (alone.high - alone.low) / 3
    assert not difference([trial("a", base)], [trial("b", rng.permutation(base))], "rmse_px").excludes_zero


def test_where_attitudes_hold_both_are_judged_on_the_frames_that_both_know() -> None:
    def known(method: str, rmse: np.ndarray, e_q: np.ndarray) -> Trial:
        return replace(trial(method, rmse), values={"rmse_px": rmse, "e_q_rad": e_q})

    rmse, right = np.arange(30.0), np.full(30, 0.1)
    counterpart, other = right.copy(), right.copy()
    counterpart[:10], other[5:12] = 3.1, 0.36
    pair = [known("a", rmse, counterpart)], [known("b", 2 * rmse, other)]
    ours, theirs = where_attitudes_hold(*pair)
    for (masked,), factor in ((ours, 1), (theirs, 2)):
        assert np.isnan(masked.values["rmse_px"][:12]).all()
        np.testing.assert_array_equal(masked.values["rmse_px"][12:], factor * rmse[12:])
    assert difference(ours, theirs, "rmse_px").mean == pytest.approx(-rmse[12:].mean())
    assert np.isfinite(pair[0][0].values["rmse_px"]).all()


def test_seeds_that_disagree_widen_the_interval() -> None:
    rng = np.random.default_rng(2)
    values = rng.normal(20, 1, 100)
    agreeing = mean_of([trial("a", values, seed) for seed in range(3)], "rmse_px")
    disagreeing = mean_of([trial("a", values + 5 * seed, seed) for seed in range(3)], "rmse_px")
    assert disagreeing.high - disagreeing.low > 3 * (agreeing.high - agreeing.low)


def test_resamples_of_few_have_their_whole_variance() -> None:
    """The mean of n values has the variance s^2 / n; n draws of them would show (n - 1) / n of it."""
    shifts = np.array([-3.0, 1.0, 4.0])
    for draws in _draws(3, 3, seed=0, resamples=40_000):
        means = draws @ shifts / draws.sum(axis=1)
        assert means.var() == pytest.approx(shifts.var(ddof=1) / 3, rel=0.03)


def test_each_seed_has_a_gap_of_its_own() -> None:
    base = np.random.default_rng(4).normal(20, 5, 100)
    first = [trial("a", base, 0), trial("a", base, 1)]
    second = [trial("b", base + 1, 0), trial("b", np.where(base > 20, np.nan, base - 0.1), 1)]
    gaps = seed_gaps(first, second, "rmse_px")
    assert gaps == pytest.approx([-1, base.mean() - base[base <= 20].mean() + 0.1])
    assert np.isnan(seed_gaps(first[:1], [trial("b", np.full(100, np.nan))], "rmse_px")).all()


def test_a_resample_without_a_known_value_is_left_out() -> None:
    values = np.full(200, np.nan)
    values[[5, 15]] = 30, 31
    found = mean_of([trial("a", values)], "rmse_px")
    assert found.low >= 30
    gap = difference([trial("a", values)], [trial("b", values + 10)], "rmse_px")
    assert gap.low == pytest.approx(-10)
    assert gap.high == pytest.approx(-10)


def test_different_frames_are_not_compared() -> None:
    values = np.arange(20.0)
    with pytest.raises(GknetError, match="different frames"):
        difference([trial("a", values)], [trial("b", values[:10])], "rmse_px")
    with pytest.raises(GknetError, match="different frames"):
        where_attitudes_hold([trial("a", values)], [trial("b", values[:10])])
    with pytest.raises(GknetError, match="at least one"):
        mean_of([], "rmse_px")
    with pytest.raises(GknetError, match="no frame"):
        mean_of([trial("a", np.full(20, np.nan))], "rmse_px")
    with pytest.raises(GknetError, match="no metric swapped"):
        mean_of([trial("a", values)], "swapped")


def test_a_trial_survives_json() -> None:
    values = np.array([1.23456, np.nan, 3.0])
    first = trial("a", values)
    again = Trial.from_dict(json.loads(json.dumps(first.to_dict())))
    np.testing.assert_allclose(again.values["rmse_px"], values, rtol=1e-3)
    assert again.sequences == first.sequences
    assert (again.confusion == first.confusion).all()
    with pytest.raises(GknetError, match="trial"):
        Trial.from_dict({"method": "a"})


def test_a_trial_says_what_its_run_measured(tmp_path: Path) -> None:
    dataset = SkdDataset(write_toy_dataset(tmp_path / "set", sequences=1, frames=3))
    (run,) = evaluate(dataset, ToyEstimator(), ("oracle",)).runs
    clear, veiled, unknown = run.cases
    count = len(clear.taken_for)
    exchanged = np.arange(count)
    exchanged[[0, 1]] = 1, 0
    clear = replace(clear, errors=replace(clear.errors, visible_fraction=LOW_VISIBILITY), taken_for=exchanged)
    own = np.where(np.isnan(veiled.keypoint_px), -1, np.arange(count))
    veiled = replace(veiled, errors=replace(veiled.errors, visible_fraction=LOW_VISIBILITY - 0.01), taken_for=own)
    unknown = replace(unknown, errors=replace(unknown.errors, visible_fraction=None), taken_for=np.full(count, -1))
    values = Trial.of(replace(run, cases=(clear, veiled, unknown)), "a", "toy", 0).values
    np.testing.assert_array_equal(np.isnan(values["rmse_low_px"]), [True, False, True])
    assert values["rmse_low_px"][1] == values["rmse_px"][1] == veiled.errors.rmse_px
    np.testing.assert_allclose(values["swapped"], [2 / (~np.isnan(clear.keypoint_px)).sum(), 0, 0])
    lost = replace(clear, estimate=replace(clear.estimate, keypoints=None))
    assert np.isnan(Trial.of(replace(run, cases=(lost,)), "a", "toy", 0).values["swapped"]).all()
