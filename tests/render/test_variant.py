"""Where Dr.Jit keeps its kernels, and that Mitsuba starts without a HOME that can be written."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("mitsuba")

from gknet.errors import GknetError
from gknet.render import variant as variants
from gknet.render.variant import drjit_home


@pytest.fixture(autouse=True)
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A home, a cache and a folder for temporary files of this test's own."""
    drjit_home.cache_clear()
    for name in ("home", "cache", "tmp"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    yield
    drjit_home.cache_clear()


def block(folder: Path) -> None:
    """Make a folder unusable for everybody, root included: a file takes its place."""
    folder.rmdir()
    folder.touch()


def test_home_comes_first_then_the_cache_then_the_temporary_folder(tmp_path: Path) -> None:
    own = tmp_path / "tmp" / f"gknet-{os.getuid()}"
    for name, folder in (("home", tmp_path / "home"), ("cache", tmp_path / "cache/gknet"), ("tmp", own)):
        drjit_home.cache_clear()
        assert drjit_home() == folder
        assert (folder / ".drjit").is_dir()
        shutil.rmtree(tmp_path / name)
        (tmp_path / name).touch()


def test_the_temporary_folder_is_private(tmp_path: Path) -> None:
    for name in ("home", "cache"):
        block(tmp_path / name)
    assert drjit_home().stat().st_mode & 0o077 == 0


def test_a_home_that_is_not_there_is_not_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "nobody"))
    assert drjit_home() == tmp_path / "cache/gknet"
    assert not (tmp_path / "nobody").exists()


def test_a_folder_of_another_user_is_not_trusted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(variants, "_user", lambda: os.getuid() + 1)
    with pytest.raises(GknetError, match=r"Dr\.Jit.*home/\.drjit.*set HOME"):
        drjit_home()


def test_without_any_folder_the_remedy_is_named(tmp_path: Path) -> None:
    for name in ("home", "cache", "tmp"):
        block(tmp_path / name)
    with pytest.raises(GknetError, match=r"tmp/gknet-\d+/\.drjit.*set HOME") as caught:
        drjit_home()
    assert "\n" not in str(caught.value)


def test_mitsuba_starts_without_a_home_and_leaves_the_variable_alone(tmp_path: Path) -> None:
    code = """
import os
from gknet.render.variant import load_engine
load_engine("scalar_rgb")
print("HOME" in os.environ)
"""
    environment = {key: value for key, value in os.environ.items() if key not in ("HOME", "XDG_CACHE_HOME")}
    environment["TMPDIR"] = str(tmp_path / "tmp")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False)
    assert (done.returncode, done.stdout) == (0, "False\n"), done.stderr
    assert list((tmp_path / "tmp").glob("gknet-*/.drjit"))
