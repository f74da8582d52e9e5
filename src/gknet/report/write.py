"""An evaluation with its images, and the two files that hold it: metrics.json and report.html."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from gknet import __version__
from gknet.dataset.skd import SkdDataset
from gknet.evaluation.evaluate import PROTOCOL_WORDS, evaluate
from gknet.frame import PoseEstimator
from gknet.io.atomic import write_text
from gknet.report.gallery import galleries
from gknet.report.page import Section, page


def evaluate_section(
    dataset: SkdDataset,
    estimator: PoseEstimator,
    data: str,
    pictures: int,
    on_frame: Callable[[], None] = lambda: None,
) -> Section:
    """Evaluate an estimator, and draw the images for the page.

    Args:
        dataset: Frames with true poses.
        estimator: One without a locator is run with the oracle's crop alone.
        data: Words for the report: where the frames come from.
        images: In each gallery.
        on_frame: Called after each frame, for a progress bar.

    Raises:
        GknetError: No frame could be used.
    """
    protocols = tuple(PROTOCOL_WORDS) if estimator.has_locator else ("oracle",)
    evaluation = evaluate(dataset, estimator, protocols, data, on_frame)
    return Section(evaluation, galleries(evaluation.runs[-1], dataset, estimator.spacecraft, pictures))


def write_report(out: Path, title: str, sections: Sequence[Section], content: dict[str, object]) -> tuple[Path, Path]:
    """Write metrics.json and report.html, each whole or absent.

    Args:
        out: An existing folder.
        title: Of the page.
        sections: Of the page, one for each spacecraft.
        content: Of metrics.json, beside the version of gknet.

    Returns:
        The paths of both files.

    Raises:
        OSError: A file cannot be written.
    """
    metrics_path, page_path = out / "metrics.json", out / "report.html"
    text = json.dumps({"gknet": __version__, **content}, indent=1, allow_nan=False)
    write_text(metrics_path, text + "\n")
    write_text(page_path, page(title, sections))
    return metrics_path, page_path
