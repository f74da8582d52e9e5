"""A grid of rendered frames with their labels drawn in, for a check by eye before anything is trained on them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.frame import Frame
from gknet.inference.crop import Crop
from gknet.io.image import write_image
from gknet.spacecraft import Spacecraft

TILE_PX = 256
COLUMNS = 8
TILES = 40
VISIBLE, HIDDEN, EDGE = (80, 255, 80), (255, 90, 60), (90, 160, 255)
SUBPIXEL_BITS = 4


def write_contact_sheet(root: str | Path, tiles: int = TILES) -> Path | None:
    """Write contact_sheet.jpg: frames spread over the spacecraft and sequences of a rendered folder.

    Visible keypoints are green dots, hidden ones red rings.

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
    write_image(path, np.concatenate(rows), quality=90)
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
    picture = window.cut(frame.image)
    pixels = window.to_input(frame.keypoints_px(spacecraft.points_m))
    ends = [_fixed(point) for point in pixels]
    for i, j in spacecraft.edges:
        start, stop = ends[i], ends[j]
        if start and stop:
            cv2.line(picture, start, stop, EDGE, 1, cv2.LINE_AA, SUBPIXEL_BITS)
    for k, end in enumerate(ends):
        is_visible = frame.visible is None or frame.visible[k]
        if end:
            radius = round(2.2 * 2**SUBPIXEL_BITS)
            colour, width = (VISIBLE, cv2.FILLED) if is_visible else (HIDDEN, 1)
            cv2.circle(picture, end, radius, colour, width, cv2.LINE_AA, SUBPIXEL_BITS)
    label = f"{frame.name}  {frame.range_m:.1f} m"
    cv2.putText(picture, label, (4, TILE_PX - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (255, 255, 0), 1, cv2.LINE_AA)
    return picture


def _fixed(point: ndarray) -> tuple[int, int] | None:
    """OpenCV's fixed-point pixels, whose centres are at whole numbers; None for a point too far out to draw."""
    if not (np.isfinite(point).all() and np.abs(point).max() < 8 * TILE_PX):
        return None
    x, y = np.round((point - 0.5) * 2**SUBPIXEL_BITS).astype(int)
    return int(x), int(y)
