"""The second test set, judged once a release: frames that no rule, no weight and no setting was ever chosen by.

    pip install '.[render]'
    python experiments/release_test.py --work runs/release_test

Hardware   2 CPU cores
Time       10 minutes of rendering, 4 minutes of judging
Expected   1,200 frames with the labels of results/release_test/manifest.json, three files of figures for the version
           that is installed in results/release_test, and the table of docs/experiments.md

It is `skd` with seed 1 where everything else uses seed 0: other orbits, motions, light and cameras for the same three
spacecraft. Of each spacecraft's 20 test sequences every 15th frame is taken, as in the figures of the shipped models.
A version is judged once, whatever comes of it; only a fault of this program is a reason for --again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from pathlib import Path

import numpy as np

from gknet import __version__, load_estimator
from gknet.dataset.skd import SkdDataset, open_dataset
from gknet.errors import GknetError, ends_in_one_line
from gknet.evaluation.evaluate import Evaluation, ProtocolRun, evaluate
from gknet.fleet import NAMES
from gknet.io.atomic import write_text
from gknet.io.text import read_json
from gknet.render.generate import generate
from gknet.render.options import Options, Selection
from gknet.render.render_progress import RenderProgress

RECIPE, SEED, SPLIT, EVERY = "skd", 1, "test", 15
RESULTS = Path(__file__).parents[1] / "results/release_test"
MANIFEST = "manifest.json"
DECIMALS = 5
"""Of the labels that are compared: 10 micrometres, and what rounding on another processor does not reach."""

WRONG_RAD = 0.35
"""An attitude that is off by more is wrong: it belongs to a symmetric counterpart, or to nothing."""

CONFIDENCES = (0.5, 0.8)
"""Attitude confidences below which wrong attitudes are counted."""

SHOWN = {"rmse_px": "RMSE px", "e_t": "E_t", "e_q_rad": "E_q rad"}


def render(work: Path) -> None:
    """The frames of all spacecraft; what is there is kept."""
    with RenderProgress() as progress:
        generate(RECIPE, work, Options(SEED), Selection(split=SPLIT, every=EVERY), on_progress=progress.show)


def labels(dataset: SkdDataset) -> dict[str, str]:
    """SHA-256 of each sequence's labels: the frames' numbers and their poses, rounded.

    Images, and keypoints that are hidden by a hair's breadth, may differ between processors; poses may not.
    """
    sums: dict[str, hashlib._Hash] = {}
    for i in range(len(dataset)):
        pose, extras = dataset.frame(i, image=False).cam_from_body, dataset.extras(i)
        if pose is None:
            raise GknetError(f"{dataset.root}: frame {i} has no pose")
        numbers = np.round([*pose.rotation.ravel(), *pose.translation_m], DECIMALS) + 0.0
        row = f"{extras.category} {extras.index} " + " ".join(f"{number:.{DECIMALS}f}" for number in numbers) + "\n"
        sums.setdefault(extras.sequence, hashlib.sha256()).update(row.encode())
    return {sequence: found.hexdigest() for sequence, found in sums.items()}


def check_labels(work: Path, manifest: Path) -> None:
    """Hold the rendered labels against the manifest, or write it where there is none yet."""
    dataset = SkdDataset(work, SPLIT)
    about = {"recipe": RECIPE, "seed": SEED, "split": SPLIT, "every": EVERY, "frames": len(dataset)}
    found = labels(dataset)
    if not manifest.exists():
        write_text(manifest, json.dumps({**about, "sha256": found}, indent=1) + "\n")
    expected = read_json(manifest)["sha256"]
    wrong = sorted(name for name in {*found, *expected} if found.get(name) != expected.get(name))
    if wrong:
        raise GknetError(
            f"{work}: the labels of {len(wrong)} of {len(expected)} sequences are not those of {manifest}, the first "
            f"is {wrong[0]}; render into an empty folder with --work"
        )


def judge(work: Path, out: Path) -> list[Evaluation]:
    """The figures of the shipped models, each in a file; oracle crop and detected crop."""
    found = []
    for name in NAMES:
        estimator = load_estimator(name)
        dataset = open_dataset(work, estimator.spacecraft, SPLIT, every=1)
        words = f"{RECIPE}, seed {SEED}, split {SPLIT}, every {EVERY}th frame"
        found.append(evaluate(dataset, estimator, data=words))
    out.mkdir(parents=True, exist_ok=True)
    for name, evaluation in zip(NAMES, found, strict=True):
        wrong = {run.protocol: wrong_attitudes(run) for run in evaluation.runs}
        content = {"gknet": __version__, **evaluation.to_dict(), "wrong_attitudes": wrong}
        write_text(out / f"{name}.json", json.dumps(content, indent=1, allow_nan=False) + "\n")
    return found


def wrong_attitudes(run: ProtocolRun) -> dict[str, int]:
    """Poses whose attitude is wrong, and how many of them, and of the others, have a low attitude confidence."""
    errors = [case.errors for case in run.cases if case.errors.failure is None]
    wrong = np.array([error.e_q_rad > WRONG_RAD for error in errors])
    confidence = np.array([1.0 if error.attitude_confidence is None else error.attitude_confidence for error in errors])
    counts = {"poses": len(errors), "wrong": int(wrong.sum())}
    for limit in CONFIDENCES:
        counts[f"wrong_below_{limit}"] = int((wrong & (confidence < limit)).sum())
        counts[f"right_below_{limit}"] = int((~wrong & (confidence < limit)).sum())
    return counts


def check_unjudged(out: Path, again: bool) -> None:
    """Refuse to judge a version twice."""
    if out.exists() and any(out.iterdir()) and not again:
        raise GknetError(
            f"{out}: gknet {__version__} was judged already, and a second try would make a choice of it; "
            "print its table with --table, or give --again if the first run was faulty"
        )


def table(out: Path) -> str:
    """Markdown: mean, median of each spacecraft under each crop."""
    lines = ["| spacecraft, crop | frames | no pose | " + " | ".join(SHOWN.values()) + " | in 95 % | IoU >= 0.7 |"]
    lines.append("|---" * (len(SHOWN) + 5) + "|")
    for name in NAMES:
        for protocol, run in read_json(out / f"{name}.json")["runs"].items():
            located = f"{100 * run['located_07']:.1f} %" if protocol == "detected" else ""
            pairs = [(run["metrics"][key]["mean"], run["metrics"][key]["median"]) for key in SHOWN]
            cells = [f"{name}, {protocol} crop", str(run["frames"]), str(sum(run["failures"].values()))]
            cells += [f"{mean:.3g}, {median:.3g}" for mean, median in pairs]
            lines.append("| " + " | ".join([*cells, f"{100 * run['coverage_95']:.0f} %", located]) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--work", type=Path, help="folder to render into (250 MB)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the manifest and of the figures")
    parser.add_argument("--labels-only", action="store_true", help="render and check the labels, judge nothing")
    parser.add_argument("--table", action="store_true", help="print the table of this version's figures, and end")
    parser.add_argument("--again", action="store_true", help="judge a version that was judged, and replace its figures")
    arguments = parser.parse_args()
    out = arguments.results / __version__
    if not arguments.table:
        if arguments.work is None:
            parser.error("--work: expected a folder to render into")
        if not arguments.labels_only:
            check_unjudged(out, arguments.again)
        arguments.results.mkdir(parents=True, exist_ok=True)
        render(arguments.work)
        check_labels(arguments.work, arguments.results / MANIFEST)
        if arguments.labels_only:
            return
        judge(arguments.work, out)
    print(table(out))


if __name__ == "__main__":
    with ends_in_one_line():
        main()
