"""Exact grey values of a decoded video frame: those of the file, never converted through a colour range."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import numpy as np

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.luma import luma
from sphereorient.movies.movie import Grey

if TYPE_CHECKING:
    import av

PLANE_0_IS_GREY = ("gray", "yuv", "nv", "p01")  # starts of the names of formats whose first plane may be the grey one


def grey_dtype(pixel_format: av.VideoFormat) -> np.dtype[Any]:
    """Return uint8, or uint16 for a format with more than 8 bits."""
    return np.dtype(np.uint8 if pixel_format.components[0].bits <= 8 else np.uint16)


def check_format(name: str, pixel_format: av.VideoFormat) -> None:
    """Refuse pixel formats whose grey values cannot be had exactly.

    Args:
        name: of the movie, for the message.
        pixel_format: of its frames.

    Raises:
        MovieError: neither a format with a grey plane of whole numbers nor a colour format.
    """
    if not (_has_grey_plane(pixel_format) or _is_colour(pixel_format)):
        do = "convert it, lossless: ffmpeg -i MOVIE -c:v ffv1 -pix_fmt gray MOVIE.mkv"
        raise MovieError(refusal(name, expected="grey, planar YUV or RGB pixels", got=pixel_format.name, do=do))


def grey_values(frame: av.VideoFrame) -> Grey:
    """Return the grey values of a frame, (H, W) uint8 or uint16, row 0 on top.

    Grey and YUV formats give their first plane as it is, RGB formats their luma, which is exact for R = G = B.
    """
    pixel_format = frame.format
    if _has_grey_plane(pixel_format):
        return _plane_0(frame)
    return _colour(frame, grey_dtype(pixel_format), pixel_format.components[0].bits)


def _colour(frame: av.VideoFrame, dtype: np.dtype[Any], bits: int) -> Grey:
    # FFmpeg only puts the channels side by side here; its own grey would follow another formula than our formats'.
    interleaved = frame.reformat(format="rgb24" if dtype.itemsize == 1 else "rgb48le")
    values = _plane_0(interleaved, samples=3).reshape(frame.height, frame.width, 3)
    if dtype.itemsize == 2:
        values = values >> (16 - bits)  # 10 and 12 bit come scaled to 16, by their own leading bits
    red, green, blue = np.moveaxis(values, 2, 0)
    return luma(red, green, blue)


def _is_colour(pixel_format: av.VideoFormat) -> bool:
    return bool(pixel_format.is_rgb or pixel_format.has_palette) and not pixel_format.is_bit_stream


def _has_grey_plane(pixel_format: av.VideoFormat) -> bool:
    """Whether plane 0 holds nothing but grey: not so for packed formats (yuyv422, ya8), whose planes are shared."""
    grey, *others = pixel_format.components
    alone = all(other.plane != grey.plane for other in others)
    return alone and pixel_format.name.startswith(PLANE_0_IS_GREY) and "f32" not in pixel_format.name


def _plane_0(frame: av.VideoFrame, samples: int = 1) -> Grey:
    """Return the values of the first plane, (H, W), or (H, samples W) where pixels hold several."""
    plane, height, width = frame.planes[0], frame.height, frame.width * samples
    dtype = grey_dtype(frame.format)
    stored = dtype.newbyteorder(">" if frame.format.is_big_endian else "<")
    # Rows are padded to line_size, which is negative where the picture is stored bottom-up; buffer_ptr is then the
    # top row, the last one in memory. Read by address: releases of PyAV differ in where their buffer begins.
    reach = (height - 1) * plane.line_size
    size = abs(reach) + width * dtype.itemsize
    memory = memoryview((ctypes.c_uint8 * size).from_address(plane.buffer_ptr + min(reach, 0))).cast("B")
    strides = (plane.line_size, dtype.itemsize)
    rows: Grey = np.ndarray((height, width), stored, buffer=memory, offset=max(-reach, 0), strides=strides)
    return rows.astype(dtype, order="C")  # a copy: the memory is the frame's
