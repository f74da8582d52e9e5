"""Rendering single frames: what each process of a rendering job does."""

from __future__ import annotations

import errno
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Lock

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray

from gknet.dataset.skd_format import Annotation, category_of, row_of, sequence_name
from gknet.dataset.skd_write import write_frame_files
from gknet.geometry import Camera
from gknet.inference.crop import Crop
from gknet.io.spacecraft_file import load_spacecraft
from gknet.render.background import background
from gknet.render.folder import folder_lock
from gknet.render.journal import JOURNAL, append_row
from gknet.render.plan import Job, SequencePlan, window_of
from gknet.render.scenario import Shot, shoot
from gknet.render.scene import Renderer
from gknet.render.sensor import expose
from gknet.spacecraft import Spacecraft

FATAL_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES)
"""Errors of the disk that no other frame will escape."""


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """A finished frame: what is written to disk.

    Attributes:
        rgb: (s, s, 3) uint8.
        mask: (s, s) whether the ray of the pixel's centre meets the spacecraft.
        depth_m: (s, s) z of that point in the camera frame in m, 0 outside of the mask.
        visible: (n,) whether each keypoint is in the full image and not hidden.
        camera: Of this image, which may be a part of the full image.
    """

    rgb: UInt8[ndarray, "s s 3"]
    mask: Bool[ndarray, "s s"]
    depth_m: Float[ndarray, "s s"]
    visible: Bool[ndarray, " n"]
    camera: Camera


@dataclass(frozen=True)
class Outcome:
    """What became of a chunk of frames.

    Attributes:
        sequence: Of the chunk.
        done: The number of frames that are on disk now.
        failures: Reasons, one for each frame that has no image.
    """

    sequence: int
    done: int
    failures: tuple[str, ...] = ()


@dataclass
class WorkerState:
    """What a rendering process keeps from frame to frame.

    Attributes:
        job: The folder and its options.
        variant: Mitsuba's.
        threads: Of this process, None for all cores.
        renderers: One for each spacecraft, made when first needed.
        writing: Held while files are written.
    """

    job: Job
    variant: str
    threads: int | None = None
    renderers: dict[str, tuple[Spacecraft, Renderer]] = field(default_factory=dict)
    writing: Lock = field(default_factory=Lock)

    def renderer(self, name: str) -> tuple[Spacecraft, Renderer]:
        """A spacecraft of the folder, and its renderer."""
        if name not in self.renderers:
            spacecraft = load_spacecraft(self.job.spacecraft_path(name))
            self.renderers[name] = spacecraft, Renderer(spacecraft, self.variant, self.job.options.spp, self.threads)
        return self.renderers[name]


def render_shot(renderer: Renderer, spacecraft: Spacecraft, shot: Shot, window: Crop) -> RenderedFrame:
    """The image of a window as the sensor gives it: black beyond its edge, as where a crop leaves an image.

    Args:
        renderer: Of the spacecraft.
        spacecraft: Its keypoints get their visibility.
        shot: The frame.
        window: A square of its full image.
    """
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


def render_frame(state: WorkerState, name: str, sequence: int, index: int) -> None:
    """Render one frame, write its files, and then its label row into the sequence's journal."""
    job, options = state.job, state.job.options
    spacecraft, renderer = state.renderer(name)
    shot = shoot(job.recipe, spacecraft, options.seed, sequence, index)
    picture = render_shot(renderer, spacecraft, shot, window_of(options, shot, spacecraft.points_m))
    row = row_of(
        Annotation(
            category=category_of(name),
            index=index,
            cam_from_body=shot.cam_from_body,
            time_s=shot.time_s,
            visible=picture.visible,
            sun_direction=shot.sun_direction,
            earth=shot.earth is not None,
            camera=picture.camera,
            recipe=job.recipe.name,
            seed=options.seed,
        )
    )
    with state.writing:
        write_frame_files(
            job.folder(sequence),
            index,
            picture.rgb,
            shot.sensor.jpeg_quality,
            picture.mask if options.has_masks else None,
            picture.depth_m if options.depth else None,
        )
        with folder_lock(job.root):
            append_row(job.folder(sequence) / JOURNAL, row)


def render_chunk(state: WorkerState, plan: SequencePlan, is_stopped: Callable[[], bool]) -> Outcome:
    """Render the frames of a plan; a frame that fails is reported and the others go on, a full disk ends it all.

    Args:
        state: Of this process.
        plan: The frames.
        is_stopped: Asked before each frame; once it is true, the rest is left out.
    """
    done, failures = 0, []
    for index in plan.indices:
        if is_stopped():
            break
        try:
            render_frame(state, plan.spacecraft, plan.sequence, index)
            done += 1
        except OSError as error:
            if error.errno in FATAL_ERRNOS:
                raise
            failures.append(_reason(plan.sequence, index, error))
        except Exception as error:
            failures.append(_reason(plan.sequence, index, error))
    return Outcome(plan.sequence, done, tuple(failures))


def _reason(sequence: int, index: int, error: Exception) -> str:
    text = str(error).strip().splitlines() or [""]
    return f"{sequence_name(sequence)} frame {index}: {type(error).__name__}: {text[0]}"
