"""The size that a picture's header claims, and its grey values in their own depth."""

from __future__ import annotations

import struct
import zlib

import cv2
import numpy as np
import pytest
import tifffile

from sphereorient.errors import TextureError
from sphereorient.files.picture import BOMB_PIXELS, claimed_pixels, decoded, decoded_grey
from sphereorient.sphere import load_texture

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


def sized_twice(kind: int, large: tuple[int, int], small: tuple[int, int]) -> bytes:
    """A TIFF that gives width and height twice: first `large` as `kind`, 4 (LONG) or 17 (SLONG8), then `small`."""
    packed = zlib.compress(bytes(large[0] * large[1]), 1) if large[0] * large[1] < 10**6 else b"none"
    sizes = [
        (code, each, value) for k, code in enumerate((256, 257)) for each, value in ((kind, large[k]), (4, small[k]))
    ]
    after = 8 + 2 + 12 * 11 + 4
    more = b"".join(struct.pack("<q", value) for _, each, value in sizes if each == 17)
    rest = [(258, 3, 8), (259, 3, 8), (262, 3, 1), (273, 4, after + len(more)), (277, 3, 1)]
    rest += [(278, 4, large[1]), (279, 4, len(packed))]
    places = iter(range(after, after + len(more), 8))
    entries = [(code, each, next(places) if each == 17 else value) for code, each, value in sizes] + rest
    table = b"".join(struct.pack("<HHII", code, each, 1, value) for code, each, value in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + table + bytes(4) + more + packed


@pytest.mark.parametrize("kind", [4, 17])
def test_where_a_size_stands_twice_the_decoders_counts(kind, tmp_path):
    """Before: 2048 pixels claimed, 10,000 decoded; 450 million passed the limit of 33.6 million and took 3.9 GB."""
    twice = sized_twice(kind, (100, 100), (64, 32))
    assert decoded_grey(twice).size == 10_000
    assert claimed_pixels(twice) >= 10_000
    (tmp_path / "map.tif").write_bytes(sized_twice(kind, (30_000, 15_000), (64, 32)))
    with pytest.raises(TextureError, match=r"33\.6 million pixels"):
        load_texture(tmp_path / "map.tif")


@pytest.mark.parametrize("kind", ["white is zero", "colour planes"])
def test_sixteen_bits_that_the_decoder_would_garble_are_refused(kind, tmp_path):
    deep, path = np.repeat(GREY[:, :1].astype(np.uint16), 24, 1) * 257, tmp_path / "map.tif"
    if kind == "white is zero":
        tifffile.imwrite(path, 65535 - deep, photometric="miniswhite")
    else:
        tifffile.imwrite(path, np.stack([deep] * 3), photometric="rgb", planarconfig="separate")
    assert decoded_grey(path.read_bytes()) is None
    with pytest.raises(TextureError, match="does not decode"):
        load_texture(path)
    assert decoded_grey(path.read_bytes()[:40]) is None


def test_eight_bits_with_white_as_zero_or_in_colour_planes_are_read(tmp_path):
    path = tmp_path / "map.tif"
    tifffile.imwrite(path, 255 - GREY, photometric="miniswhite")
    np.testing.assert_array_equal(decoded_grey(path.read_bytes()), GREY)
    tifffile.imwrite(path, np.stack([GREY] * 3), photometric="rgb", planarconfig="separate")
    np.testing.assert_array_equal(decoded_grey(path.read_bytes()), GREY)
