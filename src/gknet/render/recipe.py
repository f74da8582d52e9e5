"""A recipe: the ranges from which a dataset's sequences are drawn, read from a TOML file.

A sequence belongs to one spacecraft and one split, by its number alone, so that any part of a dataset can be rendered
anywhere and still be the same part.
"""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat

from gknet.errors import GknetError
from gknet.io.text import read_toml, validated

Split = Literal["train", "val", "test"]
SPLIT_CYCLE: tuple[Split, ...] = ("train", "val", "train", "test", "train")
"""The splits of a spacecraft's consecutive sequences: 3:1:1."""

MOST_SEQUENCES = 999_999
"""What the six digits of a sequence's folder can count."""

MOST_FRAMES = 10_000
"""Of a sequence, whose motion is kept in memory as a whole."""


def _ascending(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] > limits[1]:
        raise ValueError(f"expected [low, high], got {list(limits)}")
    return limits


Fraction = Annotated[FiniteFloat, Field(ge=0, le=1)]
Positive = Annotated[FiniteFloat, Field(gt=0, le=1e9)]
Range = Annotated[tuple[Positive, Positive], AfterValidator(_ascending)]
"""Low and high, from which a value is drawn."""

Degrees = Annotated[FiniteFloat, Field(ge=0, le=180)]
TumbleRate = Annotated[FiniteFloat, Field(gt=0, le=360)]
TimeStep = Annotated[FiniteFloat, Field(gt=0, le=60)]
Quality = Annotated[int, Field(ge=1, le=100)]
SpacecraftName = Annotated[str, Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$", max_length=100)]
RECIPE_FOLDER = Path(__file__).parent / "recipes"


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Motion(_Part):
    """How the chaser moves about the spacecraft, and the spacecraft about itself.

    Attributes:
        approach: Weight of approaches among the three kinds of relative motion.
        fly_around: Weight of fly-arounds.
        hold: Weight of station-keeping.
        approach_ratio: First range of an approach over its last.
        span: Longer side of the keypoints' box over the image's side, kept on every frame.
        whole_fraction: Least part of a sequence's frames that show every keypoint.
        keypoint_fraction: Least part of the keypoints in view, on every frame.
        keypoints_min: Least number of keypoints in view, on every frame.
        off_centre: How far the pointing error may use the room beside the spacecraft; 1 is up to the edge.
        tumble_deg_s: Speed of the spacecraft's rotation in deg/s.
        step_s: Time between frames in s.
        step_deg: Rotation between frames in deg; it goes before `step_s` where both cannot be had.
    """

    approach: Positive
    fly_around: Positive
    hold: Positive
    approach_ratio: Range
    span: Range
    whole_fraction: Fraction
    keypoint_fraction: Fraction
    keypoints_min: Annotated[int, Field(ge=4, le=10_000)]
    off_centre: Range
    tumble_deg_s: Annotated[tuple[TumbleRate, TumbleRate], AfterValidator(_ascending)]
    step_s: Annotated[tuple[TimeStep, TimeStep], AfterValidator(_ascending)]
    step_deg: Range


class LightLimits(_Part):
    """Orbit, Earth and sun.

    Attributes:
        altitude_km: Of the circular orbit in km.
        phase_deg: Angle at the spacecraft between the sun and the camera in deg.
        earth_fraction: Part of the sequences that have the Earth in view.
        earth_fills: Part of those in which it fills the frame.
    """

    altitude_km: Range
    phase_deg: Annotated[tuple[Degrees, Degrees], AfterValidator(_ascending)]
    earth_fraction: Fraction
    earth_fills: Fraction


class Detector(_Part):
    """Camera and exposure control; widths in native pixels, charges in electrons.

    Attributes:
        psf_sigma_px: Gaussian point spread.
        full_well_e: Electrons of a full pixel.
        read_noise_e: Standard deviation of the read-out noise.
        bloom: Part of the light that scatters into a wide halo.
        veil: Stray light of a sun ten degrees off the optical axis, in radiance.
        gamma: Pixel = 255 signal^(1 / gamma).
        exposure_sigma: Standard deviation of the natural logarithm of the exposure control's error.
        exposure_failure: Part of the sequences in which the control is off by a factor drawn from `failure_factor`.
        failure_factor: That factor, up or down.
        monochrome: Part of the sequences without colour.
        jpeg_quality: Of the files, 1 to 100.
    """

    psf_sigma_px: Range
    full_well_e: Range
    read_noise_e: Range
    bloom: Range
    veil: Range
    gamma: Range
    exposure_sigma: Positive
    exposure_failure: Fraction
    failure_factor: Range
    monochrome: Fraction
    jpeg_quality: Annotated[tuple[Quality, Quality], AfterValidator(_ascending)]


class Recipe(_Part):
    """The ranges of a whole dataset. Sequence i shows spacecraft i modulo their number.

    Attributes:
        name: Lower-case letters, digits, - and _; it goes into every random seed.
        sequences: Of all spacecraft together.
        frames: Of each sequence.
        spacecraft: Names, in the order in which sequences take them.
        motion: Of chaser and spacecraft.
        light: Orbit, Earth and sun.
        detector: Camera and exposure control.
    """

    name: Annotated[str, Field(pattern=r"^[a-z0-9_-]+$", max_length=100)]
    sequences: Annotated[int, Field(gt=0, le=MOST_SEQUENCES)]
    frames: Annotated[int, Field(gt=0, le=MOST_FRAMES)]
    spacecraft: Annotated[tuple[SpacecraftName, ...], Field(min_length=1, max_length=1000)]
    motion: Motion
    light: LightLimits
    detector: Detector

    def spacecraft_of(self, sequence: int) -> str:
        """The spacecraft of a sequence, whose number counts from 0.

        Raises:
            GknetError: The recipe has no such sequence.
        """
        self._check(sequence)
        return self.spacecraft[sequence % len(self.spacecraft)]

    def split_of(self, sequence: int) -> Split:
        """The split of a sequence, whose number counts from 0.

        Raises:
            GknetError: The recipe has no such sequence.
        """
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
    """A recipe by the name of one that ships (skd, skd-hard), or from a TOML file.

    Raises:
        GknetError: There is no such recipe, or the file is not one.
    """
    shipped = RECIPE_FOLDER / f"{name_or_path}.toml"
    path = shipped if shipped.parent == RECIPE_FOLDER and shipped.is_file() else Path(name_or_path)
    if not path.exists():
        known = ", ".join(sorted(file.stem for file in RECIPE_FOLDER.glob("*.toml")))
        raise GknetError(f"recipe {name_or_path}: expected one of {known}, or a TOML file; there is no such file")
    return validated(Recipe, read_toml(path), path)


RECIPES: dict[str, Recipe] = {name: load_recipe(name) for name in ("skd", "skd-hard")}
