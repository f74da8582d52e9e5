"""Photons to pixels: stray light, bloom, point spread, exposure, noise, saturation, tone.

A window may be rendered smaller than the sensor's own pixels (scale < 1). Each of its pixels then stands for
1 / scale^2 native ones, whose noise is averaged, and every width shrinks with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray

from gknet.errors import GknetError

BLOOM_SIGMAS_PX = (10.0, 60.0)
"""The halo's two Gaussians, native pixels; they share the light equally."""

BLOOM_LIMIT = 300.0
"""Light beyond this many times the saturation blooms no further."""

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
_LEVELS = 1 << 14


@dataclass(frozen=True)
class Sensor:
    """One frame's camera and exposure; widths in native pixels.

    Attributes:
        psf_sigma_px: Gaussian point spread.
        exposure: The radiance that fills a pixel (1 = a white surface that faces the full sun).
        full_well_e: Electrons of a full pixel.
        read_noise_e: Standard deviation of the read-out noise, in electrons.
        bloom: Part of the light that scatters into a wide halo.
        veil: Stray light of the sun over the whole image, in radiance.
        gamma: Pixel = 255 signal^(1 / gamma).
        monochrome: Whether the three channels have one luminance.
        jpeg_quality: Of the file, 1 to 100.
    """

    psf_sigma_px: float
    exposure: float
    full_well_e: float
    read_noise_e: float
    bloom: float
    veil: float
    gamma: float
    monochrome: bool
    jpeg_quality: int


def expose(radiance: Float[ndarray, "h w 3"], sensor: Sensor, scale: float, seed: int) -> UInt8[ndarray, "h w 3"]:
    """The image that the sensor makes of light; the same arguments give the same image.

    Shot noise is taken as Gaussian: below some 20 electrons, where it is not, the read noise covers it.

    Args:
        radiance: (h, w, 3) linear RGB, 1 = a white surface that faces the full sun.
        sensor: Detector and exposure.
        scale: The window's pixels per native pixel. Above 1 the noise is that of one native pixel.
        seed: Of the noise.

    Returns:
        (h, w, 3) uint8 RGB.

    Raises:
        GknetError: `scale` is not positive.
    """
    if not scale > 0:
        raise GknetError(f"scale: expected a positive number of pixels per native pixel, got {scale}")
    light = np.ascontiguousarray(radiance, dtype=np.float32)
    if sensor.monochrome:
        light = light @ LUMINANCE
    signal = _optics(light * np.float32(1 / sensor.exposure), sensor, scale)
    signal = _with_noise(signal, sensor, scale, seed)
    np.clip(signal, 0, 1, out=signal)
    signal *= _LEVELS - 1
    picture = _tone(sensor.gamma)[(signal + np.float32(0.5)).astype(np.uint16)]
    return cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB) if sensor.monochrome else picture


def _optics(signal: Float32[ndarray, "..."], sensor: Sensor, scale: float) -> Float32[ndarray, "..."]:
    """Veil, bloom and point spread of light in units of the saturation."""
    signal = signal + np.float32(sensor.veil / sensor.exposure)
    if sensor.bloom > 0:
        halo = _halo(np.minimum(signal, np.float32(BLOOM_LIMIT)), scale)
        signal = cv2.addWeighted(signal, 1 - sensor.bloom, halo, sensor.bloom, 0.0)
    sigma = sensor.psf_sigma_px * scale
    return cv2.GaussianBlur(signal, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE) if sigma > 0.15 else signal


def _halo(signal: Float32[ndarray, "..."], scale: float) -> Float32[ndarray, "..."]:
    """The wide blur of the bloom, computed on a coarser grid."""
    height, width = signal.shape[:2]
    total = np.zeros_like(signal)
    for sigma_px in BLOOM_SIGMAS_PX:
        step = max(1, round(sigma_px * scale / 2.5))
        size = (max(1, round(width / step)), max(1, round(height / step)))
        coarse = cv2.resize(signal, size, interpolation=cv2.INTER_AREA)
        coarse = cv2.GaussianBlur(coarse, (0, 0), sigma_px * scale * size[0] / width, borderType=cv2.BORDER_REPLICATE)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return total * np.float32(1 / len(BLOOM_SIGMAS_PX))


def _with_noise(signal: Float32[ndarray, "..."], sensor: Sensor, scale: float, seed: int) -> Float32[ndarray, "..."]:
    """Shot and read noise on a signal in units of the full well."""
    rng = np.random.Generator(np.random.SFC64(seed))
    noise = rng.standard_normal(signal.shape, dtype=np.float32)
    shot = np.float32(1 / sensor.full_well_e)
    read = np.float32((sensor.read_noise_e / sensor.full_well_e) ** 2)
    spread = np.sqrt(np.minimum(signal, 1) * shot + read)
    return signal + noise * spread * np.float32(min(scale, 1.0))


def _tone(gamma: float) -> UInt8[ndarray, " levels"]:
    """The 8-bit value of each level of the signal."""
    levels = np.arange(_LEVELS) / (_LEVELS - 1)
    return np.round(255 * levels ** (1 / gamma)).astype(np.uint8)
