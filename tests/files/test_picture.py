"""The size that a picture's header claims, and its grey values in their own depth."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sphereorient.files.picture import BOMB_PIXELS, claimed_pixels, decoded, decoded_grey

GREY = (np.arange(12 * 17) % 251).astype(np.uint8).reshape(12, 17)


def content(suffix: str, picture: np.ndarray = GREY) -> bytes:
    ok, encoded = cv2.imencode(suffix, picture)
    assert ok
    return encoded.tobytes()


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif", ".jpg", ".pgm"])
def test_the_size_is_read_from_the_header_alone(suffix):
    assert claimed_pixels(content(suffix)) == 12 * 17
    if suffix in (".png", ".bmp", ".pgm"):  # the headers of the others refer to what follows
        assert claimed_pixels(content(suffix)[:60]) == 12 * 17


@pytest.mark.parametrize("garbage", [b"", b"text", b"\x89PNG\r\n\x1a\n", b"BM", b"II*\0", b"\xff\xd8\xff", bytes(1000)])
def test_other_files_have_no_size(garbage):
    assert claimed_pixels(garbage) is None
    assert decoded_grey(garbage) is None


def test_a_size_beyond_any_camera_is_reported_as_such():
    assert claimed_pixels(b"P5\n60000 60000\n255\n") == BOMB_PIXELS
    assert claimed_pixels(b"P5\n10000 10000\n255\n") == 10**8  # Pillow only warns of this one


@pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
def test_sixteen_bits_come_out_as_they_are(suffix):
    deep = GREY.astype(np.uint16) * 257
    np.testing.assert_array_equal(decoded_grey(content(suffix, deep)), deep)
    np.testing.assert_array_equal(decoded(content(suffix, deep), cv2.IMREAD_UNCHANGED), deep)
