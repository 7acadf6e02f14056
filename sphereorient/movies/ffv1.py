"""Writing movies without loss: FFV1 in Matroska."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from itertools import chain
from pathlib import Path

import av
import numpy as np

from sphereorient.errors import MovieError, refusal
from sphereorient.files.outputs import put_aside
from sphereorient.movies.movie import Grey

PIXEL_FORMATS = {np.dtype(np.uint8): "gray", np.dtype(np.uint16): "gray16le"}
# Every frame a key frame, with check sums: any frame can be read alone, and damage stays in its frame.
FFV1_OPTIONS = {"level": "3", "g": "1", "slicecrc": "1"}


def write_ffv1(path: Path | str, frames: Iterable[Grey], frame_rate_hz: float) -> int:
    """Write grey frames as FFV1 in Matroska, aside and then under their name, and return their number.

    Args:
        path: the movie, .mkv; an old one is replaced.
        frames: (H, W) uint8 or uint16 each, all alike; taken one by one.
        frame_rate_hz: for players only: sphereorient reads times from the experiment, never from the movie.

    Raises:
        MovieError: no frame, or frames that are not alike (H, W) uint8 or uint16.
        OutputError: the file cannot be written.
    """
    path = Path(path)
    with put_aside(path, also=(av.FFmpegError,)) as aside, av.open(str(aside), "w", format="matroska") as container:
        return _encode(container, path, frames, Fraction(frame_rate_hz).limit_denominator(1_000_000))


def _encode(container: av.container.OutputContainer, path: Path, frames: Iterable[Grey], rate: Fraction) -> int:
    source = iter(frames)
    first = next(source, None)
    if first is None:
        raise MovieError(refusal(str(path), expected="frames to write", got="none", do="pass at least one"))
    check_kind(path, 0, first)
    pixel_format = PIXEL_FORMATS[first.dtype]
    stream = container.add_stream("ffv1", rate=rate, options=dict(FFV1_OPTIONS))
    stream.height, stream.width = first.shape
    stream.pix_fmt = pixel_format
    number = -1
    for number, picture in enumerate(chain([first], source)):
        check_alike(path, number, picture, first)
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format=pixel_format)
        frame.pts, frame.time_base = number, 1 / rate
        container.mux(stream.encode(frame))
    container.mux(stream.encode(None))
    return number + 1


def check_kind(path: Path, number: int, picture: Grey) -> None:
    """Refuse a frame to be written that is not (H, W) uint8 or uint16.

    Raises:
        MovieError: it is not.
    """
    if picture.ndim != 2 or picture.dtype not in PIXEL_FORMATS:
        expected, got = "frames (H, W) of uint8 or uint16", f"{picture.shape} of {picture.dtype}"
        raise MovieError(refusal(f"{path}, frame {number}", expected=expected, got=got, do="convert them"))


def check_alike(path: Path, number: int, picture: Grey, first: Grey) -> None:
    """Refuse a frame to be written that is not like the first one.

    Raises:
        MovieError: it is not.
    """
    if picture.shape != first.shape or picture.dtype != first.dtype:
        expected, got = f"{first.shape} of {first.dtype}", f"{picture.shape} of {picture.dtype}"
        raise MovieError(refusal(f"{path}, frame {number}", expected=expected, got=got, do="make them alike"))
