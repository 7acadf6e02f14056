from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

FRAMES, HEIGHT, WIDTH = 30, 37, 51


def pictures(dtype: type = np.uint8, shape: tuple[int, int, int] = (FRAMES, HEIGHT, WIDTH)) -> NDArray[Any]:
    """Noise over all grey values; the corner at top left is dark, with one bright pixel at row 1, column 2."""
    frames = np.random.default_rng(7).integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)
    frames[:, :4, :5] = 0
    frames[:, 1, 2] = np.iinfo(dtype).max
    return frames


def smooth(shape: tuple[int, int, int] = (40, 38, 52)) -> NDArray[np.uint8]:
    """Waves that move, so that codecs predict one frame from others; all frames differ."""
    k, y, x = np.ogrid[: shape[0], : shape[1], : shape[2]]
    return (110 + 60 * np.sin((x + k) / 7) + 40 * np.cos((y - 2 * k) / 5)).astype(np.uint8)


def encode(
    path: Path,
    frames: NDArray[Any],
    codec: str,
    pixel_format: str,
    options: dict[str, str] | None = None,
    container: dict[str, str] | None = None,
    source_format: str | None = None,
) -> Path:
    """Write frames with PyAV at 600 frames per second; `options` are the codec's, `container` the file's."""
    rate = Fraction(600)
    with av.open(str(path), "w", options=container or {}) as file:
        stream = file.add_stream(codec, rate=rate, options=options or {})
        stream.height, stream.width, stream.pix_fmt = frames.shape[1], frames.shape[2], pixel_format
        for number, picture in enumerate(frames):
            grey = source_format or ("gray" if frames.dtype == np.uint8 else "gray16le")
            frame = av.VideoFrame.from_ndarray(picture, format=grey).reformat(format=pixel_format)
            frame.pts, frame.time_base = number, 1 / rate
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    return path
