"""A folder of results: one run at a time, never two runs mixed, nothing left of a killed one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.frame import Estimate, Failure, FailureKind, Frame, Unreadable
from gknet.io.lock import LOCK_NAME
from gknet.predict.results import PredictionWriter
from gknet.predict.run_record import RunRecord, load_record
from tests.cli.toy import CAMERA, ToyEstimator, toy_picture, toy_spacecraft

SPACECRAFT = toy_spacecraft()
RECORD = RunRecord(inputs=("/in",), model="/models/a")


def writer(folder: Path, **options: object) -> PredictionWriter:
    return PredictionWriter(folder, SPACECRAFT, **{"record": RECORD, "overlays": False, **options})  # type: ignore[arg-type]


def frame(number: int) -> Frame:
    return Frame(f"{number}.jpg", toy_picture(number), CAMERA)


def estimate(number: int) -> Estimate:
    return ToyEstimator().estimate(toy_picture(number), CAMERA)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name != LOCK_NAME)


def test_an_unused_folder_is_left_as_it_was(tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "out"
    with writer(folder):
        assert folder.exists()
    assert not folder.exists()
    with pytest.raises(GknetError, match="nothing"), writer(tmp_path):
        raise GknetError("nothing")
    assert names(tmp_path) == ["deep"]


def test_two_writers_at_once_are_refused(tmp_path: Path) -> None:
    with writer(tmp_path) as first:
        with pytest.raises(GknetError, match="another gknet command"), writer(tmp_path):
            pass
        first.add(frame(0), estimate(0))
    assert names(tmp_path) == ["poses.jsonl", "prediction.json"]


def test_a_folder_that_cannot_be_written_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"), writer(tmp_path / "file" / "out"):
        pass


def test_counts_and_resumed_counts_agree(tmp_path: Path) -> None:
    ambiguous = replace(estimate(1), attitude_confidence=0.1)
    dark = Estimate(failure=Failure(FailureKind.NO_SPACECRAFT, "dark"))
    with writer(tmp_path) as first:
        first.add(frame(0), estimate(0))
        first.add(frame(1), ambiguous)
        first.add(frame(2), dark)
        first.add_unreadable(Unreadable.because("3.jpg", "gone"))
    with writer(tmp_path, existing="resume") as second:
        assert [second.is_kept(f"{k}.jpg") for k in range(4)] == [True, True, True, False]
        assert not second.is_kept("0.jpg"), "a name counts as often as it was written"
        second.add(frame(3), estimate(3))
    assert (second.pose_count, second.ambiguous_count, second.kept_count, second.count) == (3, 1, 3, 4)
    assert [failure.name for failure in second.failures] == ["2.jpg"]
    assert second.failures[0].failure == dark.failure


def test_resume_takes_what_a_killed_run_left(tmp_path: Path) -> None:
    with writer(tmp_path) as first:
        for number in range(3):
            first.add(frame(number), estimate(number))
    text = (tmp_path / "poses.jsonl").read_text()
    (tmp_path / "poses.jsonl").unlink()
    (tmp_path / ".poses.jsonl.0123456789abcdef.tmp").write_text(text[:-50])
    (tmp_path / ".overlay.mp4.0123456789abcdef.tmp.mp4").write_text("")
    with writer(tmp_path, existing="resume") as second:
        second.add(frame(2), estimate(2))
    assert second.kept_count == 2
    assert (tmp_path / "poses.jsonl").read_text() == text
    assert names(tmp_path) == ["poses.jsonl", "prediction.json"]


def test_a_run_without_a_pose_stands_in_nobodys_way(tmp_path: Path) -> None:
    with writer(tmp_path) as first:
        first.add_unreadable(Unreadable.because("a.jpg", "gone"))
    other = replace(RECORD, every=2)
    with writer(tmp_path, record=other) as second:
        second.add(frame(0), estimate(0))
    assert load_record(tmp_path) == other
    with pytest.raises(GknetError, match="every 2, not 1"), writer(tmp_path):
        pass


def test_files_that_gknet_did_not_make_are_refused(tmp_path: Path) -> None:
    (tmp_path / "poses.jsonl").write_text("mine\n")
    with pytest.raises(GknetError, match="--overwrite"), writer(tmp_path, existing="resume"):
        pass
    assert (tmp_path / "poses.jsonl").read_text() == "mine\n"


def test_the_same_run_again_leaves_no_overlay_of_a_picture_that_is_gone(tmp_path: Path) -> None:
    with writer(tmp_path, overlays=True) as first:
        for number in range(2):
            first.add(frame(number), estimate(number))
    (tmp_path / "overlays" / "mine.jpg").write_bytes(b"")
    with writer(tmp_path, overlays=True) as second:
        second.add(frame(0), estimate(0))
    assert names(tmp_path / "overlays") == ["0.jpg", "mine.jpg"]


def test_a_drawing_that_fails_costs_no_pose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> np.ndarray:
        raise ZeroDivisionError

    monkeypatch.setattr("gknet.predict.results.draw_overlay", fail)
    with writer(tmp_path, overlays=True, fps=5.0) as results:
        results.add(frame(0), estimate(0))
    assert results.pose_count == 1
    assert results.losses == ["1 overlay could not be written; the first, 0.jpg: ZeroDivisionError"]
    assert names(tmp_path) == ["poses.jsonl", "prediction.json"]
