from pathlib import Path

import av
import numpy as np
import pytest
from conftest import SHARED
from movie_examples import FRAMES, encode, pictures, smooth

from sphereorient.movies import open_movie, write_ffv1

LOSSLESS_H264 = {"qp": "0", "g": "8", "sc_threshold": "0"}


def all_of(path: Path) -> np.ndarray:
    with open_movie(path) as movie:
        return np.stack(list(movie.frames()))


def test_numpy_files_of_the_other_byte_order_give_the_same_values(tmp_path):
    np.save(tmp_path / "movie.npy", pictures(np.uint16).astype(">u2"))
    with open_movie(tmp_path / "movie.npy") as movie:
        assert movie.dtype.isnative
        assert np.array_equal(movie.sample(range(FRAMES)), pictures(np.uint16))


@pytest.mark.parametrize("bits", [10, 12, 16])
def test_more_than_eight_bits_are_neither_lost_nor_rescaled(tmp_path, bits):
    frames = pictures(np.uint16) >> (16 - bits)
    path = encode(tmp_path / "movie.mkv", frames, "ffv1", f"gray{bits}le", source_format=f"gray{bits}le")
    with open_movie(path) as movie:
        assert movie.dtype == np.uint16
        assert np.array_equal(movie.sample(range(FRAMES)), frames)


def test_rows_stored_bottom_up_come_out_top_down(tmp_path):
    # The option flags rows as stored bottom-up without turning them, so the decoder hands them out upside down,
    # with a negative line size.
    frames = pictures()
    upside_down = np.ascontiguousarray(frames[:, ::-1])
    path = encode(tmp_path / "movie.avi", upside_down, "rawvideo", "bgr24", container={"flipped_raw_rgb": "1"})
    with av.open(str(path)) as container:
        assert next(container.decode(video=0)).planes[0].line_size < 0
    assert np.array_equal(all_of(path), frames)


def needs_h264() -> None:
    if "libx264" not in av.codecs_available:
        pytest.skip("this FFmpeg has no libx264")


@pytest.mark.parametrize("name", ["movie.mp4", "movie.mov", "movie.mkv"])
def test_lossless_h264_is_exact_and_not_stretched_to_full_range(tmp_path, name):
    needs_h264()
    frames = smooth()
    path = encode(tmp_path / name, frames, "libx264", "gray", LOSSLESS_H264)
    assert np.array_equal(all_of(path), frames)


REORDERED = {"bf": "2", "b_strategy": "0", "sc_threshold": "0", "g": "9"}
CODED = {
    "every frame a key": ("movie.mkv", "ffv1", "gray", {"g": "1"}),
    "a key now and then": ("movie.avi", "ffv1", "gray", {"g": "7"}),
    "raw": ("movie.avi", "rawvideo", "gray", {}),
    "reordered mp4": ("movie.mp4", "libx264", "yuv420p", REORDERED),
    "reordered mkv": ("movie.mkv", "libx264", "yuv420p", REORDERED),
    "reordered avi, without true stamps": ("movie.avi", "libx264", "yuv420p", REORDERED),
    "open groups": ("movie.mp4", "libx264", "yuv420p", REORDERED | {"g": "3", "x264opts": "open-gop=1"}),
    "reordered mpeg4": ("movie.mp4", "mpeg4", "yuv420p", {"bf": "2", "g": "9"}),
}


@pytest.mark.parametrize(("name", "codec", "pixels", "options"), CODED.values(), ids=CODED)
def test_random_access_equals_sequential_reading(tmp_path, name, codec, pixels, options):
    if codec == "libx264":
        needs_h264()
    movie = open_movie(encode(tmp_path / name, smooth(), codec, pixels, options))
    sequential = np.stack(list(movie.frames()))
    assert len(sequential) == len(movie) == len(smooth())
    assert len({frame.tobytes() for frame in sequential}) == len(movie)  # no two alike: a shift would show
    for indices in ([39, 3, 17, 3, 18, 0, 25, 24], [22], [8, 9, 10], range(40), []):
        assert np.array_equal(movie.sample(indices), sequential[list(indices)])
    for number in range(40):
        assert np.array_equal(movie.sample([number])[0], sequential[number])
    for first, last in ((0, 0), (0, 5), (11, 20), (38, 40), (9, None)):
        read = list(movie.frames(first, last))
        assert np.array_equal(np.array(read).reshape(-1, 38, 52), sequential[first:last])


def test_two_readers_of_one_movie_do_not_disturb_each_other(tmp_path):
    movie = open_movie(encode(tmp_path / "movie.mkv", pictures(), "ffv1", "gray"))
    one = movie.frames()
    next(one)
    movie.sample([20])
    for second, frame in enumerate(movie.frames(), start=1):
        assert np.array_equal(frame, pictures()[second - 1])
        if second < FRAMES:
            assert np.array_equal(next(one), pictures()[second])


@pytest.mark.parametrize("frame_rate_hz", [29.97, 600.0, 7000.0])  # stamps of MKV count ms: at 7 kHz they repeat
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_frames_of_write_ffv1_come_back(tmp_path, dtype, frame_rate_hz):
    frames = pictures(dtype)
    assert write_ffv1(tmp_path / "movie.mkv", iter(frames), frame_rate_hz) == FRAMES
    with open_movie(tmp_path / "movie.mkv") as movie:
        assert len(movie) == FRAMES
        assert np.array_equal(np.stack(list(movie.frames())), frames)
        assert np.array_equal(movie.sample([29, 4, 5]), frames[[29, 4, 5]])
    assert [file.name for file in tmp_path.iterdir()] == ["movie.mkv"]


@pytest.mark.shared
def test_movies_of_a_path_tracer_are_read_whole():
    with open_movie(SHARED / "experiment" / "cam1.mkv") as movie:
        assert (len(movie), movie.frame_shape, movie.dtype) == (240, (650, 650), np.uint8)
        some = movie.sample([0, 100, 239])
        assert np.array_equal(some[1], next(movie.frames(100)))


@pytest.mark.shared
def test_a_movie_that_holds_grey_as_colour_is_read_by_its_grey_values():
    with open_movie(SHARED / "fixed_ball" / "s90_4.avi") as movie:
        assert (len(movie), movie.frame_shape) == (250, (288, 384))
        corner = movie.sample([0])[0, :40, :40]  # the background is 60 with a noise of 4
        assert abs(corner.mean() - 60) < 1
