"""Image files: exact or close round trips, and damaged files refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.io.image import is_whole_jpeg, read_image, read_mask, write_image, write_mask


@pytest.fixture
def rgb() -> np.ndarray:
    y, x = np.mgrid[:40, :60]
    return np.stack([4 * x, 6 * y, 255 - 4 * x], axis=-1).astype(np.uint8)


def test_png_round_trip_is_exact_and_rgb(tmp_path: Path, rgb: np.ndarray) -> None:
    write_image(tmp_path / "a.png", rgb)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), rgb)


def test_jpeg_round_trip_is_close_and_quality_counts(tmp_path: Path, rgb: np.ndarray) -> None:
    write_image(tmp_path / "a.jpg", rgb, quality=95)
    write_image(tmp_path / "b.jpg", rgb, quality=20)
    back = read_image(tmp_path / "a.jpg")
    assert np.abs(back.astype(int) - rgb).mean() < 3
    assert (tmp_path / "b.jpg").stat().st_size < (tmp_path / "a.jpg").stat().st_size
    assert is_whole_jpeg(tmp_path / "a.jpg")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.jpg", "b.jpg"]


def test_grey_pictures_become_rgb(tmp_path: Path, rgb: np.ndarray) -> None:
    write_mask(tmp_path / "m.png", rgb[..., 0] > 100)
    np.testing.assert_array_equal(read_mask(tmp_path / "m.png"), rgb[..., 0] > 100)
    assert read_image(tmp_path / "m.png").shape == (40, 60, 3)


@pytest.mark.parametrize("name", ["a.jpg", "a.png"])
@pytest.mark.parametrize("kept", [0.3, 0.9, 0.99])
def test_truncation_is_found(tmp_path: Path, rgb: np.ndarray, name: str, kept: float) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    write_image(tmp_path / name, noise)
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: int(kept * len(data))])
    with pytest.raises(GknetError, match=f"{name}.*truncated"):
        read_image(tmp_path / name)
    assert not is_whole_jpeg(tmp_path / name)


def test_missing_empty_and_foreign_files(tmp_path: Path, rgb: np.ndarray) -> None:
    (tmp_path / "empty.jpg").touch()
    (tmp_path / "text.jpg").write_text("no picture")
    for name in ("missing.jpg", "empty.jpg", "text.jpg", "."):
        with pytest.raises(GknetError, match=str(tmp_path)):
            read_image(tmp_path / name)
    with pytest.raises(GknetError, match="uint8 RGB"):
        write_image(tmp_path / "x.png", rgb[..., 0])
    with pytest.raises(GknetError, match="encode"):
        write_image(tmp_path / "x.nonsense", rgb)
