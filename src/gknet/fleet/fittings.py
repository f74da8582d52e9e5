"""Pieces that several spacecraft carry: solar panels, yokes, thrusters, star trackers, antennas, blankets."""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray

from gknet.fleet import materials as m
from gknet.fleet import shapes as s
from gknet.fleet.materials import CELL_M, Material
from gknet.fleet.model import Model
from gknet.fleet.shapes import Point, frame, point_of

RIM_M = 0.02
"""Bare border of a solar panel, and the gap between its two sheets of cells."""
THICKNESS_M = 0.026


def bus_frame(model: Model, half: Point, height: float = 0.0) -> None:
    """A bus at `height` on the z axis: corner posts that reach `half` on each side, beams, black foil behind them."""
    outside = np.asarray(half, dtype=float)
    at = frame((0, 0, height))
    model.add("bus", m.black_foil(), s.box(2 * (outside - 0.03), radius=0.01), at=at)
    x, y, z = outside - 0.025
    signs = [(a, b) for a in (-1, 1) for b in (-1, 1)]
    posts = [s.box((0.05, 0.05, 2 * outside[2]), (a * x, b * y, 0), 0.006) for a, b in signs]
    beams = [s.box((2 * x, 0.044, 0.044), (0, a * y, b * z), 0.006) for a, b in signs]
    beams += [s.box((0.044, 2 * y, 0.044), (a * x, 0, b * z), 0.006) for a, b in signs]
    model.add("bus", m.aluminium(), *posts, *beams, at=at)


def panel_size(columns: int, rows: int) -> tuple[float, float]:
    """Width and length in metres of a panel of two sheets of `columns` x `rows` cells, both even."""
    return columns * CELL_M[0] + 2 * RIM_M, 2 * rows * CELL_M[1] + 3 * RIM_M


def panel_corners(columns: int, rows: int) -> Float[ndarray, "4 3"]:
    """In the panel's frame, anticlockwise from (-x, -y)."""
    half_width, half_length = np.array(panel_size(columns, rows)) / 2
    return np.array([(x * half_width, y * half_length, 0) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))])


def panel(model: Model, part: str, at: Float[ndarray, "4 4"], columns: int, rows: int, cells: Material) -> None:
    """A solar panel centred on its frame: x along the columns, y along the rows, the cells face +z."""
    width, length = panel_size(columns, rows)
    sheet = (columns * CELL_M[0], rows * CELL_M[1], 0.004)
    top = THICKNESS_M / 2
    model.add(part, m.carbon(), s.box((width, length, THICKNESS_M), radius=0.005), at=at)
    for side in (-1, 1):
        middle = np.array([0, side * (sheet[1] + RIM_M) / 2, top + 0.0005])
        model.add(part, cells, s.box(sheet, radius=0.0012, steps=2), at=at @ frame(middle))
    edge = [s.rod((x, -length / 2 + 0.03, top), (x, length / 2 - 0.03, top), 0.004, 8) for x in _ends(width / 2 - 0.01)]
    grid_x, grid_y = np.meshgrid(np.linspace(-0.46, 0.46, 9) * width, (-length / 2 + 0.01, 0, length / 2 - 0.01))
    heads = np.column_stack([grid_x.ravel(), grid_y.ravel(), np.full(grid_x.size, top)])
    model.add(part, m.aluminium(), *edge, s.bolts(heads, 0.006, 0.004), *_ribs(width, length), at=at)
    model.add(part, m.copper(), *_harness(width, length), at=at)


def _ends(value: float) -> tuple[float, float]:
    return -value, value


def _ribs(width: float, length: float) -> list[trimesh.Trimesh]:
    """Stiffeners and hold-down cups on the back."""
    z = -THICKNESS_M / 2
    ribs = [s.box((0.025, length - 0.06, 0.02), (x, 0, z - 0.008), 0.003, 2) for x in _ends(0.3 * width)]
    ribs += [s.box((width - 0.06, 0.02, 0.014), (0, y, z - 0.005), 0.003, 2) for y in _ends(0.36 * length)]
    cup = s.turned([(0, z + 0.004), (0.035, z + 0.004), (0.035, z - 0.01), (0.02, z - 0.028), (0, z - 0.028)], 16)
    places = [(x, y) for x in _ends(0.15 * width) for y in _ends(0.2 * length)]
    return ribs + [cup.copy().apply_translation((x, y, 0)) for x, y in places]


def _harness(width: float, length: float) -> list[trimesh.Trimesh]:
    """Wires along the back, with a wave between the ties."""
    y = np.linspace(-length / 2 + 0.04, length / 2 - 0.04, 7)
    wave = 0.008 * np.cos(np.pi * np.arange(7))
    z = np.full(7, -THICKNESS_M / 2 - 0.004)
    return [s.cable(np.column_stack([x + wave, y, z]), 0.005, 6, 4) for x in (-0.05 * width, 0.03 * width)]


def hinges(model: Model, part: str, at: Float[ndarray, "4 4"], width: float, gap: float) -> None:
    """Two spring hinges across a gap along y, at the frame's origin, `width` apart along x."""
    for x in _ends(width / 2):
        knuckle = s.rod((x - 0.035, 0, 0.002), (x + 0.035, 0, 0.002), 0.012, 12)
        leaves = [s.box((0.05, 0.05, 0.008), (x, y, 0.014), 0.002, 2) for y in _ends(gap / 2 + 0.02)]
        model.add(part, m.aluminium(), knuckle, *leaves, at=at)


def yoke(model: Model, part: str, at: Float[ndarray, "4 4"], reach: float, width: float) -> None:
    """A drive at the frame's origin and a V of bars along +y to a crossbar of `width` at `reach`."""
    drive = s.moved(s.cylinder(0.075, -0.04, 0.09, 40), frame((0, 0, 0), (0, 1, 0)))
    ring = s.moved(s.tube(0.095, 0.07, 0.02, 0.05, 40), frame((0, 0, 0), (0, 1, 0)))
    bars = [s.rod((0.02 * np.sign(x), 0.07, 0), (x, reach, 0), 0.016, 16) for x in _ends(width / 2 - 0.05)]
    bars.append(s.rod((-width / 2, reach, 0), (width / 2, reach, 0), 0.014, 16))
    bars.append(s.rod((-0.2 * width, 0.5 * reach, 0), (0.2 * width, 0.5 * reach, 0), 0.010, 12))
    model.add(part, m.aluminium(), drive, ring, *bars, at=at)
    wire = [(0.0, 0.05, 0.05), (0.04, 0.3 * reach, 0.02), (-0.02, 0.6 * reach, 0.025), (0.05, reach + 0.03, 0.015)]
    model.add(part, m.black_paint(), s.cable(wire, 0.009), at=at)


def thruster(model: Model, part: str, at: Float[ndarray, "4 4"], exit_radius: float = 0.045) -> None:
    """A small thruster that fires along +z; the middle of its mouth is at (0, 0, 0.13)."""
    length = 2 * exit_radius
    bell = s.nozzle(0.4 * exit_radius, exit_radius, length, length - 0.008, 20, 5).apply_translation(
        (0, 0, 0.138 - length)
    )
    body = s.cylinder(0.4 * exit_radius, 0.0, 0.141 - length, 12)
    flange = s.cylinder(0.75 * exit_radius, -0.01, 0.012, 16)
    model.add(part, m.nozzle_metal(), bell, body, at=at)
    model.add(part, m.aluminium(), flange, at=at)


def engine(model: Model, part: str, at: Float[ndarray, "4 4"], exit_radius: float, length: float) -> None:
    """A large engine along +z, hollow to its throat."""
    sections = 64 if exit_radius > 0.15 else 32
    bell = s.nozzle(0.22 * exit_radius, exit_radius, length, 0.06 * length, sections, 7)
    bands = [
        s.tube(radius + 0.006, radius - 0.01, z - 0.006, z + 0.006, sections)
        for z, radius in ((t * length, exit_radius * (0.22 + 0.78 * t**0.6)) for t in (0.35, 0.7))
    ]
    model.add(part, m.nozzle_metal(), bell, *bands, at=at)
    head = s.cylinder(0.42 * exit_radius, -0.35 * length, 0.04 * length, sections // 2)
    feeds = [
        s.cable(
            [
                (a * 0.6 * exit_radius, b * 0.6 * exit_radius, -0.5 * length),
                (a * 0.7 * exit_radius, 0, -0.2 * length),
                (0.2 * a * exit_radius, 0, 0.02 * length),
            ],
            0.012,
            steps=5,
        )
        for a, b in ((-1, 1), (1, -1))
    ]
    model.add(part, m.steel(), head, *feeds, at=at)


def star_tracker(model: Model, part: str, at: Float[ndarray, "4 4"], length: float = 0.3) -> None:
    """A camera with a stepped baffle along +z; the middle of its lens cap is at (0, 0, length)."""
    baffle = s.turned(
        [
            (0, 0.02),
            (0.045, 0.02),
            (0.045, 0.4 * length),
            (0.085, length),
            (0.078, length),
            (0.06, length - 0.006),
            (0, length - 0.006),
        ],
        40,
    )
    vanes = [
        s.tube(0.05 + 0.04 * t, 0.03 + 0.04 * t, length * (0.4 + 0.6 * t) - 0.006, length * (0.4 + 0.6 * t), 40)
        for t in (0.1, 0.5)
    ]
    model.add(part, m.black_paint(), baffle, *vanes, at=at)
    model.add(part, m.glass(), s.cylinder(0.055, length - 0.012, length, 32), at=at)
    fins = [s.box((0.15, 0.15, 0.008), (0, 0, z), 0.002, 2) for z in (-0.02, 0.0, 0.02)]
    model.add(part, m.white_paint(), s.box((0.12, 0.12, 0.11), (0, 0, -0.01), 0.008), *fins, at=at)


def helix_antenna(model: Model, part: str, at: Float[ndarray, "4 4"], height: float, radius: float = 0.045) -> None:
    """A helix over a ground plate along +z; its tip is at (0, 0, height)."""
    t = np.linspace(0, 1, 60)
    shrink = radius * (1 - 0.45 * t)
    coil = np.column_stack(
        [shrink * np.cos(14 * np.pi * t), shrink * np.sin(14 * np.pi * t), 0.02 + t * (height - 0.12)]
    )
    model.add(part, m.copper(), s.cable(coil, 0.005, 6, 3), at=at)
    model.add(part, m.white_paint(), s.spike(0.013, 0.0, height), at=at)
    model.add(part, m.aluminium(), s.cylinder(1.9 * radius, -0.015, 0.012, 40), at=at)


def dish_antenna(
    model: Model, part: str, at: Float[ndarray, "4 4"], radius: float, depth: float, focus: float
) -> Float[ndarray, "3"]:
    """A white dish at the origin that faces +z, with feed and struts. Returns the outer tip of the feed (body, m)."""
    model.add(part, m.white_paint(), s.dish(radius, depth), at=at)
    spokes = [
        s.rod(
            (0.12 * radius * c, 0.12 * radius * d, -0.05),
            (0.85 * radius * c, 0.85 * radius * d, 0.70 * depth - 0.01),
            0.014,
        )
        for c, d in s.regular(6, 1.0)
    ]
    hub = s.cylinder(0.22 * radius, -0.12, -0.008, 40)
    ring = s.tube(0.5 * radius, 0.46 * radius, 0.2 * depth - 0.055, 0.2 * depth - 0.015, 60)
    struts = [
        s.rod((0.8 * radius * c, 0.8 * radius * d, 0.63 * depth), (0.05 * c, 0.05 * d, focus - 0.02), 0.009)
        for c, d in s.regular(3, 1.0, np.pi / 2)
    ]
    model.add(part, m.aluminium(), hub, ring, *spokes, *struts, at=at)
    cone = s.turned(
        [
            (0, focus - 0.09),
            (0.03, focus - 0.09),
            (0.085, focus),
            (0.085, focus + 0.03),
            (0.05, focus + 0.05),
            (0, focus + 0.05),
        ],
        40,
    )
    horn = s.turned([(0, 0), (0.07, 0), (0.045, 0.06), (0.06, 0.16), (0.05, 0.16), (0.03, 0.08), (0, 0.08)], 40)
    model.add(part, m.white_paint(), cone, at=at)
    model.add(part, m.black_paint(), horn, at=at)
    return point_of(at, (0, 0, focus + 0.05))


def blanket(model: Model, part: str, at: Float[ndarray, "4 4"], size: tuple[float, float], material: Material) -> None:
    """A padded foil blanket on a wall that faces +z, held by buttons."""
    width, height = size
    model.add(part, material, s.box((width, height, 0.05), (0, 0, 0.0), 0.022, 4), at=at)
    columns, rows = max(2, round(width / 0.3)), max(2, round(height / 0.3))
    x, y = np.meshgrid(np.linspace(-0.44, 0.44, columns) * width, np.linspace(-0.44, 0.44, rows) * height)
    button = s.turned([(0, 0.02), (0.014, 0.02), (0.014, 0.027), (0.008, 0.030), (0, 0.030)], 12)
    model.add(
        part,
        m.aluminium(),
        *[button.copy().apply_translation((a, b, 0)) for a, b in zip(x.flat, y.flat, strict=True)],
        at=at,
    )


def radiator(model: Model, part: str, at: Float[ndarray, "4 4"], size: tuple[float, float]) -> None:
    """A plate of mirror tiles on a wall that faces +z, in an aluminium frame."""
    width, height = size
    model.add(part, m.mirror_tiles(), s.box((width, height, 0.024), (0, 0, 0.012), 0.003, 2), at=at)
    bars = [s.box((width + 0.05, 0.025, 0.034), (0, y, 0.012), 0.004, 2) for y in _ends(height / 2 + 0.0125)]
    bars += [s.box((0.025, height + 0.05, 0.030), (x, 0, 0.012), 0.004, 2) for x in _ends(width / 2 + 0.0125)]
    model.add(part, m.aluminium(), *bars, at=at)
