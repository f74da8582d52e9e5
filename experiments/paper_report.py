"""Tables 1 to 3 of the paper, the graph's ablation and the swaps, from what experiments/paper_tables.py left.

    python experiments/paper_report.py --scale cpu --results results/paper_tables

Hardware   any
Time       seconds
Expected   RESULTS/SCALE/README.md and its charts; it says what is missing when trainings are
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gknet.errors import GknetError, ends_in_one_line
from gknet.evaluation.comparison import (
    ATTITUDE_HOLDS_RAD,
    LOW_VISIBILITY,
    Interval,
    NothingKnownError,
    Trial,
    difference,
    mean_of,
    seed_gaps,
    where_attitudes_hold,
)
from gknet.fleet import NAMES
from gknet.io.atomic import write_text
from gknet.report.chart import Axis, Series, bar_chart, standalone

PAPER_RMSE = {
    "HRNet": (6.12, 74.69, 32.64),
    "ResUNet": (5.62, 59.22, 54.11),
    "GKNet": (5.38, 29.11, 24.58),
    "GKNet, no graph branch": (5.92, 37.30, 27.03),
}
PAPER_POSE = {
    "DMANet": ((1.136, 0.997), (2.627, 1.821), (1.405, 2.745)),
    "HRNet": ((0.754, 0.612), (3.042, 2.157), (1.151, 2.029)),
    "ResUNet": ((0.725, 0.553), (1.416, 1.995), (1.281, 1.953)),
    "GKNet": ((0.763, 0.547), (1.163, 1.016), (0.978, 1.485)),
}
PROTOCOLS = {
    "paper": "the paper's decoding (highest cell of 32x32, plain PnP, oracle crop)",
    "oracle": "ours, oracle crop",
    "detected": "ours, detected crop",
}
ORDER = ("DMANet", "HRNet", "ResUNet", "GKNet")
DIRECT = "DMANet"
"""It detects no keypoints: table 1, from which the paper leaves it out, has those that its pose projects."""
GRAPHS = ("GKNet", "GKNet, no edges", "GKNet, random edges", "GKNet, no graph branch")

METRICS = ("rmse_px", "rmse_hidden_px", "rmse_low_px", "swapped", "e_t", "e_q_rad")
"""What a trial knows of each frame, and what the graphs are compared by."""

COSTS = ("parameters", "gmac", "ms", "learning_rate", "samples", "minutes", "curve")
"""What a result holds of its training, beside its trials."""

Trials = dict[tuple[str, str, str], list[Trial]]
"""(name, spacecraft, protocol) -> one for each seed"""


def read(folder: Path) -> tuple[Trials, dict[str, list[dict]]]:
    """Every training's trials, and what each method cost."""
    trials: Trials = defaultdict(list)
    costs: dict[str, list[dict]] = defaultdict(list)
    for path in sorted(folder.glob("satellite_*.json")):
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            protocols = content.pop("protocols")
            if "oracle" not in protocols:
                raise GknetError("no oracle crop")
            for protocol, values in protocols.items():
                trial = Trial.from_dict(values)
                unknown = [metric for metric in METRICS if metric not in trial.values]
                if unknown:
                    raise GknetError(f"no {', '.join(unknown)}")
                trials[content["name"], trial.spacecraft, protocol].append(trial)
            missing = [key for key in COSTS if key not in content]
            if missing:
                raise GknetError(f"no {', '.join(missing)}")
            costs[content["name"]].append(content | {"spacecraft": trial.spacecraft})
        except (OSError, ValueError, LookupError, TypeError, AttributeError, GknetError) as error:
            raise GknetError(f"{path}: not a result of experiments/paper_tables.py ({error}); delete it") from error
    if not trials:
        raise GknetError(f"{folder}: no results; run experiments/paper_tables.py first")
    return trials, costs


def shown(interval: Interval) -> str:
    return f"{interval.mean:.3g} [{interval.low:.3g}, {interval.high:.3g}]"


def interval(trials: Trials, name: str, spacecraft: str, protocol: str, metric: str) -> Interval | None:
    """None where no frame has a value, as of hidden keypoints where none is hidden."""
    try:
        return mean_of(trials[name, spacecraft, protocol], metric)
    except NothingKnownError:
        return None


def cell(trials: Trials, name: str, spacecraft: str, protocol: str, metric: str) -> str:
    if not trials.get((name, spacecraft, protocol)):
        return "not run"
    found = interval(trials, name, spacecraft, protocol, metric)
    return "-" if found is None else shown(found)


def markdown(header: list[str], rows: list[list[str]]) -> str:
    lines = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def rmse_table(trials: Trials, names: tuple[str, ...], protocol: str, metric: str = "rmse_px") -> str:
    rows = []
    for name in names:
        printed = PAPER_RMSE.get(name) if metric == "rmse_px" else None
        row = [name, *[cell(trials, name, spacecraft, protocol, metric) for spacecraft in NAMES]]
        row[0] += " (its pose's keypoints)" if name == DIRECT else ""
        rows.append([*row, ", ".join(f"{value:g}" for value in printed) if printed else ""])
    return markdown(["method", *NAMES, "the paper's, its own spacecraft"], rows)


def pose_table(trials: Trials, protocol: str) -> str:
    rows = []
    for name in ORDER:
        read = "oracle" if name == DIRECT and protocol == "paper" else protocol  # no heatmaps: nothing to decode
        both = [
            f"{cell(trials, name, craft, read, 'e_t')}; {cell(trials, name, craft, read, 'e_q_rad')}" for craft in NAMES
        ]
        rows.append([name, *both, "; ".join(f"{e_t:g}, {e_q:g}" for e_t, e_q in PAPER_POSE[name])])
    return markdown(["method", *[f"{name}: E_t; E_q rad" for name in NAMES], "the paper's, its own spacecraft"], rows)


def difference_row(
    trials: Trials, first: str, second: str, metric: str, protocol: str, attitudes_hold: bool = False
) -> list[str]:
    """The first method less the second on each spacecraft, paired by frame, of the seeds that both have.

    Bold where the interval excludes zero and each seed by itself puts the same one ahead.
    """
    row = []
    for spacecraft in NAMES:
        pair = [trials.get((each, spacecraft, protocol), []) for each in (first, second)]
        seeds = {trial.seed for trial in pair[0]} & {trial.seed for trial in pair[1]}
        if not seeds:
            row.append("not run")
            continue
        ours, theirs = ([trial for trial in side if trial.seed in seeds] for side in pair)
        if attitudes_hold:
            ours, theirs = where_attitudes_hold(ours, theirs)
        try:
            gap = difference(ours, theirs, metric)
            part = 100 * gap.mean / mean_of(theirs, metric).mean
            each = seed_gaps(ours, theirs, metric)
        except NothingKnownError:
            row.append("-")
            continue
        words = f"{shown(gap)}, {part:+.0f} %, 1 seed"
        if len(each) > 1:
            words = f"{shown(gap)}, {part:+.0f} %, {len(each)} seeds: {', '.join(f'{value:.2g}' for value in each)}"
        sure = gap.excludes_zero and len(set(np.sign(each))) == 1
        row.append(f"**{words}**" if sure else words)
    return row


def difference_table(
    trials: Trials,
    firsts: tuple[str, ...],
    seconds: tuple[str, ...],
    metrics: tuple[str, ...],
    protocol: str,
    attitudes_hold: bool = False,
) -> str:
    """Each first method less each second one; on all frames, or on those in which both attitudes are right."""
    rows = [
        [f"{first} less {second}", metric, *difference_row(trials, first, second, metric, protocol, attitudes_hold)]
        for first in firsts
        for second in seconds
        for metric in metrics
    ]
    return markdown(["methods", "metric", *NAMES], rows)


def cost_table(costs: dict[str, list[dict]]) -> str:
    rows = []
    for name, found in costs.items():
        one = found[0]
        minutes = [content["minutes"] for content in found]
        rows.append(
            [
                name,
                f"{one['parameters'] / 1e6:.2f} M",
                f"{one['gmac']:.3f}",
                f"{np.median([content['ms'] for content in found]):.1f}",
                ", ".join(f"{rate:g}" for rate in sorted({content["learning_rate"] for content in found})),
                str(one["samples"]),
                f"{np.mean(minutes):.1f}",
                str(len(found)),
            ]
        )
    header = ["method", "parameters", "GMAC a crop", "ms a crop", "learning rate", "images seen", "minutes"]
    return markdown([*header, "trainings"], rows)


def curve_table(costs: dict[str, list[dict]]) -> str:
    """Validation RMSE along the training, mean over the seeds: how many images it takes."""
    curves: dict[tuple[str, str], list[list[list[float]]]] = defaultdict(list)
    for name, found in costs.items():
        for content in found:
            curves[content["spacecraft"], name].append(content["curve"])
    rows = []
    for (spacecraft, name), each in sorted(curves.items()):
        pictures, rmse = np.mean(each, axis=0).T  # (validations, 2)
        words = ", ".join(f"{value:.1f}" for value in rmse)
        rows.append([spacecraft, name, words, f"{pictures[-1]:.0f}", str(len(each))])
    return markdown(["spacecraft", "method", "RMSE at equal steps to the end", "images seen by then", "seeds"], rows)


def graph_table(trials: Trials, words: Callable[[list[Trial]], str], protocol: str = "oracle") -> str:
    """The trials of each graph on each spacecraft, summarised by `words`."""
    rows = []
    for name in GRAPHS:
        found = [trials.get((name, spacecraft, protocol)) for spacecraft in NAMES]
        rows.append([name, *[words(each) if each else "not run" for each in found]])
    return markdown(["graph", *NAMES], rows)


def swaps(found: list[Trial]) -> str:
    """Of the detections that lie at a keypoint: at their own, at another one (a swap)."""
    matrix = np.sum([trial.confusion for trial in found], axis=0)
    right, all_near = np.trace(matrix), matrix.sum()
    return f"{right} right, {all_near - right} swapped ({100 * (1 - right / max(all_near, 1)):.1f} %)"


def wrong_attitudes(found: list[Trial]) -> str:
    """Of the frames, and of the sum of the RMSE of hidden keypoints, what belongs to wrong attitudes."""
    wrong = np.concatenate([trial.values["e_q_rad"] for trial in found]) > ATTITUDE_HOLDS_RAD
    hidden = np.concatenate([trial.values["rmse_hidden_px"] for trial in found])
    part = np.nansum(hidden[wrong]) / max(np.nansum(hidden), 1e-9)
    return f"{wrong.sum()} of {len(wrong)}, {100 * part:.0f} % of the RMSE"


def bars(trials: Trials, spacecraft: str) -> str:
    """RMSE of every method that detects keypoints, of all and of the hidden ones, as an SVG file."""
    names = [name for name in (*ORDER, *GRAPHS[1:]) if name != DIRECT and trials.get((name, spacecraft, "oracle"))]
    series = []
    for words, metric in (("all keypoints", "rmse_px"), ("hidden", "rmse_hidden_px")):
        found = [interval(trials, name, spacecraft, "oracle", metric) for name in names]
        rows = [(each.mean, each.low, each.high) if each else (np.nan,) * 3 for each in found]
        mean, low, high = np.array(rows).T
        series.append(Series(words, np.arange(len(names)), mean, low, high))
    title = f"{spacecraft}, oracle crop"
    return standalone(bar_chart(title, Axis("mean RMSE, px of the 256 crop"), names, series))


def page(trials: Trials, costs: dict[str, list[dict]], scale: str, pictures: list[str]) -> str:
    parts = [
        f"# The paper's tables, scale `{scale}`",
        "Made by `experiments/paper_tables.py` and `experiments/paper_report.py`; the method, the differences from the "
        "paper "
        "and what follows from the figures are in [docs/paper.md](../../../docs/paper.md). Means over the test frames "
        "and seeds with 95 % intervals, bootstrapped over sequences, and over seeds where there are several. The "
        "variance between trainings is not in the interval of one seed, and too little in that of two or three. Pixels "
        "of the 256 crop, radians.",
        *[f"![RMSE of the methods on {Path(name).stem}]({name})" for name in pictures],
        "## Cost\n" + cost_table(costs),
    ]
    parts.append("## While training: RMSE in px on validation frames, oracle crop\n" + curve_table(costs))
    hybrid = tuple(name for name in ORDER if name != DIRECT)
    for protocol, words in PROTOCOLS.items():
        names = hybrid if protocol == "paper" else ORDER
        parts.append(f"## Table 1, RMSE in px: {words}\n" + rmse_table(trials, names, protocol))
    parts.append("## Hidden keypoints, RMSE in px: ours, oracle crop\n")
    parts[-1] += rmse_table(trials, ORDER, "oracle", "rmse_hidden_px")
    for protocol, words in PROTOCOLS.items():
        parts.append(f"## Table 2, pose: {words}\n" + pose_table(trials, protocol))
    parts.append(
        "## GKNet less the others, paired by frame, ours, oracle crop\n"
        "Bold here and below: the interval excludes zero, and each seed has the same sign.\n\n"
    )
    parts[-1] += difference_table(trials, ("GKNet",), hybrid[:-1], ("rmse_px", "e_t", "e_q_rad"), "oracle")
    for protocol in ("oracle", "detected"):
        parts.append(f"## The hybrid methods less {DIRECT}, paired by frame, {PROTOCOLS[protocol]}\n")
        parts[-1] += difference_table(trials, hybrid, (DIRECT,), ("e_t", "e_q_rad"), protocol)
    parts.append("## Table 3 and beyond: which graph? RMSE in px, ours, oracle crop\n")
    parts[-1] += rmse_table(trials, GRAPHS, "oracle")
    parts.append(
        "## The graph on hidden keypoints, RMSE in px\n" + rmse_table(trials, GRAPHS, "oracle", "rmse_hidden_px")
    )
    parts.append(
        f"## The graph where less than {100 * LOW_VISIBILITY:.0f} % of the keypoints are visible, RMSE in px\n"
        + rmse_table(trials, GRAPHS, "oracle", "rmse_low_px")
    )
    parts.append("## The skeleton less the other graphs, paired by frame\n")
    parts[-1] += difference_table(trials, ("GKNet",), GRAPHS[1:], METRICS, "oracle")
    parts.append(f"## Frames with a wrong attitude (E_q above {ATTITUDE_HOLDS_RAD} rad), ours, oracle crop\n")
    parts[-1] += graph_table(trials, wrong_attitudes)
    parts.append("## The skeleton less the other graphs, on frames where both attitudes are right\n")
    parts[-1] += difference_table(trials, ("GKNet",), GRAPHS[1:], METRICS, "oracle", attitudes_hold=True)
    parts.append(
        "## Swaps among the detections that lie at a keypoint, ours, oracle crop\n" + graph_table(trials, swaps)
    )
    return "\n\n".join(parts) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--results", type=Path, required=True, help="folder of the figures")
    parser.add_argument("--scale", default="cpu", help="its sub-folder")
    arguments = parser.parse_args()
    folder = arguments.results / arguments.scale
    trials, costs = read(folder)
    pictures = []
    for spacecraft in NAMES:
        if any(craft == spacecraft and name != DIRECT for name, craft, _ in trials):
            pictures.append(f"{spacecraft}.svg")
            write_text(folder / pictures[-1], bars(trials, spacecraft))
    text = page(trials, costs, arguments.scale, pictures)
    write_text(folder / "README.md", text)
    print(text)


if __name__ == "__main__":
    with ends_in_one_line():
        main()
