"""Behind the spacecraft: Earth, stars, sun, in the renderer's unit of radiance (1 = white, facing the full sun).

The Earth is a sphere met by each pixel's ray: Blue Marble's colours, clouds, a thin atmosphere that hazes the ground
and glows at the limb. What the limb cuts is computed on every pixel; what varies slowly, on coarser grids.
Lengths are in Earth radii here.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from gknet.geometry import Camera
from gknet.inference.crop import Crop
from gknet.render.earth_texture import earth_surface
from gknet.render.scenario import EARTH_RADIUS_M, EarthView, Shot
from gknet.render.stars import add_stars

TOP = 80e3 / EARTH_RADIUS_M
"""Height above which the atmosphere is black."""

ZENITH_DEPTH = np.array([0.075, 0.13, 0.26], dtype=np.float32)
"""Optical depth of the clear air straight up, RGB: Rayleigh's and some haze."""

AIR_SCALE_HEIGHT = 8.5e3 / EARTH_RADIUS_M
LIMB_AIRMASS = 35.0
"""Airmass of a ray that grazes the ground and ends there; one that passes meets twice as much."""

SKYLIGHT = np.array([0.17, 0.24, 0.36], dtype=np.float32)
"""Radiance of a deep, fully lit column of air."""

SUN_RADIANCE = 300.0
"""Of the sun's disc: in truth 46,000, but a sensor that is blinded is blinded."""

SUN_RADIUS_RAD = np.radians(0.265)
_FINE_SCALE = 0.5
"""From this scale of the window on, the ground is computed on every second pixel: its textures are smooth there."""


def background(shot: Shot, window: Crop) -> Float32[ndarray, "s s 3"]:
    """What the window would show without the spacecraft.

    Args:
        shot: The frame.
        window: A square of its full image; the image has `s = window.size` pixels a side.

    Returns:
        (s, s, 3) linear RGB radiance.
    """
    picture = np.zeros((window.size, window.size, 3), dtype=np.float32)
    add_stars(picture, shot.camera, window, shot.cam_from_inertial)
    _add_sun(picture, shot, window)
    if shot.earth is not None:
        _paint_earth(picture, shot, shot.earth, window)
    return picture


@dataclass(frozen=True, eq=False)
class _Rays:
    """Slopes x / z and y / z of the rays through the columns' and the rows' pixel centres."""

    x: Float32[ndarray, " w"]
    y: Float32[ndarray, " h"]

    @property
    def squared(self) -> Float32[ndarray, "h w"]:
        """|(x, y, 1)|^2."""
        return (self.y**2 + 1)[:, None] + self.x**2

    def along(self, vector: Float[ndarray, "3"]) -> Float32[ndarray, "h w"]:
        """(x, y, 1) . vector."""
        a, b, c = np.asarray(vector, dtype=np.float32)
        return (self.y * b + c)[:, None] + self.x * a


def _rays(camera: Camera, window: Crop) -> _Rays:
    centres = (np.arange(window.size) + 0.5) / window.scale
    k = camera.matrix
    x = (centres + window.x0 - k[0, 2]) / k[0, 0]
    y = (centres + window.y0 - k[1, 2]) / k[1, 1]
    return _Rays(x.astype(np.float32), y.astype(np.float32))


def _add_sun(picture: Float32[ndarray, "s s 3"], shot: Shot, window: Crop) -> None:
    """The sun's disc, its edge as wide as a pixel."""
    sun = shot.sun_direction
    if sun[2] <= 0.5:
        return
    centre = window.to_input(shot.camera.project(np.asarray(sun, dtype=np.float64)[None]))[0]
    radius = SUN_RADIUS_RAD * shot.camera.matrix[0, 0] * window.scale
    if not ((centre > -radius).all() and (centre < window.size + radius).all()):
        return
    grid = np.arange(window.size) + 0.5
    distance = np.hypot(*np.meshgrid(grid - centre[0], grid - centre[1]))
    picture += (SUN_RADIANCE * np.clip(radius - distance + 0.5, 0, 1)).astype(np.float32)[..., None]


def _paint_earth(picture: Float32[ndarray, "s s 3"], shot: Shot, earth: EarthView, window: Crop) -> None:
    """The Earth over what is there, within the rectangle that it and its atmosphere reach."""
    rays = _rays(shot.camera, window)
    centre = np.asarray(earth.centre_cam_m) / EARTH_RADIUS_M
    reach = _rectangle(rays, centre)
    if reach is None:
        return
    rows, columns = reach
    rays = _Rays(rays.x[columns], rays.y[rows])
    along, squared = rays.along(centre), rays.squared
    beside2 = np.float32(centre @ centre) - along * along / squared
    sun_earth = earth.cam_from_earth.T @ shot.sun_direction
    part = picture[rows, columns]
    depth, glow = _air(beside2)
    ground, sky = _earth_light(rays, centre, earth, sun_earth, shot.sequence, 4 if window.scale >= _FINE_SCALE else 2)
    through = cv2.exp(-depth[..., None] * ZENITH_DEPTH)
    hit = ((beside2 < 1) & (along > 0))[..., None]
    sky *= glow[..., None]
    light = np.where(hit, ground, part)
    light -= sky
    light *= through
    np.add(light, sky, out=part)


def _rectangle(rays: _Rays, centre: Float[ndarray, "3"]) -> tuple[slice, slice] | None:
    """Rows and columns where a ray passes below the atmosphere's top, from every eighth ray and the border."""
    rows = np.unique(np.append(np.arange(0, len(rays.y), 8), len(rays.y) - 1))
    columns = np.unique(np.append(np.arange(0, len(rays.x), 8), len(rays.x) - 1))
    few = _Rays(rays.x[columns], rays.y[rows])
    along = few.along(centre)
    near = (centre @ centre - along * along / few.squared < (1 + TOP) ** 2) & (along > 0)
    if not near.any():
        return None
    y, x = rows[near.any(axis=1)], columns[near.any(axis=0)]
    return slice(max(y[0] - 8, 0), y[-1] + 9), slice(max(x[0] - 8, 0), x[-1] + 9)


def _air(beside2: Float32[ndarray, "h w"]) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """Airmass of each ray, and a factor on its light that takes the glow's top softly to black."""
    cosine = np.sqrt(np.maximum(1 - beside2, 0))
    height = np.sqrt(np.maximum(beside2, 1)) - 1
    grazing = 2 * LIMB_AIRMASS * np.exp(-height / np.float32(AIR_SCALE_HEIGHT))
    airmass = np.where(beside2 < 1, 1 / (cosine + np.float32(1 / LIMB_AIRMASS)), grazing)
    return airmass, np.clip((np.float32(TOP) - height) / np.float32(0.3 * TOP), 0, 1)


def _earth_light(
    rays: _Rays, centre: Float[ndarray, "3"], earth: EarthView, sun: Float[ndarray, "3"], sequence: int, step: int
) -> tuple[Float32[ndarray, "h w 3"], Float32[ndarray, "h w 3"]]:
    """Radiance of the ground with its clouds, and of the air above it if it were deep, for every ray.

    Geometry on every `step`-th pixel, ground on every (step / 2)-th. A ray that misses takes the point of its closest
    approach, so that nothing jumps at the limb.
    """
    earth_from_cam = earth.cam_from_earth.T
    few = _Rays(_every(rays.x, step), _every(rays.y, step))
    along, squared = few.along(centre), few.squared
    reach = np.sqrt(np.maximum(along * along - squared * np.float32(centre @ centre - 1), 0))
    direction = np.stack([few.along(axis) for axis in earth_from_cam], axis=-1)
    point = ((along - reach) / squared)[..., None] * direction - (earth_from_cam @ centre).astype(np.float32)
    point /= np.linalg.norm(point, axis=-1, keepdims=True)
    sunlight, sky = _sunlight(point @ sun.astype(np.float32))
    glint = _glint(point, direction / np.sqrt(squared)[..., None], sun.astype(np.float32))
    point, sunlight, glint = _double(point), _double(sunlight), _double(glint)
    below = -earth_from_cam @ centre
    ground_below = earth_surface(point, below / np.linalg.norm(below), sequence)
    ground = (ground_below.albedo + (glint * ground_below.water)[..., None]) * sunlight
    sky = _double(sky)
    if step == 4:
        ground, sky = _double(ground), _double(sky)
    inside = np.s_[step : step + len(rays.y), step : step + len(rays.x)]
    return ground[inside], sky[inside]


def _glint(
    point: Float32[ndarray, "h w 3"], direction: Float32[ndarray, "h w 3"], sun: Float32[ndarray, "3"]
) -> Float32[ndarray, "h w"]:
    """The sun's image on water that waves make rough, as an addition to the albedo."""
    half = sun - direction
    facing = np.einsum("hwi,hwi->hw", point, half) / np.maximum(np.linalg.norm(half, axis=-1), 1e-6)
    return np.float32(0.9) * np.exp((facing - 1) / np.float32(0.012)) * np.clip(point @ sun * 4, 0, 1)


def _every(values: Float32[ndarray, " n"], step: int) -> Float32[ndarray, " m"]:
    """Values at the centres of `step`-wide blocks, one block more on either side."""
    spacing = values[1] - values[0] if len(values) > 1 else np.float32(0)
    blocks = -(-len(values) // step)
    return values[0] + spacing * (np.arange(-1, blocks + 1, dtype=np.float32) * step + np.float32((step - 1) / 2))


def _double(values: Float32[ndarray, "..."]) -> Float32[ndarray, "..."]:
    """A grid twice as fine, linearly."""
    return cv2.resize(values, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)


def _sunlight(height: Float32[ndarray, "h w"]) -> tuple[Float32[ndarray, "h w 3"], Float32[ndarray, "h w 3"]]:
    """Sun on the ground and light in the air, RGB, by the sine of the sun's height: red when low, dusk below."""
    above = np.maximum(height, 0)
    airmass = 1 / (above + 0.06)
    sunlight = above[..., None] * np.exp(-airmass[..., None] * ZENITH_DEPTH * 0.6)
    dusk = 1 / (1 + np.exp(-(height - 0.02) / 0.045))
    sky = SKYLIGHT * (dusk * (0.35 + 0.65 * np.sqrt(above)))[..., None]
    redden = np.exp(-np.minimum(airmass, 14)[..., None] * ZENITH_DEPTH * 0.35)
    return sunlight.astype(np.float32), (sky * redden * 1.25).astype(np.float32)
