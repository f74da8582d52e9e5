"""The cache keeps the frames' labels; keypoint k stays row k; item i never depends on the order."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from gknet.dataset.skd import SkdDataset  # noqa: E402
from gknet.errors import GknetError  # noqa: E402
from gknet.frame import Box, Frame  # noqa: E402
from gknet.geometry import Camera, Pose  # noqa: E402
from gknet.inference.crop import Crop  # noqa: E402
from gknet.training.batch import Loader, Sample, draw_box, draw_keypoints  # noqa: E402
from gknet.training.cache import Cache, build_cache, cached_row, craft_window  # noqa: E402
from gknet.training.schedule import Stage  # noqa: E402
from tests.training.toy import POINTS, drawn, toy_spacecraft, write_toy  # noqa: E402

CRAFT = toy_spacecraft()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("toy")
    write_toy(root, 12, 3, 96)
    return root


def a_frame(place: tuple[float, float, float] = (0.3, -0.2, 12.0), size: int = 512) -> Frame:
    camera = Camera.from_focal(1.2 * size, size, size)
    pose = Pose.from_rotation_vector([0.5, 0.2, -0.7], place)
    return Frame("one", drawn(camera, pose), camera, pose)


def box_of(frame: Frame) -> Box:
    box = frame.true_box(POINTS)
    assert box is not None
    return box


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


class Frames:
    """A dataset in memory; frame `bad` cannot be read."""

    def __init__(self, frames: list[Frame], bad: int = -1) -> None:
        self.frames, self.bad, self.reads = frames, bad, 0

    def __len__(self) -> int:
        return len(self.frames)

    def frame(self, i: int, image: bool = True) -> Frame:
        if image:
            self.reads += 1
            if i == self.bad:
                raise GknetError("frame 1: truncated")
        return self.frames[i] if image else replace(self.frames[i], image=None)


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


def test_nothing_to_train_on_is_an_error(tmp_path: Path) -> None:
    for frames in ([], [a_frame((40.0, 0.0, 12.0), 64)]):
        with pytest.raises(GknetError, match="cache"):
            build_cache(Frames(frames), CRAFT, tmp_path / "cache", 64)
    assert not [path for path in tmp_path.iterdir() if path.is_dir()]


def loader(folder: Path, draw=draw_keypoints, **options: int) -> Loader:
    data = SkdDataset(folder, "train", "satellite_01")
    window = "picture" if draw is draw_box else "craft"
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
    def broken(*_: object) -> None:
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
