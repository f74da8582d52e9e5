"""What inputs name: which files, in which order, and by which names."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gknet.errors import GknetError
from gknet.predict.inputs import Found, Kind, find_files, natural_key


def touched(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    return folder


def names(*inputs: str | Path) -> list[str]:
    return [item.name for item in find_files(inputs)]


def test_numbers_count_as_numbers(tmp_path: Path) -> None:
    touched(tmp_path, "10.png", "9.png", "1.png", "b2/1.png", "b10/1.png", "a.png", "img_2.png", "img_11.png")
    assert names(tmp_path) == [
        *("1.png", "9.png", "10.png", "a.png", "b2/1.png", "b10/1.png", "img_2.png", "img_11.png"),
    ]


@given(st.lists(st.integers(0, 10**6), unique=True, max_size=20))
def test_natural_order_is_that_of_numbers(numbers: list[int]) -> None:
    assert sorted((f"f{n}.png" for n in numbers), key=natural_key) == [f"f{n}.png" for n in sorted(numbers)]


@given(st.lists(st.text("a1٣²/.:", max_size=6), max_size=6))
def test_any_names_have_an_order(texts: list[str]) -> None:
    assert sorted(sorted(texts, key=natural_key)) == sorted(texts)


def test_videos_inside_a_folder(tmp_path: Path) -> None:
    found = find_files([touched(tmp_path, "a.png", "b/film.MP4", "c.txt", "d.avi")])
    assert [(item.kind, item.name) for item in found] == [
        (Kind.IMAGE, "a.png"),
        (Kind.VIDEO, "b/film"),
        (Kind.VIDEO, "d"),
    ]


def test_several_inputs_keep_their_order_and_a_file_is_there_once(tmp_path: Path) -> None:
    touched(tmp_path, "b/2.png", "b/1.png", "a.png")
    assert names(tmp_path / "b", tmp_path / "a.png", tmp_path / "b" / "1.png") == ["1.png", "2.png", "a.png"]


def test_names_differ(tmp_path: Path) -> None:
    touched(tmp_path, "x/1.png", "y/1.png", "y/2.png", "f.mp4", "f.avi")
    assert names(tmp_path / "x", tmp_path / "y") == ["x/1.png", "y/1.png", "2.png"]
    assert names(tmp_path / "f.mp4", tmp_path / "f.avi") == ["f.mp4", "f.avi"]
    touched(tmp_path, os.fsdecode(b"z/\xe9.png"), "z/\\xe9.png")
    found = names(tmp_path / "z")
    assert len(set(found)) == 2
    assert all(name.isprintable() for name in found)


def test_patterns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touched(tmp_path, "s10/a.png", "s2/a.png", "s2/b.txt", "s2/sub/c.jpg", "odd[1].png")
    assert names(f"{tmp_path}/s*/*.png") == ["s2/a.png", "s10/a.png"]
    assert names(f"{tmp_path}/s2/*") == ["a.png", "c.jpg"]
    assert names(f"{tmp_path}/s2/**") == ["a.png", "sub/c.jpg"]
    assert names(f"{tmp_path}/odd[1].png") == ["odd[1].png"]
    with pytest.raises(GknetError, match=r"\*\.bmp: no file matches this pattern"):
        find_files([f"{tmp_path}/*.bmp"])
    monkeypatch.chdir(tmp_path)
    assert names("s?/*.png") == ["a.png"]
    monkeypatch.chdir(tmp_path / "s2")
    assert names("../s*/*.png") == ["s2/a.png", "s10/a.png"]
    with pytest.raises(GknetError, match=r"no file matches|not a pattern"):
        find_files(["**x/[a"])


def test_lists(tmp_path: Path) -> None:
    touched(tmp_path, "x/1.png", "y/1.png", "y/2.png", "f.mp4", "c:d.png")
    (tmp_path / "list.txt").write_bytes(
        b"\xef\xbb\xbf# comment\r\nx/1.png\r\n\r\ny/1.png\r\nf.mp4\r\nc:d.png\r\nmissing.png\r\n"
    )
    for form in (tmp_path / "list.txt", f"@{tmp_path}/list.txt"):
        found = find_files([form])
        assert [item.name for item in found] == ["x/1.png", "y/1.png", "f", "c:d.png", "missing.png"]
        assert found[-1].kind is Kind.BAD
        assert "listed in" in found[-1].reason
    (tmp_path / "list.txt").write_text(f"{tmp_path}/y\nx/*.png\n")
    assert names(tmp_path / "list.txt") == ["y/1.png", "2.png", "x/1.png"]
    (tmp_path / "loop.txt").write_text("loop.txt\n")
    with pytest.raises(GknetError, match="another list"):
        find_files([tmp_path / "loop.txt"])
    (tmp_path / "empty.txt").write_text("\n# nothing\n")
    with pytest.raises(GknetError, match="found none"):
        find_files([tmp_path / "empty.txt"])


def test_cameras_and_streams(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_files(["0"]) == [Found(Kind.LIVE, "0", "camera0")]
    assert find_files(["rtsp://host/1"]) == [Found(Kind.LIVE, "rtsp://host/1", "stream")]
    assert names("rtsp://host/1", "rtsp://host/2", "rtsp://host/1") == ["stream", "stream-2"]
    touched(tmp_path, "0/a.png")
    assert names("0") == ["a.png"]


def test_links_are_followed_once(tmp_path: Path) -> None:
    touched(tmp_path, "outside/3.png", "in/1.png", "in/sub/2.png")
    for name in ("up", "up2", "up3"):  # followed without memory, three loops are 3^40 folders
        (tmp_path / "in" / name).symlink_to(tmp_path / "in")
    assert names(f"{tmp_path}/in/**/*.png") == ["1.png", "2.png"]
    (tmp_path / "in" / "link").symlink_to(tmp_path / "outside")
    (tmp_path / "in" / "link2").symlink_to(tmp_path / "outside")
    (tmp_path / "in" / "4.png").symlink_to(tmp_path / "outside" / "3.png")
    (tmp_path / "in" / "broken.png").symlink_to(tmp_path / "none")
    assert names(tmp_path / "in") == ["1.png", "4.png", "broken.png", "link/3.png", "sub/2.png"]


def test_an_unreadable_folder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    touched(tmp_path, "1.png", "locked/2.png")
    scan = os.scandir

    def refusing(path: str) -> object:
        if path.endswith("locked"):
            raise PermissionError(13, "Permission denied", path)
        return scan(path)

    monkeypatch.setattr(os, "scandir", refusing)
    first, second = find_files([tmp_path])
    assert first.name == "1.png"
    assert (second.kind, second.name) == (Kind.BAD, "locked")
    assert "Permission denied" in second.reason


def test_what_gknet_wrote_is_no_input(tmp_path: Path) -> None:
    touched(tmp_path, "1.png", "predictions/poses.jsonl", "predictions/overlays/1.jpg", "predictions/overlay.mp4")
    touched(tmp_path, "csv/poses.csv", "csv/overlays/1.jpg", "csv/own.png", "other/overlays/2.png", ".hidden/3.png")
    assert names(tmp_path) == ["1.png", "csv/own.png", "other/overlays/2.png"]
    assert names(tmp_path / "predictions" / "overlays") == ["1.jpg"]
    with pytest.raises(GknetError, match="no image in this folder"):
        find_files([tmp_path / "predictions"])


def test_pipes_in_a_folder_are_skipped(tmp_path: Path) -> None:
    touched(tmp_path, "1.png")
    os.mkfifo(tmp_path / "pipe.png")
    assert names(tmp_path) == ["1.png"]


@pytest.mark.parametrize("text", ["", " "])
def test_an_empty_input_is_refused(text: str) -> None:
    with pytest.raises(GknetError, match="empty name"):
        find_files([text])
    with pytest.raises(GknetError, match="no input"):
        find_files([])


def test_what_is_not_there(tmp_path: Path) -> None:
    for text in (f"{tmp_path}/none.png", "none.mp4", "12345"):
        with pytest.raises(GknetError, match="no such image, video or folder"):
            find_files([text])
