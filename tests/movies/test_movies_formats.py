"""Every reader: the same frames bit for bit, in order and at random, upright and not mirrored."""

import cv2
import numpy as np
import pytest
import tifffile
from movie_examples import FRAMES, HEIGHT, WIDTH, pictures
from movie_formats import EIGHT_BIT, LOSSLESS, LOSSY

from sphereorient.movies import flipped, movie_files, open_movie

EVERY = [(name, write, np.uint8) for name, write in (LOSSLESS | EIGHT_BIT).items()]
EVERY += [(name, write, np.uint16) for name, write in LOSSLESS.items()]
IDS = [f"{name}, {np.dtype(dtype).itemsize * 8} bit" for name, _, dtype in EVERY]


@pytest.mark.parametrize(("name", "write", "dtype"), EVERY, ids=IDS)
def test_the_same_frames_come_back_bit_for_bit_from_every_lossless_format(tmp_path, name, write, dtype):
    frames = pictures(dtype)
    with open_movie(write(tmp_path, frames)) as movie:
        assert (len(movie), movie.frame_shape, movie.dtype) == (FRAMES, (HEIGHT, WIDTH), dtype)
        assert movie.dtype.isnative
        assert movie.format
        read = list(movie.frames())
        assert all(one.dtype == dtype and one.flags.c_contiguous and one.flags.writeable for one in read)
        assert np.array_equal(np.stack(read), frames)
        for indices in ([29, 3, 17, 3, 0], [12], [], range(FRAMES)):
            assert np.array_equal(movie.sample(indices), frames[list(indices)])
        for first, last in ((0, 0), (4, 9), (28, None)):
            assert np.array_equal(
                np.array(list(movie.frames(first, last))).reshape(-1, HEIGHT, WIDTH), frames[first:last]
            )
            again = list(movie.readable(first, last))
            assert np.array_equal(np.array(again).reshape(-1, HEIGHT, WIDTH), frames[first:last])
        assert not any("truncated" in remark for remark in movie.remarks)


def marked() -> np.ndarray:
    """Grey, with a bright block at top left and a smaller, darker one below it at the left edge."""
    frames = np.full((10, 64, 96), 60, np.uint8)
    frames[:, :16, :32] = 250
    frames[:, 40:48, :16] = 160
    return frames


SMOOTH_COPIES = {name: write for name, write in (LOSSLESS | EIGHT_BIT | LOSSY).items() if "not in order" not in name}


@pytest.mark.parametrize("write", SMOOTH_COPIES.values(), ids=SMOOTH_COPIES)
def test_no_reader_mirrors_or_turns_the_picture(tmp_path, write):
    """A mirrored movie turns every rotation inside out."""
    frames = marked()
    with open_movie(write(tmp_path, frames)) as movie:
        got = movie.sample([3])[0].astype(float)
    wrong = [frames[3, ::-1], frames[3, :, ::-1], frames[3, ::-1, ::-1]]
    # Codecs with a limited range and loss move grey values, not blocks.
    assert np.corrcoef(got.ravel(), frames[3].ravel())[0, 1] > 0.99
    assert all(np.corrcoef(got.ravel(), one.ravel())[0, 1] < 0.7 for one in wrong)
    assert got[4, 4] > got[44, 4] > got[60, 90]
    assert got[4, 90] < got[44, 4]


@pytest.mark.parametrize(
    ("how", "turn"),
    [
        ("none", lambda frames: frames),
        ("vertical", lambda frames: frames[..., ::-1, :]),
        ("horizontal", lambda frames: frames[..., ::-1]),
        ("both", lambda frames: frames[..., ::-1, ::-1]),
    ],
)
@pytest.mark.parametrize("name", ["ffv1 mkv", "npy"])
def test_a_flipped_movie_is_the_movie_in_a_mirror(tmp_path, name, how, turn):
    frames = pictures()
    movie = open_movie(LOSSLESS[name](tmp_path, frames))
    with flipped(movie, how) as mirrored:
        assert np.array_equal(np.stack(list(mirrored.frames(3, 9))), turn(frames)[3:9])
        assert np.array_equal(np.stack(list(mirrored.readable(3, 9))), turn(frames)[3:9])
        assert np.array_equal(mirrored.sample([5, 1]), turn(frames)[[5, 1]])
        assert (len(mirrored), mirrored.path, mirrored.frame_shape) == (FRAMES, movie.path, movie.frame_shape)
        assert any("flipped" in remark for remark in mirrored.remarks) == (how != "none")


@pytest.mark.parametrize("name", ["cine, colour", "tiff, colour", "png, colour", "ffv1 bgra", "raw bgr avi"])
def test_colour_is_made_grey_with_a_remark(tmp_path, name):
    movie = open_movie((LOSSLESS | EIGHT_BIT)[name](tmp_path, pictures()))
    assert any("colour" in remark for remark in movie.remarks)


def test_the_same_colours_give_the_same_grey_in_every_format(tmp_path):
    from cine_writer import Cine, write_cine
    from movie_examples import encode

    colours = np.random.default_rng(3).integers(0, 256, (4, HEIGHT, WIDTH, 3), dtype=np.uint8)
    red, green, blue = np.moveaxis(colours.astype(int), 3, 0)
    expected = (299 * red + 587 * green + 114 * blue + 500) // 1000
    (tmp_path / "png").mkdir()
    for number, frame in enumerate(colours):
        cv2.imwrite(str(tmp_path / "png" / f"{number}.png"), frame[..., ::-1])
    tifffile.imwrite(tmp_path / "movie.tif", colours, photometric="rgb")
    paths = [
        tmp_path / "png",
        tmp_path / "movie.tif",
        write_cine(tmp_path / "movie.cine", Cine(colours)),
        encode(tmp_path / "movie.avi", colours, "rawvideo", "bgr24", source_format="rgb24"),
        encode(tmp_path / "movie.mkv", colours, "ffv1", "bgra", source_format="rgb24"),
    ]
    for path in paths:
        assert np.array_equal(open_movie(path).sample(range(4)), expected), path


@pytest.mark.parametrize("write", LOSSY.values(), ids=LOSSY)
def test_a_lossy_codec_is_remarked_upon(tmp_path, write):
    remarks = open_movie(write(tmp_path, marked())).remarks
    assert any("fine detail" in remark for remark in remarks)


def test_a_lossless_grey_movie_needs_no_remark(tmp_path):
    for name in ("ffv1 mkv", "npy", "tiff", "png", "hdf5"):
        (tmp_path / name).mkdir()
        assert open_movie(LOSSLESS[name](tmp_path / name, pictures())).remarks == ()


def test_the_files_of_a_movie_are_reported(tmp_path):
    folder = LOSSLESS["png"](tmp_path, pictures())
    assert len(movie_files(folder)) == FRAMES
    assert len(movie_files(folder / "cam1_1*.png")) == 10
    assert movie_files(LOSSLESS["hdf5, named"](tmp_path, pictures())) == [tmp_path / "movie.h5"]
