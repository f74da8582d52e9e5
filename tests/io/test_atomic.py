"""Files appear whole or not at all; temporary names stand in nobody's way."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest

from gknet.io.atomic import replacing, write_bytes, write_text


def test_a_file_is_replaced_and_nothing_else_stays(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    for text in ("one", "two"):
        write_text(path, text)
        assert path.read_text(encoding="utf-8") == text
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


@pytest.mark.parametrize("umask", [0o022, 0o077, 0o002])
def test_permissions_are_those_of_the_umask(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        write_bytes(tmp_path / "a", b"")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o666 & ~umask


def write_half(path: Path, keep_on_error: bool) -> None:
    with replacing(path, keep_on_error=lambda: keep_on_error) as temporary:
        temporary.write_bytes(b"half")
        raise KeyboardInterrupt


def test_an_error_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt):
        write_half(path, keep_on_error=False)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"a": b"old"}


def test_an_error_keeps_what_there_is_where_that_is_wanted(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with pytest.raises(KeyboardInterrupt):
        write_half(path, keep_on_error=True)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"a": b"half"}


def test_writers_of_one_path_have_temporary_files_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    with replacing(path, keep_suffix=True) as first, replacing(path, keep_suffix=True) as second:
        assert first != second
        assert {first.suffix, second.suffix} == {".mp4"}
        assert first.name.startswith(".")
        assert first.parent == tmp_path


def test_what_a_killed_writer_left_stands_in_nobodys_way(tmp_path: Path) -> None:
    for name in (".a.123.tmp", ".a.tmp", "a.tmp"):
        (tmp_path / name).mkdir()
    write_bytes(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"new"


@pytest.mark.parametrize("name", ["x" * 255, "é" * 127, os.fsdecode(b"\xe9" * 255), "卫" * 85])
def test_every_legal_name_can_be_written(tmp_path: Path, name: str) -> None:
    write_bytes(tmp_path / name, b"new")
    assert (tmp_path / name).read_bytes() == b"new"


def test_errors_name_the_file_and_not_the_temporary_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileNotFoundError) as caught:
        write_bytes(tmp_path / "none" / "a", b"")
    assert caught.value.filename == str(tmp_path / "none" / "a")
    (tmp_path / "folder").mkdir()
    with pytest.raises(IsADirectoryError) as refused:
        write_bytes(tmp_path / "folder", b"")
    assert refused.value.filename == str(tmp_path / "folder")

    def full(self: Path, data: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space left") as ended:
        write_bytes(tmp_path / "a", b"new")
    assert ended.value.filename == str(tmp_path / "a")
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]


def test_text_that_utf8_lacks_is_escaped(tmp_path: Path) -> None:
    write_text(tmp_path / "a", os.fsdecode(b"caf\xe9") + "\ud800")
    assert (tmp_path / "a").read_text(encoding="utf-8") == "caf\\udce9\\ud800"
