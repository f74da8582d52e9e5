"""Estimates as text: one JSON object or one CSV row for each image, in a file that appears when the run ends."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Literal

import numpy as np
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import AMBIGUOUS_BELOW, Estimate, Failure, FailureKind
from gknet.io.atomic import replacing
from gknet.io.text import parse_json, read_text, spreadsheet_text, writable

PoseFormat = Literal["jsonl", "csv"]

_COVARIANCE_CELLS = tuple((i, j) for i in range(6) for j in range(i, 6))


def _plain(value: ndarray | float | None) -> object:
    """A float, or nested lists of them, with nine digits; NaN, which JSON lacks, becomes None."""
    if value is None:
        return None
    array = np.asarray(value, dtype=np.float64)
    if array.ndim:
        return [_plain(item) for item in array]
    return float(f"{float(array):.9g}") if np.isfinite(array) else None


def record(name: str, time_s: float | None, estimate: Estimate, keypoint_names: Sequence[str]) -> dict[str, object]:
    """The JSON object of one image; poses are cam_from_body, lengths in metres, pixels of the full image."""
    pose, box = estimate.cam_from_body, estimate.box
    return {
        "name": writable(name),
        "time_s": _plain(time_s),
        "status": "ok" if pose is not None else "no pose",
        "failure": _failure_record(estimate.failure) if estimate.failure else None,
        "translation_m": _plain(pose.translation_m) if pose else None,
        "quaternion_wxyz": _plain(pose.quaternion_wxyz) if pose else None,
        "covariance": _plain(estimate.covariance),
        "attitude_confidence": _plain(estimate.attitude_confidence),
        "reprojection_rms_px": _plain(estimate.reprojection_rms_px),
        "inlier_count": int(estimate.inliers.sum()) if estimate.inliers is not None else None,
        "box": _plain(np.array([box.x0, box.y0, box.x1, box.y1])) if box else None,
        "keypoints": _keypoint_records(estimate, keypoint_names),
    }


def _keypoint_records(estimate: Estimate, names: Sequence[str]) -> list[dict[str, object]] | None:
    keypoints = estimate.keypoints
    if keypoints is None:
        return None
    return [
        {
            "name": name,
            "pixel": _plain(keypoints.pixels[k]),
            "score": _plain(keypoints.score[k]),
            "covariance_px2": _plain(keypoints.covariance_px2[k]),
            "inlier": bool(estimate.inliers[k]) if estimate.inliers is not None else None,
        }
        for k, name in enumerate(names)
    ]


def unreadable_record(name: str, failure: Failure) -> dict[str, object]:
    """The JSON object of an image that could not be read."""
    return {"name": writable(name), "time_s": None, "status": "unreadable", "failure": _failure_record(failure)}


def _failure_record(failure: Failure) -> dict[str, str]:
    return {key: writable(text) for key, text in failure.to_dict().items()}


@dataclass(frozen=True)
class PoseLine:
    """One line of a file of poses.

    Attributes:
        name: The image's, as it stands in the file.
        failure: Why there is no pose; None when there is one.
        is_unreadable: The image could not be read.
        is_ambiguous: The network gives a higher probability to other attitudes than to the pose's.
        text: The line as it stands in the file, with its end.
    """

    name: str
    failure: Failure | None
    is_unreadable: bool
    is_ambiguous: bool
    text: str


class PoseWriter:
    """Writes records as JSON lines or CSV. Used with `with`; the file takes its name at the end, however it ends.

    A record is in the (temporary) file once it is added, whole or not at all. When the block ends with an exception,
    the file keeps what was added, unless a file of that name with more records is there.

    Args:
        path: The file to write.
        keypoint_names: Of the spacecraft, in order.
        layout: "jsonl" or "csv".
        kept: Lines of an earlier run, which come first.
    """

    def __init__(
        self, path: str | Path, keypoint_names: Sequence[str], layout: PoseFormat, kept: Sequence[PoseLine] = ()
    ) -> None:
        self._path = Path(path)
        self._names = tuple(keypoint_names)
        self._layout = layout
        self._kept = tuple(kept)
        self._count = 0
        self._stack = ExitStack()
        self._file: BinaryIO | None = None

    def __enter__(self) -> PoseWriter:
        temporary = self._stack.enter_context(replacing(self._path, keep_on_error=self._keeps_on_error))
        self._file = self._stack.enter_context(open(temporary, "wb", buffering=0))
        if self._layout == "csv":
            self._append(_csv_text(csv_columns(self._names)))
        for line in self._kept:
            self._append(line.text)
        self._count = len(self._kept)
        return self

    def add(self, name: str, time_s: float | None, estimate: Estimate) -> None:
        """Append the answer for one image."""
        self._write(record(name, time_s, estimate, self._names))

    def add_unreadable(self, name: str, failure: Failure) -> None:
        """Append an image that could not be read."""
        self._write(unreadable_record(name, failure))

    def _write(self, entry: dict[str, object]) -> None:
        if self._layout == "csv":
            self._append(_csv_text(csv_row(entry, self._names)))
        else:
            self._append(json.dumps(entry, allow_nan=False) + "\n")
        self._count += 1

    def _append(self, text: str) -> None:
        """The whole text, or on a full disk nothing of it."""
        if self._file is None:
            raise GknetError(f"{self._path}: the writer is used inside 'with' only")
        start, rest = self._file.tell(), memoryview(text.encode("utf-8"))
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except BaseException:
            self._file.truncate(start)
            self._file.seek(start)
            raise

    def _keeps_on_error(self) -> bool:
        """Whether there is something to keep, and no more of it in a file that is there."""
        there = self._path.read_bytes().count(b"\n") if self._path.is_file() else 0
        return 0 < self._count >= there - (self._layout == "csv")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file = None
        self._stack.__exit__(kind, error, trace)


def read_poses(path: str | Path, layout: PoseFormat) -> list[PoseLine]:
    """The lines of a file that `PoseWriter` wrote; none where there is no such file.

    A line that is not whole, as a killed run may leave one, is left out.
    """
    if not Path(path).exists():
        return []
    lines = read_text(path).splitlines(keepends=True)
    if layout == "jsonl":
        entries = [_json_entry(line) for line in lines]
    else:
        columns = next(csv.reader(lines[:1]), [])
        entries = [_csv_entry(line, columns) for line in lines[1:]]
        lines = lines[1:]
    return [_pose_line(path, entry, line) for entry, line in zip(entries, lines, strict=True) if entry is not None]


def _json_entry(line: str) -> dict[str, object] | None:
    try:
        entry = parse_json(line, "poses")
    except GknetError:
        return None
    return entry if isinstance(entry, dict) and {"name", "status"} <= set(entry) else None


def _csv_entry(line: str, columns: list[str]) -> dict[str, object] | None:
    """The cells that a `PoseLine` needs, as the JSON object has them."""
    cells = next(csv.reader([line]), [])
    if len(cells) != len(columns) or not line.endswith("\n"):
        return None
    entry: dict[str, object] = dict(zip(columns, cells, strict=True))
    if not {"name", "status", "failure_kind", "failure_detail", "attitude_confidence"} <= set(entry):
        return None
    failure = {"kind": entry["failure_kind"], "detail": entry["failure_detail"]} if entry["failure_kind"] else None
    name = str(entry["name"]).removeprefix("'")
    return {**entry, "name": name, "failure": failure, "attitude_confidence": entry["attitude_confidence"] or None}


def _pose_line(path: str | Path, entry: dict[str, object], text: str) -> PoseLine:
    failure, confidence = entry.get("failure"), entry.get("attitude_confidence")
    try:
        why = Failure(FailureKind(failure["kind"]), str(failure["detail"])) if isinstance(failure, dict) else None
        is_ambiguous = why is None and confidence is not None and float(str(confidence)) < AMBIGUOUS_BELOW
    except (KeyError, ValueError) as error:
        raise GknetError(f"{path}: a line of another version of gknet ({error}); give --overwrite") from error
    return PoseLine(str(entry["name"]), why, entry["status"] == "unreadable", is_ambiguous, text)


def csv_columns(keypoint_names: Sequence[str]) -> list[str]:
    """Covariance is its upper triangle, row by row, of (rotation vector, translation)."""
    columns = ["name", "time_s", "status", "failure_kind", "failure_detail"]
    columns += ["tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz"]
    columns += ["attitude_confidence", "reprojection_rms_px", "inlier_count", "box_x0", "box_y0", "box_x1", "box_y1"]
    columns += [f"covariance_{i}{j}" for i, j in _COVARIANCE_CELLS]
    return columns + [f"{name}_{what}" for name in keypoint_names for what in ("x", "y", "score")]


def csv_row(entry: dict[str, object], keypoint_names: Sequence[str]) -> list[object]:
    """The cells of a record, in the order of `csv_columns`; an unknown value is an empty cell."""

    def cells(key: str, count: int) -> list[object]:
        values = entry.get(key)
        return list(values) if isinstance(values, list) else [None] * count

    covariance, failure = entry.get("covariance"), entry["failure"]
    row: list[object] = [entry["name"], entry["time_s"], entry["status"]]
    row += [failure["kind"], failure["detail"]] if isinstance(failure, dict) else [None, None]
    row += cells("translation_m", 3) + cells("quaternion_wxyz", 4)
    row += [
        entry.get("attitude_confidence"),
        entry.get("reprojection_rms_px"),
        entry.get("inlier_count"),
        *cells("box", 4),
    ]
    row += [covariance[i][j] if isinstance(covariance, list) else None for i, j in _COVARIANCE_CELLS]
    for keypoint in cells("keypoints", len(keypoint_names)):
        row += [*keypoint["pixel"], keypoint["score"]] if isinstance(keypoint, dict) else [None] * 3
    return row


def _csv_text(row: Sequence[object]) -> str:
    """One line; texts are made safe for spreadsheets."""
    text = io.StringIO()
    csv.writer(text).writerow([spreadsheet_text(cell) if isinstance(cell, str) else cell for cell in row])
    return text.getvalue()
