"""Opening a container with FFmpeg, and what its header tells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.luma import COLOUR_REMARK

THREADS = 2  # slices of one frame in parallel: 1.8 times faster for FFV1 on 2 cores, and errors keep their frame


def opened(path: Path) -> av.container.InputContainer:
    """Open a movie so that damage raises instead of being painted over.

    Raises:
        MovieError: FFmpeg cannot open it, or it has no pictures that FFmpeg decodes.
    """
    name = str(path)
    try:
        container = av.open(name)
    except (av.FFmpegError, OSError, ValueError) as error:
        do = "check that it plays; export it again if not"
        raise MovieError(refusal(name, expected="a readable movie", got=words(error), do=do)) from error
    if not container.streams.video:
        container.close()
        do = "name the movie's own file"
        raise MovieError(refusal(name, expected="a movie with pictures", got="no video stream", do=do))
    context: Any = container.streams.video[0].codec_context  # None for a codec that FFmpeg does not know
    if context is None:
        container.close()
        do = "export it as FFV1 in .mkv"
        raise MovieError(refusal(name, expected="a movie that FFmpeg decodes", got="an unknown codec", do=do))
    context.thread_type, context.thread_count = "SLICE", THREADS
    context.options = {"err_detect": "crccheck+explode"}
    return container


def stream_remarks(container: av.container.InputContainer, pixel_format: str, count: int) -> tuple[str, ...]:
    """Return what a user should know of a movie.

    Args:
        container: the movie.
        pixel_format: name of that of its frames.
        count: of its frames that are there.
    """
    stream = container.streams.video[0]
    remarks = []
    if stream.frames > count:
        remarks.append(f"truncated: its header tells of {stream.frames} frames, {count} are there")
    if loss(stream.codec_context):
        remarks.append(f"codec {stream.codec_context.name} {loss(stream.codec_context)}")
    if av.VideoFormat(pixel_format).is_rgb:
        remarks.append(COLOUR_REMARK)
    elif not pixel_format.startswith("gray"):
        remarks.append(f"stored as colour ({pixel_format}): its brightness is taken as it is")
    return tuple(remarks)


def loss(context: av.CodecContext) -> str:
    """Return in words whether a codec loses grey values, empty where it does not."""
    codec = context.codec
    if not codec.lossy:
        return ""
    return "may lose fine detail of the pictures" if codec.lossless else "loses fine detail of the pictures"


def words(error: Exception) -> str:
    """Return an error of FFmpeg in one line, without the file's name, which our message has already."""
    text = getattr(error, "strerror", None) or str(error)
    return f"'{text.splitlines()[0]}'" if text else type(error).__name__
