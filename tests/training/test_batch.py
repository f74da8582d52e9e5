"""Keypoint k stays row k through every augmentation; sample i never depends on the order."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

import torch

from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.training.batch import Draw, Loader, Sample, draw_box, draw_keypoints
from gknet.training.cache import Cache, Window, build_cache
from gknet.training.schedule import Stage
from tests.training.toy import CRAFT, Frames, a_frame, toy_spacecraft, write_toy


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("toy")
    write_toy(root, 12, 3, 96)
    return root


def test_a_sample_moves_every_point_as_one_and_never_renumbers(tmp_path: Path) -> None:
    """One turn, scale and shift takes the points of the cache to those of the sample, row by row, to a thousandth."""
    cache = build_cache(Frames([a_frame((3.0, 0.5, 12.0), 256), a_frame(size=256)]), CRAFT, tmp_path / "cache", 96)
    masked = 0
    for seed in range(20):
        row = seed % 2
        sample = draw_keypoints(np.random.default_rng(seed), cache, row, 64)
        seen = sample.weight > 0
        assert seen.sum() > 4
        assert not seen[~cache.in_view[row]].any()
        before, after = (points[seen] @ (1, 1j) for points in (cache.points_px[row], sample.points_px))
        similarity = np.stack([before, np.ones(len(before))], axis=1)
        fitted = similarity @ np.linalg.lstsq(similarity, after, rcond=None)[0]
        assert np.abs(fitted - after).max() < 1e-3
        masked += (~seen).sum()
    assert masked > 20


def loader(folder: Path, draw: Draw = draw_keypoints, **options: int) -> Loader:
    data = SkdDataset(folder, "train", "satellite_01")
    window: Window = "image" if draw is draw_box else "craft"
    return Loader(build_cache(data, data.spacecraft, folder / f"cache_{window}", 96, window), draw, 7, **options)


def test_an_epoch_shows_every_row_once(folder: Path) -> None:
    """Twelve rows in batches of five: the last, partial batch of an epoch goes on into the next epoch."""
    shown: list[int] = []

    def draw(rng: np.random.Generator, cache: Cache, row: int, size: int) -> Sample:
        shown.append(row)
        return draw_keypoints(rng, cache, row, size)

    items = loader(folder, draw)
    for position in range(0, 60, 5):
        items.batch(position, Stage(1, 64, 5))
    epochs = [shown[start : start + 12] for start in range(0, 60, 12)]
    assert all(sorted(rows) == list(range(12)) for rows in epochs)
    assert epochs[0] != epochs[1]
    shown.clear()
    for position in range(0, 10, 5):
        replace(items, seed=items.seed + 1).batch(position, Stage(1, 64, 5))
    assert shown != epochs[0][:10]  # another seed, another order


def test_a_batch_is_its_samples_in_order(folder: Path) -> None:
    for draw in (draw_keypoints, draw_box):
        items = loader(folder, draw)
        batch = items.batch(3, Stage(1, 64, 4))
        for k in range(4):
            sample = items.sample(3 + k, 64)
            np.testing.assert_array_equal(batch.image[k], sample.image)
            np.testing.assert_array_equal(batch.points_px[k], sample.points_px)
            np.testing.assert_array_equal(batch.weight[k], sample.weight)


def test_a_batch_depends_on_its_position_only(folder: Path) -> None:
    items = loader(folder)
    stage = Stage(1, 64, 5)
    stream = items.batches(0, lambda place: stage)
    streamed = [next(stream) for _ in range(4)]
    stream.close()
    resumed = items.batches(10, lambda place: stage)
    third = next(resumed)
    resumed.close()
    assert [batch.position for batch in streamed] == [5, 10, 15, 20]
    assert torch.equal(streamed[2].image, third.image)
    assert torch.equal(streamed[2].points_px, third.points_px)


def test_processes_share_the_samples_of_one(folder: Path) -> None:
    whole = loader(folder).batch(0, Stage(1, 64, 4))
    parts = [loader(folder, rank=rank, world=2).batch(0, Stage(1, 64, 2)) for rank in range(2)]
    assert {part.position for part in parts} == {whole.position}
    together = torch.stack([part.points_px for part in parts], dim=1).flatten(0, 1)
    assert torch.equal(together, whole.points_px)


def test_an_error_in_the_thread_reaches_the_loop(folder: Path) -> None:
    def broken(*_: object) -> Sample:
        raise GknetError("no such sample")

    stream = loader(folder, broken).batches(0, lambda place: Stage(1, 64, 2))
    with pytest.raises(GknetError, match="no such sample"):
        next(stream)


def test_the_network_sees_what_the_points_say(folder: Path) -> None:
    """At the points of a bright mast's end there is light; weights are 1 for what is in view."""
    batch = loader(folder).batch(0, Stage(1, 128, 8))
    image = batch.network_input(torch.device("cpu"))
    assert image.shape == (8, 3, 128, 128)
    assert image.is_contiguous(memory_format=torch.channels_last)
    assert 0 <= image.min() < image.max() <= 1
    assert batch.points_px.shape == (8, len(toy_spacecraft().points_m), 2)
    seen = batch.weight > 0
    assert seen.float().mean() > 0.8
    assert (batch.points_px[seen] >= 0).all()
    assert (batch.points_px[seen] <= 128).all()


def test_a_box_lies_about_the_craft_of_its_own_picture(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gknet.training.batch.photometric", lambda rng, image, ranges: image)
    batch = loader(folder, draw_box).batch(0, Stage(1, 96, 12))
    for image, corners in zip(batch.image.numpy(), batch.points_px.numpy(), strict=True):
        rows, columns = np.nonzero(image.max(axis=2) > 25)
        lit = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
        np.testing.assert_allclose(corners.ravel(), lit, atol=5)


def test_boxes_are_corners_in_order_inside_the_input(folder: Path) -> None:
    batch = loader(folder, draw_box).batch(0, Stage(1, 64, 12))
    low, high = batch.points_px[:, 0], batch.points_px[:, 1]
    assert (batch.weight == 1).all()
    assert ((low >= 0) & (high <= 64) & (high > low)).all()


def test_some_of_the_points_in_view_of_some_samples_are_prompted() -> None:
    """In half of the samples, up to .6 of the points in view, 15 % of all; one out of view never."""
    count, points = 400, 10
    generator = np.random.default_rng(1)
    cache = Cache(
        np.zeros((1, 64, 64, 3), np.uint8),
        generator.uniform(20, 40, (1, points, 2)).astype(np.float32),
        np.arange(points)[None] != 3,
        np.array([[20, 20, 40, 40]], np.float32),
        np.full((1, 7), np.nan, np.float32),
    )
    samples = [draw_keypoints(np.random.default_rng(i), cache, 0, 64) for i in range(count)]
    prompted = np.stack([sample.prompted for sample in samples])
    assert not prompted[np.stack([sample.weight for sample in samples]) == 0].any()
    assert not prompted[:, 3].any()
    assert 0.35 < prompted.any(axis=1).mean() < 0.55
    assert 0.12 < prompted[:, :3].mean() < 0.18
    assert prompted.sum(axis=1).max() <= 9
