"""Draws the pictures of conventions.md and how-it-works.md: python docs/figures.py [FOLDER].

They are kept in docs/images; draw them again when a convention or the network changes, and look at them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, FancyArrowPatch, FancyBboxPatch, Polygon, Rectangle
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from gknet import Box, Pose
from gknet.inference.crop import Crop

INK, BLUE, ORANGE, GREEN, GREY = "#222222", "#1f5fa8", "#c8560a", "#2f7d32", "#9a9a9a"
PALE_BLUE, PALE_ORANGE, PALE_GREEN, PALE_GREY = "#dce8f5", "#fbe5d3", "#dcefdc", "#efefef"
AXIS_COLOURS = ("#c62828", "#2e7d32", "#1565c0")


def canvas(width: float, height: float) -> tuple[Figure, Axes]:
    """A figure of width x height inches whose one axes has inches as its units, y upward."""
    figure = plt.figure(figsize=(width, height))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(0, height))
    axes.axis("off")
    return figure, axes


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], colour: str = INK, **style: Any) -> None:
    options: dict[str, Any] = {
        "arrowstyle": "-|>",
        "mutation_scale": 11,
        "linewidth": 1.3,
        "shrinkA": 0,
        "shrinkB": 0,
    }
    axes.add_patch(FancyArrowPatch(start, end, color=colour, **(options | style)))


def note(axes: Axes, x: float, y: float, text: str, **style: Any) -> None:
    options: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 9, "color": INK}
    axes.text(x, y, text, **(options | style))


def label(axes: Axes, place: np.ndarray | tuple[float, float], text: str, **style: Any) -> None:
    note(axes, float(place[0]), float(place[1]), text, **style)


FROM_BEHIND = np.array([[1.0, 0.0], [0.0, -1.0], [0.55, 0.38]])
"""Camera axes on paper: x to the right, y down, z into the paper's upper right."""

FROM_THE_SIDE = np.array([[-0.42, -0.32], [0.0, -1.0], [1.0, 0.0]])
"""The same with z to the right and x towards the reader."""


def view(points: np.ndarray, on_paper: np.ndarray = FROM_BEHIND) -> np.ndarray:
    """(n, 3) in camera axes -> (n, 2) on paper."""
    return points @ on_paper


def triad(
    axes: Axes,
    place: np.ndarray,
    rotation: np.ndarray,
    length: float,
    names: tuple[str, str, str],
    on_paper: np.ndarray = FROM_BEHIND,
) -> None:
    """The three axes of a frame that is turned by `rotation` against the camera's."""
    for k in range(3):
        direction = view(rotation[:, k][None], on_paper)[0]
        arrow(axes, tuple(place), tuple(place + direction * length), AXIS_COLOURS[k], linewidth=1.8)
        away = place + direction * (length + 0.17 / np.linalg.norm(direction))
        label(axes, away, names[k], color=AXIS_COLOURS[k], fontsize=11)


def cuboid(axes: Axes, pose: Pose, half: np.ndarray, origin: np.ndarray, scale: float) -> None:
    """A box for a body, with a panel on either side."""

    def draw(corners: np.ndarray, colour: str) -> None:
        axes.add_patch(Polygon(origin + scale * view(pose.transform(corners)), fc=colour, ec=INK, lw=0.9, alpha=0.9))

    signs = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]])
    for side in (-1, 1):
        wing = np.column_stack([signs[:, 0] * 0.8 + side * (half[0] + 0.8), signs[:, 1] * 0.35, np.zeros(4)])
        draw(wing, PALE_BLUE)
    faces = []
    for axis in range(3):
        for side in (-1, 1):
            corners = np.zeros((4, 3))
            corners[:, axis] = side * half[axis]
            corners[:, [k for k in range(3) if k != axis]] = signs * half[[k for k in range(3) if k != axis]]
            faces.append((pose.transform(corners)[:, 2].mean(), corners))
    for _, corners in sorted(faces, key=lambda face: -face[0]):
        draw(corners, PALE_ORANGE)


def frames() -> Figure:
    figure, axes = canvas(7.2, 3.2)
    camera, body = np.array([0.8, 1.45]), np.array([5.0, 1.95])
    pose = Pose.from_rotation_vector([0.3, 0.25, 0.3], [0, 0, 0])
    cuboid(axes, pose, np.array([0.45, 0.35, 0.4]), body, 0.75)
    triad(axes, camera, np.eye(3), 0.8, ("$x$", "$y$", "$z$"))
    triad(axes, body, pose.rotation, 0.75, ("$x_b$", "$y_b$", "$z_b$"))
    arrow(axes, tuple(camera), tuple(body), INK, linestyle=(0, (4, 2)))
    note(axes, 2.9, 1.48, "$t$", fontsize=13)
    point = body + 0.75 * view(pose.transform(np.array([[-2.05, -0.35, 0.0]])))[0]
    axes.plot(*point, "o", color=GREEN, ms=6)
    arrow(axes, tuple(camera), tuple(point), GREEN, shrinkB=4)
    note(axes, 2.1, 2.3, r"$p_\mathrm{cam}$", color=GREEN, fontsize=12)
    arrow(axes, tuple(body), tuple(point), GREEN, linestyle=(0, (2, 2)), shrinkB=4)
    note(axes, 4.75, 2.72, r"$p_\mathrm{body}$", color=GREEN, fontsize=12)
    note(axes, 1.6, 0.15, "camera frame: x right, y down, z forward")
    note(axes, 5.4, 0.15, r"body frame:  $p_\mathrm{cam} = R\,p_\mathrm{body} + t$", fontsize=11)
    return figure


def camera() -> Figure:
    figure, axes = canvas(7.2, 3.3)
    eye = np.array([0.9, 1.85])

    def on_paper(x: float, y: float, z: float) -> np.ndarray:
        return eye + view(np.array([[x, y, z]]), FROM_THE_SIDE)[0]

    depth, half = 2.0, 0.95
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    axes.add_patch(Polygon([on_paper(*corner, depth) for corner in corners], fc=PALE_GREY, ec=INK, lw=1.2))
    for corner in corners:
        axes.plot(*np.array([eye, on_paper(*corner, depth)]).T, color=GREY, lw=0.7, ls=":")
    axes.plot(*np.array([eye, on_paper(0, 0, 5.2)]).T, color=GREY, lw=0.9, ls="--")
    triad(axes, eye, np.eye(3), 0.7, ("$x$", "$y$", "$z$"), FROM_THE_SIDE)
    centre, seen = on_paper(0, 0, depth), np.array([-0.35, -0.3, depth])
    point = seen * 2.3
    axes.plot(*centre, "+", color=INK, ms=9)
    label(axes, (centre + (0.05, -0.17)), "$(c_x, c_y)$", fontsize=10)
    axes.plot(*np.array([eye, on_paper(*point)]).T, color=GREEN, lw=1.2)
    axes.plot(*on_paper(*point), "o", color=GREEN, ms=6)
    axes.plot(*on_paper(*seen), "o", color=ORANGE, ms=6)
    label(axes, (on_paper(*point) + (0.45, -0.02)), "$(x, y, z)$", color=GREEN, fontsize=11)
    label(axes, (on_paper(*seen) + (-0.02, 0.2)), "$(u, v)$", color=ORANGE, fontsize=11)
    label(axes, (on_paper(*corners[0], depth) + (0.3, 0.02)), "(0, 0)", fontsize=8.5)
    label(axes, (on_paper(*corners[2], depth) + (-0.38, 0.0)), "$(W, H)$", fontsize=8.5)
    note(axes, 4.9, 1.15, r"$u = f_x\, x / z + c_x$", fontsize=13, ha="left")
    note(axes, 4.9, 0.75, r"$v = f_y\, y / z + c_y$", fontsize=13, ha="left")
    note(axes, 3.6, 0.18, "The camera's z axis meets the image at $(c_x, c_y)$.")
    return figure


def pixels() -> Figure:
    figure, axes = canvas(7.2, 3.1)
    left, top, cell = 0.9, 2.55, 0.62
    for row in range(3):
        for column in range(4):
            x, y = left + column * cell, top - (row + 1) * cell
            first = row == column == 0
            axes.add_patch(Rectangle((x, y), cell, cell, fc=PALE_ORANGE if first else "white", ec=INK, lw=1))
            axes.plot(x + cell / 2, y + cell / 2, ".", color=ORANGE if first else GREY, ms=6)
    for column in range(5):
        note(axes, left + column * cell, top + 0.14, str(column), fontsize=9)
    for row in range(4):
        note(axes, left - 0.14, top - row * cell, str(row), fontsize=9)
    arrow(axes, (left, top + 0.33), (left + 4.5 * cell, top + 0.33))
    note(axes, left + 4.75 * cell, top + 0.33, "$x$", fontsize=11)
    arrow(axes, (left - 0.35, top), (left - 0.35, top - 3.5 * cell))
    note(axes, left - 0.35, top - 3.8 * cell, "$y$", fontsize=11)
    note(axes, 3.7, 2.4, "The centre of the top-left pixel is (0.5, 0.5).", ha="left", color=ORANGE)
    arrow(
        axes, (3.65, 2.4), (left + cell * 0.58, top - cell * 0.45), ORANGE, linewidth=1, connectionstyle="arc3,rad=0.12"
    )
    note(axes, 3.7, 1.95, "This image spans [0, 4] x [0, 3], its centre is (2, 1.5).", ha="left")
    axes.plot(left + 2 * cell, top - 1.5 * cell, "x", color=BLUE, ms=8, mew=2)
    arrow(
        axes, (3.65, 1.92), (left + 2.15 * cell, top - 1.48 * cell), BLUE, linewidth=1, connectionstyle="arc3,rad=0.1"
    )
    note(axes, 3.7, 1.5, r"Resizing by $s$ is pure scaling:  $x' = s\,x$.", ha="left")
    note(axes, 3.7, 1.05, "Code with integer pixel centres (OpenCV)", ha="left", color=GREY)
    note(
        axes, 3.7, 0.8, r"has other coordinates:  $x_\mathrm{gknet} = x_\mathrm{OpenCV} + 0.5$.", ha="left", color=GREY
    )
    return figure


def crop() -> Figure:
    figure, axes = canvas(7.2, 3.5)
    width, height, unit = 400, 300, 2.6 / 400
    left, top = 0.9, 3.0

    def on_paper(x: float, y: float) -> tuple[float, float]:
        return left + x * unit, top - y * unit

    def square(x0: float, y0: float, wide: float, high: float, **style: Any) -> None:
        corner = on_paper(x0, y0 + high)
        axes.add_patch(Rectangle(corner, wide * unit, high * unit, **style))

    box = Box(245, 105, 398, 205)
    made = Crop.around(box, 256)
    square(made.x0, made.y0, made.side, made.side, fc="#404040", ec="none")
    square(0, 0, width, height, fc=PALE_BLUE, ec=INK, lw=1.2)
    square(box.x0, box.y0, box.x1 - box.x0, box.y1 - box.y0, fc=PALE_ORANGE, ec=ORANGE, lw=1, ls="--")
    square(made.x0, made.y0, made.side, made.side, fc="none", ec=BLUE, lw=2)
    axes.plot(*on_paper(300, 140), "o", color=GREEN, ms=5)
    label(axes, on_paper(0, -18), "(0, 0)", fontsize=8.5)
    label(axes, on_paper(made.x0 - 4, made.y0 - 16), "$(x_0, y_0)$", color=BLUE, fontsize=10)
    label(axes, on_paper(made.x0 + made.side / 2, made.y0 + made.side + 16), "side", color=BLUE)
    label(axes, on_paper(110, 150), "image", fontsize=10)
    label(axes, on_paper(200, 330), "outside of the image the crop is black", fontsize=8.5)
    side, x1, y1 = 2.0, 4.75, 0.75
    scale = side / made.side
    axes.add_patch(Rectangle((x1, y1), side, side, fc="#404040", ec=BLUE, lw=2))
    axes.add_patch(Rectangle((x1, y1), (width - made.x0) * scale, side, fc=PALE_BLUE, ec="none"))
    inside_x, inside_y = x1 + (box.x0 - made.x0) * scale, y1 + side - (box.y1 - made.y0) * scale
    axes.add_patch(
        Rectangle(
            (inside_x, inside_y),
            (box.x1 - box.x0) * scale,
            (box.y1 - box.y0) * scale,
            fc=PALE_ORANGE,
            ec=ORANGE,
            ls="--",
        )
    )
    axes.add_patch(Rectangle((x1, y1), side, side, fc="none", ec=BLUE, lw=2))
    point = made.to_input(np.array([300.0, 140.0])) / made.size * side
    axes.plot(x1 + point[0], y1 + side - point[1], "o", color=GREEN, ms=6)
    note(axes, x1, y1 + side + 0.13, "(0, 0)", fontsize=8.5)
    note(axes, x1 + side, y1 - 0.13, "(size, size)", fontsize=8.5)
    note(axes, x1 + side / 2, y1 + side + 0.32, "input of the network", fontsize=10)
    arrow(axes, (3.85, 1.75), (4.6, 1.75))
    note(
        axes,
        3.6,
        0.25,
        r"$p_\mathrm{input} = (p_\mathrm{image} - (x_0, y_0)) \cdot \mathrm{size} / \mathrm{side}$",
        fontsize=12,
    )
    return figure


def heatmap() -> Figure:
    figure, axes = canvas(7.2, 3.2)
    left, top, fine, stride = 0.8, 2.75, 0.145, 4
    cells = 4
    side = cells * stride * fine
    peak = np.array([9.0, 6.6])
    for row in range(cells):
        for column in range(cells):
            centre = stride * (np.array([column, row]) + 0.5)
            value = np.exp(-((centre - peak) ** 2).sum() / (2 * (1.0 * stride) ** 2))
            corner = (left + column * stride * fine, top - (row + 1) * stride * fine)
            shade = tuple(1 - value * (1 - np.array([0.12, 0.37, 0.66])))
            axes.add_patch(Rectangle(corner, stride * fine, stride * fine, fc=shade, ec=INK, lw=1.1))
            axes.plot(
                left + centre[0] * fine, top - centre[1] * fine, ".", color="white" if value > 0.5 else GREY, ms=5
            )
    for k in range(cells * stride + 1):
        axes.plot([left + k * fine] * 2, [top, top - side], color=GREY, lw=0.3)
        axes.plot([left, left + side], [top - k * fine] * 2, color=GREY, lw=0.3)
    axes.plot(left + peak[0] * fine, top - peak[1] * fine, "x", color=ORANGE, ms=9, mew=2.2)
    for k in range(cells + 1):
        note(axes, left + k * stride * fine, top + 0.13, str(k * stride), fontsize=8.5)
        note(axes, left - 0.16, top - k * stride * fine, str(k * stride), fontsize=8.5)
    note(
        axes,
        left + side / 2,
        top - side - 0.2,
        "input pixels (thin lines); cells of stride $s = 4$ (thick lines)",
        fontsize=8.5,
    )
    note(axes, 3.75, 2.5, "Cell (row $i$, column $j$) covers", ha="left")
    note(axes, 3.75, 2.2, r"$[s j,\ s (j + 1)] \times [s i,\ s (i + 1)]$,", ha="left", fontsize=11)
    note(axes, 3.75, 1.9, r"its centre is  $(s (j + 0.5),\ s (i + 0.5))$.", ha="left", fontsize=10)
    note(axes, 3.75, 1.35, "The keypoint (cross) lies between the centres:", ha="left", color=ORANGE)
    note(axes, 3.75, 1.1, "a Gaussian is fitted to the cells about the highest.", ha="left", color=ORANGE)
    return figure


def rotation() -> Figure:
    figure, axes = canvas(7.2, 2.9)
    left = np.array([1.7, 1.65])
    first, second = Rotation.from_rotvec([0.15, 0.35, 0.1]), Rotation.from_rotvec([0.15, 0.35, 0.75])
    for turned, style in ((first, "-"), (second, (0, (3, 2)))):
        for k in range(3):
            tip = left + view(turned.as_matrix()[:, k][None])[0] * 0.95
            arrow(axes, tuple(left), tuple(tip), AXIS_COLOURS[k], linestyle=style, linewidth=1.7)
    for k, name in enumerate("xyz"):
        label(
            axes,
            (left + view(first.as_matrix()[:, k][None])[0] * 1.12),
            f"${name}$",
            color=AXIS_COLOURS[k],
            fontsize=10,
        )
    note(axes, 1.7, 0.15, r"two attitudes:  $\theta = 2 \arccos |\langle q_1, q_2 \rangle|$", fontsize=11)
    centre, radius = np.array([5.3, 1.35]), 0.75
    arrow(axes, tuple(centre - (0.25, 0.85)), tuple(centre + (0.36, 1.22)), INK, linewidth=1.6)
    label(axes, (centre + (0.52, 1.25)), "$n$", fontsize=12)
    angles = np.radians(np.linspace(200, 480, 80))
    ring = centre + np.column_stack(
        [radius * np.cos(angles), 0.3 * radius * np.sin(angles) - 0.22 * radius * np.cos(angles)]
    )
    axes.plot(*ring.T, color=BLUE, lw=1.6)
    arrow(axes, tuple(ring[-2]), tuple(ring[-1]), BLUE, mutation_scale=15)
    label(axes, (centre + (0.98, -0.12)), r"$\theta$", fontsize=13, color=BLUE)
    note(axes, 5.3, 0.15, r"$q = (\cos \frac{\theta}{2},\ n \sin \frac{\theta}{2})$, and $-q$ is the same", fontsize=11)
    return figure


def ellipse(axes: Axes, centre: np.ndarray, covariance: np.ndarray, scale: float, colour: str, sigmas: float) -> None:
    values, vectors = np.linalg.eigh(covariance)
    angle = np.degrees(np.arctan2(*vectors[::-1, 1]))
    long, short = 2 * sigmas * np.sqrt(values[::-1]) * scale
    axes.add_patch(Ellipse(tuple(centre), long, short, angle=angle, fc="none", ec=colour, lw=1.5))


def covariance() -> Figure:
    figure, axes = canvas(7.2, 3.1)
    points = {
        "sharp peak": ((0.8, 2.2), np.diag([1.0, 1.0])),
        "edge": ((2.0, 1.3), np.array([[9.0, 6.0], [6.0, 5.0]])),
        "hidden": ((2.75, 2.35), np.diag([14.0, 10.0])),
    }
    for name, (place, matrix) in points.items():
        axes.plot(*place, "+", color=ORANGE, ms=8, mew=1.6)
        for sigmas in (1, 2):
            ellipse(axes, np.array(place), matrix, 0.055, BLUE, sigmas)
        note(axes, place[0], place[1] - 0.14 - 0.11 * np.sqrt(matrix[1, 1]), name, fontsize=8.5)
    note(axes, 1.8, 0.25, r"keypoints: 2x2 in px$^2$, ellipses of 1 and 2 $\sigma$", fontsize=10)
    left, top, cell = 4.5, 2.65, 0.33
    names = (
        r"$\delta\omega_x$",
        r"$\delta\omega_y$",
        r"$\delta\omega_z$",
        "$\\delta t_x$",
        "$\\delta t_y$",
        "$\\delta t_z$",
    )
    for row in range(6):
        for column in range(6):
            colour = PALE_ORANGE if row < 3 and column < 3 else PALE_BLUE if row >= 3 and column >= 3 else PALE_GREY
            axes.add_patch(Rectangle((left + column * cell, top - (row + 1) * cell), cell, cell, fc=colour, ec="white"))
        note(axes, left - 0.22, top - (row + 0.5) * cell, names[row], fontsize=10)
        note(axes, left + (row + 0.5) * cell, top + 0.14, names[row], fontsize=10)
    note(axes, left + 1.5 * cell, top - 1.5 * cell, "rad$^2$", fontsize=11)
    note(axes, left + 4.5 * cell, top - 4.5 * cell, "m$^2$", fontsize=11)
    note(axes, left + 4.5 * cell, top - 1.5 * cell, "rad m", fontsize=10)
    note(axes, left + 1.5 * cell, top - 4.5 * cell, "rad m", fontsize=10)
    note(axes, 5.4, 0.25, r"pose: 6x6, camera frame,  $R_\mathrm{true} = \exp([\delta\omega]_\times)\,R$", fontsize=10)
    return figure


def errors() -> Figure:
    figure, axes = canvas(7.2, 2.9)
    eye, truth, found = np.array([0.4, 1.15]), np.array([2.0, 2.2]), np.array([2.35, 1.8])
    axes.plot(*eye, "s", color=INK, ms=7)
    note(axes, eye[0], eye[1] - 0.2, "camera", fontsize=8.5)
    arrow(axes, tuple(eye), tuple(truth), INK, shrinkB=4)
    arrow(axes, tuple(eye), tuple(found), BLUE, shrinkB=4, linestyle=(0, (4, 2)))
    arrow(axes, tuple(truth), tuple(found), ORANGE, linewidth=2)
    axes.plot(*truth, "o", color=INK, ms=6)
    axes.plot(*found, "o", color=BLUE, ms=6)
    note(axes, 1.1, 1.83, "$t$", fontsize=12)
    note(axes, 1.5, 1.32, r"$\hat t$", fontsize=12, color=BLUE)
    note(axes, 2.55, 2.1, r"$\hat t - t$", fontsize=11, color=ORANGE)
    note(axes, 1.4, 0.45, r"$E_t = \|\hat t - t\| / \|t\|$", fontsize=11)
    centre = np.array([3.85, 1.3])
    for angle, colour in ((70, INK), (35, BLUE)):
        turn = np.radians(angle)
        arrow(axes, tuple(centre), tuple(centre + 0.95 * np.array([np.cos(turn), np.sin(turn)])), colour, linewidth=1.8)
    arc = np.radians(np.linspace(35, 70, 20))
    axes.plot(*(centre[:, None] + 0.6 * np.array([np.cos(arc), np.sin(arc)])), color=ORANGE, lw=2)
    label(axes, (centre + 0.8 * np.array([np.cos(0.92), np.sin(0.92)])), "$E_q$", fontsize=11, color=ORANGE)
    note(axes, centre[0] + 0.42, centre[1] + 1.05, "$q$", fontsize=12)
    note(axes, centre[0] + 0.95, centre[1] + 0.6, r"$\hat q$", fontsize=12, color=BLUE)
    note(axes, 4.1, 0.45, r"$E_q = 2 \arccos |\langle q, \hat q \rangle|$", fontsize=11)
    inset = figure.add_axes((0.76, 0.3, 0.22, 0.6))
    nees = np.linspace(0, 20, 200)
    inset.plot(nees, chi2.pdf(nees, 6), color=BLUE, lw=1.6)
    limit = chi2.ppf(0.95, 6)
    inset.fill_between(nees, chi2.pdf(nees, 6), where=nees <= limit, color=PALE_BLUE)
    inset.axvline(6, color=INK, lw=0.9, ls="--")
    inset.axvline(limit, color=ORANGE, lw=0.9, ls="--")
    inset.set_xticks([0, 6, limit], ["0", "6", f"{limit:.1f}"])
    inset.set(yticks=[], ylim=(0, 0.16), xlim=(0, 20))
    inset.tick_params(labelsize=8)
    inset.text(6.3, 0.148, "mean", fontsize=7.5)
    inset.text(limit + 0.4, 0.06, "95 %", fontsize=7.5, color=ORANGE)
    for side in ("top", "right", "left"):
        inset.spines[side].set_visible(False)
    note(axes, 6.25, 0.25, r"NEES $= e^\top C^{-1} e \sim \chi^2_6$", fontsize=11)
    return figure


def block(
    axes: Axes, x: float, y: float, wide: float, high: float, title: str, under: str = "", colour: str = PALE_GREY
) -> None:
    """A box about (x, y) with a title and a smaller second line."""
    shape = FancyBboxPatch(
        (x - wide / 2, y - high / 2),
        wide,
        high,
        boxstyle="round,pad=0.02,rounding_size=0.06",
        fc=colour,
        ec=INK,
        lw=0.9,
    )
    axes.add_patch(shape)
    note(axes, x, y + (0.09 * (1 + under.count("\n")) if under else 0), title, fontsize=9.4, fontweight="bold")
    if under:
        note(axes, x, y - 0.1, under, fontsize=8.3)


def pipeline() -> Figure:
    figure, axes = canvas(9.2, 2.2)
    stages = (
        ("image, camera", "RGB uint8, K", "white"),
        ("locate", "locator.onnx:\nbox", PALE_BLUE),
        ("crop", "1.25 x the box,\n192 x 192", PALE_GREY),
        ("network", "keypoints.onnx:\nn heatmaps", PALE_BLUE),
        ("decode", "pixel, score,\n2x2 covariance", PALE_GREY),
        ("pose", "LO-RANSAC, LM,\nchecks", PALE_GREY),
        ("estimate", "pose, 6x6 cov.,\nor failure", PALE_GREEN),
    )
    step = 1.3
    for k, (title, under, colour) in enumerate(stages):
        x = 0.7 + k * step
        block(axes, x, 1.45, 1.1, 0.85, title, under, colour)
        if k:
            arrow(axes, (x - step + 0.58, 1.45), (x - 0.59, 1.45))
    x0, x1 = 0.7 + 2 * step, 0.7 + 5 * step
    axes.plot([x1, x1, x0], [0.98, 0.55, 0.55], color=ORANGE, lw=1.3)
    arrow(axes, (x0, 0.55), (x0, 0.98), ORANGE)
    note(axes, (x0 + x1) / 2, 0.38, "crop refinement: once, when the crop was off", color=ORANGE)
    return figure


def architecture() -> Figure:
    figure, axes = canvas(10.4, 7.0)
    image_y, row1, row2, row3 = 6.45, 5.4, 4.25, 2.9
    for y0, y1, name in ((2.4, 3.55, "first_pass()"), (0.75, 1.88, "second_pass()")):
        axes.add_patch(Rectangle((0.1, y0), 8.05, y1 - y0, fc="#f7f7fb", ec=BLUE, lw=1, ls="--"))
        note(axes, 8.1, y1 - 0.1, name, ha="right", color=BLUE, fontsize=9.5, family="monospace")
    block(axes, 1.3, image_y, 1.7, 0.55, "image", "3 x 192 x 192")
    block(axes, 1.3, row1, 2.1, 0.85, "residual encoder", "32x48x48, 64x24x24,\n128x12x12, 256x6x6", PALE_BLUE)
    block(
        axes,
        4.2,
        row1,
        2.0,
        0.85,
        "context (transformer)",
        "36 cells x 128, added\nto the coarsest: 384x6x6",
        PALE_BLUE,
    )
    block(axes, 1.3, row2, 2.1, 0.75, "pyramid, eq. 1", "48 x 48 x 48", PALE_BLUE)
    block(axes, 7.6, row1, 2.1, 0.75, "attitude head", "864 classes", PALE_GREEN)
    block(axes, 7.6, row2, 2.1, 0.75, "keypoint prior", "n x 8 x 8, by geometry", PALE_GREEN)
    block(axes, 1.3, row3, 2.1, 0.75, "pixel maps + prior", "n x 48 x 48", PALE_ORANGE)
    block(axes, 4.4, row2, 1.9, 0.75, "memory", "(36 + 144) cells x 128", PALE_BLUE)
    block(
        axes,
        4.6,
        row3,
        2.5,
        0.78,
        "graph decoder, 3 layers",
        "attend, sample features,\nedges (eqs. 2, 3): n x 128",
        PALE_BLUE,
    )
    block(axes, 7.1, row3, 1.5, 0.78, "node maps", "n x 48 x 48", PALE_ORANGE)
    second = 1.25
    block(
        axes,
        4.6,
        second,
        2.5,
        0.78,
        "same decoder, same weights",
        "samples at the first result,\nposition votes along the edges",
        PALE_BLUE,
    )
    block(axes, 7.1, second, 1.5, 0.78, "node maps", "n x 48 x 48", PALE_ORANGE)
    block(axes, 1.3, second, 2.1, 0.78, "pixel maps + new prior", "n x 48 x 48", PALE_ORANGE)
    block(axes, 4.6, 0.3, 2.9, 0.46, "1x1 fusion, softmax: heatmaps", "", PALE_ORANGE)
    note(axes, 6.2, 0.3, "n x 48 x 48", fontsize=8, ha="left")
    arrow(axes, (1.3, 6.16), (1.3, 5.86))
    arrow(axes, (2.38, row1), (3.17, row1))
    arrow(axes, (5.23, row1), (6.52, row1))
    arrow(axes, (1.3, 4.95), (1.3, 4.66))
    arrow(axes, (3.4, 4.95), (2.38, 4.45))
    arrow(axes, (4.3, 4.95), (4.35, 4.66))
    arrow(axes, (7.6, 5.0), (7.6, 4.66))
    arrow(axes, (1.0, 3.85), (1.0, 3.31))
    arrow(axes, (4.5, 3.85), (4.55, 3.32))
    axes.plot([7.6, 7.6, 1.6], [3.86, 3.66, 3.66], color=GREEN, lw=1.3)
    arrow(axes, (1.6, 3.66), (1.6, 3.31), GREEN)
    note(axes, 6.1, 3.76, "added to the maps", color=GREEN, fontsize=8.4)
    arrow(axes, (2.38, row3), (3.32, row3))
    note(axes, 2.72, row3 + 0.13, "where", fontsize=8.4)
    arrow(axes, (5.88, row3), (6.32, row3))
    axes.plot([7.87, 9.1, 9.1], [row3, row3, row1], color=ORANGE, lw=1.3)
    arrow(axes, (9.1, row1), (8.68, row1), ORANGE)
    note(axes, 9.2, 3.9, "the first maps\n(pixel + node)\nupdate the\nattitude", color=ORANGE, fontsize=8.4, ha="left")
    axes.plot([7.1, 7.1, 4.9], [2.49, 2.2, 2.2], color=INK, lw=1.3)
    arrow(axes, (4.9, 2.2), (4.9, 1.66))
    arrow(axes, (2.38, second), (3.32, second))
    note(axes, 2.76, second + 0.13, "where", fontsize=8.4)
    note(axes, 5.02, 2.04, "sum sharpened; some keypoints teacher-forced in training", fontsize=8.4, ha="left")
    arrow(axes, (1.3, 2.5), (1.3, 1.66))
    note(axes, 1.4, 2.08, "prior of the\nupdated attitude", fontsize=8.4, ha="left", color=GREEN)
    arrow(axes, (5.88, second), (6.32, second))
    arrow(axes, (1.3, 0.83), (3.1, 0.35))
    arrow(axes, (7.1, 0.83), (6.1, 0.42))
    return figure


DRAWINGS: dict[str, Callable[[], Figure]] = {
    "frames": frames,
    "camera": camera,
    "pixels": pixels,
    "crop": crop,
    "heatmap": heatmap,
    "rotation": rotation,
    "covariance": covariance,
    "errors": errors,
    "pipeline": pipeline,
    "architecture": architecture,
}


def draw(folder: Path, suffix: str = "svg") -> list[Path]:
    """Every drawing as FOLDER/<name>.<suffix>; the same bytes come out every time."""
    plt.rcParams.update(
        {
            "svg.hashsalt": "gknet",
            "svg.fonttype": "path",
            "font.family": "DejaVu Sans",
            "mathtext.fontset": "dejavusans",
        }
    )
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, make in DRAWINGS.items():
        path = folder / f"{name}.{suffix}"
        figure = make()
        figure.savefig(path, dpi=110, metadata={"Date": None} if suffix == "svg" else None, facecolor="white")
        plt.close(figure)
        paths.append(path)
    return paths


if __name__ == "__main__":
    for path in draw(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "images"):
        print(path)
