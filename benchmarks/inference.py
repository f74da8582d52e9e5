"""Milliseconds from pixels to pose, at one and two threads, and of peers with --peers.

    python benchmarks/inference.py satellite_01 --peers

`satellite_01` is a shipped model or a folder with keypoints.onnx (or direct.onnx) and locator.onnx. Each figure is the
median of `--runs` calls on one thread setting, after a warm-up. The image is noise, which costs the networks what any
image does. The pose solver is timed on projected keypoints with noise, since noise alone has no pose.

--peers needs the extra `train`. It exports networks of the published sizes with random weights, whose speed is that of
any others, and runs all networks in turns, so that a busy machine slows all of them alike.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy import ndarray
from rich.console import Console
from rich.table import Table

from gknet.errors import GknetError, ends_in_one_line
from gknet.frame import Box, Keypoints
from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.inference.decode import decode_heatmaps
from gknet.inference.direct_estimator import DirectEstimator, decode_output
from gknet.inference.keypoint_estimator import KeypointEstimator
from gknet.inference.load import load_estimator
from gknet.inference.network_io import network_input
from gknet.inference.onnx_session import open_session
from gknet.inference.pnp import solve_pnp

CAMERA = Camera.from_focal(1400, 1024, 1024)
THREADS = (1, 2)
PEERS = {
    "GKNet, the paper's size": "gknet-paper",
    "HRNet-W32": "hrnet",
    "ResUNet-34": "resunet",
    "DMANet": "dmanet",
}


PEER_SIZE = 256


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
    if isinstance(estimator, DirectEstimator):
        further = direct_stages(estimator, given, crop, runs)
    else:
        further = keypoint_stages(estimator, given, crop, runs)
    found = {"cut the crop": median_ms(lambda: network_input(image, crop), runs), **further}
    whole = sum(found.values())
    if estimator.locator is not None:
        found["locate (whole frame)"] = median_ms(lambda: estimator.locate(image), runs)
        whole += found["locate (whole frame)"]
    found["frame to pose"] = whole
    if isinstance(estimator, KeypointEstimator):
        found["pose without the box"] = keypoint_stages(estimator, given, crop, runs, False)["pose"]
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
    """From the crop to a pose by direct regression."""
    output = estimator.network(given)[0]
    shown = decode_output(output, estimator.bins)
    assert shown is not None  # the weights are finite
    return {
        "direct network": median_ms(lambda: estimator.network(given), runs),
        "decode": median_ms(lambda: decode_output(output, estimator.bins), runs),
        "pose": median_ms(lambda: shown.pose(CAMERA, crop, estimator.spacecraft.diameter_m), runs),
    }


@cache
def exported(name: str) -> bytes:
    """A network of the list for 16 keypoints on a chain, with random weights, as an export would have it."""
    import torch

    from gknet.network.build import build
    from gknet.training.onnx_graph import onnx_graph

    chain = np.eye(16, dtype=bool) | np.eye(16, k=1, dtype=bool) | np.eye(16, k=-1, dtype=bool)
    points_m = np.random.default_rng(0).normal(size=(16, 3))
    network = build(name, chain, points_m).eval()
    return onnx_graph(network, torch.zeros(2, 3, PEER_SIZE, PEER_SIZE)).SerializeToString()


def networks_in_turns(estimator: KeypointEstimator, threads: int, runs: int) -> dict[str, float]:
    """Median milliseconds of a crop: the estimator's network and the peers, one call of each after the other."""
    size = estimator.settings.input_size
    ours = np.random.default_rng(0).random((1, 3, size, size), dtype=np.float32)
    theirs = np.random.default_rng(0).random((1, 3, PEER_SIZE, PEER_SIZE), dtype=np.float32)

    def call_of(model: bytes) -> Callable[[], object]:
        session = open_session(model, threads)
        return lambda: session.run(None, {"image": theirs})

    calls: dict[str, Callable[[], object]] = {f"this model, {size} px": lambda: estimator.keypoint_network(ours)}
    calls |= {f"{words}, {PEER_SIZE} px": call_of(exported(name)) for words, name in PEERS.items()}
    times: dict[str, list[float]] = {words: [] for words in calls}
    for _ in range(runs):
        for words, call in calls.items():
            start = time.perf_counter()
            call()
            times[words].append(time.perf_counter() - start)
    return {words: 1000 * float(np.median(found[1:] or found)) for words, found in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="a shipped model's name or a folder with keypoints.onnx or direct.onnx")
    parser.add_argument("--peers", action="store_true", help="time networks of the published sizes too")
    parser.add_argument("--runs", type=int, default=100)
    parser.add_argument("--tta-rotations", type=int, default=1, help="rotations of a crop that are averaged")
    chosen = parser.parse_args()

    table = Table("stage", *(f"ms, {threads} threads" for threads in THREADS), title=f"inference, {chosen.model}")
    estimators = [load_estimator(chosen.model, threads, tta_rotations=chosen.tta_rotations) for threads in THREADS]
    found = [stages(estimator, chosen.runs) for estimator in estimators]
    for stage in found[0]:
        table.add_row(stage, *(f"{each[stage]:.2f}" for each in found))
    Console().print(table)
    if not chosen.peers:
        return
    peers = Table("network alone, a crop", *(f"ms, {threads} threads" for threads in THREADS), "of this model")
    timed = []
    for estimator, threads in zip(estimators, THREADS, strict=True):
        if not isinstance(estimator, KeypointEstimator):
            raise GknetError("--peers: expected a keypoint model")
        timed.append(networks_in_turns(estimator, threads, max(5, chosen.runs // 5)))
    first = next(iter(timed[0]))
    for words in timed[0]:
        peers.add_row(words, *(f"{each[words]:.1f}" for each in timed), f"{timed[-1][words] / timed[-1][first]:.1f}")
    Console().print(peers)


if __name__ == "__main__":
    with ends_in_one_line():
        main()
