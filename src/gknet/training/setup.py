"""What a training needs before its loop: device and precision, network and task, cached crops."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable
from pathlib import Path

import torch
from lightning_fabric import Fabric

from gknet.dataset.skd import SkdDataset
from gknet.errors import GknetError
from gknet.inference.attitude import AttitudeBins
from gknet.inference.crop_pose import has_square_pixels
from gknet.network.build import build, spec_of
from gknet.network.direct_pose import DirectNetwork
from gknet.network.network import Network
from gknet.spacecraft import Spacecraft
from gknet.training.cache import Cache, FrameSource, build_cache
from gknet.training.checkpoint import warm_start
from gknet.training.settings import TrainSettings
from gknet.training.tasks import DirectTask, KeypointTask, LocatorTask, Task

logger = logging.getLogger(__name__)

BF16_FLAGS = {"avx512_bf16", "amx_bf16"}
IMAGE_SIZE = 256
"""Side of a cached whole image: the locator's input."""


def cpu_has_bf16() -> bool:
    """Whether this CPU multiplies bfloat16 in hardware; where it does not, bfloat16 is slower."""
    try:
        flags = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return False
    return any(flag in flags for flag in BF16_FLAGS)


def _is_on_gpu(settings: TrainSettings) -> bool:
    return settings.device == "cuda" or (settings.device == "auto" and torch.cuda.is_available())


def chosen_precision(settings: TrainSettings) -> str:
    """The precision of the settings; for "auto" bfloat16 where the device multiplies it in hardware."""
    if settings.precision != "auto":
        return settings.precision
    has_bf16 = torch.cuda.is_bf16_supported() if _is_on_gpu(settings) else cpu_has_bf16()
    return "bf16-mixed" if has_bf16 else "32-true"


def make_fabric(settings: TrainSettings) -> Fabric:
    """The devices of the settings.

    Raises:
        GknetError: This machine does not have them, or not in that precision.
    """
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)  # no notes about the precision that was chosen
    available = {"auto": True, "cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if not available[settings.device]:
        raise GknetError(f"device: '{settings.device}' is not available on this machine; leave it out")
    if settings.precision == "16-mixed" and not _is_on_gpu(settings):
        raise GknetError("precision: 16-mixed needs a GPU; leave it out, or choose bf16-mixed")
    try:
        fabric = Fabric(
            accelerator=settings.device,
            devices=settings.devices,
            strategy="ddp" if settings.devices > 1 else "auto",
            precision=chosen_precision(settings),  # type: ignore[arg-type]
        )
        fabric.launch()
    except (ValueError, RuntimeError, ImportError) as error:  # a device or a precision that is not there
        raise GknetError(f"train: {str(error).splitlines()[0]}") from error
    if fabric.world_size > 1 and settings.minutes is not None:
        raise GknetError("train: several devices cannot agree on a clock; give --samples instead of --minutes")
    return fabric


def make_network(spacecraft: Spacecraft, settings: TrainSettings, is_fresh: bool) -> Network:
    """The network of the settings; a fresh one begins with the weights of `settings.init`."""
    torch.manual_seed(settings.seed)
    network = build(settings.network, spacecraft.adjacency, spacecraft.points_m, settings.graph, settings.chosen_loss)
    if settings.init is not None and is_fresh:
        taken, total = warm_start(network, settings.init)
        logger.info("%s: %d of %d tensors taken", settings.init, taken, total)
    return network


def make_task(network: Network, spacecraft: Spacecraft, settings: TrainSettings) -> Task:
    """What the network is trained for."""
    kind, size = spec_of(settings.network).kind, settings.input_size
    bins = None if network.attitude_bins is None else AttitudeBins(network.attitude_bins)
    if kind == "locator":
        assert network.stride is not None
        return LocatorTask(spacecraft, network.stride, size)
    if kind == "direct":
        assert bins is not None
        return DirectTask(spacecraft, bins, size)
    return KeypointTask(spacecraft, size, settings.auxiliary, bins)


def check_cameras(network: Network, frames: FrameSource) -> None:
    """Refuse pixels that are not square to a direct network: a rotated image of them is that of no camera."""
    if not isinstance(network, DirectNetwork):
        return
    for i in range(len(frames)):
        try:
            frame = frames.frame(i, image=False)
        except GknetError:  # a bad label is left out by the cache
            continue
        if not has_square_pixels(frame.camera):
            ratio = frame.camera.matrix[0, 0] / frame.camera.matrix[1, 1]
            raise GknetError(
                f"{frame.name}: expected square pixels, got fx / fy of {ratio:.3f}; resize the images to train on"
            )


def open_cache(
    data: SkdDataset, settings: TrainSettings, folder: Path, report: Callable[[str], None] = logger.warning
) -> Cache:
    """The decoded crops of a dataset, built under `folder` if they are not there.

    Args:
        data: The dataset.
        settings: Of the run: window, size and workers.
        folder: Of caches. The dataset has one place there for each window and size.
        report: Called with a line for each frame that is left out.
    """
    from gknet.io.progress import progress

    size = IMAGE_SIZE if settings.window == "image" else settings.cache_size
    with progress() as bar:
        task = bar.add_task("decoding", total=len(data))
        return build_cache(
            data,
            data.spacecraft,
            folder / _cache_name(data, folder, f"{settings.window}_{size}"),
            size,
            settings.window,
            picture_stamp(data),
            settings.workers,
            lambda done, total: bar.update(task, completed=done),
            report,
        )


def _cache_name(data: SkdDataset, folder: Path, kind: str) -> str:
    """A name in `folder` for the cache of a dataset, which stays when the dataset's content changes."""
    root = os.path.relpath(data.root.resolve(), folder.resolve())  # both may move together
    digest = hashlib.sha256(os.fsencode(f"{root} {data.spacecraft.name}")).hexdigest()
    return f"{kind}_{digest[:12]}"


def picture_stamp(data: SkdDataset) -> str:
    """Sizes and times of all image files in one digest, which changes with any of them."""
    digest = hashlib.sha256()
    for row in range(len(data)):
        try:
            file = data.extras(row).image_path.stat()
        except (GknetError, OSError):  # no label or no image: the cache leaves the frame out
            digest.update(b"-")
        else:
            digest.update(f"{file.st_size}:{file.st_mtime_ns};".encode())
    return digest.hexdigest()
