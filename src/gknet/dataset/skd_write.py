"""Writing the SKD layout: a sequence's small files, its annotations.csv, and the split files of a root."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from numpy import ndarray

from gknet.dataset.skd_format import (
    AUTHORS_COLUMNS,
    OUR_COLUMNS,
    SPLITS,
    category_of,
    frame_stem,
    sequence_name,
    to_skd_matrix,
    to_skd_points,
)
from gknet.geometry import Camera
from gknet.io.atomic import write_bytes, write_text
from gknet.io.image import write_image, write_mask
from gknet.spacecraft import Spacecraft


def _matrix_text(matrix: ndarray) -> str:
    return "\n".join(", ".join(f"{value + 0.0:.9g}" for value in row) for row in matrix) + "\n"


def write_camera_matrix(path: Path, camera: Camera) -> None:
    """K in SKD's axes as a camera_matrix.txt."""
    write_text(path, _matrix_text(to_skd_matrix(camera.matrix)))


def _write_torch_skeleton(path: Path, edges: list[tuple[int, int]]) -> None:
    """The authors' pickle, where torch is installed; skeleton.json has the same content without it."""
    import gknet.io.openmp  # noqa: F401 (before torch)

    try:
        import torch
    except ImportError:
        return
    buffer = io.BytesIO()
    torch.save(edges, buffer)
    write_bytes(path, buffer.getvalue())


def write_sequence_files(folder: Path, camera: Camera, spacecraft: Spacecraft) -> None:
    """Write camera_matrix.txt, keypoints.txt and the skeleton of a sequence.

    Args:
        folder: The sequence's, made where it is missing.
        camera: The whole sensor's. Frames that are cut-outs have their own in the `camera` column.
        spacecraft: Its keypoints and edges.
    """
    folder.mkdir(parents=True, exist_ok=True)
    edges = [(int(i), int(j)) for i, j in spacecraft.edges]
    write_camera_matrix(folder / "camera_matrix.txt", camera)
    write_text(folder / "keypoints.txt", _matrix_text(to_skd_points(spacecraft.points_m)))
    write_text(
        folder / "skeleton.json",
        json.dumps({"keypoint_names": spacecraft.keypoint_names, "edges": edges}, indent=1) + "\n",
    )
    _write_torch_skeleton(folder / "skeleton.pth", edges)
    _write_torch_skeleton(folder / "skeleton_pres.pth", edges)


def write_annotations(folder: Path, rows: Iterable[dict[str, str]]) -> None:
    """Write annotations.csv, in the order of the frames."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [*AUTHORS_COLUMNS, *OUR_COLUMNS], lineterminator="\n")
    writer.writeheader()
    writer.writerows(sorted(rows, key=lambda row: int(row["frame"])))
    write_text(folder / "annotations.csv", text.getvalue())


def write_frame_files(
    folder: Path, index: int, rgb: ndarray, quality: int, mask: ndarray | None, depth_m: ndarray | None
) -> None:
    """Write image/000001.jpg, and where given mask/000001.png and depth/000001.npz.

    Args:
        folder: The sequence's.
        index: The frame's place in it, from 0.
        rgb: (h, w, 3) uint8.
        quality: JPEG's, 1 to 100.
        mask: (h, w) bool.
        depth_m: (h, w) z in the camera frame in m, 0 where there is nothing; written as float32.
    """
    stem = frame_stem(index)
    if mask is not None:
        write_mask(_made(folder / "mask") / f"{stem}.png", mask)
    if depth_m is not None:
        buffer = io.BytesIO()
        np.savez_compressed(buffer, depth_m=depth_m.astype(np.float32))
        write_bytes(_made(folder / "depth") / f"{stem}.npz", buffer.getvalue())
    write_image(_made(folder / "image") / f"{stem}.jpg", rgb, quality)


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def sequences_on_disk(root: Path) -> list[int]:
    """The sequences (from 0) whose annotations.csv is written."""
    folders = (root / "data").glob("[0-9]*")
    numbers = (int(folder.name) for folder in folders if re.fullmatch(r"\d{6}", folder.name))
    return sorted(n - 1 for n in numbers if (root / "data" / f"{n:06d}" / "annotations.csv").exists())


def write_splits(root: Path, split_of: Callable[[int], str], spacecraft_of: Callable[[int], str]) -> None:
    """Write train.json, val.json and test.json from the sequences on disk.

    Several writers may share a root: each lists the sequences again after writing, so the last one lists them all.
    """
    present: list[int] | None = None
    while present != (found := sequences_on_disk(root)):
        present = found
        for split in SPLITS:
            listing: dict[str, list[str]] = {}
            for sequence in present:
                if split_of(sequence) == split:
                    listing.setdefault(category_of(spacecraft_of(sequence)), []).append(sequence_name(sequence))
            write_text(root / f"{split}.json", json.dumps(dict(sorted(listing.items())), indent=1) + "\n")
