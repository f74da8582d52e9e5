"""Motion: the chaser about the spacecraft, the spacecraft about itself, the orbit of both.

LVLH axes move with the spacecraft on its circular orbit: x radially out, y along the velocity, z along the orbit's
normal. Relative motion follows Clohessy and Wiltshire,
    x'' = 3 n^2 x + 2 n y',    y'' = -2 n x',    z'' = -n^2 z,
whose solution is closed. Attitude follows Euler's equations without torque.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from gknet.errors import GknetError

GRAVITY_M3_S2 = 3.986004418e14
"""The Earth's gravitational parameter."""

Times = Float[ndarray, " t"]
Positions = Float[ndarray, "t 3"]


def mean_motion(orbit_radius_m: float) -> float:
    """n in rad/s of a circular orbit, from its radius in m."""
    return float(np.sqrt(GRAVITY_M3_S2 / orbit_radius_m**3))


def relative_transition(rate: float, time_s: Times) -> Float[ndarray, "t 6 6"]:
    """The state (x, y, z, x', y', z') at each time from that at 0 (Clohessy and Wiltshire).

    Args:
        rate: Mean motion n of the orbit, in rad/s.
        time_s: (t,) in s.

    Returns:
        (t, 6, 6) matrices.
    """
    n, t = rate, np.asarray(time_s, dtype=np.float64)
    s, c = np.sin(n * t), np.cos(n * t)
    phi = np.zeros((len(t), 6, 6))
    phi[:, 0, 0], phi[:, 0, 3], phi[:, 0, 4] = 4 - 3 * c, s / n, 2 * (1 - c) / n
    phi[:, 1, 0], phi[:, 1, 1], phi[:, 1, 3] = 6 * (s - n * t), 1, -2 * (1 - c) / n
    phi[:, 1, 4] = (4 * s - 3 * n * t) / n
    phi[:, 2, 2], phi[:, 2, 5] = c, s / n
    phi[:, 3, 0], phi[:, 3, 3], phi[:, 3, 4] = 3 * n * s, c, 2 * s
    phi[:, 4, 0], phi[:, 4, 3], phi[:, 4, 4] = 6 * n * (c - 1), -2 * s, 4 * c - 3
    phi[:, 5, 2], phi[:, 5, 5] = -n * s, c
    return phi


def approach(rate: float, time_s: Times, start_m: Float[ndarray, "3"], end_m: Float[ndarray, "3"]) -> Positions:
    """The free flight between two points of LVLH.

    Args:
        rate: Mean motion n of the orbit, in rad/s.
        time_s: (t,) in s, ascending.
        start_m: (3,) at the first time.
        end_m: (3,) at the last time.

    Returns:
        (t, 3) positions in m.

    Raises:
        GknetError: The flight takes half an orbit or more.
    """
    elapsed = time_s - time_s[0]
    if not 0 < rate * elapsed[-1] < np.pi:
        raise GknetError(
            f"approach: expected less than half an orbit, got {rate * elapsed[-1] / (2 * np.pi):.2f} orbits"
        )
    phi = relative_transition(rate, elapsed)
    velocity = np.linalg.solve(phi[-1, :3, 3:], end_m - phi[-1, :3, :3] @ start_m)
    return phi[:, :3] @ np.concatenate([start_m, velocity])


def fly_around(
    rate: float, time_s: Times, radial_m: float, normal_m: float, angles_rad: tuple[float, float]
) -> Positions:
    """The closed relative ellipse. Without y' = -2 n x it would drift.

    Args:
        rate: Mean motion n of the orbit, in rad/s.
        time_s: (t,) in s.
        radial_m: Its radial semi-axis; that along the track is twice as long.
        normal_m: Its amplitude across the orbital plane.
        angles_rad: Phases in the orbital plane and across it at time 0.

    Returns:
        (t, 3) positions in LVLH in m.
    """
    in_plane, across = (rate * time_s + angle for angle in angles_rad)
    return np.stack([radial_m * np.cos(in_plane), -2 * radial_m * np.sin(in_plane), normal_m * np.cos(across)], axis=1)


def hold(time_s: Times, point_m: Float[ndarray, "3"], slack: float, rng: np.random.Generator) -> Positions:
    """Station-keeping at a point of LVLH.

    Only points on the track (x = z = 0) are equilibria; the others cost propellant, and inspectors pay it.

    Args:
        time_s: (t,) in s.
        point_m: (3,) in LVLH.
        slack: Thrust holds the position within this fraction of the point's distance.
        rng: Draws the motion.

    Returns:
        (t, 3) positions in LVLH in m.
    """
    wander = np.stack([band_limited(time_s, rng, (60.0, 400.0)) for _ in range(3)], axis=1)
    return point_m + slack * float(np.linalg.norm(point_m)) * wander


def band_limited(time_s: Times, rng: np.random.Generator, periods_s: tuple[float, float]) -> Times:
    """A smooth random process in [-1, 1]: five sines with random phases.

    Args:
        time_s: (t,) in s.
        rng: Draws the sines.
        periods_s: The shortest and the longest period, in s.
    """
    periods = np.exp(rng.uniform(np.log(periods_s[0]), np.log(periods_s[1]), size=5))
    weights = rng.dirichlet(np.full(5, 2.0))
    phases = rng.uniform(0, 2 * np.pi, size=5)
    return np.sin(2 * np.pi * np.asarray(time_s)[:, None] / periods + phases) @ weights


def tumble(
    inertia: Float[ndarray, "3"], attitude_wxyz: Float[ndarray, "4"], spin_rad_s: Float[ndarray, "3"], time_s: Times
) -> tuple[Float[ndarray, "t 4"], Positions]:
    """Torque-free rotation (Euler's equations). Angular momentum and energy stay to about 1e-9.

    Args:
        inertia: (3,) principal moments, along the body's axes here; only their ratios matter.
        attitude_wxyz: (4,) quaternion, inertial from body, at time 0.
        spin_rad_s: (3,) body rates at time 0.
        time_s: (t,) in s, from 0.

    Returns:
        (t, 4) quaternions wxyz and (t, 3) body rates in rad/s.
    """
    a, b, c = (
        float((inertia[1] - inertia[2]) / inertia[0]),
        float((inertia[2] - inertia[0]) / inertia[1]),
        float((inertia[0] - inertia[1]) / inertia[2]),
    )

    def derivative(_time: float, state: ndarray) -> list[float]:
        w, x, y, z, p, q, r = state.tolist()
        return [
            (-x * p - y * q - z * r) / 2,
            (w * p + y * r - z * q) / 2,
            (w * q + z * p - x * r) / 2,
            (w * r + x * q - y * p) / 2,
            a * q * r,
            b * r * p,
            c * p * q,
        ]

    start = np.concatenate([attitude_wxyz, spin_rad_s])
    solution = solve_ivp(
        derivative, (0.0, float(time_s[-1]) + 1e-9), start, "DOP853", t_eval=time_s, rtol=1e-10, atol=1e-12
    )
    quaternions = solution.y[:4].T
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True), solution.y[4:].T


def random_inertia(rng: np.random.Generator) -> Float[ndarray, "3"]:
    """Principal moments of some body: sums of pairs of positive second moments, so that the triangle rule holds."""
    second = rng.uniform(0.15, 1.0, size=3)
    return second.sum() - second


def orbit_frames(rate: float, time_s: Times, plane: Float[ndarray, "3 3"]) -> Float[ndarray, "t 3 3"]:
    """inertial_from_lvlh at each time; the columns of `plane` are LVLH's axes in the inertial frame at time 0."""
    turns = Rotation.from_rotvec(rate * np.asarray(time_s)[:, None] * np.array([0.0, 0.0, 1.0])).as_matrix()
    return plane @ turns


def random_rotation(rng: np.random.Generator) -> Rotation:
    """Uniform on the rotations."""
    return Rotation.from_quat(rng.standard_normal(4))


def random_direction(rng: np.random.Generator) -> Float[ndarray, "3"]:
    """Uniform on the sphere."""
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def look_at(target: Positions, up: Float[ndarray, "3"]) -> Float[ndarray, "t 3 3"]:
    """Attitudes of cameras by where they point.

    Args:
        target: (t, 3) directions of the optical axes.
        up: (3,) image up is on the side of this vector.

    Returns:
        (t, 3, 3) rotations cam_from_frame, from the frame of the vectors.
    """
    z = target / np.linalg.norm(target, axis=1, keepdims=True)
    x = np.cross(z, up)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=1)
