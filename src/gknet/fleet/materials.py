"""Surfaces of spacecraft: PBR materials (glTF's metallic-roughness) whose textures are drawn here, the same every time.

Every texture tiles: it repeats each `tile_m` metres, so that its density is the same on every part.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from PIL import Image
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import gaussian_filter
from trimesh.visual.material import PBRMaterial

Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Material:
    """`tile_m` is the width and height that one copy of the textures covers."""

    pbr: PBRMaterial
    tile_m: tuple[float, float] = (1.0, 1.0)

    @property
    def name(self) -> str:
        return str(self.pbr.name)


def _plain(name: str, colour: Colour, metallic: float, roughness: float) -> Material:
    """One even colour, linear RGB."""
    factor = np.array([*colour, 1.0])
    pbr = PBRMaterial(name=name, baseColorFactor=factor, metallicFactor=metallic, roughnessFactor=roughness)
    return Material(pbr)


def _textured(
    name: str,
    colour: Float[ndarray, "h w 3"],
    metallic: float,
    roughness: float,
    tile_m: tuple[float, float],
    height: Float[ndarray, "h w"] | None = None,
) -> Material:
    """From an sRGB image 0 to 1, and a relief in units of its own pixels."""
    pbr = PBRMaterial(
        name=name,
        baseColorFactor=np.ones(4),
        baseColorTexture=_picture(colour),
        normalTexture=None if height is None else _picture(_normals(height)),
        metallicFactor=metallic,
        roughnessFactor=roughness,
    )
    return Material(pbr, tile_m)


def _picture(values: Float[ndarray, "h w 3"]) -> Image.Image:
    return Image.fromarray(np.round(255 * np.clip(values, 0, 1)).astype(np.uint8))


def _normals(height: Float[ndarray, "h w"]) -> Float[ndarray, "h w 3"]:
    """The tangent-space normal map of a tiling relief (x right, y up, as glTF has it)."""
    right = (np.roll(height, -1, axis=1) - np.roll(height, 1, axis=1)) / 2
    down = (np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0)) / 2
    normal = np.stack([-right, down, np.ones_like(height)], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True) / 2 + 0.5


def _facets(size: int, count: int, rise: float, rng: np.random.Generator) -> Float[ndarray, "size size"]:
    """A tiling relief of flat triangles between `count` random points: crumpled foil."""
    points = rng.uniform(0, size, (count, 2))
    heights = rng.normal(0, rise, count)
    shifts = [(dx * size, dy * size) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
    surface = LinearNDInterpolator(np.vstack([points + shift for shift in shifts]), np.tile(heights, len(shifts)))
    grid = np.arange(size) + 0.5
    x, y = np.meshgrid(grid, grid)
    return surface(x, y)


def _grain(size: int, sigma_px: float, rng: np.random.Generator) -> Float[ndarray, "size size"]:
    """Tiling noise, blurred, of unit deviation."""
    noise = gaussian_filter(rng.normal(size=(size, size)), sigma_px, mode="wrap")
    return noise / noise.std()


def _foil(name: str, colour: Colour, metallic: float, roughness: float, slope: float, seed: int) -> Material:
    """Crinkled foil: large and small facets, and a colour that follows them a little. `slope` is the steepness."""
    rng = np.random.default_rng(seed)
    size = 512
    relief = _facets(size, 110, 14 * slope, rng) + _facets(size, 700, 5 * slope, rng)
    relief = gaussian_filter(relief, 0.7, mode="wrap")
    tint = 1 + 0.04 * _grain(size, 24, rng) + 0.006 * (relief - relief.mean())
    return _textured(name, np.asarray(colour) * tint[..., None], metallic, roughness, (0.7, 0.7), relief)


@cache
def gold_foil() -> Material:
    return _foil("gold_foil", (0.93, 0.70, 0.33), 0.88, 0.38, 0.55, seed=1)


@cache
def silver_foil() -> Material:
    return _foil("silver_foil", (0.86, 0.87, 0.89), 0.8, 0.4, 0.4, seed=2)


@cache
def black_foil() -> Material:
    return _foil("black_foil", (0.19, 0.19, 0.20), 0.15, 0.45, 0.45, seed=3)


@cache
def purple_foil() -> Material:
    """The doped-silicon side of a sunshield."""
    return _foil("purple_foil", (0.72, 0.56, 0.66), 0.75, 0.42, 0.3, seed=4)


@cache
def solar_cells() -> Material:
    return _cells("solar_cells", (0.13, 0.18, 0.43), seed=5)


@cache
def blue_cells() -> Material:
    """Cells of another make, bluer and brighter."""
    return _cells("blue_cells", (0.16, 0.38, 0.72), seed=6)


CELL_M = (0.12, 0.08)
"""Width and height of a solar cell with its gap."""


def _cells(name: str, colour: Colour, seed: int) -> Material:
    """Four by six cells a tile: cut corners, gaps, three busbars, fine fingers, each cell of its own tint."""
    rng = np.random.default_rng(seed)
    across, down, width, height = 4, 6, 192, 128
    picture = np.empty((down * height, across * width, 3))
    relief = np.zeros(picture.shape[:2])
    shape = _cell_shape(width, height)
    for row in range(down):
        for column in range(across):
            place = np.s_[row * height : (row + 1) * height, column * width : (column + 1) * width]
            tint = rng.normal(1, 0.09) * (1 + rng.normal(0, 0.03, 3))
            picture[place] = _cell(np.asarray(colour) * tint, shape)
            relief[place] = 1.2 * gaussian_filter(shape.astype(float), 1.0)
    return _textured(name, picture, 0.35, 0.24, (across * CELL_M[0], down * CELL_M[1]), relief)


def _cell_shape(width: int, height: int, gap: int = 4, corner: int = 20) -> ndarray:
    """Where the wafer is: a rectangle with rounded corners inside the gap."""
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    beyond_x = np.maximum(np.abs(x - width / 2) - (width / 2 - gap - corner), 0)[None]
    beyond_y = np.maximum(np.abs(y - height / 2) - (height / 2 - gap - corner), 0)[:, None]
    return np.hypot(beyond_x, beyond_y) <= corner


def _cell(colour: Float[ndarray, "3"], shape: ndarray) -> Float[ndarray, "h w 3"]:
    height, width = shape.shape
    cell = np.broadcast_to(colour, (height, width, 3)).copy()
    cell[:, ::6] = cell[:, ::6] * 0.8 + 0.10
    for bar in (height // 6, height // 2, 5 * height // 6):
        cell[bar - 1 : bar + 2] = (0.72, 0.73, 0.76)
    cell[~shape] = (0.47, 0.43, 0.38)
    return cell


@cache
def mirror_tiles() -> Material:
    """Optical solar reflectors: a white, silvery radiator of small tiles."""
    rng = np.random.default_rng(7)
    count, tile = 8, 64
    shade = np.kron(rng.normal(0.90, 0.02, (count, count)), np.ones((tile, tile)))
    edge = np.arange(count * tile) % tile
    seam = (edge < 2)[:, None] | (edge < 2)[None]
    shade[seam] = 0.55
    colour = shade[..., None] * np.array([0.97, 0.985, 1.0])
    return _textured("mirror_tiles", colour, 0.25, 0.18, (0.4, 0.4), 0.8 * gaussian_filter((~seam).astype(float), 1))


@cache
def white_paint() -> Material:
    rng = np.random.default_rng(8)
    shade = 0.90 + 0.010 * _grain(256, 12, rng) + 0.006 * _grain(256, 1.5, rng)
    return _textured("white_paint", shade[..., None] * np.array([1.0, 0.995, 0.98]), 0.0, 0.55, (0.6, 0.6))


@cache
def aluminium() -> Material:
    """Milled plate: streaks along u."""
    rng = np.random.default_rng(9)
    streaks = gaussian_filter(rng.normal(size=(256, 256)), (0.6, 18), mode="wrap")
    shade = 0.80 + 0.035 * streaks / streaks.std()
    return _textured("aluminium", shade[..., None] * np.array([1.0, 1.0, 1.01]), 0.7, 0.45, (0.3, 0.3))


@cache
def carbon() -> Material:
    """A panel's back: dark woven fibre under resin."""
    rng = np.random.default_rng(10)
    grid = np.arange(256) // 16
    weave = ((grid[:, None] + grid[None]) % 2).astype(float)
    shade = 0.20 + 0.035 * weave + 0.012 * _grain(256, 10, rng)
    return _textured("carbon", shade[..., None] * np.array([1.0, 1.0, 1.04]), 0.05, 0.45, (0.32, 0.32), 0.6 * weave)


@cache
def black_paint() -> Material:
    return _plain("black_paint", (0.018, 0.018, 0.020), 0.0, 0.6)


@cache
def nozzle_metal() -> Material:
    return _plain("nozzle_metal", (0.10, 0.09, 0.085), 0.75, 0.42)


@cache
def steel() -> Material:
    return _plain("steel", (0.56, 0.55, 0.53), 1.0, 0.25)


@cache
def glass() -> Material:
    """A lens: nearly black, smooth."""
    return _plain("glass", (0.010, 0.012, 0.022), 0.2, 0.08)


@cache
def mirror() -> Material:
    return _plain("mirror", (0.92, 0.92, 0.93), 1.0, 0.06)


@cache
def red_paint() -> Material:
    return _plain("red_paint", (0.55, 0.045, 0.03), 0.0, 0.5)


@cache
def copper() -> Material:
    return _plain("copper", (0.72, 0.36, 0.20), 0.95, 0.35)
