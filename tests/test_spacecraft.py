"""Spacecraft: invariants, and values that are refused."""

from __future__ import annotations

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.spacecraft import MAX_KEYPOINTS, Spacecraft, diameter


def probe() -> Spacecraft:
    return Spacecraft("probe", ("a", "b", "c", "d"), np.eye(4, 3), ((1, 0), (0, 1), (2, 3)), 2.0)


def test_edges_are_sorted_and_single() -> None:
    assert probe().edges == ((0, 1), (2, 3))


def test_adjacency_is_symmetric_with_ones_on_the_diagonal() -> None:
    """Eq. 3."""
    adjacency = probe().adjacency
    assert (adjacency == adjacency.T).all()
    assert adjacency.diagonal().all()
    assert adjacency.sum() == 4 + 2 * 2


def test_points_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        probe().points_m[0, 0] = 9


@pytest.mark.parametrize("edge", [(0, 4), (-1, 2), (3, 3)])
def test_edge_out_of_range_is_refused(edge: tuple[int, int]) -> None:
    with pytest.raises(GknetError, match="edge"):
        Spacecraft("probe", ("a", "b", "c", "d"), np.eye(4, 3), (edge,), 2.0)


@pytest.mark.parametrize("points", [np.eye(3), np.full((4, 3), np.nan)])
def test_bad_points_are_refused(points: np.ndarray) -> None:
    with pytest.raises(GknetError, match="keypoints"):
        Spacecraft("probe", ("a", "b", "c", "d"), points, (), 2.0)


@pytest.mark.parametrize("large", [1e308, -2e5])
def test_lengths_beyond_reason_are_refused(large: float) -> None:
    """Their squares would overflow, or lose the rest of the craft."""
    points = np.eye(4, 3)
    points[2, 1] = large
    with pytest.raises(GknetError, match="within 100000 m"):
        Spacecraft("probe", ("a", "b", "c", "d"), points, (), 2.0)


@pytest.mark.parametrize("diameter_m", [0.0, -1.0, float("nan"), float("inf"), 1e6])
def test_bad_diameter_is_refused(diameter_m: float) -> None:
    with pytest.raises(GknetError, match="diameter"):
        Spacecraft("probe", ("a", "b", "c", "d"), np.eye(4, 3), (), diameter_m)


def test_more_keypoints_than_fit_into_memory_are_refused() -> None:
    for count in (MAX_KEYPOINTS, MAX_KEYPOINTS + 1):
        names = tuple(f"k{k}" for k in range(count))
        if count <= MAX_KEYPOINTS:
            assert Spacecraft("probe", names, np.zeros((count, 3)), (), 2.0).keypoint_count == count
        else:
            with pytest.raises(GknetError, match="at most 1000 keypoints"):
                Spacecraft("probe", names, np.zeros((count, 3)), (), 2.0)


def test_diameter_is_the_largest_distance() -> None:
    points = np.random.default_rng(2).normal(size=(60, 3))
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    assert diameter(points) == pytest.approx(distances.max())
