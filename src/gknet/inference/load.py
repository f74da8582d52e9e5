"""Estimators on disk: the models that are shipped, and folders of exported networks."""

from __future__ import annotations

import os
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path

from gknet.errors import GknetError
from gknet.inference.attitude import AttitudeBins
from gknet.inference.crop_estimator import InferenceSettings
from gknet.inference.decode import Decoding
from gknet.inference.direct_estimator import DirectEstimator
from gknet.inference.keypoint_estimator import KeypointEstimator
from gknet.inference.onnx_model import OnnxModel
from gknet.inference.pnp import PnpSettings

KINDS = ("keypoints", "direct")
"""What a model's folder holds, as KIND.onnx: one of them, perhaps with a locator.onnx."""


def shipped_models() -> tuple[str, ...]:
    """Names that `load_estimator` knows without a path."""
    folder = resources.files("gknet") / "models"
    if not folder.is_dir():
        return ()
    return tuple(sorted(entry.name for entry in folder.iterdir() if _kinds_in(entry)))


def shipped_folder(name: str) -> Path:
    """The folder of a shipped model, whatever the current folder holds.

    Args:
        name: One of `shipped_models`.

    Raises:
        GknetError: No such model is shipped.
    """
    if name not in shipped_models():
        known = ", ".join(shipped_models()) or "none"
        raise GknetError(f"model '{name}': expected a shipped model ({known})")
    return Path(str(resources.files("gknet") / "models" / name))


def load_estimator(
    name_or_folder: str | Path, threads: int | None = None, device: str = "cpu", tta_rotations: int = 1
) -> KeypointEstimator | DirectEstimator:
    """Load an estimator.

    Args:
        name_or_folder: The name of a shipped model (`shipped_models`), or a folder with keypoints.onnx or direct.onnx,
            and perhaps a locator.onnx. A `Path`, and a string with a path separator, is a folder always.
        threads: Of one call of a network, 1 to 1024; None leaves the choice to onnxruntime (every core).
        device: "cpu", or "cuda" with the package onnxruntime-gpu.
        tta_rotations: `InferenceSettings.tta_rotations`: 1, 2 or 4.

    Returns:
        A `PoseEstimator`. With a locator it needs no box.

    Raises:
        GknetError: No such model; a name that is both a shipped model and a folder here; files that are not gknet's, or
            of different spacecraft; an argument out of range.
    """
    folder = _folder_of(name_or_folder)
    kinds = _kinds_in(folder)
    if len(kinds) != 1:
        known = ", ".join(shipped_models()) or "none"
        got = "; it has both, remove one" if kinds else ""
        raise GknetError(
            f"model '{name_or_folder}': expected a shipped model ({known}) "
            f"or a folder with keypoints.onnx or direct.onnx{got}"
        )
    network = _open(folder, kinds[0], threads, device)
    locator = _open_locator(folder, network, threads, device)
    about = network.metadata
    locator_size = locator.metadata.input_size if locator else InferenceSettings.locator_size
    settings = InferenceSettings(about.input_size, locator_size, tta_rotations=tta_rotations)
    bins = None if about.bins is None else AttitudeBins(about.bins)
    if kinds[0] == "direct":
        assert bins is not None  # by its metadata
        if tta_rotations > 1:
            raise GknetError(f"tta_rotations: expected 1 for a direct network, got {tta_rotations}")
        return DirectEstimator(network, network.spacecraft, bins, locator, settings)
    return KeypointEstimator(
        network.predict,
        network.spacecraft,
        locator,
        settings,
        Decoding(about.floor_cells, about.spread_scale),
        PnpSettings(covariance_scale=about.pose_scale),
        bins,
    )


def _folder_of(name_or_folder: str | Path) -> Path:
    """The folder of a shipped model or of the user's; a name that may mean either is refused."""
    if not str(name_or_folder) or "\0" in str(name_or_folder):
        raise GknetError("model: expected the name of a shipped model or a folder, got no name")
    folder = Path(name_or_folder)
    separators = {os.sep, os.altsep or os.sep}
    if isinstance(name_or_folder, Path) or any(sign in name_or_folder for sign in separators):
        return folder
    if name_or_folder not in shipped_models():
        return folder
    if folder.exists():
        raise GknetError(
            f"model '{name_or_folder}': a shipped model and a folder here both have this name; "
            f"give '.{os.sep}{name_or_folder}' for the folder, or run where there is no such folder"
        )
    return shipped_folder(name_or_folder)


def _kinds_in(folder: Path | Traversable) -> list[str]:
    return [kind for kind in KINDS if (folder / f"{kind}.onnx").is_file()]


def _open(folder: Path, kind: str, threads: int | None, device: str) -> OnnxModel:
    network = OnnxModel(folder / f"{kind}.onnx", threads, device)
    if network.metadata.kind != kind:
        raise GknetError(f"{network.path}: expected a network of kind '{kind}', got '{network.metadata.kind}'")
    return network


def _open_locator(folder: Path, network: OnnxModel, threads: int | None, device: str) -> OnnxModel | None:
    """The locator beside a network, of the same spacecraft; None when there is none."""
    if not (folder / "locator.onnx").is_file():
        return None
    locator = _open(folder, "locator", threads, device)
    expected, got = network.spacecraft.name, locator.spacecraft.name
    if got != expected:
        raise GknetError(
            f"{locator.path}: expected a locator of {expected}, as {network.path.name} is, got one of {got}"
        )
    return locator
