"""Evaluations as tables: the rows that the terminal and the page share, and the terminal's rendering."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.table import Table
from rich.text import Text

from gknet.evaluation.evaluate import Evaluation, ProtocolRun
from gknet.evaluation.summary import Statistic
from gknet.io.text import printable


@dataclass(frozen=True)
class Row:
    """A metric as it is shown.

    Attributes:
        metric: Its key in a summary.
        title: Its name in tables.
        unit: Of its values.
        digits: After the decimal point.
        meaning: In one line.
    """

    metric: str
    title: str
    unit: str
    digits: int
    meaning: str

    @property
    def short_unit(self) -> str:
        """The unit where the title alone would mislead."""
        return self.unit.split()[0] if self.unit in ("px of 256", "rad") else ""


ROWS = (
    Row("rmse_px", "RMSE", "px of 256", 2, "keypoints in view, root mean square in each image"),
    Row("rmse_hidden_px", "RMSE, hidden", "px of 256", 2, "the keypoints in view that the spacecraft hides"),
    Row("pck_2", "PCK 2 px", "fraction", 3, "keypoints nearer than 2 px to the truth"),
    Row("pck_5", "PCK 5 px", "fraction", 3, "keypoints nearer than 5 px to the truth"),
    Row("pck_10", "PCK 10 px", "fraction", 3, "keypoints nearer than 10 px to the truth"),
    Row("e_t", "E_t", "of range", 4, "translation error over range; a failure counts as 1"),
    Row("e_q_rad", "E_q", "rad", 4, "rotation error; a failure counts as pi"),
    Row("speed_score", "SPEED score", "", 4, "E_t + E_q"),
    Row("add", "ADD", "diameters", 4, "mean distance of the keypoints between both poses"),
    Row("add_s", "ADD-S", "diameters", 4, "the same to the nearest keypoint"),
    Row("add_below_tenth", "ADD < 0.1", "fraction", 3, "frames whose ADD is below a tenth of the diameter"),
    Row("locator_iou", "Box IoU", "", 3, "overlap of the box used with the true one"),
    Row("nees", "NEES", "", 1, "squared pose error over its covariance; 6 is right"),
)


COUNT_MEANINGS = (
    (
        "in 68 % ellipsoid",
        "poses whose true value lies in the 68 % ellipsoid of their covariance; likewise 95 %",
    ),
    ("median time", "from the image in memory to the pose, on this machine"),
)


def statistic(run: ProtocolRun, metric: str) -> Statistic | None:
    """A metric of a run; the oracle's box is the truth itself, so its overlap means nothing."""
    if run.protocol == "oracle" and metric == "locator_iou":
        return None
    return run.summary.metrics.get(metric)


def interval_text(found: Statistic | None, digits: int) -> str:
    """The mean with its 95 % interval where there is one, "mean [low, high]"; "-" for None."""
    if found is None:
        return "-"
    mean = f"{found.mean:.{digits}f}"
    return mean if found.low is None else f"{mean} [{found.low:.{digits}f}, {found.high:.{digits}f}]"


def mean_heading(run: ProtocolRun, interval: str = "") -> str:
    """The heading of a column of `interval_text`; it names the interval where a metric of the run has one."""
    has_interval = any(found.low is not None for found in run.summary.metrics.values())
    return f"mean [{f'95 % {interval}'.strip()}]" if has_interval else "mean"


def median_text(found: Statistic | None, digits: int) -> str:
    """The median; "-" for None."""
    return "-" if found is None else f"{found.median:.{digits}f}"


def failure_count(run: ProtocolRun) -> int:
    """Frames without a pose."""
    return sum(run.summary.failures.values())


def percent_text(part: float | None) -> str:
    """A share, 0 to 1, in per cent; "-" for None."""
    return "-" if part is None else f"{100 * part:.1f} %"


def metric_table(evaluation: Evaluation) -> Table:
    """Every metric, the protocols side by side; it fits a terminal of 80 columns."""
    table = _plain_table(printable(f"{evaluation.spacecraft.name}: {evaluation.data}"))
    table.add_column("metric", no_wrap=True)
    for run in evaluation.runs:
        table.add_column(f"{run.protocol}: {mean_heading(run)}", justify="right", no_wrap=True)
        table.add_column("median", justify="right", no_wrap=True)
    for row in ROWS:
        found = [statistic(run, row.metric) for run in evaluation.runs]
        if any(found):
            cells = [text(one, row.digits) for one in found for text in (interval_text, median_text)]
            table.add_row(f"{row.title} {row.short_unit}".strip(), *cells)
    for title, texts in summary_rows(evaluation):
        table.add_row(title, *[cell for text in texts for cell in (text, "")], style="dim")
    return table


def _plain_table(title: str) -> Table:
    """A table without lines; rich sees no markup in its title."""
    title_text = Text(title, style="bold")
    return Table(title=title_text, title_justify="left", box=None, padding=(0, 1, 0, 0), pad_edge=False)


def summary_rows(evaluation: Evaluation) -> list[tuple[str, list[str]]]:
    """What has no mean: counts, coverages, time; one text a run."""
    runs = evaluation.runs
    return [
        ("frames (seq.)", [f"{run.summary.frames} ({run.summary.sequences})" for run in runs]),
        ("failures", [str(failure_count(run)) for run in runs]),
        (
            "box IoU >= 0.7",
            [percent_text(run.summary.located_07 if run.protocol == "detected" else None) for run in runs],
        ),
        ("in 68 % ellipsoid", [percent_text(run.summary.coverage_68) for run in runs]),
        ("in 95 % ellipsoid", [percent_text(run.summary.coverage_95) for run in runs]),
        ("median time", [f"{run.median_ms:.1f} ms" for run in runs]),
    ]


def comparison_table(evaluations: Sequence[Evaluation], title: str) -> Table:
    """One row a spacecraft and protocol, the headline metrics only."""
    table = _plain_table(title)
    table.add_column("spacecraft")
    table.add_column("crop")
    for heading in (
        "frames",
        "failed",
        "RMSE\npx",
        "E_t\nmean",
        "E_t\nmedian",
        "E_q rad\nmean",
        "E_q rad\nmedian",
        "ms",
    ):
        table.add_column(heading, justify="right", no_wrap=True)
    for evaluation in evaluations:
        for run in evaluation.runs:
            found = run.summary.metrics
            table.add_row(
                Text(printable(evaluation.spacecraft.name)),
                run.protocol,
                str(run.summary.frames),
                str(failure_count(run)),
                f"{found['rmse_px'].mean:.2f}" if "rmse_px" in found else "-",
                f"{found['e_t'].mean:.4f}",
                f"{found['e_t'].median:.4f}",
                f"{found['e_q_rad'].mean:.4f}",
                f"{found['e_q_rad'].median:.4f}",
                f"{run.median_ms:.1f}",
            )
    return table
