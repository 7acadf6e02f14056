"""Metadata of containers: time stamps, edit lists, fields, axes, parts; files of other programs."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import h5py
import numpy as np
import pytest
import tifffile
from movie_examples import pictures, smooth
from numpy.typing import NDArray

from sphereorient.errors import MovieError
from sphereorient.movies import flipped, open_movie

JITTER_S = np.cumsum([0.0, 0.034, 0.04, 0.02, 0.047, 0.023, 0.43, 0.03, 0.036, 0.041, 0.033, 0.029])  # with a pause


def stamped(path: Path, times_s: NDArray[np.float64], codec: str = "ffv1", rate: int = 30) -> Path:
    """Write frames with the given time stamps."""
    with av.open(str(path), "w") as file:
        stream = file.add_stream(codec, rate=rate)
        stream.height, stream.width = 38, 52
        stream.pix_fmt = "gray" if codec == "ffv1" else "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000 if codec == "ffv1" else 65000)
        for time_s, picture in zip(times_s, smooth((len(times_s), 38, 52)), strict=True):
            frame = av.VideoFrame.from_ndarray(picture, format="gray").reformat(format=stream.pix_fmt)
            frame.time_base = stream.time_base
            frame.pts = round(float(time_s) / float(stream.time_base))
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    return path


def remark(movie: Any, word: str) -> list[str]:
    return [one for one in movie.remarks if word in one]


@pytest.mark.parametrize(("suffix", "codec", "tick_s"), [(".mkv", "ffv1", 1e-3), (".mp4", "mpeg4", 1 / 65000)])
def test_uneven_time_stamps_are_the_movies_times_with_a_remark(tmp_path, suffix, codec, tick_s):
    movie = open_movie(stamped(tmp_path / f"movie{suffix}", JITTER_S, codec))
    assert movie.times_s == pytest.approx(JITTER_S, abs=0.51 * tick_s)
    (line,) = remark(movie, "not even")
    assert "after frame 5" in line
    assert f"{1e3 * tick_s:.3g} ms" in line
    assert not remark(movie, "truncated")
    assert movie.sample([7])[0].shape == (38, 52)


@pytest.mark.parametrize("rate", [25, 30, 600])
@pytest.mark.parametrize(("suffix", "codec"), [(".mkv", "ffv1"), (".mp4", "mpeg4")])
def test_even_time_stamps_are_those_of_players(tmp_path, suffix, codec, rate):
    movie = open_movie(stamped(tmp_path / f"movie{suffix}", np.arange(12) / rate, codec, rate))
    assert movie.times_s is None
    assert movie.played_hz == pytest.approx(rate, rel=1e-3)
    assert not remark(movie, "even")


def test_uneven_stamps_that_are_rounded_too_coarsely_are_no_times(tmp_path):
    times_s = np.cumsum([0.0, *[0.005, 0.007, 0.005, 0.003] * 5])
    movie = open_movie(stamped(tmp_path / "movie.mkv", times_s, rate=200))
    assert movie.times_s is None
    assert remark(movie, "too coarse")


@pytest.mark.parametrize(
    "times_s", [JITTER_S, np.arange(12) / 30, 7 + np.arange(12) / 30], ids=["uneven", "even", "late"]
)
def test_a_cut_off_matroska_is_truncated_with_any_stamps(tmp_path, times_s):
    path = stamped(tmp_path / "movie.mkv", times_s)
    assert not remark(open_movie(path), "truncated")
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert remark(open_movie(path), "truncated")


def cut(source: Path, target: Path, first: int) -> Path:
    """Copy packets so that presentation begins later, as a cut without encoding does: an edit list hides the first."""
    with av.open(str(source)) as old, av.open(str(target), "w", options={"movflags": "faststart"}) as new:
        stream = old.streams.video[0]
        copy = new.add_stream_from_template(stream)
        shift = None
        for packet in old.demux(stream):
            if packet.dts is None:
                continue
            shift = packet.duration * first if shift is None else shift
            packet.pts, packet.dts, packet.stream = packet.pts - shift, packet.dts - shift, copy
            new.mux(packet)
    return target


def test_frames_that_an_edit_list_hides_are_not_missing(tmp_path):
    whole = stamped(tmp_path / "whole.mp4", np.arange(12) / 25, "mpeg4", 25)
    path = cut(whole, tmp_path / "cut.mp4", 5)
    movie, full = open_movie(path), open_movie(whole)
    assert len(movie) == 7
    assert not remark(movie, "truncated")
    assert np.array_equal(movie.sample([0, 6]), full.sample([5, 11]))
    content = path.read_bytes()  # its table of frames is at the beginning
    path.write_bytes(content[: len(content) - 200])
    movie = open_movie(path)
    assert len(movie) < 7
    assert remark(movie, "truncated: its header states 12")


@pytest.mark.parametrize("interlaced", [True, False])
def test_interlaced_frames_are_to_be_parted_first(tmp_path, interlaced):
    with av.open(str(tmp_path / "movie.mkv"), "w") as file:
        stream = file.add_stream("mpeg2video", rate=25, options={"flags": "+ildct+ilme"} if interlaced else {})
        stream.height, stream.width, stream.pix_fmt = 64, 96, "yuv420p"
        for picture in smooth((6, 64, 96)):
            frame = av.VideoFrame.from_ndarray(picture, format="gray").reformat(format="yuv420p")
            file.mux(stream.encode(frame))
        file.mux(stream.encode(None))
    found = remark(open_movie(tmp_path / "movie.mkv"), "interlaced")
    assert len(found) == interlaced
    assert all("send_field" in one for one in found)


@pytest.mark.parametrize("chunks", [None, (4, 37, 51), (7, 20, 20)])
@pytest.mark.parametrize("suffix", [".h5", ".mat"])
def test_movies_of_matlab_have_its_rows_and_columns(tmp_path, suffix, chunks):
    """MATLAB saves H x W x N as (N, W, H)."""
    frames = pictures()
    with h5py.File(tmp_path / f"movie{suffix}", "w", userblock_size=512) as file:
        file.create_dataset("mov", data=frames.swapaxes(1, 2), chunks=None if chunks is None else (chunks[0], 5, 5))
        file["mov"].attrs["MATLAB_class"] = np.bytes_(b"uint8")
        file["times"] = np.arange(30.0)[:, None] / 100  # 1 x 30 there
    movie = open_movie(tmp_path / f"movie{suffix}")
    assert np.array_equal(np.stack(list(movie.frames())), frames)
    assert movie.times_s == pytest.approx(np.arange(30) / 100)


def test_a_mat_file_of_an_older_version_is_refused_with_advice(tmp_path):
    (tmp_path / "movie.mat").write_bytes(b"MATLAB 5.0 MAT-file, Platform: GLNXA64".ljust(400, b"\0"))
    with pytest.raises(MovieError, match=r"-v7\.3"):
        open_movie(tmp_path / "movie.mat")


def test_a_transposed_movie_is_reported_where_nothing_marks_it_and_flip_undoes_it(tmp_path):
    frames = pictures()
    with h5py.File(tmp_path / "movie.h5", "w") as file:
        file["mov"] = frames.swapaxes(1, 2)
    movie = open_movie(tmp_path / "movie.h5")
    assert movie.frame_shape == (51, 37)
    assert remark(movie, "flip: transpose")
    back = flipped(movie, "transpose")
    assert not remark(back, "flip: transpose")
    assert back.frame_shape == (37, 51)
    assert np.array_equal(np.stack(list(back.frames())), frames)
    assert np.array_equal(back.sample([3]), frames[[3]])


FOURTH = [(30, 37, 51, 1), (30, 1, 37, 51), (30, 37, 1, 51)]


@pytest.mark.parametrize("shape", FOURTH, ids=str)
@pytest.mark.parametrize("chunked", [False, True])
def test_a_fourth_axis_of_one_is_left_out(tmp_path, shape, chunked):
    np.save(tmp_path / "movie.npy", pictures().reshape(shape))
    with h5py.File(tmp_path / "movie.h5", "w") as file:
        tiles = tuple(min(size, 16) for size in shape) if chunked else None
        file.create_dataset("box", data=pictures().reshape(shape), chunks=tiles)
    for name in ("movie.npy", "movie.h5"):
        movie = open_movie(tmp_path / name)
        assert movie.frame_shape == (37, 51)
        assert np.array_equal(np.stack(list(movie.frames())), pictures())
        assert np.array_equal(movie.sample([29, 4]), pictures()[[29, 4]])


@pytest.mark.parametrize("shape", [(5, 37, 51, 3), (5, 3, 37, 51), (2, 5, 37, 51), (5, 1, 37, 1)], ids=str)
def test_other_arrays_of_four_axes_are_refused_with_their_shape(tmp_path, shape):
    np.save(tmp_path / "movie.npy", np.zeros(shape, np.uint8))
    with h5py.File(tmp_path / "movie.h5", "w") as file:
        file["box"] = np.zeros(shape, np.uint8)
    for name, do in (("movie.npy", "one channel"), ("movie.h5", "one channel"), ("movie.h5::box", "one channel")):
        with pytest.raises(MovieError, match=do) as refusal:
            open_movie(tmp_path / name)
        assert str(shape) in str(refusal.value)


def test_ome_parts_and_channels_are_refused_and_one_of_each_is_read(tmp_path):
    frames = pictures()
    path = tmp_path / "movie.ome.tif"
    for axes in ("TYX", "ZYX", "TCYX"):
        stack = frames[:, None] if axes == "TCYX" else frames
        tifffile.imwrite(path, stack, metadata={"axes": axes}, ome=True)
        assert np.array_equal(np.stack(list(open_movie(path).frames())), frames)
        assert not remark(open_movie(path), "truncated")
    tifffile.imwrite(path, np.stack([frames] * 3, -1), photometric="rgb", metadata={"axes": "TYXS"}, ome=True)
    assert np.array_equal(open_movie(path).sample([4])[0], frames[4])
    tifffile.imwrite(path, frames.reshape(15, 2, 37, 51), metadata={"axes": "TCYX"}, ome=True)
    with pytest.raises(MovieError, match="one channel"):
        open_movie(path)
    with tifffile.TiffWriter(path, ome=True) as file:
        file.write(frames[:20], metadata={"axes": "TYX"})
        file.write(frames[20:], metadata={"axes": "TYX"})
    with pytest.raises(MovieError, match="one movie"):
        open_movie(path)


def test_a_cut_off_ome_movie_gives_its_pages_with_a_remark(tmp_path):
    pixels = (
        '<Pixels ID="P:0" DimensionOrder="XYZCT" Type="uint8" SizeX="51" SizeY="37" SizeZ="1" SizeC="1" SizeT="30"/>'
    )
    ome = f'<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">{pixels}</OME>'
    with tifffile.TiffWriter(tmp_path / "movie.ome.tif") as file:
        for k in range(20):  # tables lie between the pictures
            file.write(pictures()[k], description=ome if k == 0 else None, metadata=None, contiguous=False)
    movie = open_movie(tmp_path / "movie.ome.tif")
    assert np.array_equal(np.stack(list(movie.frames())), pictures()[:20])
    assert remark(movie, "header states 30 frames, the file holds 20")


def test_a_part_of_an_ome_movie_in_several_files_is_refused(tmp_path):
    uuid = "urn:uuid:00000000-0000-0000-0000-00000000000"
    data = "".join(
        f'<TiffData FirstT="{10 * k}" PlaneCount="10"><UUID FileName="m_{k}.ome.tif">{uuid}{k}</UUID></TiffData>'
        for k in range(3)
    )
    ome = (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" '
        f'UUID="{uuid}0"><Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="uint8" SizeX="51" '
        f'SizeY="37" SizeZ="1" SizeC="1" SizeT="30">{data}</Pixels></Image></OME>'
    )
    tifffile.imwrite(tmp_path / "m_0.ome.tif", pictures()[:10], description=ome, metadata=None)
    with pytest.raises(MovieError, match="3 files"):
        open_movie(tmp_path / "m_0.ome.tif")


@pytest.mark.parametrize(
    ("name", "word"),
    [
        ("a.mraw", "pyMRAW"),
        ("a.cihx", "pyMRAW"),
        ("a.seq", "NorpixSeq"),
        ("a.fmf", "fmf2bmps"),
        ("a.pkg.slp", "labelled"),
    ],
)
def test_files_of_other_programs_get_advice_of_their_own(tmp_path, name, word):
    (tmp_path / name).write_bytes(b"1")
    with pytest.raises(MovieError, match=word) as refusal:
        open_movie(tmp_path / name)
    assert "ffmpeg -i" not in str(refusal.value)
    (tmp_path / "a.wmv").write_bytes(b"1")
    with pytest.raises(MovieError, match=r"ffmpeg -i a\.wmv "):
        open_movie(tmp_path / "a.wmv")
