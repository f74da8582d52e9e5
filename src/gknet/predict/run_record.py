"""prediction.json in a folder of results: what they were made of, so that two runs are never mixed."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from pydantic import TypeAdapter

from gknet import __version__
from gknet.errors import GknetError
from gknet.io.atomic import write_text
from gknet.io.text import quoted, read_json, validated, writable

RECORD_NAME = "prediction.json"


@dataclass(frozen=True)
class RunRecord:
    """What the poses of a run depend on. Two runs with equal records find the same poses.

    Attributes:
        inputs: Absolute paths or addresses of the images.
        model: Absolute path of the model's folder.
        camera: The camera option and its value; empty for a dataset, which brings its own camera.
        box: x0, y0, x1, y1 in px as given; None when it is found or taken from the labels.
        oracle: The box comes from the labels of a dataset.
        split: Of a dataset; None for all.
        every: Each n-th image was taken.
        bit_depth: Of images of more than 8 bits, as given.
        tta_rotations: See `gknet.inference.crop_estimator.InferenceSettings`.
        version: Of gknet.
    """

    inputs: tuple[str, ...]
    model: str
    camera: str = ""
    box: tuple[float, float, float, float] | None = None
    oracle: bool = False
    split: str | None = None
    every: int = 1
    bit_depth: int | None = None
    tta_rotations: int = 1
    version: str = __version__

    def __post_init__(self) -> None:
        object.__setattr__(self, "inputs", tuple(writable(text) for text in self.inputs))
        object.__setattr__(self, "model", writable(self.model))
        object.__setattr__(self, "camera", writable(self.camera))

    def save(self, folder: Path) -> None:
        """Write prediction.json into a folder."""
        write_text(folder / RECORD_NAME, json.dumps(asdict(self), indent=1) + "\n")

    def difference(self, other: RunRecord) -> str:
        """The first setting in which two records differ, for a message; empty when they are equal."""
        for field in fields(self):
            mine, theirs = getattr(self, field.name), getattr(other, field.name)
            if mine != theirs:
                return f"{field.name} {quoted(theirs)}, not {quoted(mine)}"
        return ""


def load_record(folder: Path) -> RunRecord | None:
    """The record of the results in a folder; None where there is none that this version can read."""
    try:
        return validated(TypeAdapter(RunRecord), read_json(folder / RECORD_NAME), folder / RECORD_NAME)
    except GknetError:
        return None
