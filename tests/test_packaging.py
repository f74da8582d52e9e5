"""What is installed: metadata, the console command, the data that the wheel carries, its size."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import gknet

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WHEEL_LIMIT_BYTES = 60e6


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def required() -> set[str]:
    lists = [PROJECT["dependencies"], *PROJECT["optional-dependencies"].values()]
    return {normal(re.split(r"[<>=!~\[; ]", line)[0]) for lines in lists for line in lines}


def pinned() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pairs = (line.split("==") for line in lines if line and not line.startswith("#"))
    return {normal(name): version for name, version in pairs}


def test_version_is_stated_once_and_the_same() -> None:
    assert PROJECT["version"] == gknet.__version__
    assert f"version: {gknet.__version__}" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_every_direct_dependency_is_pinned() -> None:
    assert required() <= set(pinned())


def test_every_direct_dependency_has_its_licence_listed() -> None:
    listed = (ROOT / "docs" / "licences.md").read_text(encoding="utf-8").lower()
    rows = {normal(row.split("|")[1].strip()) for row in listed.splitlines() if row.startswith("|")}
    assert required() <= rows


def test_console_command_prints_the_version() -> None:
    run = subprocess.run([sys.executable, "-m", "gknet.cli.main", "--help"], capture_output=True, text=True, check=True)
    assert "render" in run.stdout
    assert "predict" in run.stdout


@pytest.mark.slow
def test_wheel_carries_its_data(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "build", "--wheel", "--outdir", str(tmp_path), str(ROOT)]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout[-2000:] + run.stderr[-2000:]
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.stat().st_size < WHEEL_LIMIT_BYTES
    names = zipfile.ZipFile(wheel).namelist()
    for k in (1, 2, 3):
        assert f"gknet/fleet/satellite_0{k}.toml" in names
        assert f"gknet/models/satellite_0{k}/keypoints.onnx" in names
        assert f"gknet/models/satellite_0{k}/locator.onnx" in names
    assert any(name.startswith("gknet/demo_data/") and name.endswith(".jpg") for name in names)
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not [name for name in names if name.startswith("tests/") or name.endswith((".pyc", ".tmp", ".glb"))]
