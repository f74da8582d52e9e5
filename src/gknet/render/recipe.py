"""A recipe: the ranges from which a data set's sequences are drawn, read from a TOML file.

A sequence belongs to one spacecraft and one split, by its number alone, so that any part of a data set can be rendered
anywhere and still be the same part.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from gknet.errors import GknetError
from gknet.io.text import read_toml, validated

Split = Literal["train", "val", "test"]
SPLIT_CYCLE: tuple[Split, ...] = ("train", "val", "train", "test", "train")
"""The splits of a spacecraft's consecutive sequences: 3:1:1."""

Fraction = Annotated[FiniteFloat, Field(ge=0, le=1)]
Positive = Annotated[FiniteFloat, Field(gt=0)]
_FOLDER = Path(__file__).parent / "recipes"


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="after")
    def _ranges_ascend(self) -> Self:
        for name in type(self).model_fields:
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) == 2 and value[0] > value[1]:
                raise ValueError(f"{name}: expected [low, high], got {list(value)}")
        return self


class Motion(_Part):
    """How the chaser moves about the spacecraft, and the spacecraft about itself.

    approach, fly_around, hold   weights of the three kinds of relative motion
    approach_ratio               first range of an approach over its last
    span                         longer side of the keypoints' box over the image's side, kept on every frame
    whole_fraction               least part of a sequence's frames that show every keypoint
    keypoint_fraction            least part of the keypoints in view, on every frame
    keypoints_min                the same as a number
    off_centre                   how far the pointing error may use the room beside the spacecraft, 1 = up to the edge
    """

    approach: Positive
    fly_around: Positive
    hold: Positive
    approach_ratio: tuple[Positive, Positive]
    span: tuple[Positive, Positive]
    whole_fraction: Fraction
    keypoint_fraction: Fraction
    keypoints_min: Annotated[int, Field(ge=4)]
    off_centre: tuple[Positive, Positive]
    tumble_deg_s: tuple[Positive, Positive]
    step_s: tuple[Positive, Positive]
    step_deg: tuple[Positive, Positive]


class LightLimits(_Part):
    """Orbit, Earth and sun. `phase_deg` is the angle at the spacecraft between the sun and the camera.

    earth_fraction   part of the sequences that have the Earth in view
    earth_fills      part of those in which it fills the frame
    """

    altitude_km: tuple[Positive, Positive]
    phase_deg: tuple[Annotated[FiniteFloat, Field(ge=0, le=180)], Annotated[FiniteFloat, Field(ge=0, le=180)]]
    earth_fraction: Fraction
    earth_fills: Fraction


class Detector(_Part):
    """Camera and exposure control; widths in native pixels, charges in electrons.

    exposure_sigma     standard deviation of the natural logarithm of the exposure control's error
    exposure_failure   part of the sequences in which the control is off by a factor drawn from `failure_factor`
    bloom              part of the light that scatters into a wide halo
    veil               stray light of a sun ten degrees off the optical axis, in radiance
    """

    psf_sigma_px: tuple[Positive, Positive]
    full_well_e: tuple[Positive, Positive]
    read_noise_e: tuple[Positive, Positive]
    bloom: tuple[Positive, Positive]
    veil: tuple[Positive, Positive]
    gamma: tuple[Positive, Positive]
    exposure_sigma: Positive
    exposure_failure: Fraction
    failure_factor: tuple[Positive, Positive]
    monochrome: Fraction
    jpeg_quality: tuple[Annotated[int, Field(ge=1, le=100)], Annotated[int, Field(ge=1, le=100)]]


class Recipe(_Part):
    """Sequence i shows spacecraft i modulo their number."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_-]+$")]
    sequences: Annotated[int, Field(gt=0)]
    frames: Annotated[int, Field(gt=0)]
    spacecraft: Annotated[tuple[str, ...], Field(min_length=1)]
    motion: Motion
    light: LightLimits
    detector: Detector

    def spacecraft_of(self, sequence: int) -> str:
        self._check(sequence)
        return self.spacecraft[sequence % len(self.spacecraft)]

    def split_of(self, sequence: int) -> Split:
        self._check(sequence)
        return SPLIT_CYCLE[sequence // len(self.spacecraft) % len(SPLIT_CYCLE)]

    @property
    def key(self) -> int:
        """A number for the name, the same on every machine, that goes into every random seed."""
        return zlib.crc32(self.name.encode())

    def _check(self, sequence: int) -> None:
        if not 0 <= sequence < self.sequences:
            raise GknetError(f"sequence: expected 0 to {self.sequences - 1} in recipe {self.name}, got {sequence}")


def load_recipe(name_or_path: str | Path) -> Recipe:
    """A recipe by the name of one that ships ("skd", "skd-hard"), or from a TOML file."""
    shipped = _FOLDER / f"{name_or_path}.toml"
    path = shipped if shipped.parent == _FOLDER and shipped.is_file() else Path(name_or_path)
    if not path.exists():
        known = ", ".join(sorted(file.stem for file in _FOLDER.glob("*.toml")))
        raise GknetError(f"recipe {name_or_path}: expected one of {known}, or a TOML file")
    return validated(Recipe, read_toml(path), path)


RECIPES: dict[str, Recipe] = {name: load_recipe(name) for name in ("skd", "skd-hard")}
