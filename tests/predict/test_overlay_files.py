"""Overlays and the film: names that never meet, and failures that cost nothing else."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gknet.io.video import open_video
from gknet.predict.overlay_files import OverlayFolder, OverlayNames, OverlayVideo

PICTURE = np.zeros((64, 64, 3), dtype=np.uint8)


@given(st.lists(st.text(st.characters(exclude_categories=()), min_size=1), unique=True, max_size=12))
def test_pictures_never_share_a_file_that_every_system_takes(pictures: list[str]) -> None:
    names = OverlayNames()
    found = [names.name_for(picture) for picture in pictures]
    assert len({name.casefold() for name in found}) == len(pictures)
    for name in found:
        assert len(name.encode("utf-8")) <= 255
        assert name.endswith(".jpg")
        assert not set(name) & set('/\\:*?"<>|\0\x1b')
    again = OverlayNames()
    assert [again.name_for(picture) for picture in pictures] == found


@pytest.mark.parametrize(
    ("pictures", "expected"),
    [
        (["a.png"], ["a.jpg"]),
        (["cam1/1.jpg", "cam1_1.jpg", "cam1_1.png"], ["cam1_1.jpg", "cam1_1.jpg.jpg", "cam1_1.png.jpg"]),
        (["a/b", "a:b", "a?b", "a*b"], ["a_b.jpg", "a_b-2.jpg", "a_b-3.jpg", "a_b-4.jpg"]),
        ([os.fsdecode(b"caf\xe9.jpg")], ["caf_xe9.jpg"]),
        (["film/000001"], ["film_000001.jpg"]),
    ],
)
def test_names(pictures: list[str], expected: list[str]) -> None:
    names = OverlayNames()
    assert [names.name_for(picture) for picture in pictures] == expected


def test_names_suit_a_file_system_of_ascii_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.getfilesystemencoding", lambda: "ascii")
    names = OverlayNames()
    assert [names.name_for(name) for name in ("cafe\u0301.png", "cafe\u0302.png")] == ["cafe_.jpg", "cafe_.png.jpg"]


def test_long_names_differ_and_keep_their_ends() -> None:
    names = OverlayNames()
    found = {names.name_for(f"{start}{'é' * 200}_0001.png") for start in "ab"}
    assert len(found) == 2
    assert all(name.endswith("é_0001.jpg") for name in found)


def test_an_overlay_that_cannot_be_written_is_counted(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    overlays = OverlayFolder(tmp_path / "overlays")
    overlays.write("good.png", PICTURE)
    assert overlays.losses.sentence is None
    (tmp_path / "overlays" / "taken.jpg").mkdir()
    overlays.write("taken.png", PICTURE)
    overlays.write("wide.png", np.zeros((1, 70_000, 3), dtype=np.uint8))
    assert overlays.losses.count == 2
    assert (overlays.losses.sentence or "").startswith("2 overlays could not be written; the first, taken.png: ")
    assert capfd.readouterr().err == ""


def test_a_frame_that_the_codec_refuses_ends_no_film(tmp_path: Path) -> None:
    film = OverlayVideo(tmp_path / "overlay.mp4", 5)
    film.write("wide", np.zeros((20, 100_000, 3), dtype=np.uint8))
    for _ in range(3):
        film.write("good", PICTURE)
    film.close()
    assert film.losses.count == 1
    assert open_video(tmp_path / "overlay.mp4").announced == 3
    assert [path.name for path in tmp_path.iterdir()] == ["overlay.mp4"]


def test_a_film_without_frames_leaves_nothing(tmp_path: Path) -> None:
    film = OverlayVideo(tmp_path / "none" / "overlay.mp4", 5)
    film.write("good", PICTURE)
    film.close()
    assert film.losses.count == 1
    assert list(tmp_path.iterdir()) == []
