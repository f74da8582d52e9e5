"""An exported network: one .onnx file, run by onnxruntime, with what is needed to use it in its metadata."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import onnxruntime
from jaxtyping import Float32
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from gknet.errors import GknetError
from gknet.inference.locate import NetworkOutput
from gknet.spacecraft import Spacecraft, spacecraft_from_toml

METADATA_KEY = "gknet"

PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}


class Metadata(BaseModel):
    """What the export wrote under the key "gknet", as JSON.

    spacecraft        the text of the spacecraft's .toml: channel k of a keypoint network is its keypoint k
    stride            input pixels per cell of the output's maps; a direct network has none
    bins              cells to a turn of the attitude (attitude.py) of a direct network, or of one that sees keypoints
                      and has a belief in it
    tolerance         the largest difference from the trained network that the export allowed
    floor_cells, spread_scale, pose_scale   how sure keypoints and poses are (calibration.py), from the validation split
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    kind: Literal["keypoints", "locator", "direct"]
    version: str
    network: str
    spacecraft: str
    stride: int | None = Field(default=None, gt=0)
    bins: int | None = Field(default=None, ge=4, multiple_of=2)
    input_size: int = Field(gt=0)
    tolerance: FiniteFloat
    floor_cells: FiniteFloat = Field(default=0.3, gt=0)
    spread_scale: FiniteFloat = Field(default=1.0, gt=0)
    pose_scale: FiniteFloat = Field(default=1.0, gt=0)

    @property
    def outputs(self) -> int:
        """A keypoint network's belief in the attitude is an output of its own."""
        return 2 if self.kind == "keypoints" and self.bins is not None else 1

    @model_validator(mode="after")
    def _output_is_known(self) -> Metadata:
        direct = self.kind == "direct"
        if direct == (self.stride is not None) or (direct and self.bins is None):
            raise ValueError("expected a stride for maps, or bins for a direct network")
        if self.kind == "locator" and self.bins is not None:
            raise ValueError("expected no bins for a locator")
        return self


class OnnxModel:
    """A callable (b, 3, size, size) float32 RGB in [0, 1] -> (b, c, size / stride, size / stride), or (b, c) if direct.

    `predict` is the same for the estimator by keypoints, with the belief in the attitude.

    threads   of one call; None leaves the choice to onnxruntime (every core)
    device    "cpu", or "cuda" with the package onnxruntime-gpu
    """

    def __init__(self, path: str | Path, threads: int | None = None, device: str = "cpu") -> None:
        self.path = Path(path)
        self._session = _open(self.path, threads, device)
        self._input = self._session.get_inputs()[0].name
        text = self._session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
        self.metadata = _read_metadata(self.path, text)
        outputs = len(self._session.get_outputs())
        if outputs != self.metadata.outputs:
            raise GknetError(f"{self.path}: expected {self.metadata.outputs} outputs by its metadata, got {outputs}")

    @cached_property
    def spacecraft(self) -> Spacecraft:
        return spacecraft_from_toml(self.metadata.spacecraft, str(self.path))

    def __call__(self, images: Float32[ndarray, "b 3 size size"]) -> Float32[ndarray, "b c *cells"]:
        return self._run(images)[0]

    def predict(self, images: Float32[ndarray, "b 3 size size"]) -> NetworkOutput:
        """Of a keypoint network: its belief in the attitude too, where it has one."""
        return NetworkOutput(*self._run(images))

    def _run(self, images: Float32[ndarray, "b 3 size size"]) -> list[ndarray]:
        size = self.metadata.input_size
        if images.ndim != 4 or images.shape[1:] != (3, size, size) or images.dtype != np.float32:
            raise GknetError(
                f"{self.path.name}: expected float32 images of shape (b, 3, {size}, {size}), "
                f"got {images.dtype} of {images.shape}"
            )
        return self._session.run(None, {self._input: images})


def _open(path: Path, threads: int | None, device: str) -> onnxruntime.InferenceSession:
    if device not in PROVIDERS:
        raise GknetError(f"device: expected one of {', '.join(PROVIDERS)}, got '{device}'")
    if PROVIDERS[device] not in onnxruntime.get_available_providers():
        raise GknetError(f"device {device}: this onnxruntime cannot use it; install onnxruntime-gpu")
    if threads is not None and threads < 1:
        raise GknetError(f"threads: expected 1 or more, got {threads}")
    if not path.is_file():
        raise GknetError(f"{path}: no such model file")
    options = onnxruntime.SessionOptions()
    options.inter_op_num_threads = 1
    options.intra_op_num_threads = threads or 0
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=[PROVIDERS[device]])
    except Exception as error:  # onnxruntime's exceptions have no common base
        raise GknetError(f"{path}: not a model that onnxruntime can open ({str(error).splitlines()[0]})") from error


def _read_metadata(path: Path, text: str | None) -> Metadata:
    if text is None:
        raise GknetError(f"{path}: no '{METADATA_KEY}' metadata; expected a file written by 'gknet export'")
    try:
        return Metadata.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "JSON"
        raise GknetError(f"{path}: metadata: {place}: {first['msg']}") from error
