"""Single pictures in files: PNG, BMP, JPEG, PGM and the like through OpenCV, TIFF through tifffile."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from sphereorient.errors import MovieError, refusal
from sphereorient.files.picture_size import claimed_bytes
from sphereorient.movies.luma import luma
from sphereorient.movies.movie import Grey
from sphereorient.movies.tiff import TiffMovie

TIFF = (".tif", ".tiff")
LOSSY = (".jpg", ".jpeg")
PICTURES = (".png", ".bmp", ".pgm", ".ppm", *LOSSY, *TIFF)
# A black picture shrinks to a thousandth at most: a header that claims more has no such picture behind it.
LARGEST_RATIO = 1200
MOST_PIXELS = 1 << 26  # more than any camera has that films
LARGEST_BYTES = 1 << 28  # of a picture's file, which is read whole


def read_picture(path: Path) -> tuple[Grey, bool]:
    """Return a picture (H, W), uint8 or uint16, row 0 on top, and whether it was in colour.

    Raises:
        MovieError: missing, no picture, or of other numbers than 8 or 16 bit.
    """
    if not path.is_file():
        raise _refuse(path, "a picture", "no such file", "find it, or record it as missing")
    if path.suffix.lower() in TIFF:
        return _tiff(path)
    if path.stat().st_size > LARGEST_BYTES:
        raise _refuse(path, "a picture", "a file as large as a movie", "export it again")
    content = path.read_bytes()
    claimed = claimed_bytes(content)
    if claimed > MOST_PIXELS:
        do = "cut out the part where the ball is"
        raise _refuse(path, f"at most {MOST_PIXELS / 1e6:.3g} million pixels", f"{claimed / 1e6:.3g} million", do)
    if claimed > LARGEST_RATIO * max(len(content), 1):
        raise _refuse(path, "a picture", "a header that claims more than the file can hold", "export it again")
    try:
        # As it is stored: neither turned by the camera's note of its position nor made 8 bit.
        picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) if content else None
    except cv2.error:
        picture = None
    if picture is None:
        raise _refuse(path, "a picture", "none that can be decoded", "export it again")
    if picture.dtype not in (np.uint8, np.uint16):
        raise _refuse(path, "8 or 16 bit", str(picture.dtype), "export it as 8 or 16 bit grey")
    if picture.ndim == 2:
        return picture, False
    if picture.shape[2] < 3:  # grey with opacity
        return np.ascontiguousarray(picture[..., 0]), False
    blue, green, red = np.moveaxis(picture[..., :3], 2, 0)
    return luma(red, green, blue), True


def _tiff(path: Path) -> tuple[Grey, bool]:
    movie = TiffMovie(path)
    if len(movie) != 1:
        raise _refuse(path, "one picture a file", f"{len(movie)} pages", "name the stack itself as the movie")
    return movie.sample([0])[0], movie.colour


def _refuse(path: Path, expected: str, got: str, do: str) -> MovieError:
    return MovieError(refusal(str(path), expected=expected, got=got, do=do))
