"""What the camera meets in frame `index` of sequence `sequence`: a pure function of (recipe, seed, sequence, index)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gknet.geometry import Camera, Pose
from gknet.render.recipe import RECIPES, Recipe, load_recipe
from gknet.render.sensor import Sensor
from gknet.spacecraft import Spacecraft

__all__ = ["CAMERA", "RECIPES", "EarthView", "Recipe", "Sensor", "Shot", "load_recipe", "shoot"]

CAMERA = Camera.from_focal(1400.0, 1024, 1024)
"""The whole sensor at its native resolution."""

EARTH_RADIUS_M = 6_371_000.0


@dataclass(frozen=True, eq=False)
class EarthView:
    """Where the Earth is. Earth-fixed axes: z to the north pole, x to longitude 0, y to longitude 90 degrees east."""

    centre_cam_m: Float[ndarray, "3"]
    cam_from_earth: Float[ndarray, "3 3"]


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame before light: all that the renderer, the background and the sensor need.

    sun_direction       unit vector to the sun, camera frame
    earth_direction     unit vector to the Earth's centre, camera frame, whether in view or not (for earthshine)
    earth               None when no part of the Earth is in view
    cam_from_inertial   inertial axes are equatorial, those of the star catalogue
    seed                of this frame's noise
    """

    recipe: str
    spacecraft: str
    sequence: int
    index: int
    time_s: float
    camera: Camera
    cam_from_body: Pose
    sun_direction: Float[ndarray, "3"]
    earth_direction: Float[ndarray, "3"]
    earth: EarthView | None
    cam_from_inertial: Float[ndarray, "3 3"]
    sensor: Sensor
    seed: int


def shoot(recipe: Recipe, spacecraft: Spacecraft, seed: int, sequence: int, index: int) -> Shot:
    """The shot of one frame, in any order."""
    raise NotImplementedError
