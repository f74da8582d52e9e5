"""The worst, some random and the best frames of a run, as small images for the page."""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.evaluation.evaluate import Case, ProtocolRun
from gknet.frame import Frame
from gknet.inference.crop import Crop
from gknet.report.overlay import draw_overlay, zoomed
from gknet.spacecraft import Spacecraft

_SIZE_PX = 560
_ZOOM_MARGIN = 1.7
_QUALITY = 82
_WEIGHT = 1.6


@dataclass(frozen=True)
class GalleryPicture:
    """An image of a gallery.

    Attributes:
        data_uri: A JPEG.
        title: The frame's name.
        caption: Its conditions and errors.
    """

    data_uri: str
    title: str
    caption: str


@dataclass(frozen=True)
class Gallery:
    """Images under a title."""

    title: str
    pictures: tuple[GalleryPicture, ...]


def galleries(run: ProtocolRun, dataset: SkdDataset, spacecraft: Spacecraft, count: int = 6) -> tuple[Gallery, ...]:
    """Worst, random and best frames by the SPEED score; a frame appears in one gallery only.

    Args:
        run: The errors.
        dataset: Where the frames are read from.
        spacecraft: That is drawn.
        count: Images in each gallery.

    Raises:
        GknetError: A frame cannot be read any more.
    """
    order = sorted(run.cases, key=lambda case: (-case.errors.speed_score, case.index))
    worst = order[:count]
    best = order[count:][::-1][:count]
    middle = order[count : len(order) - len(best)]
    picked = np.random.default_rng(0).permutation(len(middle))[:count]
    random = sorted((middle[k] for k in picked), key=lambda case: case.index)
    chosen = (("Worst", worst), ("Random", random), ("Best", best))
    return tuple(
        Gallery(title, tuple(_picture(case, dataset, spacecraft) for case in cases)) for title, cases in chosen if cases
    )


def data_uri(image: UInt8[ndarray, "h w 3"], quality: int = _QUALITY) -> str:
    """An RGB image (h, w, 3) as an inline JPEG; `quality` is 1 to 100."""
    done, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise GknetError("gallery: an image could not be encoded")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def _picture(case: Case, dataset: SkdDataset, spacecraft: Spacecraft) -> GalleryPicture:
    frame = dataset.frame(case.index)
    image = _overlay(frame, case, spacecraft)
    found = case.errors
    words = [f"range {found.range_m:.1f} m"]
    if found.phase_angle_rad is not None:
        words.append(f"phase {math.degrees(found.phase_angle_rad):.0f}°")
    if found.visible_fraction is not None:
        words.append(f"{100 * found.visible_fraction:.0f} % of keypoints visible")
    if found.failure is not None:
        words.append(f"no pose: {found.failure}")
    else:
        words.append(f"E_t {found.e_t:.4f}, E_q {found.e_q_rad:.4f} rad ({math.degrees(found.e_q_rad):.1f}°)")
    if found.rmse_px is not None:
        words.append(f"RMSE {found.rmse_px:.1f} px")
    return GalleryPicture(data_uri(image), case.frame_name, ", ".join(words))


def _overlay(frame: Frame, case: Case, spacecraft: Spacecraft) -> UInt8[ndarray, "h w 3"]:
    """Near the spacecraft: what matters fills the image, whatever its range."""
    box = frame.true_box(spacecraft.points_m)
    if box is None or frame.camera.distorted:
        image = draw_overlay(frame, spacecraft, case.estimate, lines=(), legend=False, weight=_WEIGHT)
        side = max(image.shape[:2])
        size = round(image.shape[1] * _SIZE_PX / side), round(image.shape[0] * _SIZE_PX / side)
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    crop = Crop.around(box, 2 * _SIZE_PX, _ZOOM_MARGIN)
    near, estimate = zoomed(frame, case.estimate, crop)
    image = draw_overlay(near, spacecraft, estimate, lines=(), legend=False, weight=_WEIGHT)
    return cv2.resize(image, (_SIZE_PX, _SIZE_PX), interpolation=cv2.INTER_AREA)
