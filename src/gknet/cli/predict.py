"""`gknet predict`: poses from an image, a folder of images, a video or a dataset."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gknet.errors import GknetError

if TYPE_CHECKING:
    from gknet.frame import Box, PoseEstimator
    from gknet.io.camera_file import Lens
    from gknet.predict.results import PredictionWriter
    from gknet.predict.source import Source

_SHOWN_FAILURES = 5


class PoseLayout(StrEnum):
    jsonl = "jsonl"
    csv = "csv"


def predict(
    input_path: Annotated[Path, typer.Argument(metavar="INPUT", help="Image, folder of images, video or SKD dataset.")],
    spacecraft: Annotated[str | None, typer.Option(help="A shipped model: satellite_01, satellite_02, ...")] = None,
    model: Annotated[
        Path | None, typer.Option(help="A folder with keypoints.onnx (or direct.onnx), locator.onnx.")
    ] = None,
    camera: Annotated[Path | None, typer.Option(help="Camera file: ours, SPEED+'s camera.json, or a 3x3 text.")] = None,
    focal_px: Annotated[float | None, typer.Option(help="Focal length in pixels of a centred camera.")] = None,
    hfov_deg: Annotated[float | None, typer.Option(help="Horizontal field of view of a centred camera.")] = None,
    box: Annotated[str | None, typer.Option(help="Where the spacecraft is, as x0,y0,x1,y1 in pixels.")] = None,
    oracle: Annotated[bool, typer.Option("--oracle", help="Take the box from a dataset's truth.")] = False,
    split: Annotated[str | None, typer.Option(help="Of a dataset: train, val or test.")] = None,
    every: Annotated[int, typer.Option(help="Take each n-th picture.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("predictions"),
    layout: Annotated[PoseLayout, typer.Option("--format", help="Layout of the poses file.")] = PoseLayout.jsonl,
    overlay: Annotated[bool, typer.Option("--overlay/--no-overlay", help="Write overlay pictures.")] = True,
    video: Annotated[bool, typer.Option("--video", help="Write an overlay video.")] = False,
    threads: Annotated[int | None, typer.Option(help="Threads of the network; all cores by default.")] = None,
    tta_rotations: Annotated[
        int, typer.Option(help="Average the heatmaps of 1, 2 or 4 rotations of each crop: more accurate, slower.")
    ] = 1,
) -> None:
    """Estimate the pose of a spacecraft in pictures."""
    from gknet.predict.results import STILLS_FPS, PredictionWriter
    from gknet.predict.source import open_source

    given_box = parse_box(box)
    if given_box is not None and oracle:
        raise GknetError("--box and --oracle: give one of the two")
    estimator = choose_estimator(spacecraft, model, threads, tta_rotations)
    source = open_source(input_path, choose_lens(camera, focal_px, hfov_deg), estimator.spacecraft, split, every)
    fps = (source.fps or STILLS_FPS) if video else None
    with PredictionWriter(out, estimator.spacecraft, layout.value, overlay, fps) as files:
        predict_all(source, estimator, files, given_box, oracle)
    tell(files)


def parse_box(text: str | None) -> Box | None:
    """ "x0,y0,x1,y1" as a Box."""
    from gknet.frame import Box

    if text is None:
        return None
    try:
        x0, y0, x1, y1 = (float(word) for word in text.split(","))
    except ValueError as error:
        raise GknetError(f"--box: expected four numbers x0,y0,x1,y1, got '{text}'") from error
    return Box(x0, y0, x1, y1)


def choose_lens(camera: Path | None, focal_px: float | None, hfov_deg: float | None) -> Lens | None:
    """The one camera option that was given, or None."""
    from math import radians

    from gknet.io.camera_file import FieldOfView, read_camera

    if sum(option is not None for option in (camera, focal_px, hfov_deg)) > 1:
        raise GknetError("--camera, --focal-px and --hfov-deg: give one of the three")
    if camera is not None:
        return read_camera(camera)
    if focal_px is None and hfov_deg is None:
        return None
    return FieldOfView(focal_px, None if hfov_deg is None else radians(hfov_deg))


def choose_estimator(
    spacecraft: str | None, model: Path | None, threads: int | None, tta_rotations: int = 1
) -> PoseEstimator:
    """The shipped model of a spacecraft, or a user's folder."""
    from gknet.inference.load import load_estimator, shipped_folder

    if (spacecraft is None) == (model is None):
        raise GknetError("give either --spacecraft NAME (a shipped model) or --model FOLDER")
    if threads is not None and threads < 1:
        raise GknetError(f"--threads: expected 1 or more, got {threads}")
    return load_estimator(model or shipped_folder(spacecraft or ""), threads=threads, tta_rotations=tta_rotations)


def predict_all(
    source: Source, estimator: PoseEstimator, files: PredictionWriter, box: Box | None = None, oracle: bool = False
) -> None:
    """Every picture of the source into the files; one that cannot be read is recorded and passed over."""
    from gknet.frame import Unreadable
    from gknet.io.progress import progress

    with progress() as bar:
        for picture in bar.track(source, total=source.count, description="poses"):
            if isinstance(picture, Unreadable):
                files.add_unreadable(picture)
                continue
            if picture.image is None:
                raise GknetError(f"{picture.name}: the picture came without its image")
            if oracle:
                if picture.cam_from_body is None:
                    raise GknetError("--oracle: expected a dataset with true poses; give --box, or let it be found")
                box = picture.true_box(estimator.spacecraft.points_m)
            files.add(picture, estimator.estimate(picture.image, picture.camera, box))


def tell(files: PredictionWriter) -> None:
    """The summary on standard output; GknetError when no picture gave a pose."""
    from gknet.frame import AMBIGUOUS_BELOW

    failures = files.failures
    if files.pose_count == 0:
        first = f"; the first, {failures[0].name}: {failures[0].failure}" if failures else ""
        raise GknetError(f"no pose in any of {files.count} pictures{first}")
    typer.echo(f"{files.pose_count} of {files.count} pictures have a pose, {len(failures)} failed")
    if files.ambiguous_count:
        typer.echo(
            f"  {files.ambiguous_count} of the poses may be a twin's: attitude_confidence is below {AMBIGUOUS_BELOW}"
        )
    for failure in failures[:_SHOWN_FAILURES]:
        typer.echo(f"  {failure.name}: {failure.failure}")
    if len(failures) > _SHOWN_FAILURES:
        typer.echo(f"  and {len(failures) - _SHOWN_FAILURES} more, in {files.poses_path}")
    for path in (files.poses_path, files.overlay_folder, files.video_path):
        if path is not None:
            typer.echo(f"wrote {path}")
