"""Records of estimates: what goes in comes out, NaN does not, and files are whole or absent."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gknet.frame import Box, Estimate, Failure, FailureKind, Keypoints
from gknet.geometry import Pose
from gknet.io.pose_file import PoseWriter, csv_columns, csv_row, record, unreadable_record

NAMES = ("a", "b")


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
    other = PoseWriter(tmp_path / "other.csv", NAMES, "csv")
    with pytest.raises(KeyboardInterrupt):
        interrupted(other)
    assert [path.name for path in tmp_path.iterdir()] == ["poses.jsonl"]
