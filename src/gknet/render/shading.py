"""Direct light on a spacecraft, and its labels, in batches of rays: Dr.Jit on Mitsuba's scene and BSDFs.

The sun is always sampled, and the Earth and the sky by the direction that the material prefers; so a lit surface has no
grain. What changes from frame to frame enters as opaque values, and window sizes are not compiled in: nothing is traced
or compiled again after the first frame. World of the scene: the body frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from gknet.geometry import Camera, Pose
from gknet.render.variant import Engine

PIXEL_STEPS = (0.7548776662, 0.5698402910)
MATERIAL_STEPS = (0.8191725134, 0.6710436067, 0.5497004779)
"""Additive low-discrepancy sequences (powers of the generalised golden ratio in 2 and 3 dimensions)."""


SAMPLES_AT_ONCE = 1 << 23
"""Four floats of each sample are in memory at a time: 128 MiB."""

EARTH_ALBEDO = (0.27, 0.30, 0.34)
STARLIGHT = 0.002
"""Radiance from every direction, so that no shadow is perfectly black."""


@dataclass(frozen=True, eq=False)
class IncidentLight:
    """Light in the body frame. Radiance 1.0 is a white Lambertian surface that faces the full sun.

    Attributes:
        sun: (3,) unit vector to the sun, whose irradiance is pi.
        earth_centre: (3,) from the spacecraft to the centre of the Earth, a Lambertian sphere, in Earth radii; None
            when it gives no light.
    """

    sun: Float[ndarray, "3"]
    earth_centre: Float[ndarray, "3"] | None


@dataclass(frozen=True)
class Region:
    """Whole pixels of a window: columns x0 to x0 + width, rows y0 to y0 + height."""

    x0: int
    y0: int
    width: int
    height: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Rows and columns."""
        return slice(self.y0, self.y0 + self.height), slice(self.x0, self.x0 + self.width)

    def bands(self, rows: int) -> list[Region]:
        """The region from top to bottom in parts of at most so many rows."""
        starts = range(0, self.height, rows)
        return [Region(self.x0, self.y0 + y, self.width, min(rows, self.height - y)) for y in starts]


class Shader:
    """The kernels of one scene, traced in Python once and replayed for every frame."""

    def __init__(self, engine: Engine, scene: Any, spp: int) -> None:
        self._engine, self._scene, self._spp = engine, scene, spp

        def radiance(scene: Any, index: Any, view: list[Any], window: list[Any], light: list[Any]) -> Any:
            return _radiance(engine, scene, spp, index, view, window, light)

        def depth(scene: Any, index: Any, view: list[Any], window: list[Any]) -> Any:
            return _depth(engine, scene, index, view, window)

        self._radiance, self._depth = engine.dr.freeze(radiance), engine.dr.freeze(depth)

    def radiance(
        self, camera: Camera, body_from_cam: Pose, region: Region, light: IncidentLight, seed: int
    ) -> Float32[ndarray, "h w 4"]:
        """Premultiplied linear RGB and alpha of a region, averaged over each pixel (a box filter).

        Args:
            camera: Of the window, with square pixels and no skew.
            body_from_cam: Its pose in m.
            region: The part of the window that is computed.
            light: In the body frame.
            seed: Of the samples.

        Returns:
            (h, w, 4) float32.
        """
        rows = max(1, SAMPLES_AT_ONCE // (region.width * self._spp))
        bands = [self._band(camera, body_from_cam, part, light, seed) for part in region.bands(rows)]
        return np.concatenate(bands)

    def _band(
        self, camera: Camera, body_from_cam: Pose, region: Region, light: IncidentLight, seed: int
    ) -> Float32[ndarray, "h w 4"]:
        dr = self._engine.dr
        index = self._indices(region.width * region.height * self._spp)
        window = self._integers(region.width, region.x0, region.y0, camera.width, seed & 0xFFFFFFFF)
        view = self._numbers(_view(camera, body_from_cam))
        channels = self._radiance(self._scene, index, view, window, self._numbers(_light(light)))
        means = [np.array(dr.block_sum(channel, self._spp)) for channel in channels]
        return np.stack(means, axis=-1).reshape(region.height, region.width, 4) / np.float32(self._spp)

    def depth(self, camera: Camera, body_from_cam: Pose, region: Region) -> Float32[ndarray, "h w"]:
        """z in the camera frame of the surface at each pixel's centre, 0 where there is none."""
        index = self._indices(region.width * region.height)
        window = self._integers(region.width, region.x0, region.y0)
        distance = self._depth(self._scene, index, self._numbers(_view(camera, body_from_cam)), window)
        return np.array(distance).reshape(region.height, region.width)

    def unhidden(
        self, body_from_cam: Pose, points_cam: Float[ndarray, "n 3"], tolerance_m: float
    ) -> Bool[ndarray, " n"]:
        """Which points nothing hides that is nearer to the camera by more than the tolerance."""
        mi = self._engine.mi
        length = np.linalg.norm(points_cam, axis=1)
        free_part = 1 - tolerance_m / np.maximum(length, 2 * tolerance_m)
        directions = (points_cam @ body_from_cam.rotation.T).astype(np.float32)
        origin = mi.Point3f(*self._numbers(body_from_cam.translation_m))
        ray = mi.Ray3f(origin, mi.Vector3f(*(mi.Float(column) for column in directions.T)))
        ray.maxt = mi.Float(free_part.astype(np.float32))
        return ~np.array(self._scene.ray_test(ray))

    def _indices(self, count: int) -> Any:
        index = self._engine.dr.arange(self._engine.mi.UInt32, count)
        self._engine.dr.eval(index)
        return index

    def _numbers(self, values: Float[ndarray, " n"]) -> list[Any]:
        return [self._engine.dr.opaque(self._engine.mi.Float, float(value), 1) for value in values]

    def _integers(self, *values: int) -> list[Any]:
        return [self._engine.dr.opaque(self._engine.mi.UInt32, value, 1) for value in values]


def _view(camera: Camera, body_from_cam: Pose) -> Float[ndarray, "16"]:
    """The camera's axes and origin in the body frame, and what turns pixels into directions."""
    inverse_focal = 1 / camera.matrix[[0, 1], [0, 1]]
    offset = -camera.matrix[:2, 2] * inverse_focal
    return np.concatenate([body_from_cam.rotation.T.ravel(), body_from_cam.translation_m, inverse_focal, offset])


def _light(light: IncidentLight) -> Float[ndarray, "7"]:
    """The sun's direction, the Earth's centre and its power |c|^2 - 1, infinite without an Earth."""
    if light.earth_centre is None:
        return np.array([*light.sun, 2, 0, 0, np.inf])
    return np.array([*light.sun, *light.earth_centre, light.earth_centre @ light.earth_centre - 1])


def _rays(engine: Engine, view: list[Any], x: Any, y: Any) -> Any:
    """From the camera through pixels (x, y); directions have z = 1 in the camera frame."""
    mi = engine.mi
    right, down, forward = (mi.Vector3f(*view[k : k + 3]) for k in (0, 3, 6))
    direction = right * (x * view[12] + view[14]) + down * (y * view[13] + view[15]) + forward
    return mi.Ray3f(mi.Point3f(*view[9:12]), direction)


def _radiance(
    engine: Engine, scene: Any, spp: int, index: Any, view: list[Any], window: list[Any], light: list[Any]
) -> list[Any]:
    """Four channels of each sample of each pixel; a pixel's samples do not depend on the region."""
    mi, dr = engine.mi, engine.dr
    width, x0, y0, window_width, seed = window
    sample, pixel = index % spp, index // spp
    row = pixel // width
    column, row = pixel - row * width + x0, row + y0
    shifts = _shifts(engine, row * window_width + column, seed)
    steps = PIXEL_STEPS + MATERIAL_STEPS
    numbers = [shift + mi.Float(sample) * step for shift, step in zip(shifts, steps, strict=True)]
    numbers = [number - dr.floor(number) for number in numbers]
    ray = _rays(engine, view, mi.Float(column) + numbers[0], mi.Float(row) + numbers[1])
    ray.d = dr.normalize(ray.d)
    colour, hit = _direct_light(engine, scene, ray, light, numbers[2], mi.Point2f(*numbers[3:]))
    return [colour.x, colour.y, colour.z, dr.select(hit, mi.Float(1), 0)]


def _depth(engine: Engine, scene: Any, index: Any, view: list[Any], window: list[Any]) -> Any:
    mi, dr = engine.mi, engine.dr
    width, x0, y0 = window
    row = index // width
    column, row = index - row * width + x0, row + y0
    ray = _rays(engine, view, mi.Float(column) + 0.5, mi.Float(row) + 0.5)
    hit = scene.ray_intersect_preliminary(ray, coherent=True)
    return dr.select(hit.is_valid(), hit.t, 0)


def _shifts(engine: Engine, key: Any, seed: Any) -> list[Any]:
    """Five numbers in [0, 1) for each key."""
    mi = engine.mi
    first, second = mi.sample_tea_32(key, seed)
    third, fourth = mi.sample_tea_32(first, second)
    fifth, _ = mi.sample_tea_32(third, fourth)
    return [mi.Float(bits >> 8) * (1 / 16777216) for bits in (first, second, third, fourth, fifth)]


def _direct_light(
    engine: Engine, scene: Any, ray: Any, light: list[Any], choice: Any, position: Any
) -> tuple[Any, Any]:
    """Light that reaches the camera along `ray` after one reflection, and where a surface is."""
    mi, dr = engine.mi, engine.dr
    surface = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True)
    hit = surface.is_valid()
    context, bsdf = mi.BSDFContext(), surface.bsdf()
    sun = mi.Vector3f(*light[:3])
    value = bsdf.eval(context, surface, surface.to_local(sun), hit)
    bounce, weight = bsdf.sample(context, surface, choice, position, hit)
    lit = hit & (dr.max(value) > 0)
    lit &= ~scene.ray_test(surface.spawn_ray(sun), coherent=True, active=lit)
    outward = surface.to_world(bounce.wo)
    open_sky = hit & (dr.max(weight) > 0)
    open_sky &= ~scene.ray_test(surface.spawn_ray(outward), active=open_sky)
    colour = dr.select(lit, value * dr.pi, 0)
    colour += dr.select(open_sky, weight * _sky(engine, light, outward), 0)
    return dr.select(hit, colour, 0), hit


def _sky(engine: Engine, light: list[Any], direction: Any) -> Any:
    """Radiance that comes from a direction: the lit part of the Earth before a faint sky."""
    mi, dr = engine.mi, engine.dr
    sun, centre, power = mi.Vector3f(*light[:3]), mi.Vector3f(*light[3:6]), light[6]
    along = dr.dot(direction, centre)
    inside = along * along - power
    is_earth = (along > 0) & (inside > 0)
    normal = direction * (along - dr.sqrt(dr.maximum(inside, 0))) - centre
    lambert = dr.select(is_earth, dr.maximum(dr.dot(normal, sun), 0), 0)
    return mi.Color3f(*EARTH_ALBEDO) * lambert + STARLIGHT


def sky_radiance(light: IncidentLight, directions: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """Radiance from each direction of the body frame, (n, 3): the Earth and the sky of the kernel, in numpy."""
    radiance = np.full((len(directions), 3), STARLIGHT)
    if light.earth_centre is not None:
        along = directions @ light.earth_centre
        inside = along**2 - light.earth_centre @ light.earth_centre + 1
        is_earth = (along > 0) & (inside > 0)
        distance = along[is_earth] - np.sqrt(inside[is_earth])
        normal = distance[:, None] * directions[is_earth] - light.earth_centre
        radiance[is_earth] += np.maximum(normal @ light.sun, 0)[:, None] * EARTH_ALBEDO
    return radiance
