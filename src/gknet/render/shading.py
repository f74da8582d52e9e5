"""Direct light on a spacecraft and its labels, traced in one batch of rays: written in Dr.Jit on Mitsuba's scene and BSDFs.

The sun is always sampled, and the Earth and the sky by the direction that the material prefers; so a lit surface has no
grain. What changes from frame to frame enters as opaque values, and window sizes are not compiled in: nothing is
compiled again after the first frame. World of the scene: the body frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from gknet.geometry import Camera, Pose

PIXEL_STEPS = (0.7548776662, 0.5698402910)
MATERIAL_STEPS = (0.8191725134, 0.6710436067, 0.5497004779)
"""Additive low-discrepancy sequences (powers of the generalised golden ratio in 2 and 3 dimensions)."""


@dataclass(frozen=True, eq=False)
class Light:
    """Light in the body frame. Radiance 1.0 is a white Lambertian surface that faces the full sun.

    sun            unit vector to the sun, whose irradiance is pi
    sky            radiance from everywhere
    earth          RGB albedo of the Earth, a Lambertian sphere
    earth_centre   of the Earth from the spacecraft in Earth radii, None when it gives no light
    """

    sun: Float[ndarray, "3"]
    sky: float
    earth: tuple[float, float, float]
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


def _opaque(mi: ModuleType, kind: object, value: float) -> object:
    import drjit as dr

    return dr.opaque(kind, value, 1)


def _vector(mi: ModuleType, value: Float[ndarray, "3"]) -> object:
    return mi.Vector3f(*(_opaque(mi, mi.Float, float(part)) for part in value))


def _rays(mi: ModuleType, camera: Camera, body_from_cam: Pose, x: object, y: object) -> object:
    """From the camera through pixels (x, y); directions have z = 1 in the camera frame."""
    inverse_focal = 1 / camera.matrix[[0, 1], [0, 1]]
    offset = -camera.matrix[:2, 2] * inverse_focal
    right, down, forward = (_vector(mi, column) for column in body_from_cam.rotation.T)
    horizontal = x * _opaque(mi, mi.Float, inverse_focal[0]) + _opaque(mi, mi.Float, offset[0])
    vertical = y * _opaque(mi, mi.Float, inverse_focal[1]) + _opaque(mi, mi.Float, offset[1])
    direction = right * horizontal + down * vertical + forward
    return mi.Ray3f(mi.Point3f(_vector(mi, body_from_cam.translation_m)), direction)


def radiance(
    mi: ModuleType, scene: object, camera: Camera, body_from_cam: Pose, region: Region, light: Light, spp: int, seed: int
) -> Float32[ndarray, "h w 4"]:
    """Premultiplied linear RGB and alpha of a region, averaged over each pixel (a box filter)."""
    import drjit as dr

    index = dr.arange(mi.UInt32, region.width * region.height * spp)
    sample, pixel = index % spp, index // spp
    width = _opaque(mi, mi.UInt32, region.width)
    row = pixel // width
    column = pixel - row * width + _opaque(mi, mi.UInt32, region.x0)
    row += _opaque(mi, mi.UInt32, region.y0)
    key = row * _opaque(mi, mi.UInt32, camera.width) + column
    shifts = _shifts(mi, key, _opaque(mi, mi.UInt32, seed & 0xFFFFFFFF))
    steps = PIXEL_STEPS + MATERIAL_STEPS
    numbers = [shift + mi.Float(sample) * step for shift, step in zip(shifts, steps, strict=True)]
    numbers = [number - dr.floor(number) for number in numbers]
    ray = _rays(mi, camera, body_from_cam, mi.Float(column) + numbers[0], mi.Float(row) + numbers[1])
    ray.d = dr.normalize(ray.d)
    colour, hit = _direct_light(mi, scene, ray, light, numbers[2], mi.Point2f(numbers[3], numbers[4]))
    channels = [colour.x, colour.y, colour.z, dr.select(hit, mi.Float(1), 0)]
    dr.eval(channels)
    means = [np.array(dr.block_sum(channel, spp)) for channel in channels]
    return np.stack(means, axis=-1).reshape(region.height, region.width, 4) / np.float32(spp)


def _shifts(mi: ModuleType, key: object, seed: object) -> list[object]:
    """Five numbers in [0, 1) for each key."""
    first, second = mi.sample_tea_32(key, seed)
    third, fourth = mi.sample_tea_32(first, second)
    fifth, _ = mi.sample_tea_32(third, fourth)
    return [mi.Float(bits >> 8) * (1 / 16777216) for bits in (first, second, third, fourth, fifth)]


def _direct_light(
    mi: ModuleType, scene: object, ray: object, light: Light, choice: object, position: object
) -> tuple[object, object]:
    """Light that reaches the camera along `ray` after one reflection, and where a surface is."""
    import drjit as dr

    surface = scene.ray_intersect(ray, ray_flags=mi.RayFlags.All, coherent=True)
    hit = surface.is_valid()
    context, bsdf = mi.BSDFContext(), surface.bsdf()
    sun = _vector(mi, light.sun)
    to_sun = surface.to_local(sun)
    value = bsdf.eval(context, surface, to_sun, hit)
    bounce, weight = bsdf.sample(context, surface, choice, position, hit)
    lit = hit & (dr.max(value) > 0)
    lit &= ~scene.ray_test(surface.spawn_ray(sun), coherent=True, active=lit)
    outward = surface.to_world(bounce.wo)
    open_sky = hit & (dr.max(weight) > 0)
    open_sky &= ~scene.ray_test(surface.spawn_ray(outward), active=open_sky)
    colour = dr.select(lit, value * dr.pi, 0) + dr.select(open_sky, weight * _sky(mi, light, sun, outward), 0)
    return dr.select(hit, colour, 0), hit


def _sky(mi: ModuleType, light: Light, sun: object, direction: object) -> object:
    """Radiance that comes from a direction: the lit part of the Earth before a faint sky."""
    import drjit as dr

    centre = np.array((2.0, 0, 0)) if light.earth_centre is None else light.earth_centre
    power = np.inf if light.earth_centre is None else centre @ centre - 1
    middle = _vector(mi, centre)
    along = dr.dot(direction, middle)
    inside = along * along - _opaque(mi, mi.Float, float(power))
    seen = (along > 0) & (inside > 0)
    normal = direction * (along - dr.sqrt(dr.maximum(inside, 0))) - middle
    lambert = dr.select(seen, dr.maximum(dr.dot(normal, sun), 0), 0)
    return mi.Color3f(*light.earth) * lambert + light.sky


def sky_radiance(light: Light, directions: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    """What `_sky` gives, in numpy."""
    radiance = np.full((len(directions), 3), light.sky)
    if light.earth_centre is not None:
        along = directions @ light.earth_centre
        inside = along**2 - light.earth_centre @ light.earth_centre + 1
        seen = (along > 0) & (inside > 0)
        distance = along[seen] - np.sqrt(inside[seen])
        normal = distance[:, None] * directions[seen] - light.earth_centre
        radiance[seen] += np.maximum(normal @ light.sun, 0)[:, None] * light.earth
    return radiance


def depth(
    mi: ModuleType, scene: object, camera: Camera, body_from_cam: Pose, region: Region
) -> Float32[ndarray, "h w"]:
    """z in the camera frame of the surface at each pixel's centre, 0 where there is none."""
    import drjit as dr

    pixel = dr.arange(mi.UInt32, region.width * region.height)
    width = _opaque(mi, mi.UInt32, region.width)
    row = pixel // width
    column = pixel - row * width
    x = mi.Float(column) + _opaque(mi, mi.Float, region.x0 + 0.5)
    y = mi.Float(row) + _opaque(mi, mi.Float, region.y0 + 0.5)
    hit = scene.ray_intersect_preliminary(_rays(mi, camera, body_from_cam, x, y), coherent=True)
    distance = dr.select(hit.is_valid(), hit.t, 0)
    return np.array(distance).reshape(region.height, region.width)


def unhidden(
    mi: ModuleType, scene: object, body_from_cam: Pose, points_cam: Float[ndarray, "n 3"], tolerance_m: float
) -> Bool[ndarray, "n"]:
    """Which points nothing hides that is nearer to the camera by more than the tolerance."""
    ends = points_cam @ body_from_cam.rotation.T
    length = np.linalg.norm(points_cam, axis=1)
    free_part = 1 - tolerance_m / np.maximum(length, 2 * tolerance_m)
    direction = mi.Vector3f(*(mi.Float(part.astype(np.float32)) for part in ends.T))
    ray = mi.Ray3f(mi.Point3f(_vector(mi, body_from_cam.translation_m)), direction)
    ray.maxt = mi.Float(free_part.astype(np.float32))
    return ~np.array(scene.ray_test(ray))
