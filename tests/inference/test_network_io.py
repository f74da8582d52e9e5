"""Images are taken as RGB or grey, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.inference.network_io import check_image


def test_grey_is_read_as_rgb() -> None:
    grey = np.random.default_rng(0).integers(0, 255, (20, 30), dtype=np.uint8)
    assert (check_image(grey) == grey[:, :, None]).all()
    assert check_image(grey).shape == (20, 30, 3)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((20, 30, 4), dtype=np.uint8),
        np.zeros((20, 30, 3), dtype=np.float32),
        np.zeros((0, 30, 3), dtype=np.uint8),
        np.zeros(5, dtype=np.uint8),
        None,
    ],
)
def test_other_images_are_refused(image: object) -> None:
    with pytest.raises(GknetError, match="image"):
        check_image(image)
