"""The README's animation (estimates of the shipped models), and figure 3 of the paper (detections by method).

    python experiments/paper_figures.py --out docs/images
    python experiments/paper_figures.py --out docs/images --work runs/paper --scale cpu     # figure 3 too

Hardware   any
Time       seconds
Expected   overlays.webp from the bundled frames; detections.jpg from the models of paper_tables.py
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from gknet.dataset.demo_frames import bundled_frames
from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError, ends_in_one_line
from gknet.evaluation.metrics import compute_errors, oracle_crop
from gknet.fleet import NAMES
from gknet.frame import Frame
from gknet.inference.load import load_estimator
from gknet.io.atomic import write_bytes
from gknet.report.overlay import draw_overlay, zoomed

SIDE, DETECTION_SIDE, MOVING_SIDE = 512, 384, 320
METHODS = {"HRNet": "hrnet-xs", "ResUNet": "resunet-xs", "GKNet": "gknet-xs"}
FULL_METHODS = {"HRNet": "hrnet", "ResUNet": "resunet", "GKNet": "gknet-paper"}


def image_of(frame: Frame) -> UInt8[ndarray, "h w 3"]:
    """The image of a frame that was read with it."""
    assert frame.image is not None
    return frame.image


def sheet(rows: list[list[ndarray]], gap: int = 8) -> ndarray:
    """Images of one size in rows, white between them."""
    edged = [[np.pad(picture, ((0, gap), (0, gap), (0, 0)), constant_values=255) for picture in row] for row in rows]
    return np.concatenate([np.concatenate(row, axis=1) for row in edged])


def write_jpeg(path: Path, image: ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 84])[1].tobytes())
    print(f"wrote {path}")


def overlay_figures() -> list[ndarray]:
    """A row for each frame of the bundled sequences: the estimates from the full image and the truth."""
    columns = []
    for name in NAMES:
        dataset, estimator = SkdDataset(bundled_frames(), None, name), load_estimator(name)
        column = []
        for frame in dataset:
            estimate = estimator.estimate(image_of(frame), frame.camera)
            near, close = zoomed(frame, estimate, oracle_crop(frame, dataset.spacecraft, SIDE))
            drawn = draw_overlay(near, dataset.spacecraft, close, [name], legend=False, weight=1.3)
            column.append(cv2.resize(drawn, (MOVING_SIDE, MOVING_SIDE), interpolation=cv2.INTER_AREA))
        columns.append(column)
    return [np.concatenate(row, axis=1) for row in zip(*columns, strict=True)]


def write_moving(path: Path, pictures: list[ndarray], fps: float = 4.0) -> None:
    """An animated WebP that plays forward and back, without end."""
    there_and_back = [*pictures, *pictures[-2:0:-1]]
    animation = cv2.Animation()
    animation.frames = [np.ascontiguousarray(picture[:, :, ::-1]) for picture in there_and_back]
    animation.durations = [round(1000 / fps)] * len(there_and_back)
    found, data = cv2.imencodeanimation(".webp", animation, [cv2.IMWRITE_WEBP_QUALITY, 70])
    if not found:
        raise GknetError(f"{path}: this OpenCV cannot write an animated WebP")
    write_bytes(path, data.tobytes())
    print(f"wrote {path}")


def detection_figure(work: Path, methods: dict[str, str], spacecraft_names: Sequence[str], seed: int = 0) -> ndarray:
    """A row for each spacecraft, a column for each method: the frame of median difficulty for all of them together."""
    rows = []
    for name in spacecraft_names:
        estimators = {}
        for method, key in methods.items():
            folder = work / "models" / f"{name}_{key}_{seed}"
            if not (folder / "keypoints.onnx").is_file():
                raise GknetError(f"{folder}: no model; run experiments/paper_tables.py for it first")
            estimators[method] = load_estimator(folder)
        dataset = SkdDataset(work / "frames", "test", name)
        spacecraft = dataset.spacecraft
        places = range(0, len(dataset), max(1, len(dataset) // 40))
        found = []
        for place in places:
            frame = dataset.frame(place)
            box = frame.true_box(spacecraft.points_m)
            estimates = {m: e.estimate(image_of(frame), frame.camera, box) for m, e in estimators.items()}
            rmse = {m: compute_errors(frame, estimate, spacecraft).rmse_px for m, estimate in estimates.items()}
            found.append((float(np.mean(list(rmse.values()))), frame, estimates, rmse))
        found.sort(key=lambda item: item[0])
        _, frame, estimates, rmse = found[len(found) // 2]
        row = []
        for method, estimate in estimates.items():
            near, close = zoomed(frame, estimate, oracle_crop(frame, spacecraft, DETECTION_SIDE))
            words = [method, f"RMSE {rmse[method]:.1f} px"]
            row.append(draw_overlay(near, spacecraft, close, words, legend=False, weight=1.3))
        rows.append(row)
    return sheet(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the images")
    parser.add_argument("--work", type=Path, help="work folder of experiments/paper_tables.py")
    parser.add_argument("--scale", default="cpu", help="its sub-folder")
    parser.add_argument("--spacecraft", nargs="+", choices=NAMES, default=list(NAMES), help="the rows of figure 3")
    arguments = parser.parse_args()
    write_moving(arguments.out / "overlays.webp", overlay_figures())
    if arguments.work is not None:
        methods = FULL_METHODS if arguments.scale == "full" else METHODS
        picture = detection_figure(arguments.work / arguments.scale, methods, arguments.spacecraft)
        write_jpeg(arguments.out / "detections.jpg", picture)


if __name__ == "__main__":
    with ends_in_one_line():
        main()
