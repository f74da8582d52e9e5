"""Satellite_02: a square bus with four equal wings in a cross, tanks and ring frames at both ends.

A quarter turn about z hardly changes its shape; what distinguishes its sides is on the outside: bluer cells and a
white tip on the +x wing, a red tip and a whip on the +y wing, a dark patch on -x, one star tracker on -y.
"""

from __future__ import annotations

import numpy as np
import trimesh
from jaxtyping import Float
from numpy import ndarray

from gknet.fleet import fittings as f
from gknet.fleet import materials as m
from gknet.fleet import shapes as s
from gknet.fleet.model import Model
from gknet.fleet.shapes import frame
from gknet.spacecraft import Symmetry

HALF = np.array([0.52, 0.52, 0.66])
"""Half of the bus, to the outside of its corner posts."""
COLUMNS, ROWS, PANELS = 6, 6, 2
REACH, GAP = 0.50, 0.035
SIDES = {"px": (1, 0), "py": (0, 1), "mx": (-1, 0), "my": (0, -1)}
RING_RADIUS, RING_Z = 0.92, 0.50

MARKS = "bluer cells and white tip on the +x wing, red tip and whip on +y, dark patch on -x, star tracker on -y"


def model() -> Model:
    model = Model(
        "satellite_02",
        "Square bus with four equal wings in a cross, eight tanks, two ring frames, a dish on +z and a probe on -z.",
        tuple(Symmetry(axis=[0, 0, 1], angle_deg=angle, broken_by=MARKS) for angle in (90, 180, 270)),
    )
    _bus(model)
    for name, side in SIDES.items():
        _wing(model, name, np.array([*side, 0.0]))
    for end in (1, -1):
        _tanks(model, end)
        _ring(model, end)
    _top(model)
    _bottom(model)
    _marks(model)
    _skeleton(model)
    return model


def _bus(model: Model) -> None:
    f.bus_frame(model, HALF)
    for name, (x, y) in SIDES.items():
        for level in (-0.33, 0.33):
            wall = frame((x * (HALF[0] - 0.026), y * (HALF[1] - 0.026), level), (x, y, 0), (-y, x, 0))
            f.blanket(model, f"wall_{name}", wall, (0.88, 0.56), m.gold_foil())
            plate = wall @ frame((0, 0.06 * np.sign(level), 0.018))
            f.radiator(model, f"wall_{name}", plate, (0.62, 0.30))
    for end, z in (("top", HALF[2]), ("bottom", -HALF[2])):
        wall = frame((0, 0, z - np.sign(z) * 0.026), (0, 0, z), (1, 0, 0))
        f.blanket(model, f"wall_{end}", wall, (0.92, 0.92), m.gold_foil())
        for corner, (a, b) in zip(("pp", "mp", "mm", "pm"), ((1, 1), (-1, 1), (-1, -1), (1, -1)), strict=True):
            model.mark(f"bus_{end}_{corner}", (a * HALF[0], b * HALF[1], z))


def _wing(model: Model, name: str, out: Float[ndarray, "3"]) -> None:
    """Panels in the xy plane, cells up; `left` and `right` as for a viewer at the hub who faces outward, +z up."""
    root = frame(out * (HALF[0] + 0.02), (0, 0, 1), np.cross(out, (0, 0, 1)))
    width, length = f.panel_size(COLUMNS, ROWS)
    part = f"wing_{name}"
    f.yoke(model, f"yoke_{name}", root, REACH, width - 0.06)
    for k in range(PANELS):
        start = REACH + 0.02 + k * (length + GAP)
        cells = m.blue_cells() if name == "px" and k == PANELS - 1 else m.solar_cells()
        at = root @ frame((0, start + length / 2, 0))
        f.panel(model, part, at, COLUMNS, ROWS, cells)
        f.hinges(model, part, root @ frame((0, start - GAP / 2, 0)), 0.6 * width, GAP)
    corners = f.panel_corners(COLUMNS, ROWS)
    model.mark(f"{part}_left", corners[3], at)
    model.mark(f"{part}_right", corners[2], at)
    tip = s.box((0.10, 0.05, 0.05), (0, length / 2 + 0.015, 0), 0.006)
    model.add(part, m.aluminium(), tip, at=at)


def _tanks(model: Model, end: int) -> None:
    """Four tanks over the middle of the sides, with straps, feet and pipes."""
    height = HALF[2] + 0.21
    for x, y in SIDES.values():
        at = frame((0.34 * x, 0.34 * y, end * height), (0, 0, end), (x, y, 0))
        black = end > 0 and x == -1
        model.add("tanks", m.black_foil() if black else m.silver_foil(), s.ball(0.215), at=at)
        feet = [
            s.rod((0.17 * a, 0.17 * b, -0.10), (0.22 * a, 0.22 * b, -0.23), 0.012, 8) for a in (-1, 1) for b in (-1, 1)
        ]
        band = s.tube(0.225, 0.205, -0.014, 0.014, 32)
        model.add("tanks", m.aluminium(), band, *feet, s.cylinder(0.03, 0.19, 0.245, 16), at=at)
        pipe = [(0, 0, 0.235), (-0.07, 0.04, 0.25), (-0.17, 0.05, 0.17), (-0.25, 0.03, -0.05), (-0.26, 0.0, -0.2)]
        model.add("tanks", m.copper(), s.cable(pipe, 0.010, steps=5), at=at)


def _ring(model: Model, end: int) -> None:
    """An eight-sided frame about the bus, on struts, with small thrusters at four of its corners."""
    corners = np.column_stack([s.regular(8, RING_RADIUS, np.pi / 8), np.full(8, end * RING_Z)])
    bars = [s.rod(a, b, 0.018) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    bars += [s.ball(0.030, corner, 1) for corner in corners]
    posts = [(a * (HALF[0] - 0.03), b * (HALF[1] - 0.03)) for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    for k, (x, y) in enumerate(posts):
        for corner in (corners[2 * k], corners[2 * k + 1]):
            bars.append(s.rod((x, y, end * (HALF[2] - 0.06)), corner, 0.013, 8))
            bars.append(s.rod((x, y, end * 0.18), corner, 0.010, 8))
    model.add("ring", m.aluminium(), *bars)
    for k in range(4):
        middle = (corners[2 * k] + corners[2 * k + 1]) / 2
        out = np.array([middle[0], middle[1], 0]) / np.hypot(middle[0], middle[1])
        model.add("ring", m.black_foil(), s.box((0.13, 0.13, 0.13), radius=0.012), at=frame(middle, (0, 0, 1), out))
        f.thruster(model, "ring", frame(middle + 0.055 * out, out), 0.036)
        f.thruster(model, "ring", frame(middle + (0, 0, 0.055 * end), (0, 0, end)), 0.036)


def _top(model: Model) -> None:
    at = frame((0, 0, 1.20), (0, 0, 1), (1, 0, 0))
    model.mark("dish_feed", f.dish_antenna(model, "dish", at, radius=0.46, depth=0.13, focus=0.34))
    legs = [
        s.rod((0.20 * x, 0.20 * y, HALF[2] - 0.01), (0.06 * x, 0.06 * y, 1.10), 0.016)
        for x, y in s.regular(4, 1.4, np.pi / 4)
    ]
    model.add("dish", m.aluminium(), *legs, s.cylinder(0.09, 1.03, 1.10, 40))


def _bottom(model: Model) -> None:
    """Four engines about a refuelling probe."""
    base = frame((0, 0, -HALF[2] + 0.01), (0, 0, -1), (1, 0, 0))
    for x, y in s.regular(4, 0.36, np.pi / 4):
        f.engine(model, "engines", base @ frame((x, y, 0.10), (0.12 * x, 0.12 * y, 1)), exit_radius=0.10, length=0.22)
    legs = [s.rod((x, y, 0), (0.3 * x, 0.3 * y, 0.50), 0.016) for x, y in s.regular(4, 0.20, np.pi / 4)]
    model.add("probe", m.aluminium(), *legs, s.tube(0.085, 0.05, 0.47, 0.53, 40), at=base)
    shaft = s.turned(
        [
            (0, 0.4),
            (0.05, 0.4),
            (0.05, 0.70),
            (0.035, 0.72),
            (0.035, 0.86),
            (0.055, 0.88),
            (0.05, 0.93),
            (0.012, 0.98),
            (0, 0.98),
        ]
    )
    model.add("probe", m.white_paint(), shaft, at=base, around=True)
    model.mark("probe_tip", (0, 0, 0.98), base)


def _marks(model: Model) -> None:
    """What breaks the symmetry."""
    width, length = f.panel_size(COLUMNS, ROWS)
    far = HALF[0] + 0.02 + REACH + 0.02 + PANELS * length + (PANELS - 1) * GAP
    model.add("mark_px", m.white_paint(), _tip_band(width), at=frame((far, 0, 0), x=(0, -1, 0)))
    model.add("mark_py", m.red_paint(), _tip_band(width), at=frame((0, far, 0), x=(1, 0, 0)))
    whip = frame((0.0, HALF[1] + 0.35, 0.02), (0.0, 0.35, 1.0))
    model.add("whip", m.white_paint(), s.spike(0.016, 0.0, 0.84), at=whip)
    model.add("whip", m.aluminium(), s.cylinder(0.045, -0.03, 0.05, 24), at=whip)
    model.mark("whip_tip", (0, 0, 0.84), whip)
    patch = frame((-HALF[0] - 0.012, 0, 0.34), (-1, 0, 0), (0, 1, 0))
    model.add("mark_mx", m.black_paint(), s.box((0.74, 0.42, 0.03), (0, 0, 0.022), 0.006), at=patch)
    tracker = frame((0.22, -HALF[1] - 0.02, 0.42), (0.35, -1, 0.55), (0, 0, 1))
    f.star_tracker(model, "star_tracker", tracker @ frame((0, 0, 0.12)), 0.30)
    model.add("star_tracker", m.aluminium(), s.box((0.15, 0.15, 0.16), (0, 0, 0.02), 0.008), at=tracker)
    model.mark("star_tracker", (0, 0, 0.42), tracker)


def _tip_band(width: float, depth: float = 0.13) -> trimesh.Trimesh:
    """A painted sleeve along x over a wing whose end is at y = 0; visible from both faces."""
    return s.box((width - 0.05, depth, f.THICKNESS_M + 0.012), (0, -depth / 2 - 0.003, 0), 0.004)


def _skeleton(model: Model) -> None:
    order = ("pp", "mp", "mm", "pm")
    for end in ("top", "bottom"):
        model.link(*[f"bus_{end}_{corner}" for corner in (*order, "pp")])
    for corner in order:
        model.link(f"bus_top_{corner}", f"bus_bottom_{corner}")
        model.link(f"bus_top_{corner}", "dish_feed")
        model.link(f"bus_bottom_{corner}", "probe_tip")
    beside = {"px": ("pp", "pm"), "py": ("mp", "pp"), "mx": ("mm", "mp"), "my": ("pm", "mm")}
    for name, (left, right) in beside.items():
        model.link(f"bus_top_{left}", f"wing_{name}_left", f"wing_{name}_right", f"bus_top_{right}")
    model.link("bus_top_pp", "whip_tip", "bus_top_mp")
    model.link("bus_top_pm", "star_tracker", "bus_top_mm")
