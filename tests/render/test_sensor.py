"""The sensor: linear below saturation, noise that averages, light that is kept, one image per seed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gknet.errors import GknetError
from gknet.render.sensor import Sensor, expose

PLAIN = Sensor(
    psf_sigma_px=0.6,
    exposure=1.0,
    full_well_e=20_000.0,
    read_noise_e=20.0,
    bloom=0.01,
    veil=0.0,
    gamma=1.0,
    monochrome=False,
    jpeg_quality=95,
)


def flat(value: float, size: int = 128) -> np.ndarray:
    return np.full((size, size, 3), value, dtype=np.float32)


@pytest.mark.parametrize("value", [0.1, 0.35, 0.8])
def test_mean_is_linear_below_saturation(value: float) -> None:
    assert expose(flat(value), PLAIN, 1.0, 1).mean() / 255 == pytest.approx(value, abs=0.002)


def test_exposure_scales_and_saturates() -> None:
    assert expose(flat(0.4), replace(PLAIN, exposure=0.5), 1.0, 1).mean() / 255 == pytest.approx(0.8, abs=0.002)
    assert expose(flat(0.4), replace(PLAIN, exposure=0.2), 1.0, 1).min() == 255


def test_gamma_is_the_inverse_power() -> None:
    picture = expose(flat(0.25), replace(PLAIN, gamma=2.0), 1.0, 1)
    assert picture.mean() / 255 == pytest.approx(0.5, abs=0.003)


def test_veil_adds_everywhere() -> None:
    assert expose(flat(0.2), replace(PLAIN, veil=0.1), 1.0, 1).mean() / 255 == pytest.approx(0.3, abs=0.002)


def test_noise_is_shot_and_read_noise() -> None:
    noisy = replace(PLAIN, full_well_e=1000.0, read_noise_e=30.0)
    expected = np.sqrt(0.5 * 1000 + 30**2) / 1000
    assert expose(flat(0.5), noisy, 1.0, 3).std() / 255 == pytest.approx(expected, rel=0.03)


def test_noise_at_half_scale_is_halved() -> None:
    noisy = replace(PLAIN, full_well_e=1000.0)
    full, half, double = (expose(flat(0.5), noisy, scale, 3).std() for scale in (1.0, 0.5, 2.0))
    assert half / full == pytest.approx(0.5, rel=0.05)
    assert double == pytest.approx(full, rel=0.05)


def test_the_seed_decides() -> None:
    same, again, other = (expose(flat(0.5), PLAIN, 1.0, seed) for seed in (7, 7, 8))
    np.testing.assert_array_equal(same, again)
    assert (same != other).any()


def test_input_is_left_alone() -> None:
    light = flat(0.5)
    expose(light, PLAIN, 1.0, 0)
    assert (light == 0.5).all()


def test_monochrome_is_grey_luminance() -> None:
    light = flat(0.0)
    light[..., 1] = 0.5
    picture = expose(light, replace(PLAIN, monochrome=True), 1.0, 0)
    assert (picture == picture[..., :1]).all()
    assert picture.mean() / 255 == pytest.approx(0.7152 * 0.5, abs=0.003)


def test_bloom_reaches_far_and_grows_with_the_light() -> None:
    def around(peak: float) -> float:
        light = flat(0.0)
        light[60:68, 60:68] = peak
        return float(expose(light, replace(PLAIN, bloom=0.05, read_noise_e=0.1), 1.0, 0)[64, 80:100].mean())

    assert around(20.0) > around(5.0) > 0


def test_psf_spreads_a_point_but_keeps_its_light() -> None:
    light = flat(0.1)
    light[64, 64] = 0.8
    clean = replace(PLAIN, bloom=0.0, full_well_e=1e8, read_noise_e=0.1, psf_sigma_px=1.0)
    picture = expose(light, clean, 1.0, 0)[..., 0].astype(float) / 255
    assert picture[64, 64] < 0.3
    assert (picture - 0.1)[58:71, 58:71].sum() == pytest.approx(0.7, abs=0.1)


def test_a_window_of_half_scale_looks_like_the_full_one_averaged() -> None:
    rng = np.random.default_rng(0)
    light = np.repeat(np.repeat(rng.random((16, 16, 3), dtype=np.float32), 16, 0), 16, 1)
    soft = replace(PLAIN, psf_sigma_px=2.0, bloom=0.05, full_well_e=1e7, read_noise_e=1.0)
    full = expose(light, soft, 1.0, 0).reshape(128, 2, 128, 2, 3).mean(axis=(1, 3))
    half = expose(light[::2, ::2], soft, 0.5, 0)
    assert np.abs(full - half).mean() < 2


def test_bad_scale_is_refused() -> None:
    with pytest.raises(GknetError, match="scale"):
        expose(flat(0.1), PLAIN, 0.0, 0)
