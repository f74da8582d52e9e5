"""Every example runs, without arguments on a bundled frame or with what its docstring asks for."""

from __future__ import annotations

import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import cv2
import pytest

from gknet.dataset.skd import SkdDataset
from tests.docs.pages import ROOT
from tests.docs.reader import terminal

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
DEMO = Path(str(files("gknet"))) / "demo_data"
FRAMES = sorted((DEMO / "data" / "000115" / "image").glob("*.jpg"))
PRINTS = {
    "covariance_ellipse.py": "wrote ellipses.png",
    "evaluate_dataset.py": "median of 8 frames",
    "pose_from_image.py": "quaternion",
}
VIDEO = "poses_from_video.py"


def run(example: Path, folder: Path, *words: str, code: int = 0) -> str:
    command = [sys.executable, str(example), *words]
    done = subprocess.run(command, cwd=folder, env=terminal(folder), capture_output=True, text=True, timeout=300)
    assert done.returncode == code, f"{example.name}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout + done.stderr


def film(path: Path, frames: int) -> Path:
    """A video of bundled frames."""
    images = [cv2.imread(str(frame)) for frame in FRAMES[:frames]]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 5, (1024, 1024))
    for image in images:
        assert image is not None
        writer.write(image)
    writer.release()
    return path


def test_every_example_is_tested() -> None:
    assert {path.name for path in EXAMPLES} == {*PRINTS, VIDEO}


@pytest.mark.parametrize("name", sorted(PRINTS))
def test_example(name: str, tmp_path: Path) -> None:
    assert PRINTS[name] in run(ROOT / "examples" / name, tmp_path)


def test_poses_of_a_video_are_those_of_its_frames(tmp_path: Path) -> None:
    """Each frame has a line, and the depth is near the truth."""
    truth = SkdDataset(DEMO, "test", "satellite_01")[0].cam_from_body
    assert truth is not None
    lines = run(ROOT / "examples" / VIDEO, tmp_path, str(film(tmp_path / "film.mp4", 2))).splitlines()
    assert len(lines) == 2
    assert float(lines[0].split()[4]) == pytest.approx(truth.translation_m[2], rel=0.05)


@pytest.mark.parametrize("name", ["pose_from_image.py", VIDEO])
def test_a_file_that_cannot_be_read_ends_in_one_line(name: str, tmp_path: Path) -> None:
    printed = run(ROOT / "examples" / name, tmp_path, "absent.mp4", code=1)
    assert "absent.mp4: cannot be read" in printed
    assert "Traceback" not in printed
