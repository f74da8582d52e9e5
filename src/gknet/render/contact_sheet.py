"""A grid of rendered frames with their labels drawn in, for a check by eye before anything is trained on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.frame import Frame
from gknet.inference.crop import Crop
from gknet.io.image import write_image
from gknet.report.canvas import Canvas
from gknet.report.legend import Entry, legend_strip
from gknet.report.palette import WHITE
from gknet.spacecraft import Spacecraft

TILE_PX = 320
COLUMNS = 6
TILES = 36
TEXT_PX = 15.0
MARK_PX = 3.0
VISIBLE, HIDDEN, EDGE = (80, 255, 80), (255, 90, 60), (90, 160, 255)


def write_contact_sheet(root: str | Path, tiles: int = TILES) -> Path | None:
    """Write contact_sheet.jpg: frames spread over the spacecraft and sequences of a rendered folder.

    Each tile shows the true skeleton in blue, visible keypoints as green discs, hidden ones and those out of view as
    red rings, and states its frame, spacecraft and range. A strip below explains the marks.

    Args:
        root: The dataset's folder.
        tiles: The largest number of frames.

    Returns:
        The sheet's path, None when there is no frame to show.
    """
    root = Path(root)
    pictures = [_tile(frame, craft) for frame, craft in _chosen(root, tiles)]
    if not pictures:
        return None
    columns = min(COLUMNS, len(pictures))
    pictures += [np.zeros_like(pictures[0])] * (-len(pictures) % columns)
    rows = [np.concatenate(pictures[i : i + columns], axis=1) for i in range(0, len(pictures), columns)]
    path = root / "contact_sheet.jpg"
    write_image(path, np.concatenate([*rows, _legend(rows[0].shape[1])]), quality=90)
    return path


def _chosen(root: Path, tiles: int) -> list[tuple[Frame, Spacecraft]]:
    everything = SkdDataset(root)
    views = [SkdDataset(root, spacecraft=category) for category in everything.categories]
    chosen = []
    for view in views:
        count = min(len(view), max(1, tiles // len(views)))
        for i in np.linspace(0, len(view) - 1, count).round().astype(int):
            try:
                chosen.append((view.frame(int(i)), view.spacecraft))
            except GknetError:  # a damaged file is for its reader to report; the sheet shows the others
                continue
    return chosen


def _tile(frame: Frame, spacecraft: Spacecraft) -> UInt8[ndarray, "t t 3"]:
    if frame.image is None:
        raise GknetError(f"frame {frame.name}: it was read without its image")
    window = Crop(0, 0, max(frame.camera.width, frame.camera.height), TILE_PX)
    canvas = Canvas(np.ascontiguousarray(window.cut(frame.image)), weight=1024 / TILE_PX)  # a unit is a pixel
    pixels = window.to_input(frame.keypoints_px(spacecraft.points_m))
    for i, j in spacecraft.edges:
        canvas.line(pixels[i], pixels[j], EDGE, 1, outlined=False)
    for k, pixel in enumerate(pixels):
        if frame.visible is None or frame.visible[k]:
            canvas.disc(pixel, VISIBLE, MARK_PX)
        else:
            canvas.ring(pixel, HIDDEN, MARK_PX, 1)
    lines = [frame.name, f"{spacecraft.name}, {frame.range_m:.1f} m"]
    width = max(canvas.text_width(line, TEXT_PX) for line in lines)
    canvas.shade(0, TILE_PX - 2.6 * TEXT_PX, width + TEXT_PX, TILE_PX)
    for row, line in enumerate(lines):
        canvas.text(line, np.array([0.5 * TEXT_PX, TILE_PX - (1.55 - 1.15 * row) * TEXT_PX]), WHITE, TEXT_PX)
    return canvas.image


def _legend(width_px: int) -> UInt8[ndarray, "h w 3"]:
    """What the marks of the tiles mean."""
    return legend_strip(
        width_px,
        (
            Entry("true skeleton", lambda canvas, left, right: canvas.line(left, right, EDGE)),
            Entry("visible keypoint", lambda canvas, left, right: canvas.disc((left + right) / 2, VISIBLE), 12),
            Entry("hidden or out of view", lambda canvas, left, right: canvas.ring((left + right) / 2, HIDDEN), 12),
            Entry("text: sequence/frame, spacecraft, range", lambda canvas, left, right: None, 0),
        ),
        weight=1.1 * 1024 / width_px,
    )
