import itertools
import math
import struct
import warnings
from abc import ABC, abstractmethod
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tifffile import TiffFile, TiffFileError

from sphereorient.files.whole_file import put_aside

TIFF_SIZE = (256, 257)  # the tags of width and height
WHITE_IS_ZERO, SEPARATE = 0, 2  # PhotometricInterpretation, PlanarConfiguration
EXIF, FOCAL_35MM, EXIF_SIZE = 0x8769, 0xA405, (0xA002, 0xA003)  # the block of tags, and its tags
FILM_MM = 43.27  # diagonal of 35 mm film
FORMATS = ("PNG", "JPEG", "BMP", "PPM", "TIFF")
GREY = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
BOMBS = (Image.DecompressionBombError, Image.DecompressionBombWarning)  # the warning, if warnings are errors
FAULTS = (  # of damaged headers
    *(OSError, ValueError, ArithmeticError, LookupError, MemoryError, SyntaxError, TypeError, AttributeError),
    *(RuntimeError, struct.error, TiffFileError),
)
# Thousandths with sum 1000: R = G = B keeps its value.
RED, GREEN, BLUE = 299, 587, 114
BOMB_PIXELS = 1 << 40  # reported for pictures too large for Pillow

warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # callers check the size themselves


class OnDemand(ABC):
    """Picture decoded in requested parts."""

    shape: tuple[int, int]  # (H, W)

    @abstractmethod
    def equals(self, other: object) -> bool:
        """Return whether another picture on demand is the same."""

    @abstractmethod
    def ask(self, left: int, top: int, right: int, bottom: int) -> None:
        """Start to decode a part, right and bottom included, of this picture and the next one."""

    @abstractmethod
    def part(self, left: int, top: int, right: int, bottom: int) -> NDArray[Any]:
        """Return the picture (H, W), decoded at least in this part, right and bottom included."""


def claimed_pixels(content: bytes) -> int | None:
    """Return the number of pixels claimed by a PNG, JPEG, BMP, PNM or TIFF file; None for other files. Of several sizes
    in a TIFF file the largest counts: Pillow takes the last, the decoder the first.
    """
    try:
        with Image.open(BytesIO(content), formats=FORMATS) as picture:
            pixels = picture.width * picture.height
            if picture.format != "TIFF":
                return pixels
        with TiffFile(BytesIO(content)) as file:
            page: Any = file.pages[0]
            sizes = [[int(tag.value) for tag in page.tags.getall(code)] for code in TIFF_SIZE]
        return max(pixels, *map(math.prod, itertools.product(*sizes)))
    except BOMBS:
        return BOMB_PIXELS
    except FAULTS:
        return None


def decoded(content: bytes, flags: int) -> NDArray[Any] | None:
    """Decode a picture file with OpenCV; None if that fails. Check `claimed_pixels` first, as memory is allocated."""
    try:
        return cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    except cv2.error:  # an empty file, or a header with impossible numbers
        return None


def decoded_grey(content: bytes) -> NDArray[Any] | None:
    """Return the grey values of a picture file, (H, W), in its own depth; None if decoding fails or would be wrong."""
    picture = None if _misread(content) else decoded(content, GREY)
    return None if picture is None or picture.ndim != 2 else np.asarray(picture)


def _misread(content: bytes) -> bool:
    """Return whether OpenCV decodes a TIFF file wrongly: deeper than 8 bit, with white as 0 or colours in planes."""
    with suppress(*FAULTS), TiffFile(BytesIO(content)) as file:  # a fault: another format, or a damaged file
        page: Any = file.pages[0]
        planes = page.samplesperpixel > 1 and page.planarconfig == SEPARATE
        return bool(page.dtype.itemsize > 1 and (page.photometric == WHITE_IS_ZERO or planes))
    return False


def vertical_field_deg(path: Path) -> float | None:
    """Return the vertical field of view of a photograph from its EXIF tags; None without a focal length for 35 mm film,
    or for a picture cut or scaled afterwards. CIPA DC-008: that length is for equal diagonals, 43.27 mm.
    """
    try:
        with Image.open(path, formats=FORMATS) as picture:
            tags = picture.getexif().get_ifd(EXIF)
            focal_mm = float(tags.get(FOCAL_35MM, 0))
            if focal_mm <= 0 or picture.size != tuple(int(tags.get(tag, 0)) for tag in EXIF_SIZE):
                return None
            slope = FILM_MM / 2 / focal_mm * picture.height / math.hypot(*picture.size)
    except (*BOMBS, *FAULTS):
        return None
    return math.degrees(2 * math.atan(slope))


def luma(red: NDArray[Any], green: NDArray[Any], blue: NDArray[Any]) -> NDArray[Any]:
    """Return the grey values of a colour picture (...), uint8 or uint16, by ITU-R BT.601; exact where R = G = B."""
    total = RED * red.astype(np.uint32) + GREEN * green.astype(np.uint32) + BLUE * blue.astype(np.uint32)
    return ((total + 500) // 1000).astype(red.dtype)


def eight_bits(picture: NDArray[Any]) -> NDArray[np.uint8]:
    """Return a grey picture of any number type for display, with its brightest level as white."""
    white = max(1.0, float(np.percentile(picture[::4, ::4], 99.9)))
    return np.clip(picture * (255.0 / white), 0, 255).astype(np.uint8)


def write_picture(path: Path, grey: NDArray[np.uint8]) -> None:
    """Write a picture (H, W) by the suffix of its name, whole or not at all (OutputError)."""
    with put_aside(path) as aside:
        if not cv2.imwrite(str(aside), grey):
            raise OSError("the picture could not be written")
