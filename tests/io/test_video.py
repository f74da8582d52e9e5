"""Videos: what is written can be read, and a bad end leaves nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.io.video import VideoWriter, open_video


def grey(level: int, width: int = 64, height: int = 48) -> np.ndarray:
    return np.full((height, width, 3), level, dtype=np.uint8)


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with VideoWriter(path, 8) as writer:
        for level in range(0, 200, 40):
            writer.write(grey(level))
    video = open_video(path)
    assert (video.width, video.height, video.fps, video.announced) == (64, 48, 8.0, 5)
    frames = list(video.frames())
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4]
    assert [frame.time_s for frame in frames] == pytest.approx([0, 0.125, 0.25, 0.375, 0.5])
    assert [round(float(frame.image.mean()) / 40) for frame in frames] == [0, 1, 2, 3, 4]
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_channels_are_rgb(tmp_path: Path) -> None:
    red = grey(0)
    red[:, :, 0] = 220
    with VideoWriter(tmp_path / "red.mp4", 5) as writer:
        writer.write(red)
    (frame,) = open_video(tmp_path / "red.mp4").frames()
    assert frame.image[..., 0].mean() > 150 > 60 > frame.image[..., 2].mean()


def test_every(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4", 8) as writer:
        for _ in range(7):
            writer.write(grey(9))
    assert [frame.index for frame in open_video(tmp_path / "a.mp4").frames(3)] == [0, 3, 6]


def test_odd_and_changing_sizes(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4", 8) as writer:
        writer.write(grey(9, 65, 49))
        writer.write(grey(9, 128, 96))
    video = open_video(tmp_path / "a.mp4")
    assert (video.width, video.height, video.announced) == (64, 48, 2)


def interrupted(writer: VideoWriter) -> None:
    with writer:
        writer.write(grey(9))
        raise KeyboardInterrupt


def test_an_error_leaves_nothing(tmp_path: Path) -> None:
    writer = VideoWriter(tmp_path / "a.mp4", 8)
    with pytest.raises(KeyboardInterrupt):
        interrupted(writer)
    assert list(tmp_path.iterdir()) == []


def test_no_frame_writes_no_file(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "a.mp4", 8):
        pass
    assert list(tmp_path.iterdir()) == []


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(GknetError, match="no such video"):
        open_video(tmp_path / "none.mp4")
    (tmp_path / "words.mp4").write_text("words")
    with pytest.raises(GknetError, match="not a video"):
        open_video(tmp_path / "words.mp4")
    with pytest.raises(GknetError, match="cannot write"), VideoWriter(tmp_path / "no" / "a.mp4", 8) as writer:
        writer.write(grey(9))
