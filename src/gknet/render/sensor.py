"""Photons to pixels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Sensor:
    """One frame's camera and exposure; widths in native pixels.

    psf_sigma_px   Gaussian point spread
    exposure       the radiance that fills a pixel (1 = a white surface facing the full sun)
    full_well_e    electrons of a full pixel
    read_noise_e   standard deviation of the read-out, electrons
    bloom          part of the light that scatters into a wide halo
    veil           stray light of the sun over the whole picture, in radiance
    gamma          pixel = 255 (signal)^(1 / gamma)
    monochrome     one luminance for the three channels
    jpeg_quality   for whoever writes the file
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
