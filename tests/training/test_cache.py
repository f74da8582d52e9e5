"""The cache keeps the frames' labels, notices every change of them, and survives damage and kills."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("lightning_fabric")


from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.geometry import Pose
from gknet.inference.crop import Crop
from gknet.training.cache import HEADER, IMAGES, LABELS, Cache, build_cache, cached_row, craft_window
from gknet.training.settings import TrainSettings
from gknet.training.setup import open_cache
from tests.training.toy import CRAFT, POINTS, Frames, a_frame, box_of, write_toy


def test_a_cached_row_is_the_frame_through_a_crop() -> None:
    frame = a_frame((0.3, -0.2, 30.0))
    row, box = cached_row(frame, CRAFT, "craft", 160), box_of(frame)
    assert row is not None
    crop = craft_window(frame, box, 160)
    assert crop == Crop.around(box, 160, 1.6)
    np.testing.assert_allclose(crop.to_image(row.points_px), frame.keypoints_px(POINTS))
    assert row.in_view.all()
    np.testing.assert_allclose(
        row.box_px[2:] - row.box_px[:2], (np.array([box.x1 - box.x0, box.y1 - box.y0])) * crop.scale
    )


def test_a_window_around_the_craft_is_taken_whole() -> None:
    frame = a_frame((0, 0, 8), 200)
    assert craft_window(frame, box_of(frame), 160) == Crop(0, 0, 200, 160)


def test_truncation_masks_and_never_renumbers() -> None:
    frame = a_frame((3.0, 0.5, 12.0))
    row = cached_row(frame, CRAFT, "craft", 160)
    assert row is not None
    truth = frame.keypoints_px(POINTS)
    inside = frame.camera.contains(truth)
    assert 4 <= inside.sum() < len(POINTS)
    np.testing.assert_array_equal(row.in_view, inside)
    np.testing.assert_allclose(row.points_px, craft_window(frame, box_of(frame), 160).to_input(truth))


def test_frames_without_the_craft_are_no_rows() -> None:
    assert cached_row(a_frame((40.0, 0.0, 12.0)), CRAFT, "craft", 64) is None
    behind = replace(a_frame(), cam_from_body=Pose(np.eye(3), np.array([0, 0, -20.0])))
    assert cached_row(behind, CRAFT, "craft", 64) is None


def test_the_cache_is_built_once_skips_bad_frames_and_notices_changes(tmp_path: Path) -> None:
    frames = Frames([a_frame((0.2 * k, 0, 12), 128) for k in range(5)], bad=1)
    reports: list[str] = []
    place = tmp_path / "cache"
    cache = build_cache(frames, CRAFT, place, 64, report=reports.append)
    assert len(cache) == 4
    assert reports == ["left out: frame 1: truncated"]
    again = build_cache(frames, CRAFT, place, 64)
    assert frames.reads == 5
    np.testing.assert_array_equal(again.images, cache.images)
    frames.frames[0] = a_frame((0.0, 0.1, 12), 128)
    assert not np.array_equal(build_cache(frames, CRAFT, place, 64).points_px[0], cache.points_px[0])
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["cache"]  # the stale one is gone


def test_the_cache_keeps_every_point_in_its_row_and_below_the_pixel(tmp_path: Path) -> None:
    frames = [a_frame((3.0 - k, 0.5, 12.0), 256) for k in range(3)]
    cache = build_cache(Frames(frames), CRAFT, tmp_path / "cache", 96)
    for row, frame in enumerate(frames):
        truth = frame.keypoints_px(POINTS)
        expected = craft_window(frame, box_of(frame), 96).to_input(truth)
        np.testing.assert_allclose(cache.points_px[row], expected, atol=1e-3)
        np.testing.assert_array_equal(cache.in_view[row], frame.camera.contains(truth))
    assert not cache.in_view.all()


def test_nothing_to_train_on_is_an_error(tmp_path: Path) -> None:
    for frames in ([], [a_frame((40.0, 0.0, 12.0), 64)]):
        with pytest.raises(GknetError, match="cache"):
            build_cache(Frames(frames), CRAFT, tmp_path / "cache", 64)
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_toy(tmp_path / "set", 6, 1, 64)
    return tmp_path / "set"


def opened(folder: Path, size: int = 64) -> Cache:
    settings = TrainSettings(epochs=1, network="gknet-xs", cache_size=size)
    return open_cache(SkdDataset(folder, "train", "satellite_01"), settings, folder / "cache")


def caches(folder: Path) -> list[Path]:
    return [path for path in (folder / "cache").iterdir() if path.is_dir()]


def bright(image: Path) -> None:
    """Another image of the same size, and of the same number of bytes."""
    before = image.stat().st_size
    import cv2

    cv2.imwrite(str(image), np.full((64, 64, 3), 255, np.uint8))
    content = image.read_bytes()
    image.write_bytes(content + bytes(before - len(content)))


def touched(image: Path) -> None:
    os.utime(image, ns=(1, 1))


@pytest.mark.parametrize("change", [bright, touched])
@pytest.mark.parametrize("row", range(6))
def test_a_change_of_any_one_picture_rebuilds_it_in_its_place(
    change: Callable[[Path], None], row: int, folder: Path
) -> None:
    before = np.array(opened(folder).images)
    [place] = caches(folder)
    change(sorted((folder / "data/000001/image").iterdir())[row])
    after = opened(folder)
    differs = [i for i in range(6) if not np.array_equal(before[i], after.images[i])]
    assert differs == ([row] if change is bright else [])
    assert caches(folder) == [place]


def test_an_unchanged_dataset_is_not_read_again_even_where_nothing_can_be_written(folder: Path) -> None:
    opened(folder)
    shutil.move(folder, folder.with_name("moved"))
    moved = folder.with_name("moved")
    [place] = caches(moved)
    before = (place / HEADER).stat().st_mtime_ns
    opened(moved)
    assert (place / HEADER).stat().st_mtime_ns == before
    opened(moved, size=96)
    assert len(caches(moved)) == 2  # one for each size


@pytest.mark.parametrize("name", [HEADER, IMAGES, LABELS])
@pytest.mark.parametrize("damage", ["gone", "empty", "cut", "flipped", "nested"])
def test_a_damaged_cache_is_built_anew(name: str, damage: str, folder: Path) -> None:
    before = opened(folder)
    images, points = np.array(before.images), before.points_px
    path = caches(folder)[0] / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    if damage == "gone":
        path.unlink()
    else:
        new = {"empty": b"", "cut": bytes(content[:-1]), "flipped": bytes(content), "nested": b"[" * 100_000}[damage]
        path.write_bytes(new)
    after = opened(folder)
    np.testing.assert_array_equal(after.points_px, points)
    if not (name == IMAGES and damage == "flipped"):  # another pixel is still an image
        np.testing.assert_array_equal(after.images, images)


@pytest.mark.parametrize("count", [-1, 0, 7, 10**30, 1.5, "six", None])
def test_a_header_of_another_count_is_no_cache(count: object, folder: Path) -> None:
    opened(folder)
    path = caches(folder)[0] / HEADER
    path.write_text(json.dumps({**json.loads(path.read_text()), "count": count}))
    assert len(opened(folder)) == 6


def test_a_killed_build_stands_in_nobodys_way(folder: Path) -> None:
    """And leaves nothing once the cache is built."""
    script = f"""
import os
import gknet.training.cache as cache
from tests.training.test_cache import opened
from pathlib import Path
cache._labels = lambda rows: os.kill(os.getpid(), 9)
opened(Path({str(folder)!r}))
"""
    run = subprocess.run([sys.executable, "-c", script], cwd=Path(__file__).parents[2], check=False)
    assert run.returncode == -9
    [left] = caches(folder)
    assert left.name.endswith(".tmp")
    assert len(opened(folder)) == 6
    assert not left.exists()
    assert len(caches(folder)) == 1
