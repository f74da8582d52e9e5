"""The folder that a job renders into: what is there already, and what makes it a dataset.

Several jobs may write into one folder at once, as shards do, or as two runs of one command by mistake: what reads and
then writes the same file holds the folder's lock.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from gknet import fleet
from gknet.dataset.skd_format import OUR_COLUMNS, frame_stem
from gknet.dataset.skd_sequence import read_rows
from gknet.dataset.skd_write import write_annotations, write_camera_matrix, write_sequence_files, write_splits
from gknet.errors import GknetError
from gknet.geometry import Camera
from gknet.inference.crop import Crop
from gknet.io.atomic import write_text
from gknet.io.image import is_whole_jpeg
from gknet.io.lock import locked
from gknet.io.spacecraft_file import load_spacecraft
from gknet.io.text import parse_json, quoted, read_text
from gknet.render.journal import JOURNAL, is_frame, read_journal
from gknet.render.plan import Job, SequencePlan
from gknet.render.sequence import CAMERA
from gknet.spacecraft import Spacecraft

LOCK_WAIT_S = 120.0
RECIPE_LIMIT_BYTES = 1 << 20


@contextmanager
def folder_lock(root: Path) -> Iterator[None]:
    """The folder's lock, which is never held for long: this waits for it."""
    with locked(root, wait_s=LOCK_WAIT_S):
        yield


def claim(job: Job) -> None:
    """Write recipe.json, or refuse a folder whose recipe.json is not this job's.

    Raises:
        GknetError: The folder was made with other options or by something else, or its recipe.json is damaged.
    """
    job.root.mkdir(parents=True, exist_ok=True)
    path, mine = job.root / "recipe.json", job.recorded()
    with folder_lock(job.root):
        if not path.exists():
            if (job.root / "data").exists():
                raise GknetError(f"{job.root}: it holds data that this renderer did not make; choose another folder")
            write_text(path, json.dumps(mine, indent=1) + "\n")
    try:
        theirs = parse_json(read_text(path, RECIPE_LIMIT_BYTES), path)
    except GknetError as error:
        raise GknetError(f"{error}; choose another folder") from error
    for key, want in mine.items():
        have = theirs.get(key) if isinstance(theirs, dict) else None
        if have != want:
            names = f"another {key}" if key == "recipe" else f"{key} {quoted(have)}, not {want}"
            raise GknetError(
                f"{job.root}: it was made with {names} ({path.name}); choose another folder or the same options"
            )


def load_or_build_spacecraft(job: Job, name: str) -> Spacecraft:
    """A spacecraft of spacecraft/. One of the fleet is built there first: aside, then moved, so that shards may do it.

    Raises:
        GknetError: It is neither there nor of the fleet, or its file is damaged.
    """
    target = job.spacecraft_path(name)
    target.parent.mkdir(parents=True, exist_ok=True)
    if not (target.exists() and target.with_suffix(".glb").exists()):
        with tempfile.TemporaryDirectory(dir=target.parent, prefix=f".{name}.") as folder:
            fleet.build(name, Path(folder))
            for suffix in (".glb", ".toml"):
                os.replace(Path(folder) / f"{name}{suffix}", target.with_suffix(suffix))
    return load_spacecraft(target)


def prepare(job: Job, plan: SequencePlan, spacecraft: Spacecraft) -> SequencePlan:
    """The plan without the frames that are there; the sequence's small files are written."""
    folder = job.folder(plan.sequence)
    done = _rows(job, plan.sequence, spacecraft)
    missing = replace(plan, indices=tuple(i for i in plan.indices if i not in done))
    if missing.indices and not (folder / "camera_matrix.txt").exists():
        camera = _whole_camera(job)
        write_sequence_files(folder, camera, spacecraft)
        write_camera_matrix(job.root / "camera_matrix.txt", camera)
    if not missing.indices and (folder / JOURNAL).exists():
        finish(job, plan.sequence, spacecraft)
    return missing


def finish(job: Job, sequence: int, spacecraft: Spacecraft) -> None:
    """Turn a sequence's journal into annotations.csv and list the sequence in its split."""
    folder = job.folder(sequence)
    with folder_lock(job.root):
        rows = _rows(job, sequence, spacecraft)
        if rows:
            write_annotations(folder, rows.values())
            write_splits(job.root, job.recipe.split_of, job.recipe.spacecraft_of)
        (folder / JOURNAL).unlink(missing_ok=True)


def _whole_camera(job: Job) -> Camera:
    """The whole sensor's camera, at the size of the images when they show all of it."""
    if job.options.window == "target":
        return CAMERA
    whole = Crop(0, 0, max(CAMERA.width, CAMERA.height), job.options.side_px)
    return CAMERA.warped(whole.input_from_image, whole.size, whole.size)


def _rows(job: Job, sequence: int, spacecraft: Spacecraft) -> dict[int, dict[str, str]]:
    """The label rows on disk by frame, of those frames whose files are whole."""
    folder, frames = job.folder(sequence), job.recipe.frames
    rows = [
        *_table_rows(folder / "annotations.csv", frames),
        *read_journal(folder / JOURNAL, frames, spacecraft.keypoint_count),
    ]
    by_frame = {int(row["frame"]): row for row in rows}
    return {index: row for index, row in by_frame.items() if _is_whole(job, folder, index)}


def _table_rows(table: Path, frames: int) -> tuple[dict[str, str], ...]:
    if not table.exists():
        return ()
    rows = read_rows(table)
    for number, row in enumerate(rows, start=1):
        missing = [column for column in OUR_COLUMNS if column not in row]
        if missing:
            raise GknetError(f"{table}: column '{missing[0]}' is missing; remove the file to render its frames again")
        if not is_frame(row["frame"], frames):
            raise GknetError(
                f"{table}: row {number}: frame: expected 0 to {frames - 1}, got {quoted(row['frame'])}; "
                "remove the file to render its frames again"
            )
    return rows


def _is_whole(job: Job, folder: Path, index: int) -> bool:
    stem = frame_stem(index)
    return (
        is_whole_jpeg(folder / "image" / f"{stem}.jpg")
        and (not job.options.has_masks or (folder / "mask" / f"{stem}.png").exists())
        and (not job.options.depth or (folder / "depth" / f"{stem}.npz").exists())
    )
