"""What the property tests draw from."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from gknet.frame import Box
from gknet.geometry import Camera, Pose

coordinates = st.floats(-50, 50, allow_nan=False, width=32)
unit_interval = st.floats(0, 1, allow_nan=False)


@st.composite
def quaternions(draw: st.DrawFn) -> np.ndarray:
    """Unit, any sign; half of the time within 1e-7 of a half turn or of no turn at all."""
    seed = draw(st.integers(0, 2**31))
    quaternion = np.random.default_rng(seed).normal(size=4)
    kind = draw(st.sampled_from(["any", "half turn", "no turn", "one axis"]))
    tiny = draw(st.sampled_from([0.0, 1e-12, 1e-7, -1e-7]))
    if kind == "half turn":
        quaternion[0] = tiny
    elif kind == "no turn":
        quaternion[1:] *= tiny
    elif kind == "one axis":
        quaternion[1:] *= np.eye(3)[seed % 3]
    return quaternion / np.linalg.norm(quaternion)


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    return Pose.from_quaternion(draw(quaternions()), draw(st.tuples(coordinates, coordinates, coordinates)))


@st.composite
def boxes(draw: st.DrawFn) -> Box:
    """At least 2 px wide and high, partly beyond a 1024 px image at times."""
    x0, y0 = draw(st.floats(-300, 1000)), draw(st.floats(-300, 1000))
    return Box(x0, y0, x0 + draw(st.floats(2, 900)), y0 + draw(st.floats(2, 900)))


LENSES: dict[int, list[float]] = {
    4: [-0.28, 0.07, 3e-4, 2e-4],
    5: [-0.22383, 0.51410, -0.000665, -0.000214, -0.13124],
    8: [0.5, -0.6, 1e-4, -3e-4, 0.3, 0.45, -0.5, 0.25],
    12: [0.5, -0.6, 1e-4, -3e-4, 0.3, 0.45, -0.5, 0.25, 1e-3, -2e-4, 1e-3, 1e-4],
    14: [0.5, -0.6, 1e-4, -3e-4, 0.3, 0.45, -0.5, 0.25, 1e-3, -2e-4, 1e-3, 1e-4, 0.01, -0.02],
}
"""OpenCV's pinhole coefficients by their number, as calibrations have them."""


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    """Every lens model, its coefficients scaled from nothing to those of a strong lens."""
    width, height = draw(st.sampled_from([(640, 480), (1024, 1024), (1920, 1200)]))
    focal = draw(st.floats(300, 3000))
    centre = width * draw(st.floats(0.4, 0.6)), height * draw(st.floats(0.4, 0.6))
    matrix = np.array([[focal, 0, centre[0]], [0, focal * draw(st.floats(0.95, 1.05)), centre[1]], [0, 0, 1]])
    strength = draw(st.floats(0, 1))
    if draw(st.booleans()):
        return Camera(matrix, width, height, strength * np.array([0.1, -0.02, 0.003, 0.0004]), "fisheye")
    return Camera(matrix, width, height, strength * np.array(LENSES[draw(st.sampled_from(sorted(LENSES)))]))
