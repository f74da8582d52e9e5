"""What a training needs before its loop: device and precision, network and task, cached crops."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from lightning_fabric import Fabric
from torch import nn

from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.inference.attitude import AttitudeBins
from gknet.inference.crop_pose import has_square_pixels
from gknet.network.dmanet import DMANet
from gknet.network.locator import Locator
from gknet.network.network import Network
from gknet.spacecraft import Spacecraft
from gknet.training.cache import Cache, FrameSource, build_cache
from gknet.training.settings import TrainSettings
from gknet.training.tasks import DirectTask, KeypointTask, LocatorTask, Task
from gknet.training.validation import validation_rows

BF16_FLAGS = {"avx512_bf16", "amx_bf16"}
PICTURE_SIZE = 256
"""Side of a cached whole picture: the locator's input."""
STAMPED = 64
"""So many image files, evenly spread, tell by size and time whether the pictures are still the same."""


def cpu_has_bf16() -> bool:
    """Whether this CPU multiplies bfloat16 in hardware; elsewhere it would only be slower."""
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return False
    return any(flag in flags for flag in BF16_FLAGS)


def chosen_precision(settings: TrainSettings) -> str:
    if settings.precision != "auto":
        return settings.precision
    on_gpu = settings.device in ("cuda", "gpu") or (settings.device == "auto" and torch.cuda.is_available())
    has_bf16 = torch.cuda.is_bf16_supported() if on_gpu else cpu_has_bf16()
    return "bf16-mixed" if has_bf16 else "32-true"


def make_fabric(settings: TrainSettings) -> Fabric:
    try:
        fabric = Fabric(
            accelerator=settings.device,
            devices=settings.devices,
            strategy="ddp" if settings.devices > 1 else "auto",
            precision=chosen_precision(settings),  # type: ignore[arg-type]
        )
        fabric.launch()
    except (ValueError, RuntimeError) as error:  # a device or a precision that is not there
        raise GknetError(f"train: {str(error).splitlines()[0]}") from error
    if fabric.world_size > 1 and settings.minutes is not None:
        raise GknetError("train: several devices cannot agree on a clock; give --epochs instead of --minutes")
    return fabric


def make_task(network: Network, spacecraft: Spacecraft, settings: TrainSettings) -> Task:
    if isinstance(network, Locator):
        return LocatorTask(spacecraft, network.stride, settings.input_size)
    if isinstance(network, DMANet):
        return DirectTask(spacecraft, AttitudeBins(network.config.bins), settings.input_size)
    bins = None if network.attitude_bins is None else AttitudeBins(network.attitude_bins)
    return KeypointTask(spacecraft, settings.input_size, settings.auxiliary, bins)


def check_cameras(network: Network, frames: FrameSource) -> None:
    """Refuse pixels that are not square to a direct network: turned, their picture is of no rolled camera."""
    if not isinstance(network, DMANet):
        return
    for i in range(len(frames)):
        try:
            frame = frames.frame(i, image=False)
        except GknetError:  # a bad label is left out by the cache
            continue
        if not has_square_pixels(frame.camera):
            ratio = frame.camera.matrix[0, 0] / frame.camera.matrix[1, 1]
            raise GknetError(
                f"{frame.name}: expected square pixels, got fx / fy of {ratio:.3f}; resize the pictures to train on"
            )


@torch.no_grad()
def update_average(average: nn.Module, network: nn.Module, keep: float) -> None:
    """average <- keep * average + (1 - keep) * network, statistics of the normalisation included."""
    pairs = list(zip(average.state_dict().values(), network.state_dict().values(), strict=True))
    floats = [(a, n) for a, n in pairs if a.is_floating_point()]
    torch._foreach_lerp_([a for a, _ in floats], [n for _, n in floats], 1 - keep)
    for a, n in pairs:
        if not a.is_floating_point():
            a.copy_(n)


def _stamp(data: SkdDataset, row: int) -> str:
    """Size and time of a frame's picture; nothing where its label or its picture is missing."""
    try:
        file = data.extras(row).image_path.stat()
    except (GknetError, OSError):
        return ""
    return f"{file.st_size}:{file.st_mtime_ns}"


def open_cache(data: SkdDataset, settings: TrainSettings, folder: Path, say: Callable[[str], None]) -> Cache:
    """The decoded crops of `data`, built under `folder` if they are not there."""
    from gknet.io.progress import progress

    stamp = " ".join(_stamp(data, row) for row in validation_rows(len(data), STAMPED))
    size = PICTURE_SIZE if settings.window == "picture" else settings.cache_size
    with progress() as bar:
        task = bar.add_task("decoding", total=len(data))
        return build_cache(
            data,
            data.spacecraft,
            folder,
            size,
            settings.window,
            stamp,
            settings.workers,
            lambda done, total: bar.update(task, completed=done),
            say,
        )
