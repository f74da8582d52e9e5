"""The contact sheet: labels where the truth is, in colours that its legend explains."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gknet.dataset.skd import SkdDataset
from gknet.io.image import read_image
from gknet.render.contact_sheet import COLUMNS, HIDDEN, TILE_PX, VISIBLE, write_contact_sheet
from tests.cli.toy import write_toy_dataset


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_toy_dataset(tmp_path_factory.mktemp("sheet") / "set", sequences=2, frames=5)


def shows(image: np.ndarray, colour: tuple[int, int, int], pixel: np.ndarray) -> bool:
    """Whether the colour is found within 4 px, but for the loss of a JPEG."""
    x, y = np.round(pixel).astype(int)
    window = image[max(0, y - 4) : y + 4, max(0, x - 4) : x + 4].astype(int)
    return bool((np.abs(window - colour).max(axis=2) < 90).any())


def test_keypoints_are_marked_by_visibility(root: Path) -> None:
    path = write_contact_sheet(root, tiles=3)
    assert path is not None
    sheet, dataset = read_image(path), SkdDataset(root)
    assert sheet.shape[1] == 3 * TILE_PX
    for column, index in enumerate((0, 4, 9)):  # spread over the frames
        frame = dataset.frame(index)
        assert frame.visible is not None
        tile = sheet[:TILE_PX, column * TILE_PX : (column + 1) * TILE_PX]
        pixels = frame.keypoints_px(dataset.spacecraft.points_m) * TILE_PX / frame.camera.width
        inside = (pixels > 8).all(axis=1) & (pixels < TILE_PX - 50).all(axis=1)  # not below the words
        found = [shows(tile, VISIBLE if frame.visible[k] else HIDDEN, pixels[k]) for k in np.flatnonzero(inside)]
        assert inside.sum() > 8
        assert np.mean(found) > 0.8  # one mark may cover another


@pytest.mark.parametrize("tiles", [1, 9])
def test_a_legend_lies_below_the_tiles(root: Path, tiles: int) -> None:
    path = write_contact_sheet(root, tiles)
    assert path is not None
    sheet, rows = read_image(path), -(-tiles // COLUMNS)
    assert sheet.shape[1] == min(tiles, COLUMNS) * TILE_PX
    legend = sheet[rows * TILE_PX :].astype(int)
    assert legend.shape[0] > 20
    for colour in (VISIBLE, HIDDEN):
        assert (np.abs(legend - colour).max(axis=2) < 90).any()
