"""`gknet demo`: the shipped models on the bundled test frames of all three spacecraft, offline."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gknet.cli.model_options import DeviceOption, ThreadsOption, open_estimator
from gknet.cli.terminal import print_line, print_table, print_warning
from gknet.errors import GknetError

if TYPE_CHECKING:
    from gknet.dataset.skd import SkdDataset
    from gknet.report.page import Section
    from gknet.spacecraft import Spacecraft

_FPS = 6.0


def demo(
    out: Annotated[Path, typer.Option(help="Folder for poses, overlays, video and report.")] = Path("demo-output"),
    threads: ThreadsOption = None,
    device: DeviceOption = "cpu",
) -> None:
    """Estimate the poses of the bundled test frames and compare them with the truth."""
    import time

    from gknet.dataset.demo_frames import bundled_frames
    from gknet.dataset.skd import open_dataset
    from gknet.inference.load import shipped_folder, shipped_models
    from gknet.io.atomic import output_folder
    from gknet.io.progress import progress
    from gknet.report.table import comparison_table
    from gknet.report.write import evaluate_section, write_report

    start = time.perf_counter()
    names = shipped_models()
    if not names:
        raise GknetError("demo: no model is shipped with this installation; install gknet from a built wheel")
    frames = bundled_frames()
    sections: list[Section] = []
    written: list[Path] = []
    with output_folder(out):
        for name in names:
            estimator = open_estimator(shipped_folder(name), threads, device)
            dataset = open_dataset(frames, estimator.spacecraft, None, 1)
            with progress() as bar:
                task = bar.add_task(name, total=len(dataset))
                section = evaluate_section(
                    dataset,
                    estimator,
                    "bundled test frames",
                    3,
                    lambda: bar.advance(task),  # noqa: B023
                )
            sections.append(section)
            written += write_results(out / estimator.spacecraft.name, dataset, estimator.spacecraft, section)
        evaluations = [section.evaluation for section in sections]
        content: dict[str, object] = {each.spacecraft.name: each.to_dict() for each in evaluations}
        written += write_report(out, "gknet demo", sections, {"spacecraft": content})
    print_table(comparison_table(evaluations, "errors against the truth, bundled test frames"))
    for path in written:
        print_line(f"wrote {path}")
    print_line(f"done in {time.perf_counter() - start:.1f} s")


def write_results(folder: Path, dataset: SkdDataset, spacecraft: Spacecraft, section: Section) -> list[Path]:
    """Write the poses, overlays and video of an evaluation's last protocol."""
    from gknet.predict.results import PredictionWriter

    with PredictionWriter(folder, spacecraft, fps=_FPS) as writer:
        for case in section.evaluation.runs[-1].cases:
            writer.add(dataset.frame(case.index), case.estimate)
    for sentence in writer.losses:
        print_warning(sentence)
    return [path for path in (writer.poses_path, writer.overlay_folder, writer.video_path) if path is not None]
