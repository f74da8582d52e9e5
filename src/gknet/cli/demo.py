"""`gknet demo`: the shipped models on the bundled test frames of all three spacecraft, offline."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gknet.errors import GknetError

if TYPE_CHECKING:
    from gknet.dataset.skd import SkdDataset
    from gknet.evaluation.evaluate import Evaluation
    from gknet.frame import PoseEstimator
    from gknet.report.page import Section

_FPS = 6.0


def demo(
    out: Annotated[Path, typer.Option(help="Folder for poses, overlays, video and report.")] = Path("demo-output"),
    threads: Annotated[int | None, typer.Option(help="Threads of the network; all cores by default.")] = None,
) -> None:
    """Estimate the poses of the bundled test frames and compare them with the truth."""
    import time

    from rich.console import Console

    from gknet.dataset.skd import open_dataset
    from gknet.inference.load import load_estimator, shipped_models
    from gknet.report.table import comparison_table

    start = time.perf_counter()
    names = shipped_models()
    if not names:
        raise GknetError("demo: no model is shipped with this installation; install gknet from a built wheel")
    folder = bundled_frames()
    out.mkdir(parents=True, exist_ok=True)
    sections: list[Section] = []
    written: list[Path] = []
    for name in names:
        estimator = load_estimator(name, threads=threads)
        section, paths = show(open_dataset(folder, estimator.spacecraft, None, 1), estimator, out)
        sections.append(section)
        written += paths
    written += write_comparison(out, sections)
    Console().print(comparison_table([s.evaluation for s in sections], "errors against the truth, bundled test frames"))
    for path in written:
        typer.echo(f"wrote {path}")
    typer.echo(f"done in {time.perf_counter() - start:.1f} s")


def bundled_frames() -> Path:
    """The folder of test frames that ships with the package."""
    from importlib import resources

    folder = Path(str(resources.files("gknet") / "demo_data"))
    if not (folder / "test.json").is_file():
        raise GknetError("demo: the bundled test frames are missing; install gknet from a built wheel")
    return folder


def show(dataset: SkdDataset, estimator: PoseEstimator, out: Path) -> tuple[Section, list[Path]]:
    """Evaluate one spacecraft, and write its poses, overlays and video of the last protocol."""
    from gknet.cli.evaluate import evaluate_section
    from gknet.predict.results import PredictionWriter

    section = evaluate_section(dataset, estimator, "bundled test frames", pictures=3)
    folder = out / estimator.spacecraft.name
    with PredictionWriter(folder, estimator.spacecraft, fps=_FPS) as files:
        for case in section.evaluation.runs[-1].cases:
            files.add(dataset.frame(case.index), case.estimate)
    return section, [path for path in (files.poses_path, files.overlay_folder, files.video_path) if path is not None]


def write_comparison(out: Path, sections: list[Section]) -> tuple[Path, Path]:
    """metrics.json and the page over all spacecraft."""
    from gknet.cli.evaluate import write_report

    evaluations: list[Evaluation] = [section.evaluation for section in sections]
    content: dict[str, object] = {e.spacecraft.name: e.to_dict() for e in evaluations}
    return write_report(out, "gknet demo", sections, {"spacecraft": content})
