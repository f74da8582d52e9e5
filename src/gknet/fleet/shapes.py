"""Solids in metres that the spacecraft are put together from. Every function returns a plain, closed triangle mesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray
from shapely.geometry import Polygon
from trimesh.creation import extrude_polygon, icosphere, revolve
from trimesh.util import concatenate

Point = Sequence[float] | Float[ndarray, "3"]
Points = Sequence[Point] | Float[ndarray, "n 3"]


def frame(origin: Point = (0, 0, 0), z: Point = (0, 0, 1), x: Point = (1, 0, 0)) -> Float[ndarray, "4 4"]:
    """body_from_local of a part that stands at `origin`, local z along `z`, local x as near to `x` as can be."""
    up = np.asarray(z, dtype=float) / np.linalg.norm(z)
    side = np.asarray(x, dtype=float) - up * (up @ np.asarray(x, dtype=float))
    if np.linalg.norm(side) < 1e-6:
        spare = np.eye(3)[np.argmin(np.abs(up))]
        side = spare - up * (up @ spare)
    side /= np.linalg.norm(side)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([side, np.cross(up, side), up, np.asarray(origin, dtype=float)])
    return matrix


def moved(mesh: trimesh.Trimesh, body_from_local: Float[ndarray, "4 4"]) -> trimesh.Trimesh:
    """A copy of the mesh, from its local frame into the body frame."""
    copy = mesh.copy()
    copy.apply_transform(body_from_local)
    return copy


def point_of(body_from_local: Float[ndarray, "4 4"], point: Point) -> Float[ndarray, "3"]:
    """A local point in the body frame."""
    return body_from_local[:3, :3] @ np.asarray(point, dtype=float) + body_from_local[:3, 3]


def joined(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """Several meshes as one."""
    return cast(trimesh.Trimesh, concatenate(list(meshes)))


def box(size: Point, centre: Point = (0, 0, 0), radius: float = 0.006, steps: int = 3) -> trimesh.Trimesh:
    """A box whose edges and corners are rounded by `radius`."""
    half = np.asarray(size, dtype=float) / 2
    radius = min(radius, 0.49 * float(half.min()))
    angles = np.linspace(0, np.pi / 2, steps + 1)
    octant = np.array([(np.cos(a) * np.cos(b), np.cos(a) * np.sin(b), np.sin(a)) for a in angles for b in angles])
    signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    points = (signs[:, None] * (half - radius + radius * octant)).reshape(-1, 3)
    hull = trimesh.convex.convex_hull(np.unique(np.round(points, 9), axis=0))
    hull.apply_translation(centre)
    return hull


def prism(outline: Float[ndarray, "n 2"], z0: float, z1: float, holes: Sequence[ndarray] = ()) -> trimesh.Trimesh:
    """A flat outline with holes, extruded from z0 to z1."""
    solid = extrude_polygon(Polygon(outline, holes), z1 - z0)
    return solid.apply_translation((0, 0, z0))


def regular(sides: int, radius: float, turn: float = 0.0) -> Float[ndarray, "n 2"]:
    """The corners of a regular polygon; `radius` reaches the corners, `turn` is the angle of the first in rad."""
    angles = turn + np.arange(sides) * 2 * np.pi / sides
    return radius * np.column_stack([np.cos(angles), np.sin(angles)])


def turned(profile: Sequence[tuple[float, float]], sections: int = 48) -> trimesh.Trimesh:
    """A solid of revolution about z; `profile` is (radius, z) pairs, closed by the axis or by itself."""
    line = np.asarray(profile, dtype=float)
    if line[0, 0] > 1e-9 and line[-1, 0] > 1e-9:
        line = np.vstack([line, line[:1]])
    solid = revolve(line, sections=sections)
    return oriented(solid)


def oriented(solid: trimesh.Trimesh) -> trimesh.Trimesh:
    """With its faces turned outward."""
    if solid.volume < 0:
        solid.invert()
    return solid


def cylinder(radius: float, z0: float, z1: float, sections: int = 32, bevel: float = 0.004) -> trimesh.Trimesh:
    """About z, with bevelled rims."""
    bevel = min(bevel, 0.3 * radius, 0.3 * (z1 - z0))
    return turned(
        [(0, z0), (radius - bevel, z0), (radius, z0 + bevel), (radius, z1 - bevel), (radius - bevel, z1), (0, z1)],
        sections,
    )


def spike(radius: float, z0: float, z1: float, sections: int = 16) -> trimesh.Trimesh:
    """A rod about z that ends in a slender point at z1, which is visible from nearly everywhere."""
    return turned([(0, z0), (radius, z0), (radius, z1 - 5 * radius), (0, z1)], sections)


def tube(outer: float, inner: float, z0: float, z1: float, sections: int = 48) -> trimesh.Trimesh:
    return turned([(inner, z0), (outer, z0), (outer, z1), (inner, z1)], sections)


def ball(radius: float, centre: Point = (0, 0, 0), subdivisions: int = 3) -> trimesh.Trimesh:
    return icosphere(subdivisions=subdivisions, radius=radius).apply_translation(centre)


def rod(start: Point, end: Point, radius: float, sections: int = 10) -> trimesh.Trimesh:
    """A round bar between two points."""
    length = float(np.linalg.norm(np.subtract(end, start)))
    return moved(cylinder(radius, 0, length, sections, bevel=0.15 * radius), frame(start, np.subtract(end, start)))


def cable(points: Points, radius: float, sections: int = 8, steps: int = 8) -> trimesh.Trimesh:
    """A round cable through the points, smooth (Catmull-Rom), with closed ends."""
    path = _smooth(np.asarray(points, dtype=float), steps)
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = frame((0, 0, 0), along[0])[:3, 0]
    angles = np.arange(sections) * 2 * np.pi / sections
    rings = []
    for centre, direction in zip(path, along, strict=True):
        side = side - direction * (direction @ side)
        side /= np.linalg.norm(side)
        across = np.cross(direction, side)
        rings.append(centre + radius * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * across))
    return _skin(np.array(rings))


def _smooth(points: Float[ndarray, "n 3"], steps: int) -> Float[ndarray, "m 3"]:
    padded = np.vstack([2 * points[0] - points[1], points, 2 * points[-1] - points[-2]])
    t = np.linspace(0, 1, steps, endpoint=False)[:, None]
    pieces = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(padded[:-3], padded[1:-2], padded[2:-1], padded[3:], strict=True)
    ]
    return np.vstack([*pieces, points[-1:]])


def _skin(rings: Float[ndarray, "n k 3"]) -> trimesh.Trimesh:
    """The closed surface over a row of rings."""
    count, sections = rings.shape[:2]
    i, j = np.meshgrid(np.arange(count - 1), np.arange(sections), indexing="ij")
    a, b = i * sections + j, i * sections + (j + 1) % sections
    c, d = a + sections, b + sections
    sides = np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    first, last = count * sections, count * sections + 1
    k = np.arange(sections)
    after, end = (k + 1) % sections, (count - 1) * sections
    caps = [
        np.stack([np.full(sections, first), after, k], -1),
        np.stack([np.full(sections, last), end + k, end + after], -1),
    ]
    vertices = np.vstack([rings.reshape(-1, 3), rings[0].mean(axis=0), rings[-1].mean(axis=0)])
    return oriented(trimesh.Trimesh(vertices, np.concatenate([sides, *caps]), process=False))


def dish(radius: float, depth: float, thickness: float = 0.012, sections: int = 64, rings: int = 12) -> trimesh.Trimesh:
    """A paraboloid that opens along +z, its vertex at the origin, its rim rolled."""
    r = np.linspace(0, radius, rings)
    front = np.column_stack([r, depth * (r / radius) ** 2])
    back = front - (0, thickness)
    lip = [(radius + 0.6 * thickness, depth + 0.2 * thickness), (radius + 0.6 * thickness, depth - 1.2 * thickness)]
    return turned([*map(tuple, front), *lip, *map(tuple, back[::-1])], sections)


def nozzle(
    throat: float, exit_radius: float, length: float, floor: float, sections: int = 40, rings: int = 9
) -> trimesh.Trimesh:
    """A bell from the throat at z = 0 to its open end at z = length; inside it is hollow down to z = floor."""
    t = np.linspace(0, 1, rings)
    outer = np.column_stack([throat + (exit_radius - throat) * t**0.6, length * t])
    wall = 0.06 * exit_radius
    deep = np.linspace(length, floor, rings - 2)
    inner = np.column_stack([np.interp(deep, outer[:, 1], outer[:, 0]) - wall, deep])
    return turned([(0, 0), *map(tuple, outer), *map(tuple, inner), (0, floor)], sections)


def truss(start: Point, end: Point, width: float, bays: int, bar: float, sections: int = 8) -> trimesh.Trimesh:
    """A three-sided lattice mast: longerons, rings and one diagonal a bay."""
    length = float(np.linalg.norm(np.subtract(end, start)))
    corners = regular(3, width / np.sqrt(3))
    levels = np.linspace(0, length, bays + 1)
    bars = [rod((*c, 0), (*c, length), bar, sections) for c in corners]
    for k, z in enumerate(levels):
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            bars.append(rod((*a, z), (*b, z), 0.7 * bar, sections))
            if k < bays:
                bars.append(rod((*a, z), (*b, levels[k + 1]), 0.7 * bar, sections))
    return moved(joined(*bars), frame(start, np.subtract(end, start)))


def bolts(places: Float[ndarray, "n 3"], radius: float, height: float) -> trimesh.Trimesh:
    """Hexagonal heads that stand along +z on the places."""
    head = prism(regular(6, radius), -0.3 * height, height)
    return joined(*[head.copy().apply_translation(place) for place in places])


def handle(length: float, rise: float, radius: float) -> trimesh.Trimesh:
    """A grab bar along x that stands on z = 0."""
    half = length / 2
    corner = min(0.3 * rise, 0.15 * length)
    path = [(-half, 0, -radius), (-half, 0, rise - corner), (-half + corner, 0, rise), (half - corner, 0, rise)]
    return cable([*path, (half, 0, rise - corner), (half, 0, -radius)], radius, sections=10, steps=5)
