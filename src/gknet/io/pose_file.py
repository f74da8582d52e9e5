"""Estimates as text: one JSON object or one CSV row a picture, in a file that appears only when it is complete."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Literal, TextIO

import numpy as np
from numpy import ndarray

from gknet.errors import GknetError
from gknet.frame import Estimate, Failure

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
    """The JSON object of one picture; poses are cam_from_body, lengths in metres, pixels of the full image."""
    pose, box = estimate.cam_from_body, estimate.box
    return {
        "name": name,
        "time_s": time_s,
        "status": "ok" if pose is not None else "no pose",
        "failure": estimate.failure.to_dict() if estimate.failure else None,
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
    """The JSON object of a picture that could not be read."""
    return {"name": name, "time_s": None, "status": "unreadable", "failure": failure.to_dict()}


class PoseWriter:
    """Writes records as JSON lines or CSV; used with `with`, which renames the file at the end."""

    def __init__(self, path: str | Path, keypoint_names: Sequence[str], layout: PoseFormat) -> None:
        self._path = Path(path)
        self._temporary = self._path.with_name(f".{self._path.name}.{os.getpid()}.tmp")
        self._names = tuple(keypoint_names)
        self._layout = layout
        self._file: TextIO | None = None

    def __enter__(self) -> PoseWriter:
        self._file = open(self._temporary, "w", encoding="utf-8", newline="")
        if self._layout == "csv":
            csv.writer(self._file).writerow(csv_columns(self._names))
        return self

    def add(self, name: str, time_s: float | None, estimate: Estimate) -> None:
        self._write(record(name, time_s, estimate, self._names))

    def add_unreadable(self, name: str, failure: Failure) -> None:
        self._write(unreadable_record(name, failure))

    def _write(self, entry: dict[str, object]) -> None:
        if self._file is None:
            raise GknetError(f"{self._path}: the writer is used inside 'with' only")
        if self._layout == "csv":
            csv.writer(self._file).writerow(csv_row(entry, self._names))
        else:
            self._file.write(json.dumps(entry, allow_nan=False) + "\n")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is None:
            return
        try:
            self._file.close()
            if kind is None:
                os.replace(self._temporary, self._path)
        finally:
            self._temporary.unlink(missing_ok=True)


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
