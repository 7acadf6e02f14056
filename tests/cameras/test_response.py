"""The response of a camera: light of a grey level."""

from __future__ import annotations

import numpy as np
import pytest

from sphereorient.cameras.response import LINEAR, Response

GREY = np.arange(256, dtype=np.uint8)


def test_a_linear_camera_shows_the_light():
    np.testing.assert_array_equal(LINEAR.light(GREY, 255.0), GREY.astype(np.float32))


@pytest.mark.parametrize("full_scale", [255.0, 190.0])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_a_power_of_the_grey_level_is_the_light(dtype, full_scale):
    grey = GREY[: int(full_scale) + 1]
    light = Response(gamma=2.2).light(grey.astype(dtype), full_scale)
    np.testing.assert_allclose(light, full_scale * (grey / full_scale) ** 2.2, atol=2e-3)


def test_srgb_is_the_curve_of_its_norm():
    # IEC 61966-2-1: a half of the light is grey level 187.5 of 255, a fifth 123.6, and near black it is a line.
    light = Response(srgb=True).light(np.array([187.516, 123.55, 5.0]), 255.0)
    np.testing.assert_allclose(light, [127.5, 51.0, 5.0 / 12.92], atol=0.03)


def test_a_table_is_linear_between_its_levels():
    response = Response(table=((0.0, 0.0), (0.5, 0.25), (1.0, 1.0)))
    np.testing.assert_allclose(
        response.light(np.array([0, 2048, 3072, 4095], np.uint16), 4095.0) / 4095, [0, 0.25, 0.625, 1], atol=1e-3
    )


@pytest.mark.parametrize(
    "response", [Response(gamma=2.4), Response(srgb=True), Response(table=((0.0, 0.0), (0.4, 0.1), (1.0, 1.0)))]
)
def test_more_grey_is_more_light_and_white_stays_white(response):
    for full_scale in (255.0, 4095.0):
        light = response.light(np.arange(full_scale + 1), full_scale)
        assert (np.diff(light) >= 0).all()
        assert (light[0], light[-1]) == (0.0, full_scale)
