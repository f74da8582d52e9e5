"""`gknet predict`: what it writes for good input, and how it refuses the rest."""

from __future__ import annotations

import csv
import errno
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy import ndarray

from gknet.cli.main import run
from gknet.cli.model_options import open_estimator
from gknet.dataset.skd import SkdDataset
from gknet.frame import Box, Estimate, Frame
from gknet.geometry import Camera
from gknet.inference.keypoint_estimator import KeypointEstimator
from gknet.inference.load import shipped_folder
from gknet.io.image import read_image, write_image
from gknet.io.interrupt import Interrupted
from gknet.io.lock import LOCK_NAME
from gknet.io.video import VideoWriter, open_video
from tests.cli.toy import FOCAL_PX, SIZE, Noting, ToyEstimator, picture_number, toy_picture, toy_pose

Use = Callable[[ToyEstimator], None]
Refused = Callable[..., str]
LENS = ("--focal-px", str(FOCAL_PX))
MODEL = ("--spacecraft", "toycraft")


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    folder = tmp_path / "pictures"
    (folder / "deep").mkdir(parents=True)
    for number, name in enumerate(("a.jpg", "b.png", "deep/c.jpg")):
        write_image(folder / name, toy_picture(number))
    return folder


@pytest.fixture
def film(tmp_path: Path) -> Path:
    path = tmp_path / "film.mp4"
    with VideoWriter(path, 5) as writer:
        for number in range(6):
            writer.write(toy_picture(number))
    return path


def predict(*arguments: object) -> int:
    return run(["predict", *(str(argument) for argument in arguments)])


def records(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "poses.jsonl").read_text().splitlines()]


def leftovers(out: Path) -> list[Path]:
    """What a run left, but for the lock."""
    return [path for path in out.rglob("*") if path.is_file() and path.name != LOCK_NAME] if out.exists() else []


def test_one_image(use: Use, pictures: Path, tmp_path: Path) -> None:
    use(ToyEstimator())
    out = tmp_path / "out"
    assert predict(pictures / "a.jpg", *MODEL, *LENS, "--out", out) == 0
    (record,) = records(out)
    truth = toy_pose(0)
    assert (record["name"], record["status"], record["failure"]) == ("a.jpg", "ok", None)
    assert np.allclose(record["translation_m"], truth.translation_m, rtol=1e-8)
    assert np.allclose(record["quaternion_wxyz"], truth.quaternion_wxyz, atol=1e-8)
    assert np.shape(record["covariance"]) == (6, 6)
    assert record["inlier_count"] == len(record["keypoints"]) == 13
    assert record["keypoints"][12]["name"] == "mast"
    overlay = read_image(out / "overlays" / "a.jpg")
    assert max(overlay.shape) == 3 * SIZE
    assert sorted(path.name for path in leftovers(out)) == ["a.jpg", "poses.jsonl", "prediction.json"]


@pytest.mark.parametrize(
    ("camera", "warned"),
    [
        (("--focal-px", "350"), True),
        (("--camera", "k.txt"), True),
        (("--hfov-deg", "40"), False),
        (("--camera", "k.txt", "--camera-size", "256x256", "--scale-camera"), False),
    ],
)
def test_one_focal_length_for_several_sizes_is_a_warning(
    camera: tuple[str, ...], warned: bool, use: Use, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    use(ToyEstimator())
    matrix = tmp_path / "k.txt"
    matrix.write_text("350 0 128\n0 350 128\n0 0 1\n")
    options = [str(matrix) if word == "k.txt" else word for word in camera]
    (tmp_path / "in").mkdir()
    for number, size in enumerate((256, 256, 288)):
        write_image(tmp_path / "in" / f"{number}.png", toy_picture(number, size))
    assert predict(tmp_path / "in", *MODEL, *options, "--no-overlay", "--out", tmp_path / "out") == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "focal length" in line]
    assert len(lines) == warned
    assert all("several sizes, 256x256, 288x288: " in line for line in lines)


def test_folder_goes_on_past_bad_pictures(
    use: Use, pictures: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    use(ToyEstimator(blind=frozenset({1}), ambiguous=frozenset({2})))
    data = (pictures / "a.jpg").read_bytes()
    (pictures / "half.jpg").write_bytes(data[: len(data) // 2])
    (pictures / "text.png").write_text("no image")
    out = tmp_path / "out"
    assert predict(pictures, *MODEL, *LENS, "--out", out) == 0
    status = {record["name"]: record["status"] for record in records(out)}
    assert status == {
        "a.jpg": "ok",
        "b.png": "no pose",
        "deep/c.jpg": "ok",
        "half.jpg": "unreadable",
        "text.png": "unreadable",
    }
    words = capsys.readouterr().out
    assert "pose found in 2 of 5 images, 3 failed" in words
    assert "truncated" in words
    assert "1 of the poses may be that of a symmetric counterpart" in words
    assert [record.get("attitude_confidence") for record in records(out)] == [0.9, None, 0.2, None, None]
    assert (out / "overlays" / "deep_c.jpg").exists()


def test_csv_says_the_same_as_jsonl(use: Use, pictures: Path, tmp_path: Path) -> None:
    use(ToyEstimator(error=1.0, blind=frozenset({1})))
    out = tmp_path / "out"
    for layout in ("jsonl", "csv"):
        assert predict(pictures, *MODEL, *LENS, "--out", out, "--format", layout, "--no-overlay") == 0
    with open(out / "poses.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    for row, record in zip(rows, records(out), strict=True):
        failure = record["failure"] or {"kind": "", "detail": ""}
        assert (row["name"], row["status"]) == (record["name"], record["status"])
        assert (row["failure_kind"], row["failure_detail"]) == (failure["kind"], failure["detail"])
        if record["status"] == "ok":
            assert [float(row[key]) for key in ("tx_m", "ty_m", "tz_m")] == record["translation_m"]
            assert [float(row[key]) for key in ("qw", "qx", "qy", "qz")] == record["quaternion_wxyz"]
            assert float(row["covariance_35"]) == record["covariance"][3][5]
            assert float(row["mast_x"]) == record["keypoints"][12]["pixel"][0]
        else:
            assert row["tx_m"] == row["mast_score"] == ""
    assert not (out / "overlays").exists()


def test_video_in_and_out(use: Use, film: Path, tmp_path: Path) -> None:
    use(ToyEstimator())
    out = tmp_path / "out"
    assert predict(film, *MODEL, *LENS, "--out", out, "--video", "--every", 2) == 0
    found = records(out)
    assert [record["name"] for record in found] == ["film/000000", "film/000002", "film/000004"]
    assert [record["time_s"] for record in found] == pytest.approx([0, 0.4, 0.8])
    assert np.allclose(found[2]["translation_m"], toy_pose(4).translation_m, rtol=1e-8)
    video = open_video(out / "overlay.mp4")
    assert (video.announced, video.width, video.fps) == (3, 3 * SIZE, 2.5)


def test_dataset_brings_its_camera_and_truth(use: Use, dataset: Path, tmp_path: Path) -> None:
    use(ToyEstimator())
    out = tmp_path / "out"
    assert predict(dataset, *MODEL, "--oracle", "--split", "test", "--every", 2, "--out", out) == 0
    found = records(out)
    assert [record["name"] for record in found] == [f"00000{s}/00000{i}" for s in (1, 2) for i in (1, 3, 5)]
    assert all(record["status"] == "ok" for record in found)


def test_dataset_passes_over_a_lost_image(use: Use, tmp_path: Path) -> None:
    from tests.cli.toy import write_toy_dataset

    use(ToyEstimator())
    root = write_toy_dataset(tmp_path / "set", sequences=1, frames=3)
    (root / "data" / "000001" / "image" / "000002.jpg").unlink()
    out = tmp_path / "out"
    assert predict(root, *MODEL, "--out", out) == 0
    assert [record["status"] for record in records(out)] == ["ok", "unreadable", "ok"]


def test_the_truth_is_taken_only_when_it_is_asked_for(use: Use, dataset: Path, tmp_path: Path) -> None:
    for words, boxes in (((), [None] * 10), (("--oracle",), [frame_box(dataset, i) for i in range(10)])):
        estimator = Noting()
        use(estimator)
        assert predict(dataset, *MODEL, "--no-overlay", "--overwrite", "--out", tmp_path / "out", *words) == 0
        assert estimator.given == boxes


def frame_box(dataset: Path, i: int) -> Box | None:
    frames = SkdDataset(dataset)
    return frames.frame(i, image=False).true_box(frames.spacecraft.points_m)


def test_box_is_used(use: Use, pictures: Path, tmp_path: Path) -> None:
    use(ToyEstimator())
    out = tmp_path / "out"
    assert predict(pictures / "a.jpg", *MODEL, *LENS, "--box", "10,20,200,210.5", "--out", out) == 0
    assert records(out)[0]["box"] == [10, 20, 200, 210.5]


def test_no_pose_at_all_is_two_but_is_recorded(use: Use, refused: Refused, pictures: Path, tmp_path: Path) -> None:
    use(ToyEstimator(blind=frozenset({0})))
    out = tmp_path / "out"
    line = refused("predict", pictures / "a.jpg", *MODEL, *LENS, "--out", out)
    assert "no pose in any of 1 image; the first, a.jpg: the locator finds no spacecraft" in line
    assert records(out)[0]["failure"]["kind"] == "no_spacecraft"


CAMERA_TEXTS = {
    "not JSON": ("camera.json", "{", "not valid JSON"),
    "a list": ("camera.json", "[1, 2]", "expected a JSON object"),
    "unknown key": (
        "camera.json",
        '{"matrix": [[1,0,0],[0,1,0],[0,0,1]], "width": 9, "height": 9, "f": 1}',
        "unknown key f",
    ),
    "missing key": ("camera.json", '{"matrix": [[1,0,0],[0,1,0],[0,0,1]], "width": 9}', "missing height"),
    "2 x 3": ("camera.json", '{"matrix": [[1,0,0],[0,1,0]], "width": 9, "height": 9}', "expected shape (3, 3)"),
    "ragged": ("camera.json", '{"matrix": [[1,0],[0,1,0]], "width": 9, "height": 9}', "camera matrix"),
    "NaN": ("camera.json", '{"matrix": [[NaN,0,4],[0,9,4],[0,0,1]], "width": 9, "height": 9}', "NaN"),
    "words": ("camera.json", '{"matrix": "K", "width": 9, "height": 9}', "camera matrix"),
    "half a pixel": ("camera.json", '{"matrix": [[9,0,4],[0,9,4],[0,0,1]], "width": 9.5, "height": 9}', "width"),
    "other size": ("camera.json", '{"matrix": [[9,0,4],[0,9,4],[0,0,1]], "width": 9, "height": 9}', "256 x 256"),
    "text 2 x 3": ("camera_matrix.txt", "1, 2, 3\n4, 5, 6\n", "3 x 3"),
    "text words": ("camera_matrix.txt", "a, b, c\n1, 2, 3\n1, 2, 3\n", "expected a camera file"),
    "text NaN": ("camera_matrix.txt", "1, nan, 1\n0, 1, 1\n0, 0, 1\n", "finite"),
}


@pytest.mark.parametrize("case", CAMERA_TEXTS)
def test_bad_cameras(case: str, use: Use, refused: Refused, pictures: Path, tmp_path: Path) -> None:
    use(ToyEstimator())
    name, text, words = CAMERA_TEXTS[case]
    (tmp_path / name).write_text(text)
    out = tmp_path / "out"
    assert words in refused("predict", pictures / "a.jpg", *MODEL, "--camera", tmp_path / name, "--out", out)


BAD_OPTIONS = {
    "no camera": ((*MODEL,), "--focal-px"),
    "two cameras": ((*MODEL, *LENS, "--hfov-deg", "30"), "one of the three"),
    "missing camera file": ((*MODEL, "--camera", "none.json"), "none.json"),
    "negative focal": ((*MODEL, "--focal-px", "-3"), "focal length"),
    "NaN focal": ((*MODEL, "--focal-px", "nan"), "focal length"),
    "wide field": ((*MODEL, "--hfov-deg", "181"), "field of view"),
    "no model": (LENS, "--spacecraft NAME"),
    "two models": ((*MODEL, "--model", "here", *LENS), "--spacecraft NAME"),
    "three numbers": ((*MODEL, *LENS, "--box", "1,2,3"), "--box"),
    "words": ((*MODEL, *LENS, "--box", "a,b,c,d"), "--box"),
    "empty box": ((*MODEL, *LENS, "--box", "10,10,5,20"), "x0 < x1"),
    "NaN box": ((*MODEL, *LENS, "--box", "nan,10,5,20"), "box"),
    "box and oracle": ((*MODEL, *LENS, "--box", "1,2,3,4", "--oracle"), "one of the two"),
    "oracle without truth": ((*MODEL, *LENS, "--oracle"), "true poses"),
    "every 0": ((*MODEL, *LENS, "--every", "0"), "every"),
    "no threads": ((*MODEL, *LENS, "--threads", "0"), "--threads"),
    "infinite every": ((*MODEL, *LENS, "--every", "inf"), "--every"),
    "many threads": ((*MODEL, *LENS, "--threads", "99999"), "--threads"),
    "infinite focal": ((*MODEL, "--focal-px", "inf"), "focal length"),
    "NaN field": ((*MODEL, "--hfov-deg", "nan"), "field of view"),
    "infinite box": ((*MODEL, *LENS, "--box", "0,0,inf,9"), "box"),
    "no camera to scale": ((*MODEL, *LENS, "--scale-camera"), "--camera FILE"),
    "size of no camera": ((*MODEL, *LENS, "--camera-size", "9x9"), "--camera FILE"),
    "size in words": ((*MODEL, "--camera", "c.json", "--camera-size", "big"), "WxH"),
    "resume and overwrite": ((*MODEL, *LENS, "--resume", "--overwrite"), "one of the two"),
    "resume of a film": ((*MODEL, *LENS, "--resume", "--video"), "one of the two"),
    "unknown layout": ((*MODEL, *LENS, "--format", "xml"), "xml"),
}


@pytest.mark.parametrize("case", BAD_OPTIONS)
def test_bad_options(case: str, use: Use, refused: Refused, pictures: Path, tmp_path: Path) -> None:
    use(ToyEstimator())
    options, words = BAD_OPTIONS[case]
    out = tmp_path / "out"
    assert words in refused("predict", pictures / "a.jpg", *options, "--out", out)
    assert leftovers(out) == []


def test_bad_inputs(use: Use, refused: Refused, pictures: Path, film: Path, tmp_path: Path) -> None:
    use(ToyEstimator())
    out = tmp_path / "out"
    whole = (pictures / "a.jpg").read_bytes()
    (tmp_path / "half.jpg").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "empty.jpg").write_bytes(b"")
    (tmp_path / "words.jpg").write_text("no image")
    (tmp_path / "words.mp4").write_text("no video")
    (tmp_path / "cut.mp4").write_bytes(film.read_bytes()[:300])
    (tmp_path / "nothing").mkdir()
    cases = {
        "missing.jpg": "no such image",
        "half.jpg": "truncated",
        "empty.jpg": "empty",
        "words.jpg": "expected an image",
        "words.mp4": "video",
        "cut.mp4": "video",
        "nothing": "no image in this folder",
    }
    for name, words in cases.items():
        assert words in refused("predict", tmp_path / name, *MODEL, *LENS, "--out", out), name


def test_video_without_frames(use: Use, refused: Refused, tmp_path: Path) -> None:
    use(ToyEstimator())
    path = tmp_path / "hollow.avi"
    cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 5, (64, 64)).release()
    assert "video" in refused("predict", path, *MODEL, *LENS, "--out", tmp_path / "out")


def test_turns_reach_the_estimator(refused: Refused, pictures: Path, tmp_path: Path) -> None:
    estimator = open_estimator(shipped_folder("satellite_01"), 1, "cpu", 4)
    assert isinstance(estimator, KeypointEstimator)
    assert estimator.settings.tta_rotations == 4
    shipped = ("--spacecraft", "satellite_01", *LENS)
    line = refused("predict", pictures / "a.jpg", *shipped, "--tta-rotations", "3", "--out", tmp_path / "out")
    assert "1, 2 or 4" in line
    assert "got 3" in line


def test_unknown_spacecraft(refused: Refused, pictures: Path, tmp_path: Path) -> None:
    line = refused("predict", pictures / "a.jpg", "--spacecraft", "satellite_99", *LENS, "--out", tmp_path / "out")
    assert "satellite_99" in line
    line = refused("predict", pictures / "a.jpg", "--model", tmp_path, *LENS, "--out", tmp_path / "out")
    assert "keypoints.onnx" in line


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("test.json", "{", "not valid JSON"),
        ("test.json", '["data/000001"]', "expected"),
        ("data/000001/annotations.csv", "category,position\n", "orientation"),
        ("data/000001/annotations.csv", "category,position,orientation\nToycraft,[1,2,3]\n", "cells"),
        ("data/000001/keypoints.txt", "1, 2\n", "three"),
        ("data/000001/camera_matrix.txt", "1, 2, 3\n4, 5, 6\n", "3 x 3"),
        ("spacecraft/toycraft.toml", "name = ", "not valid TOML"),
        ("spacecraft/toycraft.toml", 'name = "toycraft"\nmass = 3\n', "toycraft.toml"),
    ],
)
def test_bad_datasets(name: str, text: str, words: str, use: Use, refused: Refused, tmp_path: Path) -> None:
    from tests.cli.toy import write_toy_dataset

    use(ToyEstimator())
    root = write_toy_dataset(tmp_path / "set", sequences=1, frames=1)
    (root / name).write_text(text)
    out = tmp_path / "out"
    assert words in refused("predict", root, *MODEL, "--out", out)
    assert leftovers(out) == []


def stop_at(monkeypatch: pytest.MonkeyPatch, error: BaseException, picture: int) -> None:
    """Raise inside the estimator at an image."""
    honest = ToyEstimator.estimate
    pictures = []

    def estimate(self: ToyEstimator, image: ndarray, camera: Camera, box: Box | None = None) -> Estimate:
        pictures.append(image)
        if len(pictures) > picture:
            raise error
        return honest(self, image, camera, box)

    monkeypatch.setattr(ToyEstimator, "estimate", estimate)


def test_interrupt_keeps_what_was_found_and_resume_goes_on(
    use: Use, refused: Refused, pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(ToyEstimator())
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        stop_at(patch, Interrupted(signal.SIGTERM), 2)
        refused("predict", pictures, *MODEL, *LENS, "--out", out, code=143)
    assert [record["name"] for record in records(out)] == ["a.jpg", "b.png"]
    first = (out / "poses.jsonl").read_text()
    estimator = Noting()
    use(estimator)
    assert predict(pictures, *MODEL, *LENS, "--out", out, "--resume") == 0
    assert len(estimator.given) == 1
    assert (out / "poses.jsonl").read_text().startswith(first)
    whole = tmp_path / "whole"
    assert predict(pictures, *MODEL, *LENS, "--out", whole) == 0
    assert records(out) == records(whole)
    assert sorted(path.name for path in leftovers(out)) == sorted(path.name for path in leftovers(whole))


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stop_signal_ends_after_the_picture_and_says_what_is_kept(
    number: int, code: int, use: Use, refused: Refused, film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(ToyEstimator())
    honest = ToyEstimator.estimate

    def estimate(self: ToyEstimator, image: ndarray, camera: Camera, box: Box | None = None) -> Estimate:
        os.kill(os.getpid(), number)
        return honest(self, image, camera, box)

    monkeypatch.setattr(ToyEstimator, "estimate", estimate)
    out = tmp_path / "out"
    line = refused("predict", film, *MODEL, *LENS, "--video", "--out", out, code=code)
    assert f"interrupted; {out} holds the results of 1 image;" in line
    assert "--resume" in line
    assert len(records(out)) == 1
    assert open_video(out / "overlay.mp4").announced == 1


def test_an_interrupted_rerun_leaves_the_better_result(
    use: Use, refused: Refused, pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(ToyEstimator())
    out = tmp_path / "out"
    assert predict(pictures, *MODEL, *LENS, "--out", out) == 0
    before = records(out)
    stop_at(monkeypatch, KeyboardInterrupt(), 1)
    refused("predict", pictures, *MODEL, *LENS, "--out", out, code=130)
    assert records(out) == before


def test_a_full_disk_costs_overlays_and_no_pose(
    use: Use, pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    use(ToyEstimator())

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("gknet.predict.overlay_files.write_image", full)
    monkeypatch.setattr("gknet.io.video.VideoWriter.write", full)
    out = tmp_path / "out"
    assert predict(pictures, *MODEL, *LENS, "--video", "--out", out) == 0
    assert len(records(out)) == 3
    words = capsys.readouterr().err
    assert "warning: 3 overlays could not be written; the first, a.jpg: " in words
    assert "warning: 3 video frames could not be written" in words


def test_results_of_another_run_are_refused_and_replaced_when_asked(
    use: Use, refused: Refused, pictures: Path, film: Path, tmp_path: Path
) -> None:
    use(ToyEstimator())
    out = tmp_path / "out"
    assert predict(pictures, *MODEL, *LENS, "--out", out) == 0
    before = records(out)
    assert predict(pictures, *MODEL, *LENS, "--out", out) == 0
    for extra in ((), ("--resume",)):
        line = refused("predict", film, *MODEL, *LENS, "--out", out, *extra)
        assert "another run (inputs" in line
        assert "--overwrite" in line
        assert records(out) == before
    assert predict(film, *MODEL, *LENS, "--out", out, "--overwrite") == 0
    assert sorted(path.name for path in (out / "overlays").iterdir()) == [f"film_00000{k}.jpg" for k in range(6)]
    (out / "prediction.json").unlink()
    assert "there is no prediction.json" in refused("predict", film, *MODEL, *LENS, "--out", out)


def test_pictures_of_like_names_have_overlays_of_their_own(use: Use, tmp_path: Path) -> None:
    use(ToyEstimator())
    names = ("cam1/0001.jpg", "cam1_0001.jpg", "cam1_0001.png", "CAM1_0001.bmp")
    folder = tmp_path / "pictures"
    (folder / "cam1").mkdir(parents=True)
    for number, name in enumerate(names):
        write_image(folder / name, toy_picture(number))
    out = tmp_path / "out"
    assert predict(folder, *MODEL, *LENS, "--out", out) == 0
    assert len(list((out / "overlays").iterdir())) == 4


ODD_NAMES = {
    "not UTF-8": os.fsdecode(b"caf\xe9"),
    "250 bytes": "z" * 246,
    "a formula": "=cmd|' !A0",
    "escape": "a\x1b[31mb\x07",
    "markup": "[red]a [v2]",
    "colon": "a:b?c*",
    "a line end": "a\nb",
    "no Latin": "衛星",
}


@pytest.mark.parametrize("layout", ["jsonl", "csv"])
@pytest.mark.parametrize("case", ODD_NAMES)
def test_odd_names(case: str, layout: str, use: Use, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    use(ToyEstimator(blind=frozenset({1})))
    folder = tmp_path / f"in {ODD_NAMES[case][:100]}"
    folder.mkdir()
    for number, suffix in enumerate((".jpg", ".png")):
        write_image(folder / "a.png", toy_picture(number))
        os.replace(folder / "a.png", folder / f"{ODD_NAMES[case]}{suffix}")
    out = tmp_path / f"out {ODD_NAMES[case][:100]}"
    assert predict(folder, *MODEL, *LENS, "--out", out, "--format", layout, "--video") == 0
    printed = capsys.readouterr()
    for text in (printed.out, printed.err):
        text.encode("utf-8")
        assert not set(text) & {"\x1b", "\x07"}
    assert len(list((out / "overlays").iterdir())) == 2
    assert (out / "overlay.mp4").exists()
    text = (out / f"poses.{layout}").read_text(encoding="utf-8")
    assert len(text.splitlines()) == 2 + (layout == "csv")
    assert not any(line.startswith(("=", '"=')) for line in text.splitlines())
    assert predict(folder, *MODEL, *LENS, "--out", out, "--format", layout, "--resume") == 0
    assert (out / f"poses.{layout}").read_text(encoding="utf-8") == text
    assert "2 of them from an earlier run" in capsys.readouterr().out


def test_an_oracle_without_keypoints_in_view_is_a_failure_of_its_kind(
    use: Use, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    estimator = Noting()
    use(estimator)
    honest = Frame.true_box
    monkeypatch.setattr(
        Frame, "true_box", lambda frame, points: None if frame.name.endswith("/000002") else honest(frame, points)
    )
    out = tmp_path / "out"
    assert predict(dataset, *MODEL, "--oracle", "--no-overlay", "--out", out) == 0
    assert None not in estimator.given
    kinds = [record["failure"]["kind"] for record in records(out) if record["failure"]]
    assert kinds == ["no_keypoint_in_view"] * 2


def test_one_picture_that_the_estimator_refuses_costs_no_other(
    use: Use, pictures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use(ToyEstimator())
    honest = ToyEstimator.estimate

    def estimate(self: ToyEstimator, image: ndarray, camera: Camera, box: Box | None = None) -> Estimate:
        if picture_number(image) == 1:
            raise MemoryError
        return honest(self, image, camera, box)

    monkeypatch.setattr(ToyEstimator, "estimate", estimate)
    out = tmp_path / "out"
    assert predict(pictures, *MODEL, *LENS, "--out", out) == 0
    assert [record["status"] for record in records(out)] == ["ok", "unreadable", "ok"]


def test_out_is_a_file(use: Use, refused: Refused, pictures: Path, tmp_path: Path) -> None:
    use(ToyEstimator())
    (tmp_path / "out").write_text("here")
    assert "out" in refused("predict", pictures, *MODEL, *LENS, "--out", tmp_path / "out")
