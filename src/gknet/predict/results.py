"""The results of a run over many pictures: poses as text, overlay pictures and an overlay video."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType

from gknet.frame import Estimate, Frame, Unreadable
from gknet.io.image import write_image
from gknet.io.pose_file import PoseFormat, PoseWriter
from gknet.io.video import VideoWriter
from gknet.report.overlay import draw_overlay
from gknet.spacecraft import Spacecraft

STILLS_FPS = 10.0
"""The rate of a video made of single images."""


class PredictionWriter:
    """Takes estimates one by one; `with` completes the files at its end and leaves none half-written.

    overlays  write overlays/<name>.jpg
    fps       frames/s of overlay.mp4; None writes no video
    """

    def __init__(
        self,
        folder: str | Path,
        spacecraft: Spacecraft,
        layout: PoseFormat = "jsonl",
        overlays: bool = True,
        fps: float | None = None,
    ) -> None:
        self.folder = Path(folder)
        self.poses_path = self.folder / f"poses.{layout}"
        self.overlay_folder = self.folder / "overlays" if overlays else None
        self.video_path = self.folder / "overlay.mp4" if fps is not None else None
        self.pose_count = self.ambiguous_count = 0
        self.failures: list[Unreadable] = []
        self._spacecraft, self._layout, self._fps = spacecraft, layout, fps
        self._stack = ExitStack()
        self._poses: PoseWriter | None = None
        self._video: VideoWriter | None = None

    def __enter__(self) -> PredictionWriter:
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.overlay_folder is not None:
            self.overlay_folder.mkdir(exist_ok=True)
        self._poses = self._stack.enter_context(
            PoseWriter(self.poses_path, self._spacecraft.keypoint_names, self._layout)
        )
        if self.video_path is not None and self._fps is not None:
            self._video = self._stack.enter_context(VideoWriter(self.video_path, self._fps))
        return self

    @property
    def count(self) -> int:
        return self.pose_count + len(self.failures)

    def add(self, frame: Frame, estimate: Estimate) -> None:
        """Record the answer for one picture; a missing pose is counted and kept with its reason."""
        if self._poses is not None:
            self._poses.add(frame.name, frame.time_s, estimate)
        if estimate.failure is None:
            self.pose_count += 1
            self.ambiguous_count += estimate.is_ambiguous
        else:
            self.failures.append(Unreadable(frame.name, estimate.failure))
        if self.overlay_folder is None and self._video is None:
            return
        picture = draw_overlay(frame, self._spacecraft, estimate)
        if self.overlay_folder is not None:
            write_image(self.overlay_folder / overlay_name(frame.name), picture)
        if self._video is not None:
            self._video.write(picture)

    def add_unreadable(self, picture: Unreadable) -> None:
        """Record a picture that could not be read."""
        if self._poses is not None:
            self._poses.add_unreadable(picture.name, picture.failure)
        self.failures.append(picture)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)


def overlay_name(name: str) -> str:
    """The overlay's file name for a picture: folders become part of it, the suffix becomes .jpg."""
    return os.path.splitext(name)[0].replace("/", "_").replace("\\", "_") + ".jpg"
