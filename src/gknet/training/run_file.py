"""run.json: what `gknet export` needs to know about a training run."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated

from pydantic import Field, TypeAdapter

from gknet.errors import GknetError
from gknet.io.atomic import write_text
from gknet.io.text import read_json, validated
from gknet.training.checkpoint import BEST, weights_metadata

RUN_FILE = "run.json"


@dataclass(frozen=True)
class TrainingRun:
    """The content of run.json.

    Attributes:
        network: Its name, see `gknet.network.build`.
        graph: Of the network.
        loss: That it was trained with.
        input_size: Side of the input in pixels at which it was validated.
        spacecraft_toml: The text of the spacecraft's file.
        settings: All of `TrainSettings`.
        version: Of gknet.
        data: The folder it was trained on.
        best: Values of the best validation so far, which best.safetensors is of; None before the first.
    """

    network: str
    graph: str
    loss: str
    input_size: Annotated[int, Field(gt=0, le=4096, multiple_of=32)]
    spacecraft_toml: str
    settings: dict[str, object]
    version: str
    data: str
    best: dict[str, float] | None

    def save(self, folder: Path) -> None:
        """Write run.json into `folder`."""
        write_text(folder / RUN_FILE, json.dumps(asdict(self), indent=1, default=str) + "\n")


def load_run(folder: Path) -> TrainingRun:
    """The run in `folder`, with the validation that its best weights are of.

    Raises:
        GknetError: The folder has no run.json, or it is damaged.
    """
    path = folder / RUN_FILE
    if not path.exists():
        raise GknetError(f"{path}: no such file; expected a folder of 'gknet train'")
    values = read_json(path)
    names = {field.name for field in fields(TrainingRun)}
    if not isinstance(values, dict) or set(values) != names:
        raise GknetError(f"{path}: expected the keys {', '.join(sorted(names))}")
    run: TrainingRun = validated(TypeAdapter(TrainingRun), values, path)
    # The weights carry their own validation: a run that was killed between the two files has an older run.json.
    best = weights_metadata(folder / BEST).get("best") if (folder / BEST).exists() else None
    return run if best is None else replace(run, best=validated(TypeAdapter(dict[str, float]), best, folder / BEST))
