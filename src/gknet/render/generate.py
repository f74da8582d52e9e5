"""The rendering stage: a recipe and a seed -> a dataset on disk. It resumes after a kill, and shards."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

from gknet import fleet
from gknet.dataset.skd_format import frame_stem, sequence_name
from gknet.dataset.skd_sequence import read_rows
from gknet.dataset.skd_write import write_annotations, write_camera_matrix, write_sequence_files, write_splits
from gknet.errors import GknetError, MissingExtraError
from gknet.geometry import Camera
from gknet.inference.crop import Crop
from gknet.io.atomic import write_text
from gknet.io.image import is_whole_jpeg
from gknet.io.spacecraft_file import load_spacecraft
from gknet.io.text import read_json
from gknet.render.contact_sheet import write_contact_sheet
from gknet.render.plan import (
    DEFAULT_SIZE,
    Options,
    Selection,
    SequencePlan,
    parse_names,
    plan_sequences,
    spacecraft_path,
)
from gknet.render.render_log import Progress
from gknet.render.scenario import CAMERA, Recipe, load_recipe
from gknet.render.scene import choose_variant
from gknet.render.worker import JOURNAL, Outcome, WorkerState, read_journal, render_chunk, start_worker, worker_chunk

CHUNK = 8
"""Frames a worker takes at a time."""


@dataclass(frozen=True)
class Generated:
    """What a run did. `failures` are reasons, one for each frame without a picture."""

    out: Path
    rendered: int
    kept: int
    failures: tuple[str, ...]
    seconds: float


def generate(
    recipe: str | Path | Recipe,
    out: str | Path,
    seed: int = 0,
    spacecraft: str | Sequence[str] | None = None,
    split: str | None = None,
    sequences: int | None = None,
    every: int = 1,
    first: int = 0,
    frames: int | None = None,
    window: str = "frame",
    size: int | None = None,
    spp: int = 8,
    shard: tuple[int, int] = (0, 1),
    workers: int = 2,
    mask: bool | None = None,
    depth: bool = False,
    variant: str | None = None,
) -> Generated:
    """Render the selected frames of a recipe into the SKD layout at `out`; what is there already is kept.

    recipe      a name, a .toml, or a Recipe
    window      'frame': the whole sensor; 'target': a square around the spacecraft, with its own camera
    size        pixels of a side (frame: 1024; target: at most 320)
    sequences, every, first, frames   see `Selection`; another selection may be added to the same folder later
    workers     processes; 1 renders in this process with all cores
    mask        write masks (by default for window 'frame' only)
    variant     Mitsuba's, chosen for the machine by default

    Raises GknetError when `out` was made with other options. Frames that fail are reported in the result.
    """
    _need_mitsuba()
    started = time.monotonic()
    options = Options(
        recipe=recipe if isinstance(recipe, Recipe) else load_recipe(recipe),
        seed=seed,
        window=window,
        size=size or DEFAULT_SIZE.get(window, 0) or 1,
        spp=spp,
        mask=window == "frame" if mask is None else mask,
        depth=depth,
    )
    selection = Selection(parse_names(spacecraft), split, sequences, every, first, frames, shard)
    plans = plan_sequences(options.recipe, selection)
    root = Path(out)
    root.mkdir(parents=True, exist_ok=True)
    _claim(root, options)
    for name in sorted({plan.spacecraft for plan in plans}):
        _build_spacecraft(root, name)
    missing = [_prepared(root, options, plan) for plan in plans]
    todo = sum(len(plan.indices) for plan in missing)
    kept = sum(len(plan.indices) for plan in plans) - todo
    failures: list[str] = []
    open_frames = {plan.sequence: len(plan.indices) for plan in missing}
    with Progress(todo) as progress:
        for outcome in _outcomes(root, options, missing, workers, variant or choose_variant()):
            failures += outcome.failures
            open_frames[outcome.sequence] -= outcome.done + len(outcome.failures)
            if open_frames[outcome.sequence] == 0:
                _finish(root, options, outcome.sequence)
            progress.add(outcome.done, outcome.failures)
    write_splits(root, options.recipe.split_of, options.recipe.spacecraft_of)
    write_contact_sheet(root)
    return Generated(root, todo - len(failures), kept, tuple(failures), time.monotonic() - started)


def _need_mitsuba() -> None:
    for module in ("mitsuba", "trimesh"):
        if importlib.util.find_spec(module) is None:
            raise MissingExtraError("render", module)


def _claim(root: Path, options: Options) -> None:
    """Write recipe.json, or refuse a folder whose recipe.json says otherwise."""
    path = root / "recipe.json"
    mine = options.recorded()
    if not path.exists():
        if (root / "data").exists():
            raise GknetError(f"{root}: it holds data that this renderer did not make; choose another folder")
        write_text(path, json.dumps(mine, indent=1) + "\n")
    theirs = read_json(path)
    for key, want in mine.items():
        have = theirs.get(key) if isinstance(theirs, dict) else None
        if have != want:
            names = f"another {key}" if key == "recipe" else f"{key} {have}, not {want}"
            raise GknetError(
                f"{root}: it was made with {names} ({path.name}); choose another folder or the same options"
            )


def _build_spacecraft(root: Path, name: str) -> None:
    """spacecraft/<name>.toml and .glb, where absent: built aside, then moved, so that shards may do it at once."""
    target = spacecraft_path(root, name)
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists() and target.with_suffix(".glb").exists():
        return
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{name}.") as folder:
        fleet.build(name, Path(folder))
        for suffix in (".glb", ".toml"):
            os.replace(Path(folder) / f"{name}{suffix}", target.with_suffix(suffix))


def _prepared(root: Path, options: Options, plan: SequencePlan) -> SequencePlan:
    """The plan without the frames that are there; the sequence's small files are written."""
    folder = root / sequence_name(plan.sequence)
    done = _rows(root, options, plan.sequence)
    missing = dataclasses.replace(plan, indices=tuple(i for i in plan.indices if i not in done))
    if missing.indices and not (folder / "camera_matrix.txt").exists():
        camera = _whole_camera(options)
        write_sequence_files(folder, camera, load_spacecraft(spacecraft_path(root, plan.spacecraft)))
        write_camera_matrix(root / "camera_matrix.txt", camera)
    if not missing.indices and (folder / JOURNAL).exists():
        _finish(root, options, plan.sequence)
    return missing


def _whole_camera(options: Options) -> Camera:
    """The whole sensor's camera, at the size of the pictures when they show all of it."""
    if options.window == "target":
        return CAMERA
    whole = Crop(0, 0, max(CAMERA.width, CAMERA.height), options.size)
    return CAMERA.warped(whole.input_from_image, whole.size, whole.size)


def _rows(root: Path, options: Options, sequence: int) -> dict[int, dict[str, str]]:
    """The label rows on disk by frame, of those frames whose files are whole."""
    folder = root / sequence_name(sequence)
    table = folder / "annotations.csv"
    rows = [*(read_rows(table) if table.exists() else ()), *read_journal(folder / JOURNAL)]
    by_frame = {int(row["frame"]): row for row in rows}
    return {index: row for index, row in by_frame.items() if _is_whole(folder, options, index)}


def _is_whole(folder: Path, options: Options, index: int) -> bool:
    stem = frame_stem(index)
    return (
        is_whole_jpeg(folder / "image" / f"{stem}.jpg")
        and (not options.mask or (folder / "mask" / f"{stem}.png").exists())
        and (not options.depth or (folder / "depth" / f"{stem}.npz").exists())
    )


def _finish(root: Path, options: Options, sequence: int) -> None:
    """Turn a sequence's journal into annotations.csv and list the sequence in its split."""
    folder = root / sequence_name(sequence)
    rows = _rows(root, options, sequence)
    if rows:
        write_annotations(folder, rows.values())
        write_splits(root, options.recipe.split_of, options.recipe.spacecraft_of)
    (folder / JOURNAL).unlink(missing_ok=True)


def _chunks(plans: list[SequencePlan]) -> Iterator[SequencePlan]:
    for plan in plans:
        for start in range(0, len(plan.indices), CHUNK):
            yield dataclasses.replace(plan, indices=plan.indices[start : start + CHUNK])


def _outcomes(root: Path, options: Options, plans: list[SequencePlan], workers: int, variant: str) -> Iterator[Outcome]:
    """The outcome of each chunk as it comes."""
    if workers < 1:
        raise GknetError(f"workers: expected 1 or more, got {workers}")
    chunks = _chunks(plans)
    if workers == 1:
        state = WorkerState(root, options, variant)
        yield from (render_chunk(state, chunk) for chunk in chunks)
        return
    executor = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), initializer=start_worker, initargs=(root, options, variant)
    )
    running: set[Future[Outcome]] = set()
    try:
        for chunk in chunks:
            running.add(executor.submit(worker_chunk, chunk))
            if len(running) >= 2 * workers:
                finished, running = wait(running, return_when=FIRST_COMPLETED)
                yield from (future.result() for future in finished)
        while running:
            finished, running = wait(running, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in finished)
    except BrokenProcessPool as error:
        raise GknetError(
            "a rendering process died (out of memory, or Mitsuba aborted); run the same command again to go on, "
            "with --workers 1 or GKNET_MITSUBA_VARIANT=scalar_rgb if it happens again; a script of your own needs "
            "if __name__ == '__main__' about its call"
        ) from error
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
