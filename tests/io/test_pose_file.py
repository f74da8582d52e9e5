"""Records of estimates: what goes in comes out, NaN does not, and files are whole or absent."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gknet.frame import Box, Estimate, Failure, FailureKind, Keypoints
from gknet.geometry import Pose
from gknet.io.pose_file import PoseFormat, PoseWriter, csv_columns, csv_row, read_poses, record, unreadable_record

NAMES = ("a", "b")
LAYOUTS: tuple[PoseFormat, ...] = ("jsonl", "csv")


def estimate() -> Estimate:
    keypoints = Keypoints(np.array([[1.5, 2.5], [np.nan, 4]]), np.array([0.9, 0.1]), np.tile(np.eye(2), (2, 1, 1)))
    covariance = np.arange(36.0).reshape(6, 6)
    pose = Pose.from_rotation_vector([0.1, 0.2, 0.3], [1, 2, 30])
    return Estimate(
        keypoints,
        pose,
        covariance + covariance.T,
        np.array([True, False]),
        0.5,
        Box(0, 1, 2, 3),
        attitude_confidence=0.75,
    )


def test_record_holds_the_estimate() -> None:
    entry = json.loads(json.dumps(record("x", 0.5, estimate(), NAMES), allow_nan=False))
    assert (entry["name"], entry["time_s"], entry["status"], entry["failure"]) == ("x", 0.5, "ok", None)
    pose = Pose.from_quaternion(entry["quaternion_wxyz"], entry["translation_m"])
    truth, covariance = estimate().cam_from_body, estimate().covariance
    assert truth is not None
    assert covariance is not None
    assert pose.angle_to(truth) < 1e-7
    assert np.allclose(entry["covariance"], covariance)
    assert entry["keypoints"][0] == {
        "name": "a",
        "pixel": [1.5, 2.5],
        "score": 0.9,
        "covariance_px2": [[1, 0], [0, 1]],
        "inlier": True,
    }
    assert entry["keypoints"][1]["pixel"] == [None, 4]
    assert entry["attitude_confidence"] == 0.75
    assert (entry["inlier_count"], entry["reprojection_rms_px"], entry["box"]) == (1, 0.5, [0, 1, 2, 3])


def test_every_kind_of_failure_is_documented() -> None:
    page = Path(__file__).parents[2] / "docs" / "howto" / "poses-file.md"
    rows = re.findall(r"^\| `(\w+)` \|", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert [row for row in rows if row in set(FailureKind)] == [kind.value for kind in FailureKind]


def test_the_time_has_nine_digits_like_every_number() -> None:
    assert record("x", 0.1 + 0.5, estimate(), NAMES)["time_s"] == 0.6
    assert record("x", None, estimate(), NAMES)["time_s"] is None


@pytest.mark.parametrize(
    "entry",
    [
        record("x", None, estimate(), NAMES),
        record("x", 1.0, Estimate(failure=Failure(FailureKind.NO_CONSENSUS, "dark")), NAMES),
        unreadable_record("x", Failure(FailureKind.UNREADABLE_IMAGE, "truncated")),
    ],
)
def test_rows_fit_their_columns(entry: dict[str, object]) -> None:
    row = dict(zip(csv_columns(NAMES), csv_row(entry, NAMES), strict=True))
    assert row["name"] == "x"
    assert row["status"] == entry["status"]
    failure = entry["failure"] or {"kind": None, "detail": None}
    assert {"kind": row["failure_kind"], "detail": row["failure_detail"]} == failure
    assert (row["tz_m"] == 30) == (entry["status"] == "ok")


def interrupted(writer: PoseWriter) -> None:
    with writer:
        writer.add("x", None, estimate())
        raise KeyboardInterrupt


def test_file_appears_at_the_end_only(tmp_path: Path) -> None:
    path = tmp_path / "poses.jsonl"
    with PoseWriter(path, NAMES, "jsonl") as writer:
        writer.add("x", None, estimate())
        writer.add_unreadable("y", Failure(FailureKind.UNREADABLE_IMAGE, "gone"))
        assert not path.exists()
    assert [json.loads(line)["name"] for line in path.read_text().splitlines()] == ["x", "y"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_error_keeps_what_was_added(tmp_path: Path, layout: PoseFormat) -> None:
    path = tmp_path / "poses"
    with pytest.raises(KeyboardInterrupt):
        interrupted(PoseWriter(path, NAMES, layout))
    assert [line.name for line in read_poses(path, layout)] == ["x"]
    assert [each.name for each in tmp_path.iterdir()] == ["poses"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_an_error_never_replaces_more_by_less(tmp_path: Path, layout: PoseFormat) -> None:
    path = tmp_path / "poses"
    with PoseWriter(path, NAMES, layout) as writer:
        writer.add("a", None, estimate())
        writer.add("b", None, estimate())
    with pytest.raises(KeyboardInterrupt):
        interrupted(PoseWriter(path, NAMES, layout))
    assert [line.name for line in read_poses(path, layout)] == ["a", "b"]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_lines_come_back(tmp_path: Path, layout: PoseFormat) -> None:
    path = tmp_path / "poses"
    dark = Failure(FailureKind.NO_SPACECRAFT, '=dark,\n "here"')
    with PoseWriter(path, NAMES, layout) as writer:
        writer.add("=a, 'b'", 0.5, estimate())
        writer.add("b", None, replace(estimate(), attitude_confidence=0.2))
        writer.add("c", None, Estimate(failure=dark))
        writer.add_unreadable("d", Failure(FailureKind.UNREADABLE_IMAGE, "gone"))
    lines = read_poses(path, layout)
    assert [line.name for line in lines] == ["=a, 'b'", "b", "c", "d"]
    assert [line.failure and line.failure.kind for line in lines] == [
        None,
        None,
        FailureKind.NO_SPACECRAFT,
        FailureKind.UNREADABLE_IMAGE,
    ]
    assert [line.is_ambiguous for line in lines] == [False, True, False, False]
    assert [line.is_unreadable for line in lines] == [False, False, False, True]
    whole = path.read_bytes()
    with PoseWriter(path, NAMES, layout, kept=lines):
        pass
    assert path.read_bytes() == whole
    path.write_bytes(whole[:-20])
    assert [line.name for line in read_poses(path, layout)] == ["=a, 'b'", "b", "c"]
    assert read_poses(tmp_path / "none", layout) == []


def test_a_table_whose_columns_are_damaged_keeps_nothing(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    with PoseWriter(path, NAMES, "csv") as writer:
        writer.add("a", None, estimate())
    for column in ("name", "failure_detail", "attitude_confidence"):
        damaged = tmp_path / f"{column}.csv"
        damaged.write_text(path.read_text().replace(column, column[:-1], 1))
        assert read_poses(damaged, "csv") == []


def test_a_full_disk_leaves_whole_lines(tmp_path: Path) -> None:
    """With the size of files limited, the write that passes the limit fails as on a full disk."""
    code = """
import resource, signal, sys
from tests.io.test_pose_file import NAMES, estimate
from gknet.io.pose_file import PoseWriter
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))
with PoseWriter(sys.argv[1], NAMES, "jsonl") as writer:
    for k in range(1000):
        writer.add(f"{k}", None, estimate())
"""
    path = tmp_path / "poses.jsonl"
    done = subprocess.run([sys.executable, "-c", code, path], capture_output=True, text=True)
    assert "OSError" in done.stderr
    assert str(path) in done.stderr.splitlines()[-1]
    text = path.read_text()
    assert len(text) > 3000
    assert [json.loads(line)["name"] for line in text.splitlines()] == [f"{k}" for k in range(text.count("\n"))]
