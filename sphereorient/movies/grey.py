"""Exact grey values of colour pictures and of decoded video frames, without any colour range conversion."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.movie import Grey

if TYPE_CHECKING:
    import av

# Thousandths that add up to 1000: R = G = B keeps its value.
RED, GREEN, BLUE = 299, 587, 114
COLOUR_REMARK = "colour, made grey (0.299 R + 0.587 G + 0.114 B)"
PLANE_0_IS_GREY = ("gray", "yuv", "nv", "p01")  # pixel formats that begin so may have a grey first plane


def luma(red: NDArray[Any], green: NDArray[Any], blue: NDArray[Any]) -> NDArray[Any]:
    """Return the grey values of a colour picture (...), uint8 or uint16, by ITU-R BT.601; exact where R = G = B."""
    total = RED * red.astype(np.uint32) + GREEN * green.astype(np.uint32) + BLUE * blue.astype(np.uint32)
    return ((total + 500) // 1000).astype(red.dtype)


def grey_dtype(pixel_format: av.VideoFormat) -> np.dtype[Any]:
    """Return uint8, or uint16 for a format with more than 8 bits."""
    return np.dtype(np.uint8 if pixel_format.components[0].bits <= 8 else np.uint16)


def check_format(name: str, pixel_format: av.VideoFormat) -> None:
    """Refuse pixel formats without exact grey values: no integer grey plane and no colour (MovieError)."""
    colour = (pixel_format.is_rgb or pixel_format.has_palette) and not pixel_format.is_bit_stream
    if not (colour or _has_grey_plane(pixel_format)):
        do = "convert it, lossless: ffmpeg -i MOVIE -c:v ffv1 -pix_fmt gray MOVIE.mkv"
        raise MovieError(refusal(name, expected="grey, planar YUV or RGB pixels", got=pixel_format.name, do=do))


def grey_values(frame: av.VideoFrame) -> Grey:
    """Return the first plane of grey and YUV frames unchanged, the luma of RGB frames; (H, W), row 0 on top."""
    if _has_grey_plane(frame.format):
        return _plane_0(frame)
    # FFmpeg only interleaves the channels here: its grey formula differs from that of the other formats.
    deep = grey_dtype(frame.format).itemsize == 2
    interleaved = frame.reformat(format="rgb48le" if deep else "rgb24")
    values = _plane_0(interleaved, samples=3).reshape(frame.height, frame.width, 3)
    if deep:
        values = values >> (16 - frame.format.components[0].bits)  # 10 and 12 bit are scaled to 16
    return luma(*np.moveaxis(values, 2, 0))


def _has_grey_plane(pixel_format: av.VideoFormat) -> bool:
    """Return whether plane 0 holds only grey; in packed formats (yuyv422, ya8) it does not."""
    grey, *others = pixel_format.components
    alone = all(other.plane != grey.plane for other in others)
    return alone and pixel_format.name.startswith(PLANE_0_IS_GREY) and "f32" not in pixel_format.name


def _plane_0(frame: av.VideoFrame, samples: int = 1) -> Grey:
    plane, height, width = frame.planes[0], frame.height, frame.width * samples
    dtype = grey_dtype(frame.format)
    stored = dtype.newbyteorder(">" if frame.format.is_big_endian else "<")
    # Rows are padded to line_size, negative for pictures stored bottom-up: buffer_ptr is then the top row, the last in
    # memory. Read by address: PyAV releases differ in where their buffer begins.
    reach = (height - 1) * plane.line_size
    size = abs(reach) + width * dtype.itemsize
    memory = memoryview((ctypes.c_uint8 * size).from_address(plane.buffer_ptr + min(reach, 0))).cast("B")
    strides = (plane.line_size, dtype.itemsize)
    rows: Grey = np.ndarray((height, width), stored, buffer=memory, offset=max(-reach, 0), strides=strides)
    return rows.astype(dtype, order="C")  # a copy: the memory belongs to the frame
