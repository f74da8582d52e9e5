"""Relative motion solves its equation; a free tumble conserves what physics conserves."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError
from gknet.render import trajectory

RATE = trajectory.mean_motion(6_371_000.0 + 700_000.0)


def test_mean_motion_of_a_700_km_orbit_is_99_minutes() -> None:
    assert 2 * np.pi / RATE / 60 == pytest.approx(98.6, abs=0.3)


def test_transition_satisfies_the_differential_equation() -> None:
    n, step = RATE, 0.5
    times = np.array([100.0 - step, 100.0, 100.0 + step])
    before, now, after = trajectory.relative_transition(n, times)
    system = np.zeros((6, 6))
    system[:3, 3:] = np.eye(3)
    system[3, 0], system[3, 4], system[4, 3], system[5, 2] = 3 * n**2, 2 * n, -2 * n, -(n**2)
    derivative = (after - before) / (2 * step)
    np.testing.assert_allclose(derivative, system @ now, atol=1e-6)


def test_transition_composes_and_starts_at_identity() -> None:
    first, second, both = trajectory.relative_transition(RATE, np.array([200.0, 350.0, 550.0]))
    np.testing.assert_allclose(second @ first, both, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(trajectory.relative_transition(RATE, np.zeros(1))[0], np.eye(6), atol=1e-12)


def test_approach_starts_and_ends_where_asked_and_flies_freely_between() -> None:
    times = np.linspace(0, 400, 301)
    start, end = np.array([10.0, -80.0, 20.0]), np.array([1.0, -12.0, 3.0])
    path = trajectory.approach(RATE, times, start, end)
    np.testing.assert_allclose(path[[0, -1]], [start, end], atol=1e-8)
    assert_free_flight(path, times[1] - times[0])


def test_approach_over_half_an_orbit_is_refused() -> None:
    with pytest.raises(GknetError, match="half an orbit"):
        trajectory.approach(RATE, np.array([0.0, 4000.0]), np.ones(3), np.ones(3))


def test_fly_around_is_free_and_closes_after_one_orbit() -> None:
    period = 2 * np.pi / RATE
    times = np.linspace(0, period, 2001)
    path = trajectory.fly_around(RATE, times, 20.0, 30.0, (0.4, 2.0))
    np.testing.assert_allclose(path[0], path[-1], atol=1e-9)
    assert np.ptp(path[:, 1]) == pytest.approx(2 * np.ptp(path[:, 0]), rel=1e-4)
    assert_free_flight(path, times[1] - times[0])


def assert_free_flight(path: np.ndarray, step: float) -> None:
    """The second differences obey the Clohessy-Wiltshire equation."""
    velocity = (path[2:] - path[:-2]) / (2 * step)
    acceleration = (path[2:] - 2 * path[1:-1] + path[:-2]) / step**2
    x, z = path[1:-1, 0], path[1:-1, 2]
    expected = np.stack(
        [3 * RATE**2 * x + 2 * RATE * velocity[:, 1], -2 * RATE * velocity[:, 0], -(RATE**2) * z], axis=1
    )
    np.testing.assert_allclose(acceleration, expected, atol=1e-4 * np.abs(acceleration).max() + 1e-9)


def test_hold_stays_within_its_slack() -> None:
    point = np.array([5.0, 40.0, -3.0])
    path = trajectory.hold(np.arange(0.0, 600.0), point, 0.05, np.random.default_rng(0))
    assert np.abs(path - point).max() <= 0.05 * np.linalg.norm(point)
    assert np.ptp(path, axis=0).min() > 0


def test_band_limited_is_bounded_and_smooth() -> None:
    for seed in range(20):
        values = trajectory.band_limited(np.arange(0.0, 600.0), np.random.default_rng(seed), (60.0, 300.0))
        assert np.abs(values).max() <= 1
        assert np.abs(np.diff(values)).max() <= 2 * np.pi / 60


@pytest.mark.parametrize("seed", range(5))
def test_tumble_conserves_energy_and_angular_momentum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    inertia = trajectory.random_inertia(rng)
    start = trajectory.random_rotation(rng).as_quat()[[3, 0, 1, 2]]
    spin = np.radians(6.0) * trajectory.random_direction(rng)
    wxyz, rates = trajectory.tumble(inertia, start, spin, np.arange(300) * 2.0)
    energy = (inertia * rates**2).sum(axis=1)
    momentum = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]]).apply(inertia * rates)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7)
    np.testing.assert_allclose(momentum, np.broadcast_to(momentum[0], momentum.shape), atol=1e-7)
    assert np.ptp(rates, axis=0).max() > 1e-3, "a free body with three moments does not spin steadily"


def test_tumble_turns_at_its_own_rates() -> None:
    """q' = q w / 2: the step between attitudes is the body rate times the time."""
    step = 0.05
    wxyz, rates = trajectory.tumble(
        np.array([1.0, 1.3, 0.7]), np.array([1.0, 0, 0, 0]), np.array([0.02, 0.05, -0.03]), np.arange(3) * step
    )
    turned = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]])
    np.testing.assert_allclose((turned[0].inv() * turned[2]).as_rotvec() / (2 * step), rates[1], rtol=1e-4)


def test_random_inertia_obeys_the_triangle_rule() -> None:
    for seed in range(50):
        a, b, c = np.sort(trajectory.random_inertia(np.random.default_rng(seed)))
        assert c < a + b


def test_look_at_puts_the_target_on_the_axis_and_up_above() -> None:
    targets = np.array([[3.0, 1.0, -2.0], [0.0, 5.0, 1.0]])
    up = np.array([0.0, 0.0, 1.0])
    cam_from_frame = trajectory.look_at(targets, up)
    for rotation, target in zip(cam_from_frame, targets, strict=True):
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        np.testing.assert_allclose(rotation @ target, np.array([0, 0, np.linalg.norm(target)]), atol=1e-9)
        assert (rotation @ up)[1] < 0, "image y points down"
