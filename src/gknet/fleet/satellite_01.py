"""Satellite_01: a box with two wings, a dish on +x, a boom on -x, instruments on +z."""

from __future__ import annotations

import numpy as np

from gknet.fleet import fittings as f
from gknet.fleet import materials as m
from gknet.fleet import shapes as s
from gknet.fleet.model import Model
from gknet.fleet.shapes import frame
from gknet.spacecraft import Symmetry

HALF = np.array([0.70, 0.60, 0.80])
"""Half of the bus, to the outside of its corner posts."""
COLUMNS, ROWS, PANELS = 10, 6, 2
REACH, GAP = 0.62, 0.035


def model() -> Model:
    model = Model(
        "satellite_01",
        "Box bus with two solar wings along y, a dish along +x, a lattice boom along -x, instruments on +z.",
        (
            Symmetry(
                axis=[0, 0, 1], angle_deg=180, broken_by="dish on +x, boom on -x, antenna, bluer outer panel on +y"
            ),
        ),
    )
    _bus(model)
    for side, name in ((1, "plus"), (-1, "minus")):
        _wing(model, side, name)
    _dish(model)
    _boom(model)
    _deck(model)
    _propulsion(model)
    _skeleton(model)
    return model


def _bus(model: Model) -> None:
    f.bus_frame(model, HALF)
    for side in (-1, 1):
        for part, height, middle in (("upper", 0.66, 0.38), ("lower", 0.74, -0.35)):
            wall = frame((side * (HALF[0] - 0.022), 0, middle), (side, 0, 0), (0, 1, 0))
            f.blanket(model, f"blanket_{part}", wall, (1.06, height), m.gold_foil())
        wall = frame((0, side * (HALF[1] - 0.03), 0), (0, side, 0), (1, 0, 0))
        f.blanket(model, "blanket_side", wall @ frame((0, 0, -0.008)), (1.26, 1.46), m.gold_foil())
        for level in (-0.46, 0.46):
            plate = frame((0, side * (HALF[1] - 0.008), level), (0, side, 0), (1, 0, 0))
            f.radiator(model, "radiator", plate, (1.02, 0.46))
    for corner, (a, b) in zip(("pp", "pm", "mp", "mm"), ((1, 1), (1, -1), (-1, 1), (-1, -1)), strict=True):
        model.mark(f"bus_top_{corner}", (a * HALF[0], b * HALF[1], HALF[2]))


def _wing(model: Model, side: int, name: str) -> None:
    """Panels in the xy plane, cells up; the outer panel of the +y wing has cells of another make."""
    root = frame((0, side * (HALF[1] + 0.02), 0.0), (0, 0, 1), (side, 0, 0))
    width, length = f.panel_size(COLUMNS, ROWS)
    f.yoke(model, f"yoke_{name}", root, REACH, width - 0.1)
    for k in range(PANELS):
        start = REACH + 0.02 + k * (length + GAP)
        cells = m.blue_cells() if side > 0 and k == PANELS - 1 else m.solar_cells()
        at = root @ frame((0, start + length / 2, 0))
        f.panel(model, f"wing_{name}", at, COLUMNS, ROWS, cells)
        f.hinges(model, f"wing_{name}", root @ frame((0, start - GAP / 2, 0)), 0.6 * width, GAP)
        corners = f.panel_corners(COLUMNS, ROWS)
        if k == 0:
            _mark_ends(model, f"wing_{name}_inner", at, corners[[0, 1]])
        if k == PANELS - 1:
            _mark_ends(model, f"wing_{name}_outer", at, corners[[3, 2]])
            sensor = at @ frame((0.0, length / 2 - 0.01, 0))
            model.add(f"wing_{name}", m.aluminium(), s.box((0.12, 0.07, 0.05), (0, 0.03, 0), 0.006), at=sensor)
            model.add(f"wing_{name}", m.glass(), s.ball(0.022, (0, 0.03, 0.022), 2), at=sensor)


def _mark_ends(model: Model, name: str, at: np.ndarray, ends: np.ndarray) -> None:
    """Name the two ends by the side of the body, front (+x) and back (-x)."""
    for end in ends:
        place = s.point_of(at, end)
        model.mark(f"{name}_{'front' if place[0] > 0 else 'back'}", place)


def _dish(model: Model) -> None:
    at = frame((1.12, 0.0, 0.12), (1, 0, 0.12), (0, 1, 0))
    model.mark("dish_feed", f.dish_antenna(model, "dish", at, radius=0.58, depth=0.17, focus=0.42))
    foot = frame((HALF[0] - 0.01, 0, 0.08), (1, 0, 0), (0, 1, 0))
    model.add(
        "dish",
        m.aluminium(),
        s.cylinder(0.16, 0, 0.06, 40),
        s.bolts(np.column_stack([s.regular(10, 0.135), np.full(10, 0.06)]), 0.01, 0.01),
        at=foot,
    )
    arms = [
        s.rod((HALF[0], y, z), (1.02, 0.35 * y, 0.11), 0.022, 16) for y, z in ((0.11, 0.0), (-0.11, 0.0), (0, 0.19))
    ]
    model.add("dish", m.black_paint(), *arms, s.ball(0.075, (1.0, 0, 0.105)))
    model.add(
        "dish",
        m.copper(),
        s.cable([(HALF[0], 0.05, -0.05), (0.86, 0.1, -0.02), (0.95, 0.05, 0.05), (1.03, 0.02, 0.1)], 0.012),
    )


def _boom(model: Model) -> None:
    """A magnetometer at the end of a lattice mast, another half-way."""
    start, end = np.array([-HALF[0] + 0.01, 0.28, -0.52]), np.array([-2.35, 0.28, -0.86])
    model.add("boom", m.aluminium(), s.truss(start, end, 0.13, 14, 0.008))
    along = frame(end, end - start, (0, 1, 0))
    model.add("boom", m.black_foil(), s.box((0.17, 0.17, 0.20), (0, 0, 0.08), 0.012, 4), at=along)
    model.add("boom", m.white_paint(), s.cylinder(0.06, 0.17, 0.22, 32), s.spike(0.016, 0.2, 0.32), at=along)
    model.mark("boom_tip", (0, 0, 0.32), along)
    half = frame(start + 0.55 * (end - start), end - start, (0, 1, 0))
    model.add("boom", m.gold_foil(), s.box((0.18, 0.18, 0.10), (0, 0, 0), 0.012, 4), at=half)
    base = frame(start, (-1, 0, 0), (0, 1, 0))
    model.add("boom", m.aluminium(), s.box((0.24, 0.24, 0.07), (0, 0, 0.02), 0.008), at=base)


def _deck(model: Model) -> None:
    """The instruments on +z."""
    top = HALF[2] - 0.005
    f.blanket(model, "deck", frame((0, 0, top - 0.02)), (1.28, 1.08), m.black_foil())
    at = frame((0.30, -0.22, top))
    model.add(
        "telescope",
        m.white_paint(),
        s.turned([(0, 0), (0.20, 0), (0.20, 0.40), (0.17, 0.40), (0.17, 0.12), (0, 0.12)], 64),
        at=at,
        around=True,
    )
    model.add("telescope", m.black_paint(), s.tube(0.172, 0.145, 0.02, 0.385, 64), at=at)
    model.add("telescope", m.glass(), s.cylinder(0.15, 0.1, 0.14, 48), at=at)
    rings = [s.tube(0.212, 0.19, z, z + 0.025, 64) for z in (0.05, 0.2, 0.37)]
    model.add("telescope", m.aluminium(), *rings, at=at)
    tracker = frame((-0.42, -0.34, top + 0.10), (-0.55, -0.45, 0.7), (0, 0, 1))
    f.star_tracker(model, "star_tracker", tracker, 0.30)
    model.mark("star_tracker", (0, 0, 0.30), tracker)
    model.add("star_tracker", m.aluminium(), s.box((0.2, 0.2, 0.14), (-0.42, -0.34, top + 0.04), 0.01))
    antenna = frame((-0.45, 0.38, top + 0.02))
    f.helix_antenna(model, "antenna", antenna, 0.62)
    model.mark("antenna_tip", (0, 0, 0.62), antenna)
    model.add("instruments", m.gold_foil(), s.box((0.34, 0.40, 0.20), (0.32, 0.28, top + 0.08), 0.016, 4))
    model.add("instruments", m.aluminium(), s.box((0.22, 0.26, 0.12), (-0.12, 0.30, top + 0.05), 0.010))
    model.add("instruments", m.black_paint(), s.tube(0.075, 0.055, 0.15, 0.27, 40), at=frame((0.32, 0.28, top)))
    model.add("instruments", m.white_paint(), s.handle(0.22, 0.06, 0.008), at=frame((-0.12, 0.0, top + 0.015)))
    model.add(
        "instruments",
        m.copper(),
        s.cable(
            [(-0.12, 0.2, top + 0.04), (0.0, 0.05, top + 0.02), (0.1, 0.1, top + 0.02), (0.18, 0.22, top + 0.05)], 0.010
        ),
    )


def _propulsion(model: Model) -> None:
    """The launch ring, the engine and eight small thrusters on -z."""
    down = frame((0, 0, -HALF[2] + 0.02), (0, 0, -1), (1, 0, 0))
    f.blanket(model, "base", down @ frame((0, 0, -0.03)), (1.28, 1.08), m.gold_foil())
    model.add("base", m.aluminium(), s.tube(0.46, 0.43, 0, 0.13, 96), s.tube(0.48, 0.41, 0.11, 0.14, 96), at=down)
    model.add(
        "base",
        m.aluminium(),
        s.bolts(np.column_stack([s.regular(36, 0.445), np.full(36, 0.14)]), 0.009, 0.008),
        at=down,
    )
    f.engine(model, "engine", down @ frame((0, 0, 0.10)), exit_radius=0.19, length=0.34)
    for a in (-1, 1):
        for b in (-1, 1):
            pod = np.array([a * (HALF[0] - 0.10), b * (HALF[1] + 0.03), -0.70])
            model.add("thrusters", m.gold_foil(), s.box((0.16, 0.10, 0.16), pod, 0.012, 4))
            aft = frame(pod + (0, 0, -0.07), (0.25 * a, 0.25 * b, -1))
            f.thruster(model, "thrusters", aft, 0.05)
            f.thruster(model, "thrusters", frame(pod + (0.065 * a, 0, 0.01), (a, 0, 0)), 0.04)
            if a != b:
                model.mark(f"thruster_{'front' if a > 0 else 'back'}", (0, 0, 0.13), aft)


def _skeleton(model: Model) -> None:
    for name in ("plus", "minus"):
        inner, outer = f"wing_{name}_inner", f"wing_{name}_outer"
        model.link(f"{inner}_front", f"{outer}_front", f"{outer}_back", f"{inner}_back", f"{inner}_front")
    model.link("bus_top_pp", "bus_top_pm", "bus_top_mm", "bus_top_mp", "bus_top_pp")
    for corner, wing in (
        ("pp", "plus_inner_front"),
        ("mp", "plus_inner_back"),
        ("pm", "minus_inner_front"),
        ("mm", "minus_inner_back"),
    ):
        model.link(f"bus_top_{corner}", f"wing_{wing}")
    model.link("bus_top_pp", "dish_feed", "bus_top_pm")
    model.link("bus_top_mp", "antenna_tip")
    model.link("bus_top_mm", "star_tracker")
    model.link("bus_top_pm", "thruster_front", "thruster_back", "bus_top_mp")
    model.link("thruster_back", "boom_tip", "bus_top_mp")
