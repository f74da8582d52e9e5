"""Colours that stay apart for colour-blind readers (Okabe and Ito, 2008), as RGB."""

from __future__ import annotations

import numpy as np

RGB = tuple[int, int, int]

WHITE: RGB = (255, 255, 255)
INK: RGB = (12, 14, 20)
SKY: RGB = (86, 180, 233)
ORANGE: RGB = (230, 159, 0)
GREEN: RGB = (0, 158, 115)
YELLOW: RGB = (240, 228, 66)
BLUE: RGB = (58, 134, 255)
VERMILLION: RGB = (235, 94, 20)
PINK: RGB = (224, 140, 188)

_SCORE_STOPS: tuple[RGB, ...] = (VERMILLION, ORANGE, YELLOW, (252, 255, 220))


def score_colour(score: float) -> RGB:
    """Vermillion at 0, pale yellow at 1; lightness grows with the score, so it reads without hue."""
    position = float(np.clip(np.nan_to_num(score), 0, 1)) * (len(_SCORE_STOPS) - 1)
    low = min(int(position), len(_SCORE_STOPS) - 2)
    mixed = [a + (b - a) * (position - low) for a, b in zip(_SCORE_STOPS[low], _SCORE_STOPS[low + 1], strict=True)]
    return round(mixed[0]), round(mixed[1]), round(mixed[2])
