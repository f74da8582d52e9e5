"""The authors' SKD layout from its rules alone: a reader and a writer that import nothing of gknet.

Stored axes are Unreal's (x forward, y right, z down) and quaternions xyzw. Row vectors turn by v' = v P, rotations by
R' = P^T R P, intrinsics by K' = K P; the primed ones are OpenCV's, and both functions below speak of those. Row i of
annotations.csv is the image i + 1.
"""

from __future__ import annotations

import ast
import csv
import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy import ndarray
from scipy.spatial.transform import Rotation

P = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])


@dataclass(frozen=True, eq=False)
class Record:
    """One frame. rotation (3, 3) and translation (3,) take body to camera; keypoints (n, 2) and box x0, y0, x1, y1
    are in pixels, the box that of the keypoints, clipped to the image; None when nothing of it is inside."""

    split: str
    category: str
    image_path: Path
    matrix: ndarray
    rotation: ndarray
    translation: ndarray
    points: ndarray
    keypoints: ndarray
    box: ndarray | None


def turned(x: float, y: float, z: float, w: float) -> ndarray:
    """The active rotation of a Hamilton quaternion, written out."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def read(root: Path, size: int) -> list[Record]:
    """Every frame of the three splits; images are `size` pixels wide and high, their camera is that of the root."""
    matrix = np.loadtxt(root / "camera_matrix.txt", delimiter=",") @ P
    records = []
    for split in ("train", "val", "test"):
        path = root / f"{split}.json"
        listing = json.loads(path.read_text()) if path.exists() else {}
        for category, names in listing.items():
            for name in names:
                np.testing.assert_array_equal(np.loadtxt(root / name / "camera_matrix.txt", delimiter=",") @ P, matrix)
                points = np.loadtxt(root / name / "keypoints.txt", delimiter=",") @ P
                with open(root / name / "annotations.csv", newline="") as file:
                    rows = list(csv.DictReader(file))
                records += [
                    _record(split, category, root / name, i, row, matrix, points, size) for i, row in enumerate(rows)
                ]
    return records


def _record(
    split: str, category: str, folder: Path, i: int, row: dict, matrix: ndarray, points: ndarray, size: int
) -> Record:
    assert row["category"] == category
    rotation = P.T @ turned(*ast.literal_eval(row["orientation"])) @ P
    translation = np.array(ast.literal_eval(row["position"])) @ P
    homogeneous = (points @ rotation.T + translation) @ matrix.T
    keypoints = homogeneous[:, :2] / homogeneous[:, 2:]
    low, high = keypoints.min(axis=0).clip(0, size), keypoints.max(axis=0).clip(0, size)
    box = np.concatenate([low, high]) if (high > low).all() else None
    image_path = folder / "image" / f"{i + 1:06d}.jpg"
    return Record(split, category, image_path, matrix, rotation, translation, points, keypoints, box)


@dataclass(frozen=True, eq=False)
class Shot:
    """An image (h, w, 3) RGB and the pose behind it, OpenCV axes."""

    image: ndarray
    rotation: ndarray
    translation: ndarray


def write(
    root: Path, category: str, matrix: ndarray, points: ndarray, edges: list, sequences: dict[str, list[Shot]]
) -> None:
    """A folder with the authors' files and columns, and no others: one sequence for each split."""
    import torch

    listings: dict[str, dict] = {split: {} for split in ("train", "val", "test")}
    for number, (split, shots) in enumerate(sequences.items(), start=1):
        folder = root / "data" / f"{number:06d}"
        (folder / "image").mkdir(parents=True)
        listings[split] = {category: [f"data/{number:06d}"]}
        np.savetxt(folder / "camera_matrix.txt", matrix @ P.T, delimiter=",")
        np.savetxt(folder / "keypoints.txt", points @ P.T, delimiter=",")
        for name in ("skeleton.pth", "skeleton_pres.pth"):
            torch.save(edges, folder / name)
        with open(folder / "annotations.csv", "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["category", "position", "orientation"])
            for i, shot in enumerate(shots, start=1):
                quaternion = Rotation.from_matrix(P @ shot.rotation @ P.T).as_quat()
                writer.writerow([category, (P @ shot.translation).tolist(), quaternion.tolist()])
                cv2.imwrite(str(folder / "image" / f"{i:06d}.jpg"), shot.image[:, :, ::-1])
    np.savetxt(root / "camera_matrix.txt", matrix @ P.T, delimiter=",")
    for split, listing in listings.items():
        (root / f"{split}.json").write_text(json.dumps(listing))
