"""Pages of TIFF files compressed by LZW, which tifffile alone does not decode: handed to OpenCV, one at a time."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from sphereorient.movies.movie import Grey

LZW = 5
SHORT, LONG = 3, 4  # types of fields


def decode_lzw(page: Any) -> Grey:
    """Return the values of a page, (H, W) or (H, W, 3) in R, G, B, as `asarray` of an uncompressed one would.

    Args:
        page: of tifffile, in strips.

    Raises:
        ValueError: in tiles, or of values that OpenCV cannot decode.
    """
    if page.is_tiled or page.samplesperpixel not in (1, 3) or page.planarconfig != 1:
        raise ValueError("LZW in tiles or planes: save it uncompressed")
    handle = page.parent.filehandle
    strips = []
    for offset, size in zip(page.dataoffsets, page.databytecounts, strict=True):
        handle.seek(offset)
        strips.append(handle.read(size))
    content = np.frombuffer(_one_page_file(page, strips), np.uint8)
    try:
        picture = cv2.imdecode(content, cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError("damaged LZW") from error
    if picture is None or picture.dtype != page.dtype or picture.shape != page.shape:
        raise ValueError("damaged LZW")
    return picture if picture.ndim == 2 else picture[..., ::-1]


def _one_page_file(page: Any, strips: list[bytes]) -> bytes:
    """Wrap the strips of a page in a file of its own, with the fields needed and no note of orientation."""
    order: str = page.parent.byteorder
    samples = page.samplesperpixel
    ends: list[int] = np.cumsum([8, *map(len, strips)]).tolist()
    fields: list[tuple[int, int, list[int]]] = [
        (256, LONG, [page.imagewidth]),
        (257, LONG, [page.imagelength]),
        (258, SHORT, [page.bitspersample] * samples),
        (259, SHORT, [LZW]),
        (262, SHORT, [1 if samples == 1 else 2]),
        (273, LONG, ends[:-1]),
        (277, SHORT, [samples]),
        (278, LONG, [page.rowsperstrip]),
        (279, LONG, [len(strip) for strip in strips]),
        (317, SHORT, [int(page.predictor)]),
    ]
    table, further = b"", b""
    at_further = ends[-1] + ends[-1] % 2 + 2 + 12 * len(fields) + 4
    for tag, kind, values in fields:
        content = struct.pack(f"{order}{len(values)}{'H' if kind == SHORT else 'I'}", *values)
        if len(content) > 4:
            place = struct.pack(f"{order}I", at_further + len(further))
            further += content
        else:
            place = content.ljust(4, b"\0")
        table += struct.pack(f"{order}HHI", tag, kind, len(values)) + place
    head = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HI", 42, ends[-1] + ends[-1] % 2)
    data = b"".join(strips) + b"\0" * (ends[-1] % 2)
    return head + data + struct.pack(f"{order}H", len(fields)) + table + bytes(4) + further
