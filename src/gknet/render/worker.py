"""Rendering single frames: what each worker process of `generate` does."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from gknet.dataset.skd_format import Annotation, category_of, row_of, sequence_name
from gknet.dataset.skd_write import write_frame_files
from gknet.geometry import Camera
from gknet.inference.crop import Crop
from gknet.io.spacecraft_file import load_spacecraft
from gknet.render.background import background
from gknet.render.plan import Options, SequencePlan, spacecraft_path, window_of
from gknet.render.scenario import Shot, shoot
from gknet.render.scene import Renderer
from gknet.render.sensor import expose
from gknet.spacecraft import Spacecraft

JOURNAL = "journal.jsonl"
"""Label rows of a sequence under way, one JSON line a frame; annotations.csv takes its place at the end."""


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """A finished frame: what is written to disk."""

    rgb: UInt8[ndarray, "s s 3"]
    mask: Bool[ndarray, "s s"]
    depth_m: Float[ndarray, "s s"]
    visible: Bool[ndarray, " n"]
    camera: Camera


@dataclass(frozen=True)
class Outcome:
    """How a chunk of frames went: `failures` are the reasons, one for each frame that has no picture."""

    sequence: int
    done: int
    failures: tuple[str, ...] = ()


@dataclass
class WorkerState:
    """The renderers of a process, one for each spacecraft, made when first needed.

    threads   of this process, None for all cores
    """

    out: Path
    options: Options
    variant: str
    threads: int | None = None
    renderers: dict[str, tuple[Spacecraft, Renderer]] = field(default_factory=dict)

    def renderer(self, name: str) -> tuple[Spacecraft, Renderer]:
        if name not in self.renderers:
            spacecraft = load_spacecraft(spacecraft_path(self.out, name))
            self.renderers[name] = spacecraft, Renderer(spacecraft, self.variant, self.options.spp, self.threads)
        return self.renderers[name]


def render_shot(renderer: Renderer, spacecraft: Spacecraft, shot: Shot, window: Crop) -> RenderedFrame:
    """The picture of `window` as the sensor gives it: black beyond its edge, as where a crop leaves an image."""
    rendered = renderer.render(shot, window)
    radiance = background(shot, window)
    radiance *= (1 - rendered.alpha)[..., None]
    radiance += rendered.radiance
    rgb = expose(radiance, shot.sensor, window.scale, shot.seed)
    mask, depth_m = rendered.mask, rendered.depth_m
    inside = _on_sensor(window, shot.camera)
    if not inside.all():
        rgb = np.where(inside[..., None], rgb, np.uint8(0))
        mask, depth_m = mask & inside, np.where(inside, depth_m, np.float32(0))
    pixels = shot.camera.project(shot.cam_from_body.transform(spacecraft.points_m))
    return RenderedFrame(
        rgb=rgb,
        mask=mask,
        depth_m=depth_m,
        visible=rendered.visible & shot.camera.contains(pixels),
        camera=shot.camera.warped(window.input_from_image, window.size, window.size),
    )


def _on_sensor(window: Crop, camera: Camera) -> Bool[ndarray, "s s"]:
    """Which pixels of the window have their centre on the sensor."""
    centres = (np.arange(window.size) + 0.5) / window.scale
    x, y = centres + window.x0, centres + window.y0
    return ((y >= 0) & (y <= camera.height))[:, None] & ((x >= 0) & (x <= camera.width))[None]


def render_frame(state: WorkerState, name: str, sequence: int, index: int) -> dict[str, str]:
    """Render one frame and write its files; its label row."""
    options = state.options
    spacecraft, renderer = state.renderer(name)
    shot = shoot(options.recipe, spacecraft, options.seed, sequence, index)
    picture = render_shot(renderer, spacecraft, shot, window_of(options, shot, spacecraft.points_m))
    write_frame_files(
        state.out / sequence_name(sequence),
        index,
        picture.rgb,
        shot.sensor.jpeg_quality,
        picture.mask if options.mask else None,
        picture.depth_m if options.depth else None,
    )
    return row_of(
        Annotation(
            category=category_of(name),
            index=index,
            cam_from_body=shot.cam_from_body,
            time_s=shot.time_s,
            visible=picture.visible,
            sun_direction=shot.sun_direction,
            earth=shot.earth is not None,
            camera=picture.camera,
            recipe=options.recipe.name,
            seed=options.seed,
        )
    )


def render_chunk(state: WorkerState, plan: SequencePlan) -> Outcome:
    """Render the frames of a plan; a frame that fails is reported and the others go on, a full disk ends it all."""
    journal = state.out / sequence_name(plan.sequence) / JOURNAL
    failures = []
    for index in plan.indices:
        try:
            append_row(journal, render_frame(state, plan.spacecraft, plan.sequence, index))
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES):
                raise
            failures.append(_reason(plan.sequence, index, error))
        except Exception as error:
            failures.append(_reason(plan.sequence, index, error))
    return Outcome(plan.sequence, len(plan.indices) - len(failures), tuple(failures))


def _reason(sequence: int, index: int, error: Exception) -> str:
    text = str(error).strip().splitlines() or [""]
    return f"{sequence_name(sequence)} frame {index}: {type(error).__name__}: {text[0]}"


def append_row(journal: Path, row: dict[str, str]) -> None:
    """Append a row in one write. A line starts with its newline, so that one cut off by a kill spoils no other."""
    line = "\n" + json.dumps(row)
    handle = os.open(journal, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.write(handle, line.encode("utf-8"))
    finally:
        os.close(handle)


def read_journal(journal: Path) -> Iterable[dict[str, str]]:
    """The whole rows of a journal; a line cut off by a kill is left out, its frame is rendered again."""
    if not journal.exists():
        return
    for line in journal.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict) and str(row.get("frame", "")).isdecimal():
            yield row


_state: WorkerState | None = None


def start_worker(out: Path, options: Options, variant: str) -> None:
    """Called once in each worker process: one thread each, and a state of its own."""
    global _state
    cv2.setNumThreads(1)
    _state = WorkerState(out, options, variant, threads=1)


def worker_chunk(plan: SequencePlan) -> Outcome:
    if _state is None:
        raise RuntimeError("start_worker was not called in this process")
    return render_chunk(_state, plan)
