"""From a decoded frame to grey values, for formats without sample files."""

import av
import numpy as np
import pytest
from movie_examples import pictures

from sphereorient.errors import MovieError
from sphereorient.movies.video import check_format, grey_dtype, grey_values


def turned_over(frame: av.VideoFrame) -> av.VideoFrame:
    """FFmpeg's vertical flip keeps the memory and makes the line size negative."""
    graph = av.filter.Graph()
    size = f"video_size={frame.width}x{frame.height}:pix_fmt={frame.format.name}:time_base=1/1:pixel_aspect=1/1"
    source, flip, sink = graph.add("buffer", size), graph.add("vflip"), graph.add("buffersink")
    source.link_to(flip)
    flip.link_to(sink)
    graph.configure()
    frame.pts = 0
    source.push(frame)
    return sink.pull()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_negative_line_size_means_bottom_up(dtype):
    picture = pictures(dtype)[0]
    flipped = turned_over(av.VideoFrame.from_ndarray(picture, format="gray" if dtype == np.uint8 else "gray16le"))
    assert flipped.planes[0].line_size < 0
    assert np.array_equal(grey_values(flipped), picture[::-1])


@pytest.mark.parametrize("pixels", ["rgb24", "bgr24", "bgra", "rgba", "gbrp"])
def test_every_grey_value_survives_colour_formats(pixels):
    picture = np.arange(256, dtype=np.uint8).reshape(16, 16)
    frame = av.VideoFrame.from_ndarray(np.repeat(picture[..., None], 3, axis=2), format="rgb24").reformat(format=pixels)
    assert np.array_equal(grey_values(frame), picture)


def test_big_endian_values_are_turned_round():
    picture = pictures(np.uint16)[0]
    frame = av.VideoFrame.from_ndarray(picture, format="gray16be")
    assert grey_values(frame).dtype.isnative
    assert np.array_equal(grey_values(frame), picture)


def test_the_values_outlive_the_frame():
    frame = av.VideoFrame.from_ndarray(pictures()[0], format="gray")
    values = grey_values(frame)
    frame.planes[0].update(bytes(frame.planes[0].buffer_size))
    assert np.array_equal(values, pictures()[0])


def test_limited_range_is_not_stretched():
    frame = av.VideoFrame(16, 16, "yuv420p")
    for plane, value in zip(frame.planes, (16, 128, 128), strict=True):
        plane.update(bytes([value]) * plane.buffer_size)
    assert (grey_values(frame) == 16).all()  # black of limited range; stretched it would be 0


@pytest.mark.parametrize("pixels", ["gray", "gray10le", "gray16be", "yuv420p", "yuvj422p", "nv12", "bgra", "pal8"])
def test_usual_formats_are_accepted(pixels):
    check_format("movie", av.VideoFormat(pixels, 16, 16))
    assert grey_dtype(av.VideoFormat(pixels, 16, 16)) == (np.uint16 if "1" in pixels[4:6] else np.uint8)


@pytest.mark.parametrize("pixels", ["yuyv422", "ya8", "monow", "grayf32le"])
def test_formats_whose_first_plane_is_not_plain_grey_are_refused(pixels):
    with pytest.raises(MovieError, match=f"got {pixels}"):
        check_format("movie", av.VideoFormat(pixels, 16, 16))
