"""Videos: what is written can be read, and a bad end leaves nothing."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Iterable
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import cv2
import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.io.video import LiveVideo, Video, VideoFrame, VideoWriter, open_live, open_video


def grey(level: int, width: int = 64, height: int = 48) -> np.ndarray:
    return np.full((height, width, 3), level, dtype=np.uint8)


def levels(frames: Iterable[VideoFrame], step: int = 20) -> list[int | None]:
    """The grey level of each frame in steps; None for one that cannot be decoded."""
    return [None if frame.image is None else round(float(frame.image.mean()) / step) for frame in frames]


def written(path: Path, code: str = "mp4v", count: int = 12, fps: float = 10) -> Path:
    """Frame k is 20 k with noise, so that no codec makes it from nothing."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), fps, (128, 96))
    noise = np.random.default_rng(0).integers(-8, 9, (count, 96, 128, 3))
    for k in range(count):
        writer.write(np.clip(20 * k + noise[k], 0, 255).astype(np.uint8))
    writer.release()
    return path


def pieces(path: Path) -> list[tuple[int, int]]:
    """Where the coded frames lie in a file that OpenCV wrote, and their sizes."""
    data = path.read_bytes()
    if path.suffix == ".mp4":
        sizes_at, start_at = data.find(b"stsz"), data.find(b"stco")
        (count,) = struct.unpack_from(">I", data, sizes_at + 12)
        sizes = struct.unpack_from(f">{count}I", data, sizes_at + 16)
        (start,) = struct.unpack_from(">I", data, start_at + 12)
        return [(start + sum(sizes[:k]), sizes[k]) for k in range(count)]
    found, at, end = [], data.find(b"movi"), data.find(b"idx1")
    while 0 <= (at := data.find(b"00dc", at + 1)) < end:
        found.append((at + 8, int.from_bytes(data[at + 4 : at + 8], "little")))
    return found


def damaged(path: Path, *bad: int) -> Path:
    data, places = bytearray(path.read_bytes()), pieces(path)
    for k in bad:
        start, size = places[k]
        data[start : start + size] = bytes(size)
    path.write_bytes(data)
    return path


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
    assert levels(frames, 40) == [0, 1, 2, 3, 4]
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


def test_channels_are_rgb(tmp_path: Path) -> None:
    red = grey(0)
    red[:, :, 0] = 220
    with VideoWriter(tmp_path / "red.mp4", 5) as writer:
        writer.write(red)
    (frame,) = open_video(tmp_path / "red.mp4").frames()
    assert frame.image is not None
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


@pytest.mark.parametrize(("name", "code"), [("a.avi", "MJPG"), ("a.mp4", "mp4v")])
@pytest.mark.parametrize("bad", [(0,), (3,), (6, 7), (10,), (0, 1, 2, 5)])
def test_a_bad_frame_keeps_its_index_and_ends_nothing(
    tmp_path: Path, name: str, code: str, bad: tuple[int, ...]
) -> None:
    video = open_video(damaged(written(tmp_path / name, code), *bad))
    frames = list(video.frames())
    assert [frame.index for frame in frames] == list(range(12))
    assert [frame.index for frame in frames if frame.image is None] == list(bad)
    assert [frame.time_s for frame in frames if frame.image is None] == [None] * len(bad)
    good = [frame for frame in frames if frame.image is not None]
    assert [frame.time_s for frame in good] == pytest.approx([frame.index / 10 for frame in good])
    if code == "MJPG":
        assert levels(good) == [frame.index for frame in good]
    assert [frame.index for frame in video.frames(3)] == [0, 3, 6, 9]


@pytest.mark.parametrize(("name", "code"), [("a.avi", "MJPG"), ("a.mp4", "mp4v")])
def test_what_is_missing_at_the_end_is_counted(tmp_path: Path, name: str, code: str) -> None:
    video = open_video(damaged(written(tmp_path / name, code), 10, 11))
    assert [frame.index for frame in video.frames()] == list(range(10))
    assert video.missing_at_the_end(10) == 2
    assert video.missing_at_the_end(12) == 0
    assert Video(Path("a.mkv"), 8, 8, 10, 12).missing_at_the_end(10) == 0
    assert Video(Path("a.mkv"), 8, 8, 10, 12).missing_at_the_end(3) == 9
    assert Video(Path("a.mkv"), 8, 8, 10, 0).missing_at_the_end(3) == 0


@pytest.mark.parametrize("announced", [0, 3, 500, 2**31 - 1])
def test_a_wrong_announced_length_costs_no_frame(tmp_path: Path, announced: int) -> None:
    path = damaged(written(tmp_path / "a.avi", "MJPG"), 5)
    video = Video(path, 128, 96, 10.0, announced)
    assert levels(video.frames()) == [0, 1, 2, 3, 4, None, 6, 7, 8, 9, 10, 11]


def with_matrix(path: Path, matrix: tuple[int, ...]) -> Path:
    """Set the display matrix of an mp4's track header."""
    data = bytearray(path.read_bytes())
    at = data.find(b"tkhd") + 8 + 20 + 8 + 8
    data[at : at + 36] = struct.pack(">9i", *(v * (1 << 30 if k % 3 == 2 else 1 << 16) for k, v in enumerate(matrix)))
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("matrix", [(-1, 0, 0, 0, -1, 0, 0, 0, 1), (0, 1, 0, -1, 0, 0, 0, 0, 1)])
def test_the_rotation_flag_turns_nothing(tmp_path: Path, matrix: tuple[int, ...]) -> None:
    """It would turn the pixels and not the camera matrix."""
    path = written(tmp_path / "a.mp4", count=2)
    (plain, _), video = open_video(path).frames(), open_video(with_matrix(path, matrix))
    turned, _ = video.frames()
    assert (video.width, video.height) == (128, 96)
    assert plain.image is not None
    assert turned.image is not None
    np.testing.assert_array_equal(turned.image, plain.image)


def with_durations(path: Path, durations: list[int]) -> Path:
    """Give each frame of an mp4 its own duration in place of a common one: a variable frame rate."""
    data = path.read_bytes().replace(b"edts", b"free")  # the edit list would cut what is longer than before
    at = data.find(b"stts") - 4
    old = struct.unpack_from(">I", data, at)[0]
    table = b"".join(struct.pack(">II", 1, duration) for duration in durations)
    new = struct.pack(">I4sII", 16 + len(table), b"stts", 0, len(durations)) + table
    grown = bytearray(data[:at] + new + data[at + old :])
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
        box = grown.find(name) - 4
        struct.pack_into(">I", grown, box, struct.unpack_from(">I", grown, box)[0] + len(new) - old)
    path.write_bytes(grown)
    return path


def test_times_are_those_of_the_file(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mp4", count=5)
    data = path.read_bytes()
    unit = struct.unpack_from(">I", data, data.find(b"stts") + 16)[0]
    video = open_video(with_durations(path, [unit, 3 * unit, unit, 2 * unit, unit]))
    times = [frame.time_s for frame in video.frames()]
    assert times == pytest.approx([0, 0.1, 0.4, 0.5, 0.7], abs=1e-3)


@pytest.mark.parametrize("name", ["a:b.mp4", "c%03d.mp4", "ü.mp4", os.fsdecode(b"caf\xe9.mp4"), "http:x.mp4"])
def test_every_name_is_written_and_read(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with VideoWriter(name, 8) as writer:
        writer.write(grey(120))
    (frame,) = open_video(name).frames()
    assert frame.image is not None
    assert os.listdir(tmp_path) == [name]
    assert capfd.readouterr().err == ""


def test_a_folder_that_is_not_utf8(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"o\xe9")
    folder.mkdir()
    with VideoWriter(folder / "a.mp4", 8) as writer:
        writer.write(grey(120))
    assert len(list(open_video(folder / "a.mp4").frames())) == 1


def test_a_pipe_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mp4")
    with pytest.raises(GknetError, match="a pipe or a device"):
        open_video(tmp_path / "pipe.mp4")


def test_a_video_of_which_no_frame_decodes(tmp_path: Path) -> None:
    path = damaged(written(tmp_path / "a.avi", "MJPG", count=3), 0, 1, 2)
    with pytest.raises(GknetError, match="without frames"):
        open_video(path)


class FakeCapture:
    """A camera that delivers `frames` images and then nothing; each third grab fails."""

    def __init__(self, frames: int) -> None:
        self.left, self.grabs = frames, 0

    def isOpened(self) -> bool:
        return True

    def set(self, key: int, value: float) -> bool:
        return True

    def get(self, key: int) -> float:
        return float("nan")

    def release(self) -> None:
        pass

    def grab(self) -> bool:
        self.grabs += 1
        if self.left == 0 or self.grabs % 3 == 0:
            return False
        self.left -= 1
        return True

    def retrieve(self, *_: object) -> tuple[bool, np.ndarray]:
        return True, grey(100)


@pytest.mark.parametrize("source", [0, "rtsp://camera/1"])
def test_a_live_source_is_bounded(source: int | str, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[object] = []

    def opened(*arguments: object) -> FakeCapture:
        given.append(arguments[0])
        return FakeCapture(20)

    monkeypatch.setattr(cv2, "VideoCapture", opened)
    if source == 0:
        monkeypatch.setattr("gknet.io.video.STREAM_TIMEOUT_S", 0.2)
    start = time.monotonic()
    video = open_live(source, limit=7)
    assert video.fps == 25
    frames = list(video.frames(2))
    assert [frame.index for frame in frames] == [0, 2, 4, 6]
    times = [frame.time_s for frame in frames if frame.time_s is not None]
    assert times == sorted(times)
    assert len(list(LiveVideo(source, 25, 1000).frames())) == 20
    assert given == [source] * 3
    assert time.monotonic() - start < 8  # less than the timeout


def test_a_stream_over_http(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("http_proxy", raising=False)
    written(tmp_path / "a.mp4", count=6)
    handler = partial(QuietHandler, directory=str(tmp_path))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        video = open_live(f"http://127.0.0.1:{server.server_port}/a.mp4", limit=100)
        frames = list(video.frames())
        server.shutdown()
    assert [frame.index for frame in frames] == [0, 1, 2, 3, 4, 5]
    assert video.fps == 10


class QuietHandler(SimpleHTTPRequestHandler):
    """Serves a folder and prints nothing."""

    def log_message(self, *arguments: object) -> None:
        pass


def test_a_stream_that_is_not_there() -> None:
    with pytest.raises(GknetError, match="cannot be opened"):
        open_live("tcp://127.0.0.1:9/none", limit=5)
    with pytest.raises(GknetError, match="camera 97: cannot be opened"):
        open_live(97, limit=5)
