"""The scene of one frame: a pure function of (recipe, spacecraft, seed, sequence, index)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gknet.errors import GknetError
from gknet.geometry import Camera, Pose
from gknet.render.recipe import RECIPES, Recipe, load_recipe
from gknet.render.sensor import Sensor
from gknet.render.sequence import CAMERA, EARTH_RADIUS_M, SequenceMotion, sample_sequence
from gknet.render.trajectory import band_limited
from gknet.spacecraft import Spacecraft

__all__ = ["CAMERA", "EARTH_RADIUS_M", "RECIPES", "EarthView", "Recipe", "Sensor", "Shot", "load_recipe", "shoot"]


@dataclass(frozen=True, eq=False)
class EarthView:
    """Where the Earth is. Earth-fixed axes: z to the north pole, x to longitude 0, y to longitude 90 degrees east.

    Attributes:
        centre_cam_m: (3,) its centre in the camera frame, in m.
        cam_from_earth: (3, 3) rotation from Earth-fixed axes to the camera frame.
    """

    centre_cam_m: Float[ndarray, "3"]
    cam_from_earth: Float[ndarray, "3 3"]


@dataclass(frozen=True, eq=False)
class Shot:
    """One frame before light: all that the renderer, the background and the sensor need.

    Attributes:
        recipe: Its name.
        spacecraft: Its name.
        sequence: Number of the sequence, from 0.
        index: Number of the frame in it, from 0.
        time_s: Since the sequence's first frame, in s.
        camera: Of the whole sensor.
        cam_from_body: The pose, in m, in the OpenCV camera frame.
        sun_direction: (3,) unit vector to the sun in the camera frame.
        earth: None when no part of the Earth is in view.
        cam_from_inertial: (3, 3) rotation; inertial axes are equatorial, those of the star catalogue.
        sensor: Detector and exposure.
        seed: Of this frame's noise.
        planet: The Earth, whether in view or not: its light reaches the spacecraft in any case.
    """

    recipe: str
    spacecraft: str
    sequence: int
    index: int
    time_s: float
    camera: Camera
    cam_from_body: Pose
    sun_direction: Float[ndarray, "3"]
    earth: EarthView | None
    cam_from_inertial: Float[ndarray, "3 3"]
    sensor: Sensor
    seed: int
    planet: EarthView | None = None


def shoot(recipe: Recipe, spacecraft: Spacecraft, seed: int, sequence: int, index: int) -> Shot:
    """The shot of one frame; frames may be asked for in any order.

    The sequence's motion is sampled once and kept for the next frames.

    Args:
        recipe: The ranges.
        spacecraft: The sequence's.
        seed: Of the dataset.
        sequence: From 0.
        index: Of the frame, from 0.

    Raises:
        GknetError: The recipe has no such frame, or no motion obeys its limits.
    """
    if not 0 <= sequence < recipe.sequences:
        raise GknetError(f"sequence: expected 0 to {recipe.sequences - 1} in recipe {recipe.name}, got {sequence}")
    if not 0 <= index < recipe.frames:
        raise GknetError(f"frame: expected 0 to {recipe.frames - 1} in recipe {recipe.name}, got {index}")
    motion = sample_sequence(recipe, spacecraft, seed, sequence)
    planet = EarthView(motion.earth_centre_cam_m[index], motion.cam_from_earth[index])
    noise_seed = np.random.SeedSequence([seed, recipe.key, sequence, index]).generate_state(1)[0]
    return Shot(
        recipe=recipe.name,
        spacecraft=spacecraft.name,
        sequence=sequence,
        index=index,
        time_s=float(motion.time_s[index]),
        camera=CAMERA,
        cam_from_body=Pose(motion.cam_from_body[index], motion.body_cam_m[index]),
        sun_direction=motion.sun_direction[index],
        earth=planet if motion.earth_in_view[index] else None,
        cam_from_inertial=motion.cam_from_inertial[index],
        sensor=_sensor(recipe, motion, seed, sequence, index),
        seed=int(noise_seed) >> 1,
        planet=planet,
    )


def _sensor(recipe: Recipe, motion: SequenceMotion, seed: int, sequence: int, index: int) -> Sensor:
    """A camera for the sequence, an exposure for the frame."""
    detector = recipe.detector
    rng = np.random.default_rng([seed, recipe.key, sequence, 2**31])

    def log_uniform(limits: tuple[float, float]) -> float:
        return float(np.exp(rng.uniform(*np.log(limits))))

    error = np.exp(detector.exposure_sigma * rng.standard_normal())
    if rng.random() < detector.exposure_failure:
        error *= log_uniform(detector.failure_factor) ** rng.choice((-1, 1))
    drift = np.exp(0.3 * detector.exposure_sigma * band_limited(motion.time_s, rng, (30.0, 300.0))[index])
    metered = _metered_radiance(float(motion.phase_rad[index]), bool(motion.earth_in_view[index]))
    return Sensor(
        psf_sigma_px=log_uniform(detector.psf_sigma_px),
        exposure=float(metered * error * drift),
        full_well_e=log_uniform(detector.full_well_e),
        read_noise_e=log_uniform(detector.read_noise_e),
        bloom=log_uniform(detector.bloom),
        veil=log_uniform(detector.veil) * _sun_veil(motion.sun_direction[index]),
        gamma=rng.uniform(*detector.gamma),
        monochrome=bool(rng.random() < detector.monochrome),
        jpeg_quality=int(rng.integers(detector.jpeg_quality[0], detector.jpeg_quality[1], endpoint=True)),
    )


def _metered_radiance(phase_rad: float, earth: bool) -> float:
    """The radiance that exposure control would let fill a pixel: from the phase function of a Lambertian sphere."""
    lit = (np.sin(phase_rad) + (np.pi - phase_rad) * np.cos(phase_rad)) / np.pi
    metered = 0.85 * max(lit, 0.03) ** 0.6
    return max(metered, 0.4) if earth else metered


def _sun_veil(sun_direction: Float[ndarray, "3"]) -> float:
    """Stray light against that of a sun ten degrees off the axis: falls with the angle, nothing from behind."""
    angle_deg = float(np.degrees(np.arccos(np.clip(sun_direction[2], -1, 1))))
    return 0.0 if angle_deg > 90 else (10.0 / max(angle_deg, 4.0)) ** 1.5
