"""What a tutorial shows runs, from the first block to the last, in an empty folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.docs.pages import ROOT
from tests.docs.reader import read


def test_first_pose_and_the_pages_that_go_on_from_it(tmp_path: Path) -> None:
    printed = read("tutorials/first-pose.md", tmp_path)
    assert "attitude off by" in printed
    assert len(list((tmp_path / "predictions" / "overlays").glob("*.jpg"))) == 8
    assert "000121" in read("howto/poses-file.md", tmp_path, "python")
    assert "512" in read("howto/camera.md", tmp_path, "python")


@pytest.mark.slow
def test_render_train_export_predict(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    pytest.importorskip("torch")
    read("tutorials/train-your-own.md", tmp_path)
    assert {path.name for path in (tmp_path / "models" / "mine").glob("*.onnx")} == {"keypoints.onnx", "locator.onnx"}
    assert (tmp_path / "evaluation" / "report.html").stat().st_size > 10_000


@pytest.mark.slow
def test_paper_comparison(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    pytest.importorskip("torch")
    (tmp_path / "experiments").symlink_to(ROOT / "experiments")
    assert "GKNet" in read("tutorials/paper-comparison.md", tmp_path)


@pytest.mark.slow
def test_own_spacecraft(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    pytest.importorskip("torch")
    read("howto/own-spacecraft.md", tmp_path)
    assert {path.name for path in (tmp_path / "models" / "mysat").glob("*.onnx")} == {"keypoints.onnx", "locator.onnx"}
