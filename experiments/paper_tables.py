"""The paper's comparison, run fairly: GKNet, HRNet, ResUNet and DMANet, and GKNet with other graphs.

    pip install '.[render,train]'
    python experiments/paper_tables.py --scale cpu --work runs/paper --results results/paper_tables
    python experiments/paper_report.py --scale cpu --results results/paper_tables

--scale smoke  a few minutes: shows that every stage works and nothing about the methods
--scale cpu    2 cores: every method at 0.26 GMAC for a 256 crop, from scratch, the same crops and as many
               of them, and the same sweep of learning rates on validation; loss and read-out are ours for all
--scale full   a GPU: the paper's sizes and its training (squared error, Adam 0.01, 80 epochs, batch 16, five cosines,
               32x32 heatmaps) on every frame of the 300 sequences

DMANet regresses the pose directly: it has its own loss, no heatmaps, and so not the paper's read-out of them.

Hardware   cpu: 2 cores; two shares in two terminals, each with OMP_NUM_THREADS=1, are faster than one run (--share 0/2
           and --share 1/2)
Time       cpu: about 5 hours of two cores with bfloat16, added up from what was run: rendering 13 minutes a
           spacecraft, a sweep 12 to 40 minutes, a training 8 (ResUNet) to 20 (DMANet) minutes of one core, with another
           one on the other; up to twice as long without bfloat16; full: not run
Expected   one small JSON for each training in RESULTS/SCALE, which paper_report.py turns into tables

What is done is kept: stop it at any time and run it again. Only train sequences are trained on; validation chooses
the learning rate and the weights; test sequences are read by `judge` alone. The detected crop comes from the shipped
locators, the same for every method.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

import gknet
from gknet.dataset.skd import SkdDataset
from gknet.errors import DivergedError, GknetError, ends_in_one_line
from gknet.evaluation.comparison import Trial
from gknet.evaluation.evaluate import ProtocolRun, evaluate
from gknet.evaluation.paper_protocol import PaperEstimator
from gknet.fleet import NAMES
from gknet.inference.direct_estimator import DirectEstimator
from gknet.inference.load import load_estimator
from gknet.inference.onnx_model import OnnxModel
from gknet.io.atomic import write_text
from gknet.render.generate import generate
from gknet.render.options import Options, Selection
from gknet.render.render_progress import RenderProgress
from gknet.training.checkpoint import CHECKPOINT
from gknet.training.export import export_run
from gknet.training.schedule import Stage
from gknet.training.settings import TrainSettings
from gknet.training.train import train

DATA_SEED, SWEEP_SEED = 0, 100
SHIPPED = Path(gknet.__file__).parent / "models"


@dataclass(frozen=True)
class Method:
    """A row of a table. `network` at the scale's sizes."""

    name: str
    network: str
    graph: str = "skeleton"

    @property
    def key(self) -> str:
        return self.network if self.graph == "skeleton" else f"{self.network}_{self.graph}"


@dataclass(frozen=True)
class Scale:
    """How much is rendered, trained and judged.

    crops_every, val_every, test_every   frames of a sequence that are rendered
    sequences, size                      of the data; None renders all, whole
    seeds                                of each method
    ablation_seeds                       of gknet with its skeleton and without edges, on ABLATED
    rates                                learning rates tried first for each method on SWEPT, sweep_epochs each
    """

    methods: tuple[Method, ...]
    ablation: tuple[Method, ...]
    crops_every: int
    val_every: int
    test_every: int
    sequences: int | None
    size: int | None
    seeds: tuple[int, ...]
    ablation_seeds: tuple[int, ...]
    rates: tuple[float, ...]
    sweep_epochs: float
    settings: TrainSettings


SWEPT = "satellite_02"
TRIES = 6
"""Of learning rates at most, for each method."""
ABLATED = ("satellite_02", "satellite_03")


def methods(suffix: str) -> tuple[tuple[Method, ...], tuple[Method, ...]]:
    ours = f"gknet{suffix or '-paper'}"
    table = (
        Method("GKNet", ours),
        Method("HRNet", f"hrnet{suffix}"),
        Method("ResUNet", f"resunet{suffix}"),
        Method("DMANet", f"dmanet{suffix}"),
    )
    ablation = (
        Method("GKNet, no edges", ours, "identity"),
        Method("GKNet, random edges", ours, "random"),
        Method("GKNet, no graph branch", ours, "none"),
    )
    return table, ablation


PAPER = TrainSettings(
    epochs=80,
    stages=(Stage(1.0, 256, 16),),
    learning_rate=0.01,
    optimizer="adamw",
    weight_decay=0.0,  # AdamW without decay is Adam
    warm_up=0.0,
    cycles=5,
    auxiliary=0.0,
    ema=0.0,
    validations=10,
)
SCALES = {
    "smoke": Scale(
        *methods("-xs"), 10, 20, 20, 5, 256, (0,), (), (2e-3,), 0.2,
        TrainSettings(epochs=0.5, stages=(Stage(1.0, 64, 8),), validations=1, val_frames=8),
    ),
    "cpu": Scale(
        *methods("-xs"), 2, 30, 15, None, None, (0,), (1, 2), (3e-3, 6e-3), 3,
        TrainSettings(epochs=6, stages=(Stage(1.0, 128, 16),), validations=4, val_frames=200),
    ),
    "full": Scale(*methods(""), 1, 10, 1, None, None, (0, 1, 2), (), (0.01,), 80, PAPER),
}  # fmt: skip


def parse_share(text: str) -> tuple[int, int]:
    try:
        share, shares = (int(part) for part in text.split("/"))
    except ValueError:
        share, shares = 0, 0
    if not 0 <= share < shares:
        raise argparse.ArgumentTypeError(f"expected I/N with I from 0 to N - 1, got '{text}'")
    return share, shares


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="folder of data, caches and runs")
    parser.add_argument("--results", type=Path, required=True, help="folder of the figures")
    parser.add_argument("--scale", choices=sorted(SCALES), default="cpu")
    parser.add_argument("--locators", type=Path, default=SHIPPED, help="folder of the locators [the shipped ones]")
    parser.add_argument("--spacecraft", nargs="+", choices=NAMES, default=list(NAMES))
    parser.add_argument(
        "--share", type=parse_share, default=(0, 1), metavar="I/N", help="each N-th training, from the I-th on"
    )
    arguments = parser.parse_args()
    scale = SCALES[arguments.scale]
    share, shares = arguments.share
    work, results = arguments.work / arguments.scale, arguments.results / arguments.scale
    rendered = work / f"rendered_{'_'.join(arguments.spacecraft)}"
    if share == 0 and not rendered.exists():
        render(work, scale, arguments.spacecraft)
        rendered.touch()
    wait_for(rendered)
    (results / "sweep").mkdir(parents=True, exist_ok=True)
    swept = SWEPT if SWEPT in arguments.spacecraft else arguments.spacecraft[0]
    networks = [method.network for method in scale.methods]
    mine = networks[share::shares]
    mine_first = sorted(networks, key=lambda network: network not in mine)
    rates = {network: chosen_rate(work, results, scale, network, swept, network in mine) for network in mine_first}
    for method, spacecraft, seed in list(trials(scale, arguments.spacecraft))[share::shares]:
        if result_path(results, method, spacecraft, seed).exists():
            continue
        settings = replace(
            scale.settings,
            network=method.network,
            graph=method.graph,
            learning_rate=rates[method.network],
            seed=seed,
        )
        run = work / "runs" / f"{spacecraft}_{method.key}_{seed}"
        minutes = run_training(work, spacecraft, run, settings)
        model = work / "models" / run.name
        export_run(run, model)
        shutil.copyfile(arguments.locators / spacecraft / "locator.onnx", model / "locator.onnx")
        content = judge(work, model, method, spacecraft, seed)
        content |= {"learning_rate": settings.learning_rate, "minutes": minutes, **learning_curve(run)}
        write_text(result_path(results, method, spacecraft, seed), json.dumps(content) + "\n")


def render(work: Path, scale: Scale, spacecraft: list[str]) -> None:
    """Crops to train on; whole frames to validate and to judge on."""
    crops, frames = Options(DATA_SEED, "target"), Options(DATA_SEED, size=scale.size)
    for name in spacecraft:
        train, val, test = (
            Selection((name,), split, scale.sequences, every)
            for split, every in (("train", scale.crops_every), ("val", scale.val_every), ("test", scale.test_every))
        )
        with RenderProgress() as progress:
            generate("skd", work / "crops", crops, train, on_progress=progress.show)
            generate("skd", work / "frames", frames, val, on_progress=progress.show)
            generate("skd", work / "frames", frames, test, on_progress=progress.show)


def wait_for(path: Path) -> None:
    """For what another share makes."""
    if not path.exists():
        print(f"waiting for {path}, which another share makes", flush=True)
    while not path.exists():
        time.sleep(5)


def sweep_path(results: Path, spacecraft: str, network: str, rate: float) -> Path:
    return results / "sweep" / f"{spacecraft}_{network}_{rate:g}.json"


def try_rate(work: Path, results: Path, scale: Scale, network: str, rate: float, spacecraft: str) -> None:
    """A short training; a rate at which it diverges has no score."""
    settings = replace(
        scale.settings, network=network, epochs=scale.sweep_epochs, learning_rate=rate, seed=SWEEP_SEED, validations=1
    )
    run = work / "runs" / f"sweep_{spacecraft}_{network}_{rate:g}"
    try:
        minutes = run_training(work, spacecraft, run, settings)
        content = {"minutes": minutes, **json.loads((run / "run.json").read_text(encoding="utf-8"))["best"]}
    except DivergedError:
        content = {"score": None}
    write_text(sweep_path(results, spacecraft, network, rate), json.dumps({"spacecraft": spacecraft, **content}) + "\n")


def chosen_rate(work: Path, results: Path, scale: Scale, network: str, spacecraft: str, mine: bool) -> float:
    """The learning rate of the lowest validation score; beyond the best one are a half and twice of it, tried as well.

    mine  whether this share makes what is missing, or waits for it
    """
    rates = sorted(scale.rates)
    scores: dict[float, float] = {}
    while len(rates) > 1:
        for rate in rates:
            if rate not in scores:
                path = sweep_path(results, spacecraft, network, rate)
                if mine and not path.exists():
                    try_rate(work, results, scale, network, rate, spacecraft)
                wait_for(path)
                scores[rate] = score_of(path)
        best = min(rates, key=lambda rate: scores[rate])
        if best not in (rates[0], rates[-1]) or len(rates) == TRIES:
            return best
        rates = [best / 2, *rates] if best == rates[0] else [*rates, best * 2]
    return rates[0]


def score_of(path: Path) -> float:
    """Of a rate that was tried; infinite where the training diverged."""
    try:
        score = json.loads(path.read_text(encoding="utf-8"))["score"]
        if score is not None and math.isnan(score):
            raise ValueError("NaN")
        return math.inf if score is None else float(score)
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise GknetError(f"{path}: not a score of the sweep ({error}); delete it and run again") from error


def trials(scale: Scale, spacecraft: list[str]) -> Iterator[tuple[Method, str, int]]:
    """What is trained, the most informative first."""
    ablated = [name for name in ABLATED if name in spacecraft]
    others = [name for name in spacecraft if name not in ABLATED]
    parts = (
        (scale.methods, spacecraft, scale.seeds),
        (scale.ablation, ablated, scale.seeds),
        ((scale.methods[0], scale.ablation[0]), ablated, scale.ablation_seeds),
        (scale.ablation, others, scale.seeds),
    )
    for rows, names, seeds in parts:
        yield from product(rows, names, seeds)


def result_path(results: Path, method: Method, spacecraft: str, seed: int) -> Path:
    return results / f"{spacecraft}_{method.key}_{seed}.json"


def run_training(work: Path, spacecraft: str, out: Path, settings: TrainSettings) -> float:
    """One training, from where it stopped; its minutes."""
    resume = (out / CHECKPOINT).exists()
    state = train(work / "crops", spacecraft, out, settings, resume, work / "cache", val=work / "frames")
    return round(state.elapsed_s / 60, 2)


def learning_curve(run: Path) -> dict[str, object]:
    """Images of the whole run, and its validation RMSE in px along the way, from its metrics."""
    with (run / "metrics.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    pictures = [int(float(row["samples"])) for row in rows]
    curve = [
        [count, float(row["val_rmse_px"])] for count, row in zip(pictures, rows, strict=True) if row["val_rmse_px"]
    ]
    return {"samples": pictures[-1], "curve": curve}


def judge(work: Path, model: Path, method: Method, spacecraft: str, seed: int) -> dict[str, object]:
    """The test frames under our protocols, oracle's and detected crop, and heatmaps under the paper's read-out too."""
    estimator = load_estimator(model)
    dataset = SkdDataset(work / "frames", "test", spacecraft)
    runs: dict[str, ProtocolRun] = {run.protocol: run for run in evaluate(dataset, estimator).runs}
    size = estimator.settings.input_size
    if isinstance(estimator, DirectEstimator):
        network = OnnxModel(model / "direct.onnx")
    else:
        network = OnnxModel(model / "keypoints.onnx")
        paper = PaperEstimator(network.predict, estimator.spacecraft, size)
        runs["paper"] = evaluate(dataset, paper, ("oracle",)).runs[0]
    return {
        "name": method.name,
        **cost(method, network, size),
        "protocols": {name: Trial.of(run, method.key, spacecraft, seed).to_dict() for name, run in runs.items()},
    }


def cost(method: Method, network: OnnxModel, size: int) -> dict[str, object]:
    """Parameters, multiply-accumulates at the deployed size, milliseconds of a crop."""
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    from gknet.network.build import build

    craft = network.spacecraft
    built = build(method.network, craft.adjacency, craft.points_m, method.graph).eval()
    with FlopCounterMode(display=False) as counter:
        built(torch.zeros(1, 3, size, size))
    image = np.zeros((1, 3, size, size), np.float32)
    times = []
    for _ in range(60):
        start = time.perf_counter()
        network(image)
        times.append(time.perf_counter() - start)
    return {
        "parameters": sum(parameter.numel() for parameter in built.parameters()),
        "gmac": counter.get_total_flops() / 2e9,
        "input_size": size,
        "ms": 1000 * float(np.median(times)),
    }


if __name__ == "__main__":
    with ends_in_one_line():
        main()
