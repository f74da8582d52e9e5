"""Milliseconds from pixels to pose, at one and two threads, as ratios to gknet-paper with --paper.

    python benchmarks/inference.py satellite_01 --paper

--paper needs the extra `train`: it makes the network of the paper's size with random weights, whose speed is that of
any others.
`satellite_01` is a shipped model or a folder with keypoints.onnx (or direct.onnx) and locator.onnx. Each figure is the
median of `--runs` calls on one thread setting, after a warm-up; the picture is noise, which costs the networks what any
picture does. The pose solver is timed on the projected keypoints with noise, since noise alone has no pose.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnxruntime
from numpy import ndarray
from rich.console import Console
from rich.table import Table

from gknet.errors import ends_in_one_line
from gknet.frame import Box, Keypoints
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.inference.decode import decode_heatmaps
from gknet.inference.direct_estimator import DirectEstimator, decode_output
from gknet.inference.keypoint_estimator import KeypointEstimator
from gknet.inference.load import load_estimator
from gknet.inference.network_io import network_input
from gknet.inference.pnp import solve_pnp

CAMERA = Camera.from_focal(1400, 1024, 1024)


def median_ms(call: Callable[[], object], runs: int) -> float:
    for _ in range(max(2, runs // 10)):
        call()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1000 * float(np.median(times))


def stages(estimator: KeypointEstimator | DirectEstimator, runs: int) -> dict[str, float]:
    """Median milliseconds of each stage, and of the whole way from a 1024 x 1024 frame to a pose."""
    image = np.random.default_rng(0).integers(0, 256, (1024, 1024, 3), dtype=np.uint8)
    crop = Crop(200, 200, 600, estimator.settings.input_size)
    given = network_input(image, crop)
    look = direct_stages if isinstance(estimator, DirectEstimator) else keypoint_stages
    found = {"cut the crop": median_ms(lambda: network_input(image, crop), runs), **look(estimator, given, crop, runs)}
    whole = sum(found.values())
    if estimator.locator is not None:
        found["locate (whole frame)"] = median_ms(lambda: estimator.locate(image), runs)
        whole += found["locate (whole frame)"]
    found["frame to pose"] = whole
    if isinstance(estimator, KeypointEstimator):
        found["pose without the box's say"] = keypoint_stages(estimator, given, crop, runs, False)["pose"]
    return found


def keypoint_stages(
    estimator: KeypointEstimator, given: ndarray, crop: Crop, runs: int, trust_box: bool = True
) -> dict[str, float]:
    """From the crop to a pose by keypoints."""
    craft = estimator.spacecraft
    pose = Pose.from_quaternion([0.3, -0.5, 0.7, 0.4], [0, 0, 4 * craft.diameter_m])
    true_px = CAMERA.project(pose.transform(craft.points_m))
    pixels = true_px + np.random.default_rng(1).normal(size=true_px.shape)
    count = craft.keypoint_count
    keypoints = Keypoints(pixels, np.full(count, 0.9), np.tile(np.eye(2), (count, 1, 1)))
    box = Box.around(true_px) if trust_box else None
    views = np.repeat(given, estimator.settings.tta_rotations, axis=0)
    heatmaps = estimator.keypoint_network(given).heatmaps[0]
    stride = crop.size / heatmaps.shape[2]
    return {
        "keypoint network": median_ms(lambda: estimator.keypoint_network(views), runs),
        "decode": median_ms(lambda: decode_heatmaps(heatmaps, stride), runs),
        "pose": median_ms(lambda: solve_pnp(keypoints, CAMERA, craft.points_m, box=box), runs),
    }


def direct_stages(estimator: DirectEstimator, given: ndarray, crop: Crop, runs: int) -> dict[str, float]:
    """From the crop to a pose that the network tells."""
    output = estimator.network(given)[0]
    shown = decode_output(output, estimator.bins)
    return {
        "direct network": median_ms(lambda: estimator.network(given), runs),
        "decode": median_ms(lambda: decode_output(output, estimator.bins), runs),
        "pose": median_ms(lambda: shown.pose(CAMERA, crop, estimator.spacecraft.diameter_m), runs),
    }


def write_paper_network(path: Path) -> None:
    """gknet-paper for 16 keypoints on a chain, as an export would have it."""
    import onnx
    import torch

    from gknet.network.build import build
    from gknet.training.onnx_graph import onnx_graph

    chain = np.eye(16, dtype=bool) | np.eye(16, k=1, dtype=bool) | np.eye(16, k=-1, dtype=bool)
    network = build("gknet-paper", chain, np.zeros((16, 3))).eval()
    onnx.save(onnx_graph(network, torch.zeros(2, 3, 256, 256)), path)


def paper_ms(path: Path, threads: int, runs: int) -> float:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    given = np.random.default_rng(0).random((1, 3, 256, 256), dtype=np.float32)
    return median_ms(lambda: session.run(None, {"image": given}), max(3, runs // 10))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="a shipped model's name or a folder with keypoints.onnx or direct.onnx")
    parser.add_argument("--paper", action="store_true", help="time gknet-paper too, the unit of the ratios")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--tta-rotations", type=int, default=1, help="orientations in which a crop is seen: 1, 2 or 4")
    chosen = parser.parse_args()

    table = Table("stage", "threads", "ms", "of gknet-paper", title=f"inference, {chosen.model}")
    paper_times: dict[int, float] = {}
    if chosen.paper:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "gknet-paper.onnx"
            write_paper_network(path)
            paper_times = {threads: paper_ms(path, threads, chosen.runs) for threads in (1, 2)}
    for threads in (1, 2):
        paper = paper_times.get(threads)
        for stage, ms in stages(
            load_estimator(chosen.model, threads, tta_rotations=chosen.tta_rotations), chosen.runs
        ).items():
            table.add_row(stage, str(threads), f"{ms:.2f}", f"1/{paper / ms:.0f}" if paper else "-")
        if paper:
            table.add_row("gknet-paper's network", str(threads), f"{paper:.0f}", "1")
        table.add_section()
    Console().print(table)


if __name__ == "__main__":
    with ends_in_one_line():
        main()
