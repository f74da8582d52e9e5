"""Whatever is given becomes Frames in order, with a word for each that cannot."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.frame import Frame, Unreadable
from gknet.io.image import write_image
from gknet.io.lens import FieldOfView
from gknet.io.video import VideoWriter
from gknet.predict.source import open_source
from gknet.spacecraft import Spacecraft
from tests.cli.toy import CAMERA, picture_number, toy_picture, toy_pose, toy_spacecraft, write_toy_dataset

LENS = FieldOfView(focal_px=350.0)
TOY = toy_spacecraft()


def numbers(path: Path, every: int = 1) -> list[int]:
    return [picture_number(picture.image) for picture in open_source(path, LENS, TOY, every=every)]


def test_folder_is_sorted_and_thinned(tmp_path: Path) -> None:
    for number in (3, 1, 2, 0):
        write_image(tmp_path / f"{number}.png", toy_picture(number))
    (tmp_path / "notes.txt").write_text("no picture")
    assert numbers(tmp_path) == [0, 1, 2, 3]
    assert numbers(tmp_path, every=3) == [0, 3]
    assert open_source(tmp_path, LENS, TOY, every=3).count == 2


def test_each_image_has_the_camera_of_its_size(tmp_path: Path) -> None:
    write_image(tmp_path / "a.png", toy_picture(0)[:100])
    (frame,) = open_source(tmp_path / "a.png", LENS, TOY)
    assert isinstance(frame, Frame)
    assert (frame.camera.width, frame.camera.height) == (256, 100)
    assert np.allclose(frame.camera.matrix[:2, 2], (128, 50))


def test_video_says_when_it_ends_early(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.mp4"
    with VideoWriter(path, 10) as writer:
        for number in range(12):
            writer.write(toy_picture(number))
    source = open_source(path, LENS, TOY)
    assert source.count == 12
    assert [picture_number(picture.image) for picture in source] == list(range(12))
    whole = type(source.video).frames
    monkeypatch.setattr(type(source.video), "frames", lambda self, every: list(whole(self, every))[:5])
    *_, last = open_source(path, LENS, TOY)
    assert isinstance(last, Unreadable)
    assert "ends after 5 of 12" in last.failure.detail


def test_dataset_frames_carry_truth(tmp_path: Path) -> None:
    root = write_toy_dataset(tmp_path / "set", sequences=1, frames=3)
    frames = list(open_source(root, None, TOY))
    assert [picture_number(frame.image) for frame in frames] == [0, 1, 2]
    assert frames[2].cam_from_body.angle_to(toy_pose(2)) < 1e-6
    assert np.allclose(frames[0].camera.matrix, CAMERA.matrix)


def test_dataset_refuses_a_lens_and_other_keypoints(tmp_path: Path) -> None:
    root = write_toy_dataset(tmp_path / "set", sequences=1, frames=1)
    with pytest.raises(GknetError, match="has its own camera"):
        open_source(root, LENS, TOY)
    moved = Spacecraft(TOY.name, TOY.keypoint_names, TOY.points_m + 0.1, TOY.edges, TOY.diameter_m)
    with pytest.raises(GknetError, match="other keypoints"):
        open_source(root, None, moved)
