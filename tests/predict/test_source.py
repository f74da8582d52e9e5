"""Whatever is given becomes Frames in order, with a word for each that cannot."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from gknet.errors import GknetError
from gknet.frame import FailureKind, Frame, Unreadable
from gknet.geometry import Camera
from gknet.io.image import write_image
from gknet.io.lens import FieldOfView
from gknet.io.video import Video, VideoWriter
from gknet.predict.source import open_source
from gknet.spacecraft import Spacecraft
from tests.cli.toy import CAMERA, picture_number, toy_picture, toy_pose, toy_spacecraft, write_toy_dataset
from tests.io.test_video import FakeCapture, damaged, written

LENS = FieldOfView(focal_px=350.0)
TOY = toy_spacecraft()


def numbers(source: Iterable[Frame | Unreadable]) -> list[int]:
    """The numbers of the toy images that were read."""
    frames = [picture for picture in source if isinstance(picture, Frame)]
    return [picture_number(frame.image) for frame in frames if frame.image is not None]


def film(path: Path, *pictures: int) -> Path:
    with VideoWriter(path, 10) as writer:
        for number in pictures:
            writer.write(toy_picture(number))
    return path


def test_folder_is_sorted_and_thinned(tmp_path: Path) -> None:
    for number in (3, 1, 2, 0):
        write_image(tmp_path / f"{number}.png", toy_picture(number))
    (tmp_path / "notes.txt").write_text("no image")
    assert numbers(open_source(tmp_path, LENS, TOY)) == [0, 1, 2, 3]
    assert numbers(open_source(tmp_path, LENS, TOY, every=3)) == [0, 3]
    assert open_source(tmp_path, LENS, TOY, every=3).count == 2


def test_each_image_has_the_camera_of_its_size(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", toy_picture(0)[:100])
    (frame,) = open_source(tmp_path / "a.png", LENS, TOY)
    assert isinstance(frame, Frame)
    assert (frame.camera.width, frame.camera.height) == (256, 100)
    assert np.allclose(frame.camera.matrix[:2, 2], (128, 50))


def test_video_reports_when_it_ends_early(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = film(tmp_path / "a.mp4", *range(12))
    source = open_source(path, LENS, TOY)
    assert (source.count, source.fps) == (12, 10)
    assert numbers(source) == list(range(12))
    whole = Video.frames
    monkeypatch.setattr(Video, "frames", lambda self, every: list(whole(self, every))[:5])
    *_, last = open_source(path, LENS, TOY)
    assert isinstance(last, Unreadable)
    assert last.name == "a/000005"
    assert "the last 7 of 12 frames cannot be read" in last.failure.detail


def test_a_bad_frame_is_recorded_in_its_place(tmp_path: Path) -> None:
    path = written(tmp_path / "a.avi", "MJPG", count=8)
    source = list(open_source(damaged(path, 3, 7), LENS, TOY))
    assert [picture.name for picture in source] == [f"a/{k:06d}" for k in range(8)]
    assert [k for k, picture in enumerate(source) if isinstance(picture, Unreadable)] == [3, 7]
    times = [picture.time_s for picture in source if isinstance(picture, Frame)]
    assert times == pytest.approx([0, 0.1, 0.2, 0.4, 0.5, 0.6])


def test_several_inputs_of_all_kinds(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for number in range(3):
        write_image(tmp_path / "in" / f"{number}.png", toy_picture(number))
    film(tmp_path / "in" / "b.mp4", 5, 6)
    (tmp_path / "in" / "c.mp4").write_text("no video")
    write_image(tmp_path / "z.png", toy_picture(9))
    source = open_source([tmp_path / "in", f"{tmp_path}/z.*"], LENS, TOY)
    pictures = list(source)
    assert [picture.name for picture in pictures] == [
        *("0.png", "1.png", "2.png", "b/000000", "b/000001", "c", "z.png"),
    ]
    assert source.count == 7
    assert source.fps is None
    assert numbers(pictures) == [0, 1, 2, 5, 6, 9]
    assert numbers(open_source([tmp_path / "in", tmp_path / "z.png"], LENS, TOY, every=2)) == [0, 2, 5]


def test_further_pages_are_recorded(tmp_path: Path) -> None:
    pages = [Image.fromarray(toy_picture(number)) for number in range(3)]
    pages[0].save(tmp_path / "a.tif", save_all=True, append_images=pages[1:])
    first, rest = open_source(tmp_path / "a.tif", LENS, TOY)
    assert numbers([first]) == [0]
    assert isinstance(rest, Unreadable)
    assert "only the first page" in rest.failure.detail


def test_the_bit_depth_reaches_the_files(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), cv2.cvtColor(toy_picture(4), cv2.COLOR_RGB2BGR).astype(np.uint16) << 4)
    (refused,) = open_source(tmp_path / "a.png", LENS, TOY)
    assert isinstance(refused, Unreadable)
    assert "--bit-depth 12" in refused.failure.detail
    assert numbers(open_source(tmp_path / "a.png", LENS, TOY, bit_depth=12)) == [4]


def test_a_live_source_has_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: FakeCapture(100))
    source = open_source("rtsp://host/1", LENS, TOY, every=2, limit=9)
    assert source.count == 5
    assert [picture.name for picture in source] == [f"stream/{k:06d}" for k in (0, 2, 4, 6, 8)]
    with pytest.raises(GknetError, match="limit"):
        open_source("0", LENS, TOY, limit=0)


def test_a_camera_of_another_size_is_a_failure_of_its_own_kind(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", toy_picture(0))
    film(tmp_path / "b.mp4", 0)
    for picture in open_source(tmp_path, Camera.from_focal(500, 640, 480), TOY):
        assert isinstance(picture, Unreadable)
        assert picture.failure.kind == FailureKind.CAMERA_MISMATCH
        assert "640 x 480 pixels, the image has 256 x 256" in picture.failure.detail
    (tmp_path / "a.png").write_bytes(b"x")
    damaged_picture = next(iter(open_source(tmp_path / "a.png", LENS, TOY)))
    assert isinstance(damaged_picture, Unreadable)
    assert damaged_picture.failure.kind == FailureKind.UNREADABLE_IMAGE


def test_no_input_and_no_lens(tmp_path: Path) -> None:
    for empty in ("", " ", [""], ["a.png", ""]):
        with pytest.raises(GknetError, match="empty name"):
            open_source(empty, LENS, TOY)
    with pytest.raises(GknetError, match="its camera is unknown"):
        open_source(tmp_path, None, TOY)
    with pytest.raises(GknetError, match="every"):
        open_source(tmp_path, LENS, TOY, every=0)


def test_dataset_frames_carry_truth(tmp_path: Path) -> None:
    root = write_toy_dataset(tmp_path / "set", sequences=1, frames=3)
    frames = [frame for frame in open_source(root, None, TOY) if isinstance(frame, Frame)]
    assert numbers(frames) == [0, 1, 2]
    assert frames[2].cam_from_body is not None
    assert frames[2].cam_from_body.angle_to(toy_pose(2)) < 1e-6
    assert np.allclose(frames[0].camera.matrix, CAMERA.matrix)


def test_dataset_refuses_a_lens_and_other_keypoints(tmp_path: Path) -> None:
    root = write_toy_dataset(tmp_path / "set", sequences=1, frames=1)
    with pytest.raises(GknetError, match="has its own camera"):
        open_source(root, LENS, TOY)
    with pytest.raises(GknetError, match="read alone"):
        open_source([root, root], None, TOY)
    moved = Spacecraft(TOY.name, TOY.keypoint_names, TOY.points_m + 0.1, TOY.edges, TOY.diameter_m)
    with pytest.raises(GknetError, match="other keypoints"):
        open_source(root, None, moved)
