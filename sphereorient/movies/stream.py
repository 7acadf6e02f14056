"""Opening a container with FFmpeg, and what its header tells."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import av

from sphereorient.errors import MovieError, refusal
from sphereorient.movies.indexed import missing_remark
from sphereorient.movies.luma import COLOUR_REMARK

LOSSLESS = "lossless"
SHOWN = 8  # missing frames named in a remark
SLACK = 1.5  # frames by which a rounded duration may be too long
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


def frame_step(container: av.container.InputContainer) -> Fraction | None:
    """Return the time between frames by the header, in units of the stamps, None where it tells of none."""
    stream = container.streams.video[0]
    if not stream.average_rate or not stream.time_base:
        return None
    return 1 / (stream.average_rate * stream.time_base)


def stream_remarks(
    container: av.container.InputContainer, pixel_format: str, count: int, missing: list[int]
) -> tuple[str, ...]:
    """Return what a user should know of a movie.

    Args:
        container: the movie.
        pixel_format: name of that of its frames.
        count: of its frames, up to the last one that is there.
        missing: numbers of frames that its stamps leave out.
    """
    stream = container.streams.video[0]
    remarks = list(missing_remark(_told(container, count), count))
    if missing:
        some = ", ".join(map(str, missing[:SHOWN])) + (" ..." if len(missing) > SHOWN else "")
        remarks.append(f"its time stamps leave out frames, which count as unreadable ({len(missing)}): {some}")
    if loss(stream.codec_context) != LOSSLESS:
        remarks.append(f"codec {stream.codec_context.name} ({loss(stream.codec_context)}): fine detail may be lost")
    if av.VideoFormat(pixel_format).is_rgb:
        remarks.append(COLOUR_REMARK)
    elif not pixel_format.startswith("gray"):
        remarks.append(f"stored as colour ({pixel_format}): its brightness is taken as it is")
    return tuple(remarks)


def loss(context: av.CodecContext) -> str:
    """Return in words whether a codec loses grey values."""
    codec = context.codec
    if not codec.lossy:
        return LOSSLESS
    return "may be lossy" if codec.lossless else "lossy"


def _told(container: av.container.InputContainer, count: int) -> int:
    """Return how many frames the header tells of, 0 where it does not, or of no more than there are."""
    stream = container.streams.video[0]
    if stream.frames:
        return int(stream.frames)
    # Matroska tells no number, but the duration of what was written.
    matroska = "matroska" in container.format.name and len(container.streams) == 1
    if not (matroska and container.duration and stream.average_rate):
        return 0
    whole = container.duration * stream.average_rate / av.time_base
    return round(whole) if count < whole - SLACK else 0


def words(error: Exception) -> str:
    """Return an error of FFmpeg in one line, without the file's name, which our message has already."""
    text = getattr(error, "strerror", None) or str(error)
    return f"'{text.splitlines()[0]}'" if text else type(error).__name__
