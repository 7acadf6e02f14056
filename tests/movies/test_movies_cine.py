"""Phantom's .cine, written by the tests' own writer: pixels, row order, cropping, times, and refusals."""

import av
import numpy as np
import pytest
from cine_writer import SETUP_LENGTH, Cine, write_cine
from movie_examples import FRAMES, pictures

from sphereorient.errors import MovieError
from sphereorient.movies import open_movie

WIDE = (FRAMES, 37, 52)  # whole groups of packed pixels, as FFmpeg needs them


def deep(bits: int, shape: tuple[int, int, int] = (FRAMES, 37, 51)) -> np.ndarray:
    return pictures(np.uint16, shape) >> (16 - bits)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_deep_values_are_neither_lost_nor_rescaled(tmp_path, bits):
    movie = open_movie(write_cine(tmp_path / "movie.cine", Cine(deep(bits), real_bits=bits)))
    assert np.array_equal(movie.sample(range(FRAMES)), deep(bits))
    assert ("used" in movie.format) == (bits < 16)


@pytest.mark.parametrize("bits", [10, 12])
@pytest.mark.parametrize("flip_v", [0, 1])
@pytest.mark.parametrize("width", [49, 50, 51, 52])
def test_packed_pixels_come_out_one_by_one_and_upright(tmp_path, bits, flip_v, width):
    frames = deep(bits, (4, 37, width))
    cine = Cine(frames, packed_bits=bits, real_bits=bits, flip_v=flip_v)
    assert np.array_equal(open_movie(write_cine(tmp_path / "movie.cine", cine)).sample(range(4)), frames)


@pytest.mark.skipif(
    av.library_versions["libavformat"] < (62, 0, 0), reason="FFmpeg before 8 takes the padding of rows for pixels"
)
@pytest.mark.parametrize(
    ("cine", "shift"),
    [
        (Cine(pictures(np.uint8, WIDE)), 0),
        (Cine(pictures(np.uint8, WIDE), flip_v=1, annotation=24), 0),
        (Cine(deep(12, WIDE), real_bits=12, first_number=-9, total=500), 4),
        (Cine(deep(16, WIDE), flip_v=1), 0),
        (Cine(deep(10, WIDE), packed_bits=10, real_bits=10), 6),
        (Cine(deep(10, WIDE), packed_bits=10, real_bits=10, flip_v=1), 6),
    ],
    ids=["8 bit", "8 bit flipped", "12 in 16 bit", "16 bit flipped", "packed", "packed flipped"],
)
def test_ffmpeg_reads_the_same_pictures(tmp_path, cine, shift):
    """FFmpeg's own reader of .cine is the oracle; it scales deep values to 16 bit."""
    path = write_cine(tmp_path / "movie.cine", cine)
    with av.open(str(path)) as container:
        oracle = [frame.to_ndarray() >> shift for frame in container.decode(video=0)]
    assert np.array_equal(np.stack(oracle), open_movie(path).sample(range(FRAMES)))


def test_times_are_the_stamps_from_the_trigger_on(tmp_path):
    times_s = np.arange(FRAMES) / 600.0 - 0.01
    times_s[20:] += 0.5  # a pause
    blocks = [(1004, b"range data"), (777, b"")]
    cine = Cine(pictures(), stamps_s=times_s, blocks=blocks, blocks_after=[(1003, bytes(4 * FRAMES))], first_number=-6)
    movie = open_movie(write_cine(tmp_path / "movie.cine", cine))
    assert np.abs(movie.times_s - times_s).max() < 2.0**-29  # the two lowest bits of 2^-32 s are flags
    assert movie.remarks == ()


def test_without_stamps_times_come_from_the_frame_rate_and_the_number_from_the_trigger(tmp_path):
    cine = Cine(pictures(), first_number=-6, frame_rate=90_000, blocks=[(1004, b"x")])
    movie = open_movie(write_cine(tmp_path / "movie.cine", cine))
    assert np.allclose(movie.times_s, (np.arange(FRAMES) - 6) / 90_000, rtol=1e-14)
    assert "no time stamps" in movie.remarks[0]


def test_a_short_setup_of_an_old_version_is_read_as_far_as_it_goes(tmp_path):
    cine = Cine(pictures(), setup_length=700, frame_rate=1234)
    movie = open_movie(write_cine(tmp_path / "movie.cine", cine))
    assert np.array_equal(movie.sample(range(FRAMES)), pictures())
    assert np.allclose(movie.times_s, np.arange(FRAMES) / 1234)


def test_stamps_that_stand_still_are_not_used(tmp_path):
    movie = open_movie(write_cine(tmp_path / "movie.cine", Cine(pictures(), stamps_s=np.zeros(FRAMES))))
    assert "do not increase" in movie.remarks[0]
    assert np.allclose(movie.times_s, np.arange(FRAMES) / 1000)


@pytest.mark.parametrize(
    ("cine", "word"),
    [
        (Cine(pictures(), flip_v=1), "bFlipV"),
        (Cine(pictures(), flip_h=1), "bFlipH"),
        (Cine(pictures(), rotate=90), "90 degrees"),
        (Cine(deep(10), packed_bits=10), "not linear"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_processing_that_the_header_requests_is_remarked_upon(tmp_path, cine, word):
    movie = open_movie(write_cine(tmp_path / "movie.cine", cine))
    assert any(word in remark for remark in movie.remarks)


@pytest.mark.parametrize(("compression", "word"), [(2, "filter array"), (1, "JPEG")])
def test_pixels_that_are_not_grey_are_refused_with_what_to_do(tmp_path, compression, word):
    path = write_cine(tmp_path / "movie.cine", Cine(pictures(), compression=compression))
    with pytest.raises(MovieError, match=f"{word}.*; export it"):
        open_movie(path)


def test_an_image_size_that_is_no_whole_number_of_rows_is_refused(tmp_path):
    path = write_cine(tmp_path / "movie.cine", Cine(pictures()))
    content = bytearray(path.read_bytes())
    content[44 + 8 : 44 + 12] = (36).to_bytes(4, "little")  # biHeight
    path.write_bytes(content)
    with pytest.raises(MovieError, match="at least 51 bytes"):
        open_movie(path)


def test_a_header_that_claims_a_billion_frames_allocates_nothing(tmp_path):
    import tracemalloc

    path = write_cine(tmp_path / "movie.cine", Cine(pictures()))
    content = bytearray(path.read_bytes())
    content[20:24] = (10**9).to_bytes(4, "little")
    path.write_bytes(content)
    tracemalloc.start()
    movie = open_movie(path)
    assert tracemalloc.get_traced_memory()[1] < 2_000_000
    tracemalloc.stop()
    assert "states 1000000000 frames" in movie.remarks[0]
    assert np.array_equal(movie.sample(range(FRAMES)), pictures())


def test_the_frames_of_a_cut_off_movie_are_there(tmp_path):
    cine = Cine(pictures(), stamps_s=np.arange(FRAMES) / 600, annotation=40)
    path = write_cine(tmp_path / "movie.cine", cine)
    content = path.read_bytes()
    at_images = 84 + SETUP_LENGTH + 8 + 8 * FRAMES + 8 * FRAMES
    pitch = 40 + 37 * 51
    for whole, spare in ((1, 0), (12, 7), (29, pitch - 1)):
        path.write_bytes(content[: at_images + whole * pitch + spare])
        movie = open_movie(path)
        assert movie.remarks == (f"truncated: its header states 30 frames, the file holds {whole}",)
        assert np.array_equal(movie.sample(range(whole)), pictures()[:whole])
        assert len(movie.times_s) == whole
    path.write_bytes(content[: at_images + pitch - 1])
    with pytest.raises(MovieError, match="one whole image"):
        open_movie(path)
