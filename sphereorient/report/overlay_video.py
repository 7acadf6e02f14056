"""Writing pictures as a movie that players and browsers show: H.264, 4:2:0."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from sphereorient.errors import OutputError, refusal
from sphereorient.files.outputs import put_aside

Colour = NDArray[np.uint8]  # (H, W, 3), red green blue
FORMATS = {".mp4": "mp4", ".m4v": "mp4", ".mov": "mov", ".mkv": "matroska"}
OPTIONS = {"crf": "19", "preset": "veryfast"}


def check_video_name(path: Path) -> None:
    """Refuse a name that no player would take for a movie.

    Raises:
        OutputError: another suffix.
    """
    if path.suffix.lower() not in FORMATS:
        do = "end the name in .mp4"
        raise OutputError(refusal(f"--out {path}", expected=" ".join(FORMATS), got=f"'{path.suffix}'", do=do))


def write_video(path: Path, pictures: Iterable[Colour], fps: float) -> int:
    """Write pictures as H.264 (yuv420p), aside and then under their name, and return their number.

    Args:
        path: .mp4, .mov or .mkv; an old one is replaced.
        pictures: (H, W, 3) each, red green blue, all alike, H and W even; taken one by one.
        fps: pictures a second, of the player.

    Raises:
        OutputError: another suffix, no picture, or the file cannot be written; an old one is still there.
    """
    check_video_name(path)
    kind = FORMATS[path.suffix.lower()]
    with put_aside(path, also=(av.FFmpegError,)) as aside, av.open(str(aside), "w", format=kind) as container:
        count = _encode(container, pictures, Fraction(fps).limit_denominator(1000))
        if not count:
            raise OutputError(refusal(str(path), expected="pictures to write", got="none", do="ask for more frames"))
    return count


def _encode(container: Any, pictures: Iterable[Colour], rate: Fraction) -> int:
    stream = None
    count = 0
    for picture in pictures:
        if stream is None:
            stream = container.add_stream("libx264", rate=rate, options=dict(OPTIONS))
            stream.height, stream.width = picture.shape[:2]
            stream.pix_fmt = "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
        frame.pts, frame.time_base = count, 1 / rate
        container.mux(stream.encode(frame))
        count += 1
    if stream is not None:
        container.mux(stream.encode(None))
    return count
