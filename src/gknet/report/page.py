"""One HTML file that shows evaluations: it holds its own style, charts and images, and asks for nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gknet import __version__
from gknet.evaluation.evaluate import PROTOCOL_WORDS, UNKNOWN_WORDS, Evaluation, ProtocolRun
from gknet.evaluation.summary import Statistic
from gknet.io.text import counted
from gknet.report.chart import page_style
from gknet.report.gallery import Gallery
from gknet.report.markup import escaped
from gknet.report.plots import charts
from gknet.report.table import (
    COUNT_MEANINGS,
    ROWS,
    failure_count,
    interval_text,
    mean_heading,
    median_text,
    percent_text,
    statistic,
    summary_rows,
)


@dataclass(frozen=True, eq=False)
class Section:
    """One spacecraft's part of the page.

    Attributes:
        evaluation: The errors.
        galleries: Images, in the order of the page.
    """

    evaluation: Evaluation
    galleries: tuple[Gallery, ...] = ()


def page(title: str, sections: Sequence[Section]) -> str:
    """The whole page as HTML; every number in its tables carries its full value in `data-value`."""
    body = "".join(_section(section) for section in sections)
    links = "".join(
        f'<a href="#{escaped(s.evaluation.spacecraft.name)}">{escaped(s.evaluation.spacecraft.name)}</a>'
        for s in sections
    )
    contents = f"<nav>{links}</nav>" if len(sections) > 1 else ""
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8"/>'
        '<meta name="viewport" content="width=device-width, initial-scale=1"/>'
        f"<title>{escaped(title)}</title><style>{page_style()}</style></head><body><main>"
        f'<header><h1>{escaped(title)}</h1><p class="quiet">gknet {__version__}</p>{contents}</header>'
        f"{body}{_glossary()}</main></body></html>\n"
    )


def _section(section: Section) -> str:
    evaluation = section.evaluation
    name = escaped(evaluation.spacecraft.name)
    first = evaluation.runs[0].summary
    words = [f"{evaluation.data}: {counted(first.frames, 'frame')} of {counted(first.sequences, 'sequence')}"]
    words += [f"Unknown: {UNKNOWN_WORDS[column]}." for column in evaluation.unknown]
    lines = "".join(f'<p class="quiet">{escaped(line)}</p>' for line in words)
    return (
        f'<section id="{name}"><h2>{name}</h2>{lines}'
        f"{_cards(evaluation)}{_metric_table(evaluation)}{_failures(evaluation)}"
        f'<h3>Charts</h3><div class="charts">{"".join(charts(evaluation))}</div>'
        f"{''.join(_gallery(gallery) for gallery in section.galleries)}</section>"
    )


def _cards(evaluation: Evaluation) -> str:
    """The headline numbers of the last run, which is the one nearest to real use."""
    run = evaluation.runs[-1]
    found = run.summary.metrics
    cards = [
        ("mean RMSE", _short(found.get("rmse_px"), 2), "px of 256"),
        ("mean E_t", _short(found.get("e_t"), 4), "of the range"),
        ("mean E_q", _short(found.get("e_q_rad"), 4), "rad"),
        ("failures", str(failure_count(run)), f"of {counted(run.summary.frames, 'frame')}"),
    ]
    if run.protocol == "detected":
        cards.append(("box IoU of 0.7 or more", percent_text(run.summary.located_07), "of frames"))
    cells = "".join(
        f'<div class="card"><span>{escaped(title)}</span><strong>{escaped(value)}</strong>'
        f"<small>{escaped(unit)}</small></div>"
        for title, value, unit in cards
    )
    return f'<p class="label">{escaped(PROTOCOL_WORDS[run.protocol])}</p><div class="cards">{cells}</div>'


def _short(found: Statistic | None, digits: int) -> str:
    return "-" if found is None else f"{found.mean:.{digits}f}"


def _metric_table(evaluation: Evaluation) -> str:
    runs = evaluation.runs
    top = "".join(f'<th colspan="2">{escaped(PROTOCOL_WORDS[run.protocol])}</th>' for run in runs)
    second = "".join(f"<th>{escaped(mean_heading(run, 'interval'))}</th><th>median</th>" for run in runs)
    rows = []
    for row in ROWS:
        if not any(statistic(run, row.metric) for run in runs):
            continue
        cells = "".join(_metric_cells(run, row.metric, row.digits) for run in runs)
        title, unit = escaped(row.title), escaped(row.unit)
        head = f'<th scope="row" title="{escaped(row.meaning)}">{title} <small>{unit}</small></th>'
        rows.append(f"<tr>{head}{cells}</tr>")
    for title, texts in summary_rows(evaluation):
        cells = "".join(f'<td colspan="2">{escaped(text)}</td>' for text in texts)
        rows.append(f'<tr class="count"><th scope="row">{escaped(title)}</th>{cells}</tr>')
    return (
        f'<div class="scroll"><table><thead><tr><th rowspan="2">metric</th>{top}</tr><tr>{second}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _metric_cells(run: ProtocolRun, metric: str, digits: int) -> str:
    found = statistic(run, metric)
    if found is None:
        return "<td>-</td><td>-</td>"
    key = f"{run.protocol}.{metric}"
    return (
        f'<td data-metric="{key}.mean" data-value="{found.mean!r}">{interval_text(found, digits)}</td>'
        f'<td data-metric="{key}.median" data-value="{found.median!r}">{median_text(found, digits)}</td>'
    )


def _failures(evaluation: Evaluation) -> str:
    """Kinds of failures, with the number of frames, and frames that were skipped; nothing where all went well."""
    items = [
        f"<li>{escaped(PROTOCOL_WORDS[run.protocol])}: {count} x {escaped(kind.label)}</li>"
        for run in evaluation.runs
        for kind, count in run.summary.failures.items()
    ]
    items += [f"<li>skipped: {escaped(bad.name)}: {escaped(str(bad.failure))}</li>" for bad in evaluation.skipped]
    if not items:
        return ""
    return f"<details><summary>Failures and why ({len(items)})</summary><ul>{''.join(items)}</ul></details>"


def _gallery(gallery: Gallery) -> str:
    figures = "".join(
        f'<figure><img loading="lazy" alt="{escaped(picture.title)}" src="{picture.data_uri}"/>'
        f"<figcaption><b>{escaped(picture.title)}</b> {escaped(picture.caption)}</figcaption></figure>"
        for picture in gallery.pictures
    )
    return f'<h3>{escaped(gallery.title)}</h3><div class="gallery">{figures}</div>'


def _glossary() -> str:
    meanings = [(row.title, row.meaning) for row in ROWS] + list(COUNT_MEANINGS)
    terms = "".join(f"<dt>{escaped(title)}</dt><dd>{escaped(meaning)}</dd>" for title, meaning in meanings)
    return (
        '<section><h2>How to read this</h2><p>In the images the estimate is <span class="estimate">blue</span>, the '
        "truth white and dashed. Pink brackets are the box, arrows the body axes X (red), Y (green) and Z (blue). "
        "Keypoints are coloured by score, from vermillion (0) to pale yellow (1): a disc is visible, a ring is hidden "
        "by the spacecraft, a square is of unknown visibility, and a cross is an outlier, which has no part in the "
        "pose. Intervals come from a bootstrap over whole sequences; a single sequence has none.</p>"
        f"<dl>{terms}</dl></section>"
    )
