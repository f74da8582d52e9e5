"""An estimate drawn over its image: skeleton, body axes, box, keypoints coloured by score, and words."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Box, Estimate, Frame, Keypoints
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.report.canvas import Canvas, enlarged
from gknet.report.legend import Entry, Icon, draw_legend
from gknet.report.palette import BLUE, GREEN, PINK, RGB, SKY, VERMILLION, WHITE, score_colour
from gknet.spacecraft import Spacecraft

_AXES: tuple[tuple[str, RGB], ...] = (("X", VERMILLION), ("Y", GREEN), ("Z", BLUE))
_AXIS_LENGTH = 0.28
"""Of the spacecraft's diameter."""

_NAME_CHARACTERS = 60
_MOST_DECIMALS = 4
Mark = Callable[[Canvas, Float[ndarray, "2"], RGB], None]
"""Draws a keypoint."""

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
        frame: The image with its camera.
        spacecraft: Whose skeleton is drawn.
        estimate: Of the pose.
        lines: The text of the panel; None writes `describe(frame, estimate)`.
        truth: Draw the true skeleton too, where the frame has a pose.
        legend: Explain the marks along the lower edge.
        weight: Of lines, marks and text; more than 1 for an image that is shown small.

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
        draw_legend(canvas, _legend_entries(frame, estimate, truth and frame.cam_from_body is not None))
    return image


def describe(frame: Frame, estimate: Estimate) -> list[str]:
    """Name, range with its standard deviation, inliers, attitude confidence; or why there is no pose."""
    if estimate.cam_from_body is None:
        return [_short(frame.name), f"no pose: {estimate.failure}"]
    position = estimate.cam_from_body.translation_m
    lines = [_short(frame.name), _range_words(position, estimate.covariance)]
    score = mean_score(estimate)
    if score is not None and estimate.inliers is not None:
        lines.append(
            f"{int(estimate.inliers.sum())} of {len(estimate.inliers)} inliers, mean keypoint score {score:.2f}"
        )
    if estimate.attitude_confidence is not None:
        ambiguous = ", ambiguous" if estimate.is_ambiguous else ""
        lines.append(f"attitude confidence {estimate.attitude_confidence:.2f}{ambiguous}")
    if estimate.reprojection_rms_px is not None:
        lines.append(f"reprojection {estimate.reprojection_rms_px:.2f} px rms")
    return lines


def _range_words(position_m: Float[ndarray, "3"], covariance: Float[ndarray, "6 6"] | None) -> str:
    """The range with its standard deviation: two significant digits of the latter, as many decimals of both."""
    range_m = float(np.linalg.norm(position_m))
    if covariance is None:
        return f"range {range_m:.2f} m"
    towards = position_m / range_m
    sigma = float(np.sqrt(max(0.0, towards @ covariance[3:, 3:] @ towards)))
    decimals = int(np.clip(1 - np.floor(np.log10(max(sigma, 1e-9))), 0, _MOST_DECIMALS))
    return f"range {range_m:.{decimals}f} ± {sigma:.{decimals}f} m"


def _short(name: str) -> str:
    """The end of a long name, which differs more between images than its start."""
    return name if len(name) <= _NAME_CHARACTERS else f"...{name[-_NAME_CHARACTERS + 3 :]}"


def mean_score(estimate: Estimate) -> float | None:
    """Mean score of the inliers, 0 to 1; None without a pose."""
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


def _draw_keypoints(
    canvas: Canvas, keypoints: Keypoints, visible: Bool[ndarray, " n"] | None, inliers: Bool[ndarray, " n"] | None
) -> None:
    """A disc where visible, a ring where hidden, a square where that is not known; a cross for an outlier."""
    for k in np.argsort(keypoints.score):
        if keypoints.score[k] < _LEAST_SCORE:
            continue
        colour = score_colour(float(keypoints.score[k]))
        if inliers is not None and not inliers[k]:
            canvas.cross(keypoints.pixels[k], colour)
        elif visible is None:
            canvas.square(keypoints.pixels[k], colour)
        elif visible[k]:
            canvas.disc(keypoints.pixels[k], colour)
        else:
            canvas.ring(keypoints.pixels[k], colour)


def _draw_box(canvas: Canvas, box: Box, part: float = 0.14) -> None:
    """The four corners only, which hide nothing; `part` of the shorter side long."""
    reach = part * min(box.x1 - box.x0, box.y1 - box.y0)
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


def _legend_entries(frame: Frame, estimate: Estimate, with_truth: bool) -> list[Entry]:
    """The marks that this overlay may have."""
    entries = []
    if estimate.cam_from_body is not None:
        entries.append(Entry("estimate", lambda canvas, left, right: canvas.line(left, right, SKY)))
        entries.append(Entry("body axes", _axes_icon, 48))
    if with_truth:
        entries.append(Entry("truth", lambda canvas, left, right: canvas.dashes(left, right, WHITE)))
    if estimate.box is not None:
        entries.append(Entry("box", _box_icon))
    if estimate.keypoints is not None:
        known = [("visible", Canvas.disc), ("hidden", Canvas.ring)]
        marks = [("visibility unknown", Canvas.square)] if frame.visible is None else known
        marks += [("outlier", Canvas.cross)] if estimate.inliers is not None else []
        entries += [Entry(text, _mark_icon(mark), 12) for text, mark in marks]
        entries.append(Entry("keypoint score, 0 to 1", _score_icon, 60))
    return entries


def _mark_icon(mark: Mark) -> Icon:
    return lambda canvas, left, right: mark(canvas, (left + right) / 2, score_colour(0.66))


def _axes_icon(canvas: Canvas, left: Float[ndarray, "2"], right: Float[ndarray, "2"]) -> None:
    for k, (name, colour) in enumerate(_AXES):
        canvas.label(name, left + (right - left) * (k + 0.5) / len(_AXES), colour, 16)


def _box_icon(canvas: Canvas, left: Float[ndarray, "2"], right: Float[ndarray, "2"]) -> None:
    middle, reach = (left + right) / 2, 0.25 * (right[0] - left[0])
    _draw_box(canvas, Box(middle[0] - 1.6 * reach, middle[1] - reach, middle[0] + 1.6 * reach, middle[1] + reach), 0.3)


def _score_icon(canvas: Canvas, left: Float[ndarray, "2"], right: Float[ndarray, "2"]) -> None:
    (start, y), (end, _) = left * canvas.factor, right * canvas.factor
    for column in range(round(start), round(end)):
        colour = score_colour((column - start) / (end - start))
        canvas.image[round(y - 5 * canvas.unit) : round(y + 5 * canvas.unit), column] = colour
