"""The model cards, and tables for the documentation, from the figures that experiments/shipped_models.py left.

    python experiments/shipped_tables.py --models src/gknet/models --results results/shipped_models

Hardware   any
Time       a second
Expected   a README.md beside each model, and the tables on the terminal
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import onnxruntime

from gknet.errors import GknetError, ends_in_one_line
from gknet.fleet import NAMES
from gknet.inference.onnx_model import METADATA_KEY
from gknet.io.atomic import write_text

PROTOCOLS = {
    "oracle crop": ("oracle", ""),
    "detected crop": ("detected", ""),
    "detected crop, 4 rotations": ("detected", "_tta4"),
}
"""Column -> the protocol in a file of figures, and the end of the file's name."""
SHORT = {"oracle crop": "oracle", "detected crop": "detected", "detected crop, 4 rotations": "detected, TTA"}
"""Column -> what a narrow table calls it."""
COLUMNS = {
    "rmse_px": "RMSE px",
    "rmse_hidden_px": "RMSE hidden px",
    "pck_5": "PCK 5 px",
    "e_t": "E_t",
    "e_q_rad": "E_q rad",
    "speed_score": "SPEED score",
    "add": "ADD, diameters",
}


def figures(results: Path, name: str, recipe: str, words: str = "oracle crop") -> dict[str, Any]:
    """A run of a spacecraft's metrics.json."""
    protocol, ending = PROTOCOLS[words]
    path = results / f"{name}_{recipe}{ending}.json"
    try:
        return json.loads(path.read_text(encoding="utf-8"))["runs"][protocol]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise GknetError(f"{path}: not the figures of experiments/shipped_models.py ({error})") from error


def digits(value: float) -> str:
    """Three significant digits, zeros at the end kept: 0.05 is 0.0500."""
    return f"{value:#.3g}".removesuffix(".")


def mean_median(found: dict[str, Any]) -> str:
    """Mean (median) of a metric."""
    return f"{digits(found['mean'])} ({digits(found['median'])})"


def statistic(run: dict[str, Any], name: str) -> str:
    """Mean (median) [95 % interval of the mean]."""
    found = run["metrics"].get(name)
    if found is None:
        return ""
    return f"{mean_median(found)} [{digits(found['low'])}, {digits(found['high'])}]"


def table(results: Path, recipe: str) -> str:
    """Markdown: mean (median) of the headline figures; a row for each spacecraft and crop."""
    shown = ("rmse_px", "rmse_hidden_px", "e_t", "e_q_rad")
    header = ["spacecraft", "crop", "no pose", *[COLUMNS[name] for name in shown], "in 95 %", "IoU >= 0.7"]
    lines = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    for name in NAMES:
        for words in PROTOCOLS:
            run = figures(results, name, recipe, words)
            located = "" if words == "oracle crop" else f"{100 * run['located_07']:.1f} %"
            cells = [name, SHORT[words], str(sum(run["failures"].values()))]
            cells += [mean_median(run["metrics"][column]) for column in shown]
            lines.append("| " + " | ".join([*cells, f"{100 * run['coverage_95']:.0f} %", located]) + " |")
    return "\n".join(lines)


def binned_table(
    results: Path, names: Sequence[str], recipe: str, words: str, by: str, metric: str, columns: dict[float, str]
) -> str:
    """Markdown: frames, and mean (median) of a metric, by a condition; `columns` are lower ends of bins and names."""
    header = ["spacecraft", *columns.values()]
    lines = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    for name in names:
        bins = {b["low"]: b for b in figures(results, name, recipe, words)["bins"] if b["by"] == by}
        cells = [name]
        for low in columns:
            found = bins[low]["metrics"][metric] if low in bins else None
            cells.append("none" if found is None else f"{found['frames']}: {mean_median(found)}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def background_table(results: Path, names: Sequence[str], recipe: str) -> str:
    """RMSE of the oracle crop, by what is behind the spacecraft."""
    columns = {0.0: "black sky", 0.5: "Earth in view"}
    return binned_table(results, names, recipe, "oracle crop", "earth_in_view", "rmse_px", columns)


def confidence_table(results: Path, names: Sequence[str], recipe: str) -> str:
    """E_q of the detected crop, by the confidence in the attitude."""
    columns = {0.0: "below .5", 0.5: ".5 to .8", 0.8: ".8 to .95", 0.95: ".95 and more"}
    return binned_table(results, names, recipe, "detected crop", "attitude_confidence", "e_q_rad", columns)


def validated(path: Path) -> dict[str, Any]:
    """What the export wrote about a model, its validation included."""
    try:
        session = onnxruntime.InferenceSession(str(path))
        about = json.loads(session.get_modelmeta().custom_metadata_map[METADATA_KEY])
    except Exception as error:  # onnxruntime's exceptions have no common base
        raise GknetError(f"{path}: not a model that 'gknet export' wrote ({error})") from error
    return about


VALIDATION = (
    "",
    "The validation sequences are neither trained on nor tested; keypoints are validated with the oracle crop. `score`",
    "decides which weights are kept (lower is better). `share` is the share of the last training in the weights, which",
    "are the mean of those before and after it. The documentation (training, logged values) explains the others.",
)
LIMITS = (
    "",
    "## Limits",
    "",
    "- No real photograph was ever used, neither to train nor to test.",
    "- The models are made for spacecraft that span 8 to 90 % of a 1024 px frame. Another camera works through its",
    "  matrix; a span far outside that range does not.",
    "- Where symmetric parts look the same, the attitude can be wrong although the reprojection error is small.",
    "  A low `attitude_confidence` reveals a part of such poses; the table above shows how large a part.",
    "- The models know this spacecraft alone. An image of another one can get a confident wrong pose.",
    "- Test frames decided three rules of the pose solver (decision 0014 of the documentation).",
    "- Weights are stored in 16 bits.",
    "",
    "Licence: Apache-2.0, as the package.",
)


def card(models: Path, results: Path, name: str) -> str:
    """What is known of one spacecraft's two networks."""
    lines = [f"# gknet models of {name}", ""]
    lines += [
        "Trained on rendered images alone (renderer recipe `skd`, 4,500 sequences, seed 0) by",
        "`experiments/shipped_models.py`; the log of experiments in the documentation describes the runs.",
        "Keypoint errors are in pixels of the 256 px crop. E_t is the error of the position relative to the range.",
        "",
    ]
    lines += ["| network | input px | file | validation of these weights |", "|---|---|---|---|"]
    for kind in ("keypoints", "locator"):
        path = models / name / f"{kind}.onnx"
        about = validated(path)
        best = ", ".join(f"{key} {value:.3g}" for key, value in about["validation"].items())
        size = f"{path.name}, {path.stat().st_size / 1e6:.1f} MB"
        lines.append(f"| {about['network']} | {about['input_size']} | {size} | {best} |")
    lines += VALIDATION
    for recipe in ("skd", "skd-hard"):
        runs = [figures(results, name, recipe, words) for words in PROTOCOLS]
        lines += ["", f"## {recipe}, test sequences: mean (median) [95 % interval of the mean, over sequences]", ""]
        lines += ["| | " + " | ".join(PROTOCOLS) + " |", "|---" * (1 + len(PROTOCOLS)) + "|"]
        for column, words in COLUMNS.items():
            cells = [statistic(run, column) for run in runs]
            lines.append(f"| {words} | " + " | ".join(cells) + " |")
        covered = [f"{100 * run['coverage_95']:.0f} %" for run in runs]
        lines.append("| true poses in the 95 % ellipsoid | " + " | ".join(covered) + " |")
    lines += ["", "## skd, by background, oracle crop: frames, RMSE px as mean (median)", ""]
    lines += [background_table(results, (name,), "skd")]
    lines += ["", "## skd, by attitude_confidence, detected crop: frames, E_q rad as mean (median)", ""]
    lines += [confidence_table(results, (name,), "skd"), *LIMITS]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--models", type=Path, required=True, help="folder of the exported models")
    parser.add_argument("--results", type=Path, required=True, help="folder of the figures")
    arguments = parser.parse_args()
    for name in NAMES:
        write_text(arguments.models / name / "README.md", card(arguments.models, arguments.results, name))
    for recipe in ("skd", "skd-hard"):
        frames = figures(arguments.results, NAMES[0], recipe)["frames"]
        print(f"\n{recipe}, {frames} frames each: mean (median)\n\n{table(arguments.results, recipe)}")
        print(f"\n{recipe}, by background: frames, RMSE px\n\n{background_table(arguments.results, NAMES, recipe)}")
        confidence = confidence_table(arguments.results, NAMES, recipe)
        print(f"\n{recipe}, by attitude_confidence: frames, E_q rad\n\n{confidence}")


if __name__ == "__main__":
    with ends_in_one_line():
        main()
