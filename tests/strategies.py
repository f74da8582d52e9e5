"""What the property tests draw from."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from gknet.frame import Box
from gknet.geometry import Pose

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
