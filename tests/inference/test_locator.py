"""From a locator's maps to a box in the image."""

from __future__ import annotations

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.inference.locator import decode_locator, locate
from tests.inference.test_decode import STRIDE, gaussians


def locator_output(box: tuple[float, float, float, float], peak: float = 1.0, size: int = 256) -> np.ndarray:
    """The maps of a perfect locator for a box in input pixels."""
    cells = size // 4
    x0, y0, x1, y1 = box
    centre = np.array([[(x0 + x1) / 8, (y0 + y1) / 8]])
    y, x = (np.mgrid[:cells, :cells] + 0.5) * 4
    sides = np.stack([x - x0, y - y0, x1 - x, y1 - y]) / size
    return np.concatenate([gaussians(centre, 1.5, cells) * peak, sides]).astype(np.float32)


@pytest.mark.parametrize("box", [(40.0, 60.0, 200.0, 100.0), (0.0, 0.0, 256.0, 256.0), (3.0, 5.0, 9.0, 12.0)])
def test_maps_and_back(box: tuple[float, float, float, float]) -> None:
    found = decode_locator(locator_output(box), STRIDE, 256)
    assert found is not None
    np.testing.assert_allclose((found[0].x0, found[0].y0, found[0].x1, found[0].y1), box, atol=1.0)
    assert found[1] > 0.5


def test_nothing_is_found_without_a_peak() -> None:
    assert decode_locator(locator_output((40, 60, 200, 100), peak=0.05), STRIDE, 256) is None
    assert decode_locator(np.full((5, 64, 64), np.nan, dtype=np.float32), STRIDE, 256) is None
    assert decode_locator(np.full((5, 64, 64), -1, dtype=np.float32), STRIDE, 256) is None
    with pytest.raises(GknetError, match=r"\(5, h, w\)"):
        decode_locator(np.zeros((4, 64, 64), dtype=np.float32), STRIDE, 256)


def test_the_network_gets_the_whole_image_in_the_middle_of_a_square() -> None:
    views = []

    def network(images: np.ndarray) -> np.ndarray:
        views.append(images[0])
        return np.zeros((1, 5, 64, 64), dtype=np.float32)

    assert locate(np.full((100, 200, 3), 255, dtype=np.uint8), network, 256, 0.1) is None
    lit = views[0][0] > 0.5
    assert lit[64:192].all()
    assert not lit[:64].any()
    assert not lit[192:].any()


def test_the_box_is_in_pixels_of_the_image_and_clipped_to_it() -> None:
    """The image of 200 x 100 fills the rows 64 to 192 of the input, at 1.28 input pixels each."""
    image = np.zeros((100, 200, 3), dtype=np.uint8)
    box = locate(image, lambda _: locator_output((64.0, 96.0, 128.0, 160.0))[None], 256, 0.1)
    assert box is not None
    np.testing.assert_allclose((box.x0, box.y0, box.x1, box.y1), (50, 25, 100, 75), atol=1.0)
    cut = locate(image, lambda _: locator_output((-30.0, 96.0, 128.0, 250.0))[None], 256, 0.1)
    assert cut is not None
    np.testing.assert_allclose((cut.x0, cut.y0, cut.x1, cut.y1), (0, 25, 100, 100), atol=1.0)
