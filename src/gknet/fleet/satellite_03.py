"""Satellite_03: a six-sided telescope with a slanted mouth over a wide sunshield, its bus hidden on the other side."""

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

SHIELD_Z = -0.42
"""Height of the lowest of the three layers."""
SHIELD = {"bow_left": (2.30, 0.62), "left": (0.0, 1.75), "stern_left": (-2.30, 0.62)}
TUBE_RADIUS, WALL = 0.66, 0.025
MOUTH_Z, SLANT = 1.62, 0.45
"""Height of the mouth on the axis, and how it falls towards +x, m per m."""
BUS_HALF, BUS_TOP, BUS_BOTTOM = 0.55, -0.62, -1.26


def model() -> Model:
    model = Model(
        "satellite_03",
        "Six-sided telescope along z with a slanted mouth, over a three-layer sunshield; bus, dish and panel below it.",
        (Symmetry(axis=[0, 0, 1], angle_deg=180, broken_by="slanted mouth, solar panel at -x, dish at +x, boom"),),
    )
    _shield(model)
    _tower(model)
    _telescope(model)
    _optics(model)
    _bus(model)
    _panel(model)
    _dish(model)
    _boom(model)
    _skeleton(model)
    return model


def _shield_corners() -> dict[str, tuple[float, float]]:
    """Anticlockwise from the bow; left is +y."""
    mirrored = {name.replace("left", "right"): (x, -y) for name, (x, y) in reversed(SHIELD.items())}
    return {**SHIELD, **mirrored}


def _scalloped(corners: Float[ndarray, "n 2"], sag: float) -> Float[ndarray, "m 2"]:
    """The outline of a stretched membrane: its edges bow inward."""
    t = np.linspace(0, 1, 10, endpoint=False)[:, None]
    pieces = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        inward = -(a + b) / np.linalg.norm(a + b)
        pieces.append(a + t * (b - a) + 4 * sag * t * (1 - t) * np.linalg.norm(b - a) * inward)
    return np.vstack(pieces)


def _shield(model: Model) -> None:
    """Three membranes, each smaller than the one below, on six booms with spreaders."""
    corners = np.array(list(_shield_corners().values()))
    hole = s.regular(12, 0.30)
    layers = ((0.0, 1.0, m.silver_foil()), (0.10, 0.965, m.purple_foil()), (0.20, 0.93, m.gold_foil()))
    for height, scale, foil in layers:
        outline = _scalloped(scale * corners, 0.045)
        model.add("shield", foil, s.prism(outline, height, height + 0.004, [hole]), at=frame((0, 0, SHIELD_Z)))
        hem = np.column_stack([outline, np.full(len(outline), height + 0.002)])
        model.add("shield", m.aluminium(), s.cable(np.vstack([hem, hem[:1]]), 0.007, 6, 2), at=frame((0, 0, SHIELD_Z)))
    for name, (x, y) in _shield_corners().items():
        out = np.array([x, y, 0]) / np.hypot(x, y)
        corner = np.array([x, y, SHIELD_Z])
        boom = s.rod(0.30 * out + (0, 0, SHIELD_Z - 0.06), corner + (0, 0, -0.045), 0.026, 20)
        spreader = s.rod(corner + (0, 0, -0.06), corner - 0.16 * out + (0, 0, 0.24), 0.013)
        pin = frame(corner + (0, 0, -0.03), out)
        model.add("shield_booms", m.aluminium(), boom, spreader)
        model.add("shield_booms", m.white_paint(), s.spike(0.019, -0.03, 0.14), at=pin)
        model.mark(f"shield_{name}", (0, 0, 0.14), pin)
        ties = [
            s.rod(corner - 0.14 * out * (h > 0) + (0, 0, h), corner - (0.17 + 0.8 * h) * out + (0, 0, h), 0.004, 6)
            for h in (0.1, 0.2)
        ]
        model.add("shield_booms", m.copper(), *ties)


def _tower(model: Model) -> None:
    """What carries the telescope through the shield: a cone and six pairs of struts."""
    foot, head = s.regular(6, 0.27), s.regular(6, 0.50, np.pi / 6)
    bars = []
    for k in range(6):
        low = (*foot[k], BUS_TOP - 0.01)
        bars += [s.rod(low, (*head[j % 6], -0.02), 0.018, 14) for j in (k, k - 1)]
    model.add("tower", m.carbon(), *bars)
    model.add(
        "tower",
        m.aluminium(),
        s.tube(0.31, 0.25, SHIELD_Z - 0.10, SHIELD_Z - 0.02, 60),
        s.tube(0.31, 0.26, -0.205, -0.185, 60),
    )
    spine = [(0.05, 0.02, BUS_TOP - 0.01), (0.08, 0.05, -0.45), (0.03, 0.09, -0.2), (0.08, 0.05, 0.0)]
    model.add("tower", m.copper(), *[s.cable(np.array(spine) * (sign, sign, 1), 0.022) for sign in (-1, 1)])


def _mouth(x: float) -> float:
    return MOUTH_Z - SLANT * x


def _below_mouth(solid: trimesh.Trimesh) -> trimesh.Trimesh:
    """The part of a solid below the slanted plane of the mouth."""
    normal = np.array([SLANT, 0, 1])
    block = trimesh.creation.box((6, 6, 4)).apply_translation((0, 0, -2))
    return trimesh.boolean.intersection([solid, s.moved(block, frame((0, 0, MOUTH_Z), normal))], engine="manifold")


def _telescope(model: Model) -> None:
    """Six walls of foil, black inside, with hoops and corner seams."""
    corners = s.regular(6, TUBE_RADIUS, np.pi / 6)
    inner, lining = (s.regular(6, TUBE_RADIUS - d, np.pi / 6) for d in (WALL, 2 * WALL))
    lower, upper = s.prism(corners, 0.0, 0.50, [inner]), s.prism(corners, 0.50, 2.2, [inner])
    model.add("telescope", m.gold_foil(), lower)
    model.add("telescope", m.silver_foil(), _below_mouth(upper))
    inside = s.prism(s.regular(6, TUBE_RADIUS - WALL + 0.001, np.pi / 6), 0.02, 2.2, [lining])
    model.add("telescope", m.black_paint(), _below_mouth(inside).apply_translation((0, 0, -0.006)))
    for z in (0.0, 0.49, 0.92):
        hoop = s.prism(
            s.regular(6, TUBE_RADIUS + 0.018, np.pi / 6),
            z - 0.015,
            z + 0.02,
            [s.regular(6, TUBE_RADIUS - 0.012, np.pi / 6)],
        )
        model.add("telescope", m.aluminium(), hoop)
    seams = [s.rod((*c, 0.01), (*c, _mouth(c[0]) - 0.004), 0.011) for c in corners]
    model.add("telescope", m.aluminium(), *seams)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        model.add("telescope", m.white_paint(), s.rod((*a, _mouth(a[0])), (*b, _mouth(b[0])), 0.016, 14))
    model.add("telescope", m.white_paint(), *[s.ball(0.016, (*c, _mouth(c[0])), 2) for c in corners])
    for name, k in (("low_left", 0), ("high_left", 2), ("high_right", 3), ("low_right", 5)):
        x, y = corners[k]
        model.mark(
            f"mouth_{name}",
            np.array([x, y, _mouth(x)]) + 0.016 * np.array([x, y, TUBE_RADIUS]) / (np.sqrt(2) * TUBE_RADIUS),
        )
    model.add("telescope", m.gold_foil(), s.prism(s.regular(6, TUBE_RADIUS - 0.03, np.pi / 6), -0.05, 0.03))


def _optics(model: Model) -> None:
    """The mirrors, the baffle and the spider, deep in the tube."""
    model.add("optics", m.mirror(), s.dish(0.50, 0.08, 0.03).apply_translation((0, 0, 0.14)))
    model.add("optics", m.black_paint(), s.turned([(0.09, 0.1), (0.11, 0.1), (0.075, 0.5), (0.065, 0.5)], 40))
    cap = s.turned([(0, 0.98), (0.10, 0.98), (0.115, 1.0), (0.115, 1.10), (0.08, 1.13), (0, 1.13)], 40)
    vanes = [
        s.rod((0.10 * x, 0.10 * y, 1.05), (0.56 * x, 0.56 * y, 1.08), 0.010) for x, y in s.regular(3, 1.0, np.pi / 2)
    ]
    model.add("optics", m.black_paint(), cap, *vanes)
    for z in (0.35, 0.6, 0.85):
        rim, hole = s.regular(6, TUBE_RADIUS - 2 * WALL + 0.004, np.pi / 6), s.regular(48, 0.50)
        model.add("optics", m.black_paint(), s.prism(rim, z, z + 0.006, [hole]))


def _bus(model: Model) -> None:
    middle, half = (BUS_TOP + BUS_BOTTOM) / 2, BUS_HALF
    f.bus_frame(model, (half, half, (BUS_TOP - BUS_BOTTOM) / 2), middle)
    for side in (-1, 1):
        wall = frame((side * (half - 0.026), 0, middle), (side, 0, 0), (0, 1, 0))
        f.blanket(model, "walls", wall, (0.96, 0.52), m.gold_foil())
        wall = frame((0, side * (half - 0.028), middle), (0, side, 0), (1, 0, 0))
        f.blanket(model, "walls", wall, (0.96, 0.52), m.gold_foil())
        f.radiator(model, "radiators", wall @ frame((0, 0.0, 0.018)), (0.78, 0.38))
    _floor(model)
    for a, b in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        end = "bow" if a > 0 else "stern"
        model.mark(f"bus_{end}_{'left' if b > 0 else 'right'}", (a * half, b * half, BUS_BOTTOM))
        pod = frame((a * (half + 0.03), b * (half - 0.20), BUS_BOTTOM + 0.16), (a, 0, -0.3), (0, 1, 0))
        model.add("thrusters", m.gold_foil(), s.box((0.17, 0.15, 0.12), radius=0.012, steps=4), at=pod)
        f.thruster(model, "thrusters", pod @ frame((0.0, 0.0, 0.05)), 0.045)
        f.thruster(model, "thrusters", pod @ frame((0.0, -0.065, 0.0), (0, -1, 0)), 0.035)
        if a == b:
            model.mark(f"thruster_{end}", (0, 0, 0.18), pod)


def _floor(model: Model) -> None:
    """The launch ring, the engine, a star tracker and an antenna on -z."""
    floor = frame((0, 0, BUS_BOTTOM), (0, 0, -1), (1, 0, 0))
    f.blanket(model, "floor", floor @ frame((0, 0, -0.024)), (0.96, 0.96), m.black_foil())
    rings = s.tube(0.36, 0.335, -0.01, 0.09, 96), s.tube(0.375, 0.32, 0.075, 0.095, 96)
    model.add("floor", m.aluminium(), *rings, at=floor)
    heads = np.column_stack([s.regular(30, 0.348), np.full(30, 0.095)])
    model.add("floor", m.aluminium(), s.bolts(heads, 0.008, 0.007), at=floor)
    f.engine(model, "engine", floor @ frame((0, 0, 0.06)), exit_radius=0.12, length=0.22)
    tracker = frame((0.30, 0.46, BUS_BOTTOM - 0.06), (0.1, 0.9, -0.6), (1, 0, 0))
    f.star_tracker(model, "star_tracker", tracker, 0.28)
    f.helix_antenna(model, "antenna", floor @ frame((0.40, 0.38, 0.015)), 0.34, 0.035)


def _panel(model: Model) -> None:
    """One panel on the -x side, its cells facing down."""
    columns, rows = 8, 6
    length = f.panel_size(columns, rows)[1]
    root = frame((-BUS_HALF - 0.02, 0, -0.98), (0.55, 0, -1), (0, -1, 0))
    f.yoke(model, "yoke", root, 0.34, 0.9)
    at = root @ frame((0, 0.36 + length / 2, 0))
    f.panel(model, "panel", at, columns, rows, m.solar_cells())
    f.hinges(model, "panel", root @ frame((0, 0.345, 0)), 0.6, 0.03)
    for name, corner in zip(("left", "right"), f.panel_corners(columns, rows)[[3, 2]], strict=True):
        model.mark(f"panel_{name}", corner, at)


def _dish(model: Model) -> None:
    at = frame((1.22, 0.0, -1.02), (1, 0, -0.55), (0, 1, 0))
    model.mark("dish_feed", f.dish_antenna(model, "dish", at, radius=0.38, depth=0.11, focus=0.30))
    joint = s.point_of(at, (0, 0, -0.12))
    model.add("dish", m.aluminium(), s.rod((BUS_HALF - 0.02, 0, -0.80), joint, 0.035, 24), s.ball(0.06, joint))
    model.add(
        "dish", m.aluminium(), s.moved(s.cylinder(0.10, 0, 0.06, 36), frame((BUS_HALF - 0.01, 0, -0.80), (1, 0, 0)))
    )
    wire = [(BUS_HALF, 0.05, -0.85), (0.75, 0.06, -0.93), (0.95, 0.04, -0.93), joint + (0, 0.05, 0)]
    model.add("dish", m.black_paint(), s.cable(np.array(wire), 0.010))


def _boom(model: Model) -> None:
    """A lattice mast downward, off the axis, with a sensor at its end."""
    start, end = np.array([-0.18, -0.40, BUS_BOTTOM + 0.01]), np.array([-0.30, -0.62, -2.05])
    model.add("boom", m.aluminium(), s.truss(start, end, 0.10, 8, 0.007))
    along = frame(end, end - start, (1, 0, 0))
    model.add("boom", m.black_foil(), s.box((0.14, 0.14, 0.15), (0, 0, 0.06), 0.012, 4), at=along)
    model.add("boom", m.red_paint(), s.cylinder(0.05, 0.12, 0.17, 32), s.spike(0.016, 0.15, 0.27), at=along)
    model.mark("boom_tip", (0, 0, 0.27), along)


def _skeleton(model: Model) -> None:
    ring = [f"shield_{name}" for name in _shield_corners()]
    model.link(*ring, ring[0])
    model.link("mouth_low_left", "mouth_high_left", "mouth_high_right", "mouth_low_right", "mouth_low_left")
    model.link("bus_bow_left", "bus_bow_right", "bus_stern_right", "bus_stern_left", "bus_bow_left")
    model.link("mouth_low_left", "shield_bow_left")
    model.link("mouth_low_right", "shield_bow_right")
    model.link("mouth_high_left", "shield_stern_left")
    model.link("mouth_high_right", "shield_stern_right")
    model.link("shield_left", "bus_bow_left")
    model.link("shield_left", "bus_stern_left")
    model.link("shield_right", "bus_bow_right")
    model.link("shield_right", "bus_stern_right")
    model.link("bus_stern_left", "panel_left", "panel_right", "bus_stern_right")
    model.link("bus_bow_left", "dish_feed", "bus_bow_right")
    model.link("bus_bow_left", "thruster_bow")
    model.link("bus_stern_right", "thruster_stern")
    model.link("bus_stern_right", "boom_tip")
