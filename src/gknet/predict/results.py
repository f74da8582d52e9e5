"""The results of a run over many images: poses as text, overlay images and an overlay video."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Literal

from gknet.errors import GknetError
from gknet.frame import Estimate, Failure, Frame, Unreadable
from gknet.io.atomic import output_folder, stale_temporaries
from gknet.io.lock import LOCK_NAME, locked
from gknet.io.pose_file import PoseFormat, PoseLine, PoseWriter, read_poses
from gknet.io.text import printable
from gknet.predict.overlay_files import Losses, OverlayFolder, OverlayNames, OverlayVideo
from gknet.predict.run_record import RECORD_NAME, RunRecord, load_record
from gknet.report.overlay import draw_overlay
from gknet.spacecraft import Spacecraft

STILLS_FPS = 10.0
"""The rate of a video made of single images."""

LAYOUTS: tuple[PoseFormat, ...] = ("jsonl", "csv")

Existing = Literal["same", "resume", "overwrite"]
"""What may happen to results that a folder holds: replaced where they are of the same run; gone on with; replaced."""


class PredictionWriter:
    """Takes estimates one by one. However its `with` block ends, the poses that were added are in the file then.

    Overlays and the video end apart from the poses: what cannot be drawn or written is counted in `losses`.

    Args:
        folder: For the results; made where it is absent, and locked while the block lasts.
        spacecraft: Whose poses they are.
        layout: Of the poses: poses.jsonl or poses.csv.
        overlays: Write overlays/<name>.jpg.
        fps: Frames/s of overlay.mp4; None writes no video.
        record: What the poses depend on; kept as prediction.json. None replaces whatever is there.
        existing: What may happen to results that the folder holds already.

    Attributes:
        poses_path: The file of poses.
        overlay_folder: Of the overlays; None when there are none.
        video_path: The video; None when there is none.
        pose_count: Images with a pose.
        ambiguous_count: Those of them whose pose is ambiguous.
        failures: The others, each with its reason.
        image_sizes: Width and height of the images of this run, in the order in which they came.
        kept_count: Images of an earlier run that was gone on with; they count in the three before.

    Raises:
        GknetError: On entering: another process writes into the folder, or it holds results of another run.
        OSError: On entering, when the folder cannot be written; on adding, when the poses cannot.
    """

    def __init__(
        self,
        folder: str | Path,
        spacecraft: Spacecraft,
        layout: PoseFormat = "jsonl",
        overlays: bool = True,
        fps: float | None = None,
        record: RunRecord | None = None,
        existing: Existing = "same",
    ) -> None:
        self.folder = Path(folder)
        self.poses_path = self.folder / f"poses.{layout}"
        self.overlay_folder = self.folder / "overlays" if overlays else None
        self.video_path = self.folder / "overlay.mp4" if fps is not None else None
        self.pose_count = self.ambiguous_count = self.kept_count = 0
        self.failures: list[Unreadable] = []
        self.image_sizes: dict[tuple[int, int], None] = {}
        self._spacecraft, self._layout, self._record, self._existing = spacecraft, layout, record, existing
        self._overlays = OverlayFolder(self.overlay_folder) if self.overlay_folder else None
        self._video = OverlayVideo(self.video_path, fps) if self.video_path and fps is not None else None
        self._undrawn = Losses("overlay")
        self._kept: Counter[str] = Counter()
        self._stack = ExitStack()
        self._poses: PoseWriter | None = None

    def __enter__(self) -> PredictionWriter:
        with self._stack:
            self._stack.enter_context(output_folder(self.folder))
            self._stack.callback(self._remove_unused_lock)
            self._stack.enter_context(locked(self.folder))
            self._settle_with_existing()
            self._stack = self._stack.pop_all()
        return self

    @property
    def count(self) -> int:
        """Images so far."""
        return self.pose_count + len(self.failures)

    @property
    def losses(self) -> list[str]:
        """A sentence for each kind of thing that could not be written, other than poses."""
        found = [self._undrawn, *(output.losses for output in (self._overlays, self._video) if output is not None)]
        return [loss.sentence for loss in found if loss.sentence is not None]

    def is_kept(self, name: str) -> bool:
        """Whether the answer for the next image of this name is there from an earlier run."""
        if self._kept[printable(name)] == 0:
            return False
        self._kept[printable(name)] -= 1
        return True

    def add(self, frame: Frame, estimate: Estimate) -> None:
        """Record the answer for one image; a missing pose is counted and kept with its reason."""
        self._opened().add(frame.name, frame.time_s, estimate)
        self.image_sizes[frame.camera.width, frame.camera.height] = None
        self._count(frame.name, estimate.failure, estimate.is_ambiguous)
        if self._overlays is None and self._video is None:
            return
        try:
            picture = draw_overlay(frame, self._spacecraft, estimate)
        except Exception as error:  # whatever goes wrong with a drawing costs no pose
            self._undrawn.note(frame.name, error)
            return
        for output in (self._overlays, self._video):
            if output is not None:
                output.write(frame.name, picture)

    def add_unreadable(self, picture: Unreadable) -> None:
        """Record an image that could not be read."""
        self._opened().add_unreadable(picture.name, picture.failure)
        self._count(picture.name, picture.failure, False)

    def _count(self, name: str, failure: Failure | None, is_ambiguous: bool) -> None:
        if failure is None:
            self.pose_count += 1
            self.ambiguous_count += is_ambiguous
        else:
            self.failures.append(Unreadable(name, failure))

    def _opened(self, kept: Sequence[PoseLine] = ()) -> PoseWriter:
        """The writer of the poses; it and prediction.json are made when there is something to write."""
        if self._poses is None:
            if self._record is not None:
                self._record.save(self.folder)
            names = self._spacecraft.keypoint_names
            self._poses = self._stack.enter_context(PoseWriter(self.poses_path, names, self._layout, kept))
            if self._video is not None:
                self._stack.callback(self._video.close)
        return self._poses

    def _settle_with_existing(self) -> None:
        """Go on with the results of an earlier run, make room for this one's, or refuse."""
        stale = [*stale_temporaries(self.folder), *stale_temporaries(self.folder / "overlays")]
        if self._record is not None and _result_paths(self.folder):
            before = load_record(self.folder)
            is_same = before == self._record
            is_empty = before is not None and not _has_pose(self.folder)
            if not is_same and not is_empty and self._existing != "overwrite":
                raise GknetError(_refusal(self.folder, self._record, before))
            if not is_same:
                _remove_results(self.folder)
            elif self._existing != "resume" and self._overlays is not None:
                _remove_overlays(self.folder)
            elif self._existing == "resume":
                cut_off = stale_temporaries(self.folder, self.poses_path.name)
                self._keep(_most_lines([self.poses_path, *cut_off], self._layout))
        for path in stale:
            path.unlink(missing_ok=True)

    def _keep(self, lines: Sequence[PoseLine]) -> None:
        kept = [line for line in lines if not line.is_unreadable]
        for line in kept:
            self._kept[printable(line.name)] += 1
            self._count(line.name, line.failure, line.is_ambiguous)
            if self._overlays is not None:
                self._overlays.names.name_for(line.name)
        self.kept_count = len(kept)
        if kept:
            self._opened(kept)

    def _remove_unused_lock(self) -> None:
        """Leave nothing in a folder into which nothing was written."""
        if self._poses is None and not _result_paths(self.folder):
            (self.folder / LOCK_NAME).unlink(missing_ok=True)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)


def _result_paths(folder: Path) -> list[Path]:
    """What a run has written into a folder, apart from overlays."""
    names = [RECORD_NAME, *(f"poses.{layout}" for layout in LAYOUTS), "overlay.mp4"]
    return [folder / name for name in names if (folder / name).exists()]


def _most_lines(paths: Sequence[Path], layout: PoseFormat) -> list[PoseLine]:
    return max((read_poses(path, layout) for path in paths), key=len)


def _refusal(folder: Path, record: RunRecord, before: RunRecord | None) -> str:
    found = f"({record.difference(before)})" if before else f"(there is no {RECORD_NAME} of this version)"
    return f"{folder}: it holds the results of another run {found}; give another --out, or --overwrite to replace them"


def _has_pose(folder: Path) -> bool:
    lines = [line for layout in LAYOUTS for line in read_poses(folder / f"poses.{layout}", layout)]
    return any(line.failure is None for line in lines)


def _remove_results(folder: Path) -> None:
    """Remove what an earlier run wrote."""
    _remove_overlays(folder)
    for path in _result_paths(folder):
        path.unlink()


def _remove_overlays(folder: Path) -> None:
    """Remove the overlays of the images that an earlier run's poses name."""
    for layout in LAYOUTS:
        names = OverlayNames()
        for line in read_poses(folder / f"poses.{layout}", layout):
            if not line.is_unreadable:
                (folder / "overlays" / names.name_for(line.name)).unlink(missing_ok=True)
