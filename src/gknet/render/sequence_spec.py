"""What each sequence of a recipe shows.

It (kind of motion, Earth, phase angle) is spread evenly over the sequences of a spacecraft before
any candidate is drawn, so that rejection cannot skew it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gknet.render.recipe import Recipe

Kind = Literal["approach", "fly_around", "hold"]
Scene = Literal["sky", "earth", "earth_fills"]

_FILLS_PHASE_DEG = 100.0
"""Over an Earth that fills the frame a larger phase angle puts the sun near or behind its edge: nothing to see."""

_EVEN = np.array([0.8191725134, 0.6710436067, 0.5497004779])
"""Steps of an evenly spread sequence of points in the unit cube (the inverse powers of the root of x^4 = x + 1)."""


@dataclass(frozen=True)
class SequenceSpec:
    """What a sequence shows.

    Attributes:
        kind: Of the chaser's motion.
        scene: What is behind the spacecraft.
        phase_rad: Angle at the spacecraft between the sun and the camera at mid-sequence, in rad.
    """

    kind: Kind
    scene: Scene
    phase_rad: float


def sequence_spec(recipe: Recipe, seed: int, sequence: int) -> SequenceSpec:
    """What a sequence shows, by its number alone: spread evenly over the sequences of its spacecraft."""
    craft, turn = sequence % len(recipe.spacecraft), sequence // len(recipe.spacecraft)
    shift = np.random.default_rng([seed, recipe.key, craft]).random(3)
    u = (shift + turn * _EVEN) % 1.0
    light, motion = recipe.light, recipe.motion
    scene: Scene = "sky"
    if u[0] < light.earth_fraction:
        scene = "earth_fills" if u[0] < light.earth_fraction * light.earth_fills else "earth"
    share = u[2] * (motion.approach + motion.fly_around + motion.hold)
    kind: Kind = "hold"
    if share < motion.approach:
        kind = "approach"
    elif share < motion.approach + motion.fly_around:
        kind = "fly_around"
    low, high = light.phase_deg
    if scene == "earth_fills":
        high = max(low, min(high, _FILLS_PHASE_DEG))
    return SequenceSpec(kind, scene, float(np.radians(low + u[1] * (high - low))))
