"""`gknet predict`: poses from images, folders of images, videos or a dataset."""

from __future__ import annotations

import re
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gknet.cli.model_options import (
    DeviceOption,
    ModelOption,
    RotationsOption,
    SpacecraftOption,
    ThreadsOption,
    model_folder,
    open_estimator,
)
from gknet.cli.terminal import print_line, print_warning
from gknet.errors import GknetError

if TYPE_CHECKING:
    from gknet.frame import Box
    from gknet.io.lens import Lens
    from gknet.predict.results import PredictionWriter

_SHOWN_FAILURES = 5
_SHOWN_SIZES = 5


class PoseLayout(StrEnum):
    """How the file of poses is written."""

    jsonl = "jsonl"
    csv = "csv"


def predict(
    inputs: Annotated[
        list[str],
        typer.Argument(
            metavar="INPUT",
            help="Images, videos, folders of them, patterns, lists (@list.txt), a camera's number, a stream's URL; "
            "or an SKD dataset.",
        ),
    ],
    spacecraft: SpacecraftOption = None,
    model: ModelOption = None,
    camera: Annotated[
        Path | None, typer.Option(help="Camera file: gknet's, OpenCV's, ROS's, Kalibr's, COLMAP's ... or a 3x3 text.")
    ] = None,
    focal_px: Annotated[float | None, typer.Option(help="Focal length in pixels of a centred camera.")] = None,
    hfov_deg: Annotated[float | None, typer.Option(help="Horizontal field of view of a centred camera.")] = None,
    camera_size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Image size of --camera, where its file does not state it.")
    ] = None,
    scale_camera: Annotated[
        bool, typer.Option("--scale-camera", help="The images were resized: scale --camera to their size.")
    ] = False,
    box: Annotated[str | None, typer.Option(help="Where the spacecraft is, as x0,y0,x1,y1 in pixels.")] = None,
    oracle: Annotated[bool, typer.Option("--oracle", help="Take the box from a dataset's labels.")] = False,
    split: Annotated[str | None, typer.Option(help="Of a dataset: train, val or test.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Take each n-th image.")] = 1,
    bit_depth: Annotated[
        int | None, typer.Option(min=9, max=16, help="Of images of more than 8 bits that do not state it.")
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="Frames of a camera or a stream to read at most.")] = 100_000,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("predictions"),
    resume: Annotated[bool, typer.Option("--resume", help="Keep the poses that are in --out, and go on.")] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace results of another run that are in --out.")
    ] = False,
    layout: Annotated[PoseLayout, typer.Option("--format", help="Layout of the poses file.")] = PoseLayout.jsonl,
    overlay: Annotated[bool, typer.Option("--overlay/--no-overlay", help="Write overlay images.")] = True,
    video: Annotated[bool, typer.Option("--video", help="Write an overlay video.")] = False,
    threads: ThreadsOption = None,
    device: DeviceOption = "cpu",
    tta_rotations: RotationsOption = 1,
) -> None:
    """Estimate the pose of a spacecraft in images.

    The poses found so far are kept whatever ends the run; --resume goes on with them.
    """
    from gknet.io.progress import progress
    from gknet.predict.results import STILLS_FPS, Existing, PredictionWriter
    from gknet.predict.run import predict_all
    from gknet.predict.run_record import RunRecord
    from gknet.predict.source import open_source

    given_box = parse_box(box)
    if given_box is not None and oracle:
        raise GknetError("--box and --oracle: give one of the two")
    if resume and (overwrite or video):
        raise GknetError(f"--resume and {'--overwrite' if overwrite else '--video'}: give one of the two")
    folder = model_folder(spacecraft, model)
    lens = choose_lens(camera, focal_px, hfov_deg, parse_size(camera_size), scale_camera)
    estimator = open_estimator(folder, threads, device, tta_rotations)
    source = open_source(inputs, lens, estimator.spacecraft, split, every, bit_depth, limit)
    record = RunRecord(
        inputs=tuple(str(Path(text).absolute()) if Path(text).exists() else text for text in inputs),
        model=str(folder.absolute()),
        camera=_camera_words(camera, focal_px, hfov_deg, camera_size, scale_camera),
        box=None if given_box is None else (given_box.x0, given_box.y0, given_box.x1, given_box.y1),
        oracle=oracle,
        split=split,
        every=every,
        bit_depth=bit_depth,
        tta_rotations=tta_rotations,
    )
    fps = (source.fps or STILLS_FPS) if video else None
    existing: Existing = "overwrite" if overwrite else "resume" if resume else "same"
    writer = PredictionWriter(out, estimator.spacecraft, layout.value, overlay, fps, record, existing)
    with writer, progress() as bar:
        pictures = bar.track(source, total=source.count, description="poses")
        predict_all(pictures, estimator, writer, given_box, oracle)
    if lens is not None:
        warn_of_sizes(lens, list(writer.image_sizes))
    print_summary(writer)


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


def parse_size(text: str | None) -> tuple[int, int] | None:
    """ "1920x1080" as (width, height)."""
    if text is None:
        return None
    found = re.fullmatch(r"([1-9]\d{0,5})[x×]([1-9]\d{0,5})", text.strip())
    if found is None:
        raise GknetError(f"--camera-size: expected WxH in pixels, such as 1920x1080, got '{text}'")
    return int(found[1]), int(found[2])


def choose_lens(
    camera: Path | None,
    focal_px: float | None,
    hfov_deg: float | None,
    size: tuple[int, int] | None,
    scale: bool,
) -> Lens | None:
    """The one camera option that was given, or None."""
    from math import radians

    from gknet.io.camera_file import read_camera
    from gknet.io.lens import FieldOfView, sized_lens

    if sum(option is not None for option in (camera, focal_px, hfov_deg)) > 1:
        raise GknetError("--camera, --focal-px and --hfov-deg: give one of the three")
    if camera is not None:
        return sized_lens(read_camera(camera), size, scale)
    if size is not None or scale:
        raise GknetError(
            f"{'--camera-size' if size else '--scale-camera'}: it changes a camera file; give --camera FILE"
        )
    if focal_px is None and hfov_deg is None:
        return None
    return FieldOfView(focal_px, None if hfov_deg is None else radians(hfov_deg))


def _camera_words(
    camera: Path | None, focal_px: float | None, hfov_deg: float | None, size: str | None, scale: bool
) -> str:
    """The camera options for the record of the run."""
    given = {
        "--camera": None if camera is None else camera.absolute(),
        "--focal-px": focal_px,
        "--hfov-deg": hfov_deg,
        "--camera-size": size,
        "--scale-camera": scale or None,
    }
    return " ".join(f"{option} {value}" for option, value in given.items() if value is not None)


def warn_of_sizes(lens: Lens, sizes: Sequence[tuple[int, int]]) -> None:
    """A warning where one focal length in pixels served images of several sizes."""
    from gknet.io.lens import has_fixed_focal_length

    if len(sizes) < 2 or not has_fixed_focal_length(lens):
        return
    shown = ", ".join(f"{width}x{height}" for width, height in sizes[:_SHOWN_SIZES])
    more = f" and {len(sizes) - _SHOWN_SIZES} more" if len(sizes) > _SHOWN_SIZES else ""
    print_warning(
        f"one focal length in pixels was used for images of several sizes, {shown}{more}: it fits one size alone "
        "unless the others were cut from it; give --hfov-deg, or run each size with its own camera"
    )


def print_summary(writer: PredictionWriter) -> None:
    """The summary on standard output; GknetError when no image gave a pose."""
    from gknet.frame import AMBIGUOUS_BELOW
    from gknet.io.text import counted

    failures = writer.failures
    for sentence in writer.losses:
        print_warning(sentence)
    if writer.pose_count == 0:
        first = f"; the first, {failures[0].name}: {failures[0].failure}" if failures else ""
        raise GknetError(f"no pose in any of {counted(writer.count, 'image')}{first}")
    kept = f", {writer.kept_count} of them from an earlier run" if writer.kept_count else ""
    print_line(f"pose found in {writer.pose_count} of {counted(writer.count, 'image')}, {len(failures)} failed{kept}")
    if writer.ambiguous_count:
        print_line(
            f"  {writer.ambiguous_count} of the poses may be that of a symmetric counterpart: "
            f"attitude_confidence is below {AMBIGUOUS_BELOW}"
        )
    for failure in failures[:_SHOWN_FAILURES]:
        print_line(f"  {failure.name}: {failure.failure}")
    if len(failures) > _SHOWN_FAILURES:
        print_line(f"  and {len(failures) - _SHOWN_FAILURES} more, in {writer.poses_path}")
    for path in (writer.poses_path, writer.overlay_folder, writer.video_path):
        if path is not None and path.exists():
            print_line(f"wrote {path}")
