"""An exported network: one .onnx file, run by onnxruntime, with what is needed to use it in its metadata."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from gknet.errors import GknetError
from gknet.inference.network_io import NetworkOutput
from gknet.inference.onnx_session import open_session
from gknet.io.spacecraft_file import spacecraft_from_toml
from gknet.io.text import parse_json, validated
from gknet.spacecraft import Spacecraft

METADATA_KEY = "gknet"


class Metadata(BaseModel):
    """What the export wrote under the key "gknet", as JSON.

    Attributes:
        kind: What the network answers.
        version: Of gknet, when it was exported.
        network: Name of the architecture.
        spacecraft: The text of the spacecraft's .toml: channel k of a keypoint network is its keypoint k.
        stride: Input pixels per cell of the output's maps; None for a direct network.
        bins: Cells to a turn of the attitude (`AttitudeBins`) of a direct network, or of a keypoint network that
            estimates a distribution of the attitude.
        input_size: Side of the input in pixels.
        tolerance: The largest difference from the trained network that the export allowed.
        floor_cells: Of `Decoding`, from the calibration on the validation split.
        spread_scale: Of `Decoding`, likewise.
        pose_scale: `PnpSettings.covariance_scale`, likewise.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    kind: Literal["keypoints", "locator", "direct"]
    version: str
    network: str
    spacecraft: str
    stride: int | None = Field(default=None, gt=0, le=4096)
    bins: int | None = Field(default=None, ge=4, le=64, multiple_of=2)
    input_size: int = Field(gt=0, le=4096)
    tolerance: FiniteFloat
    floor_cells: FiniteFloat = Field(default=0.3, gt=0)
    spread_scale: FiniteFloat = Field(default=1.0, gt=0)
    pose_scale: FiniteFloat = Field(default=1.0, gt=0)

    @property
    def outputs(self) -> int:
        """The attitude of a keypoint network is an output of its own."""
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

    `predict` is the same for a keypoint network, with the attitude.

    Args:
        path: The .onnx file.
        threads: Of one call, 1 to 1024; None leaves the choice to onnxruntime (every core).
        device: "cpu", or "cuda" with the package onnxruntime-gpu.

    Attributes:
        path: The .onnx file.
        metadata: What the export wrote beside the network.

    Raises:
        GknetError: The file is missing, is no network of gknet, or its metadata differs from the network itself.
    """

    def __init__(self, path: str | Path, threads: int | None = None, device: str = "cpu") -> None:
        self.path = Path(path)
        self._session = open_session(self.path, threads, device)
        text = self._session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
        if text is None:
            raise GknetError(f"{self.path}: no '{METADATA_KEY}' metadata; expected a file written by 'gknet export'")
        source = f"{self.path}: metadata"
        self.metadata: Metadata = validated(Metadata, parse_json(text, source), source)
        self._check_graph()
        self._input = self._session.get_inputs()[0].name

    def _check_graph(self) -> None:
        """The network's own shapes, where the file states them, against those of the metadata."""
        about = self.metadata
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        size, count = about.input_size, self.spacecraft.keypoint_count
        if len(inputs) != 1 or inputs[0].type != "tensor(float)" or not _fits(inputs[0].shape, (3, size, size)):
            got = ", ".join(f"{each.type} of {each.shape}" for each in inputs)
            raise GknetError(
                f"{self.path}: expected one input tensor(float) of (b, 3, {size}, {size}) by its metadata, got {got}"
            )
        if len(outputs) != about.outputs:
            raise GknetError(f"{self.path}: expected {about.outputs} outputs by its metadata, got {len(outputs)}")
        classes = None if about.bins is None else about.bins**3 // 2
        if about.stride is not None:
            cells = size // about.stride
            expected: list[tuple[int, ...]] = [(5 if about.kind == "locator" else count, cells, cells)]
            expected += [] if classes is None else [(classes,)]
        else:
            expected = [(3 + (classes or 0),)]
        for output, shape in zip(outputs, expected, strict=True):
            if not _fits(output.shape, shape):
                raise GknetError(
                    f"{self.path}: expected the output '{output.name}' of (b, {', '.join(map(str, shape))}) by its "
                    f"metadata, got {output.shape}"
                )

    @cached_property
    def spacecraft(self) -> Spacecraft:
        """The spacecraft that the network was trained for, without its mesh."""
        return spacecraft_from_toml(self.metadata.spacecraft, str(self.path))

    def __call__(self, images: Float32[ndarray, "b 3 size size"]) -> Float32[ndarray, "b c *cells"]:
        """The network's first output."""
        return self._run(images)[0]

    def predict(self, images: Float32[ndarray, "b 3 size size"]) -> NetworkOutput:
        """Of a keypoint network: the heatmaps, and the attitude where it estimates one."""
        return NetworkOutput(*self._run(images))

    def _run(self, images: Float32[ndarray, "b 3 size size"]) -> list[ndarray]:
        size = self.metadata.input_size
        if images.ndim != 4 or images.shape[1:] != (3, size, size) or images.dtype != np.float32:
            raise GknetError(
                f"{self.path.name}: expected float32 images of shape (b, 3, {size}, {size}), "
                f"got {images.dtype} of {images.shape}"
            )
        return self._session.run(None, {self._input: images})


def _fits(stated: list[int | str | None], expected: tuple[int, ...]) -> bool:
    """Whether a shape agrees after the batch; what the file leaves open (a name, None) agrees with any number."""
    if len(stated) != 1 + len(expected):
        return False
    return all(not isinstance(got, int) or got == wanted for got, wanted in zip(stated[1:], expected, strict=True))
