"""An estimate drawn over its image: skeleton, body axes, box, keypoints coloured by score, and words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Frame, Keypoints
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.report.canvas import Canvas, enlarged
from gknet.report.palette import BLUE, GREEN, PINK, RGB, SKY, VERMILLION, WHITE, score_colour
from gknet.spacecraft import Spacecraft

_AXES: tuple[tuple[str, RGB], ...] = (("X", VERMILLION), ("Y", GREEN), ("Z", BLUE))
_AXIS_LENGTH = 0.28
"""Of the spacecraft's diameter."""

_NAME_CHARACTERS = 60
_LEAST_SCORE = 0.05
"""A keypoint below has no place of its own, and is not drawn."""


def draw_overlay(
    frame: Frame,
    spacecraft: Spacecraft,
    estimate: Estimate,
    lines: Sequence[str] | None = None,
    truth: bool = True,
    legend: bool = True,
    weight: float = 1.0,
) -> UInt8[ndarray, "h w 3"]:
    """Draw an estimate, and the truth where it is known, on a copy of the frame's image.

    Args:
        frame: The picture with its camera.
        spacecraft: Whose skeleton is drawn.
        estimate: Of the pose.
        lines: The text of the panel; None writes `describe(frame, estimate)`.
        truth: Draw the true skeleton too, where the frame has a pose.
        legend: Explain the marks along the lower edge.
        weight: Of lines, marks and text; more than 1 for a picture that is shown small.

    Returns:
        (h, w, 3) RGB; a small image is enlarged by a whole factor.

    Raises:
        GknetError: The frame has no image.
    """
    if frame.image is None:
        raise GknetError(f"frame {frame.name}: an overlay needs its image")
    image, factor = enlarged(frame.image)
    canvas = Canvas(image, factor, weight)
    if estimate.box is not None:
        _draw_box(canvas, estimate.box)
    if truth and frame.cam_from_body is not None:
        _draw_skeleton(canvas, frame.camera, frame.cam_from_body, spacecraft, dashed=True)
    if estimate.cam_from_body is not None:
        _draw_skeleton(canvas, frame.camera, estimate.cam_from_body, spacecraft, dashed=False)
    if estimate.keypoints is not None:
        _draw_keypoints(canvas, estimate.keypoints, frame.visible, estimate.inliers)
    if estimate.cam_from_body is not None:
        _draw_axes(canvas, frame.camera, estimate.cam_from_body, spacecraft.diameter_m)
    _draw_panel(canvas, describe(frame, estimate) if lines is None else lines, failed=estimate.failure is not None)
    if legend:
        _draw_legend(canvas, truth and frame.cam_from_body is not None)
    return image


def describe(frame: Frame, estimate: Estimate) -> list[str]:
    """Name, range with its standard deviation, confidence in keypoints and attitude; or why there is no pose."""
    if estimate.cam_from_body is None:
        return [_short(frame.name), f"no pose: {estimate.failure}"]
    position = estimate.cam_from_body.translation_m
    range_m = float(np.linalg.norm(position))
    words = f"range {range_m:.2f} m"
    if estimate.covariance is not None:
        towards = position / range_m
        sigma = float(np.sqrt(max(0.0, towards @ estimate.covariance[3:, 3:] @ towards)))
        words += f" ± {sigma:.2g} m" if sigma < 0.1 else f" ± {sigma:.1f} m"
    lines = [_short(frame.name), words]
    mean_score = confidence(estimate)
    if mean_score is not None and estimate.inliers is not None:
        lines.append(f"confidence {mean_score:.2f}, {int(estimate.inliers.sum())} of {len(estimate.inliers)} keypoints")
    if estimate.attitude_confidence is not None:
        ambiguous = ", ambiguous" if estimate.is_ambiguous else ""
        lines.append(f"attitude confidence {estimate.attitude_confidence:.2f}{ambiguous}")
    if estimate.reprojection_rms_px is not None:
        lines.append(f"reprojection {estimate.reprojection_rms_px:.2f} px rms")
    return lines


def _short(name: str) -> str:
    """The end of a long name, which differs more between pictures than its start."""
    return name if len(name) <= _NAME_CHARACTERS else f"...{name[-_NAME_CHARACTERS + 3 :]}"


def confidence(estimate: Estimate) -> float | None:
    """Mean score of the keypoints that the pose agrees with, 0 to 1; None without a pose."""
    if estimate.cam_from_body is None or estimate.keypoints is None:
        return None
    agreed = estimate.keypoints.score if estimate.inliers is None else estimate.keypoints.score[estimate.inliers]
    return float(np.mean(agreed)) if len(agreed) else 0.0


def zoomed(frame: Frame, estimate: Estimate, crop: Crop) -> tuple[Frame, Estimate]:
    """The frame and its estimate in the pixels of a crop.

    Args:
        frame: With an image, and a camera without distortion.
        estimate: In px of the frame's image.
        crop: Of the frame's image.

    Raises:
        GknetError: The frame has no image.
    """
    if frame.image is None:
        raise GknetError(f"frame {frame.name}: a zoom needs its image")
    camera = frame.camera.warped(crop.input_from_image, crop.size, crop.size)
    near = replace(frame, image=crop.cut(frame.image), camera=camera)
    keypoints, box = estimate.keypoints, estimate.box
    if keypoints is not None:
        pixels = crop.to_input(keypoints.pixels)
        keypoints = Keypoints(pixels, keypoints.score, keypoints.covariance_px2 * crop.scale**2)
    if box is not None:
        (x0, y0), (x1, y1) = crop.to_input(np.array([[box.x0, box.y0], [box.x1, box.y1]]))
        box = Box(float(x0), float(y0), float(x1), float(y1))
    return near, replace(estimate, keypoints=keypoints, box=box)


def _draw_skeleton(canvas: Canvas, camera: Camera, pose: Pose, spacecraft: Spacecraft, dashed: bool) -> None:
    pixels = camera.project(pose.transform(spacecraft.points_m))
    for i, j in spacecraft.edges:
        if dashed:
            canvas.dashes(pixels[i], pixels[j], WHITE)
        else:
            canvas.line(pixels[i], pixels[j], SKY)


def _draw_axes(canvas: Canvas, camera: Camera, pose: Pose, diameter_m: float) -> None:
    """Arrows along the body axes, the farthest first, so that nearer ones lie on top."""
    length = _AXIS_LENGTH * diameter_m
    tips = pose.transform(np.eye(3) * length)
    origin, *ends = camera.project(np.vstack([pose.translation_m, tips, pose.transform(np.eye(3) * length * 1.15)]))
    for k in np.argsort(-tips[:, 2]):
        name, colour = _AXES[k]
        canvas.arrow(origin, ends[k], colour)
        canvas.label(name, ends[3 + k], colour)


def _draw_keypoints(canvas: Canvas, keypoints: Keypoints, visible: ndarray | None, inliers: ndarray | None) -> None:
    """A disc where visible, a ring where the spacecraft hides it, a cross where the pose disagrees."""
    for k in np.argsort(keypoints.score):
        if keypoints.score[k] < _LEAST_SCORE:
            continue
        colour = score_colour(float(keypoints.score[k]))
        if inliers is not None and not inliers[k]:
            canvas.cross(keypoints.pixels[k], colour)
        elif visible is not None and not visible[k]:
            canvas.ring(keypoints.pixels[k], colour)
        else:
            canvas.disc(keypoints.pixels[k], colour)


def _draw_box(canvas: Canvas, box: Box) -> None:
    """The four corners only, which hide nothing."""
    reach = 0.14 * min(box.x1 - box.x0, box.y1 - box.y0)
    for x, towards_x in ((box.x0, reach), (box.x1, -reach)):
        for y, towards_y in ((box.y0, reach), (box.y1, -reach)):
            corner = np.array([x, y])
            canvas.line(corner, corner + (towards_x, 0), PINK, 1.6)
            canvas.line(corner, corner + (0, towards_y), PINK, 1.6)


def _draw_panel(canvas: Canvas, lines: Sequence[str], failed: bool) -> None:
    if not lines:
        return
    pad, step, size = 14 * canvas.unit, 27 * canvas.unit, 19.0
    width = max(canvas.text_width(line, size, 600) for line in lines)
    canvas.shade(0, 0, width + 2 * pad, step * len(lines) + 1.2 * pad)
    for row, line in enumerate(lines):
        colour = (255, 176, 130) if failed and row else WHITE
        weight = 600 if row == 0 else 400
        canvas.text(line, np.array([pad, pad * 0.4 + step * (row + 0.85)]), colour, size, weight)


def _draw_legend(canvas: Canvas, with_truth: bool) -> None:
    """Bottom left: the two line styles, the three marks, and the score's scale."""
    u, size = canvas.unit, 15.0
    x, y = 14 * u, canvas.image.shape[0] - 14 * u
    entries = ["estimate", *(["truth"] if with_truth else []), "visible", "hidden", "rejected"]
    total = sum(canvas.text_width(entry, size) + 50 * u for entry in entries) + 150 * u
    canvas.shade(0, y - 24 * u, x + total, canvas.image.shape[0])
    f = canvas.factor
    for entry in entries:
        middle = np.array([x + 12 * u, y - 5 * u]) / f
        left, right = middle - (12 * u / f, 0), middle + (12 * u / f, 0)
        if entry == "estimate":
            canvas.line(left, right, SKY)
        elif entry == "truth":
            canvas.dashes(left, right, WHITE)
        else:
            marks = {"visible": canvas.disc, "hidden": canvas.ring, "rejected": canvas.cross}
            marks[entry](middle, score_colour(0.66))
        canvas.text(entry, np.array([x + 32 * u, y]), WHITE, size, 400)
        x += canvas.text_width(entry, size) + 50 * u
    canvas.text("score 0", np.array([x, y]), WHITE, size, 400)
    x += canvas.text_width("score 0", size) + 8 * u
    for k in range(round(60 * u)):
        column = round(x + k)
        canvas.image[round(y - 11 * u) : round(y), column : column + 1] = score_colour(k / max(1, round(60 * u) - 1))
    canvas.text("1", np.array([x + 68 * u, y]), WHITE, size, 400)
