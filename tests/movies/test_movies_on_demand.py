"""Slices of FFV1 that are decoded alone: the same pixels as of whole frames, or whole frames."""

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import av
import numpy as np
import pytest

from sphereorient.files.picture import OnDemand
from sphereorient.movies import open_movie
from sphereorient.movies.ffv1 import SliceDecoder, split_slices, stub_slice

SHAPE = (97, 131)


def pictures(dtype: type = np.uint8, count: int = 6, shape: tuple[int, int] = SHAPE) -> list[np.ndarray]:
    rng = np.random.default_rng(3)
    return [rng.integers(0, np.iinfo(dtype).max, shape).astype(dtype) for _ in range(count)]


def written(path: Path, frames: list[np.ndarray], pixels: str = "gray", **options: str) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25, options={"level": "3", "g": "1", "slicecrc": "1", **options})
        stream.height, stream.width = frames[0].shape
        stream.pix_fmt = pixels
        for picture in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format=pixels)))
        container.mux(stream.encode(None))
    return path


def demanded(path: Path, first: int = 0, last: int | None = None) -> list:
    with ThreadPoolExecutor(2) as pool:
        found = list(open_movie(path).on_demand(pool, first, last))
        for picture in found:  # decode all while the pool is there
            if isinstance(picture, OnDemand):
                height, width = picture.shape
                picture.part(0, 0, width - 1, height - 1)
        return found


@pytest.mark.parametrize("slices", ["4", "6", "9", "24", "30"])
@pytest.mark.parametrize("coder", ["0", "1", "2"])
def test_parts_and_whole_pictures_are_those_of_whole_frames(tmp_path: Path, slices: str, coder: str) -> None:
    expected = pictures()
    path = written(tmp_path / "m.mkv", expected, slices=slices, coder=coder)
    rng = np.random.default_rng(0)
    with ThreadPoolExecutor(2) as pool:
        for picture, whole in zip(open_movie(path).on_demand(pool), expected, strict=True):
            assert isinstance(picture, OnDemand)
            for _ in range(3):
                (left, right), (top, bottom) = (
                    np.sort(rng.integers(0, SHAPE[1], 2)),
                    np.sort(rng.integers(0, SHAPE[0], 2)),
                )
                window = np.s_[top : bottom + 1, left : right + 1]
                np.testing.assert_array_equal(picture.part(left, top, right, bottom)[window], whole[window])
            np.testing.assert_array_equal(picture.part(0, 0, SHAPE[1] - 1, SHAPE[0] - 1), whole)


@pytest.mark.parametrize("pixels", ["gray16le", "gray10le", "gray12le"])
def test_more_than_8_bits(tmp_path: Path, pixels: str) -> None:
    expected = [picture % 1024 for picture in pictures(np.uint16)]
    path = written(tmp_path / "m.mkv", expected, pixels, slices="6")
    for picture, whole in zip(demanded(path), open_movie(path).frames(), strict=True):
        assert isinstance(picture, OnDemand)
        np.testing.assert_array_equal(picture.part(0, 0, 1, 1), whole)
        assert picture.part(0, 0, 1, 1).dtype == whole.dtype


def test_only_slices_that_hold_the_part_are_decoded_here_and_ahead_in_the_next_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path / "m.mkv", pictures(), slices="4")
    decoded: list[list[int]] = []
    real = SliceDecoder.decode
    with ThreadPoolExecutor(1) as pool:
        found = list(open_movie(path).on_demand(pool))
        monkeypatch.setattr(
            SliceDecoder,
            "decode",
            lambda self, slices, some, into: (decoded.append(some), real(self, slices, some, into)),
        )
        found[0].ask(2, 2, 5, 5)
        assert not found[0].part(2, 2, 5, 5)[60:, 80:].any()
        found[1].part(2, 2, 5, 5)
        assert decoded == [[0], [0]]  # of this frame, and ahead of the next one
        found[1].part(2, 2, 120, 5)
        assert decoded[2:] == [[1]]


def test_a_part_may_be_read_after_the_pool_has_closed(tmp_path: Path) -> None:
    expected = pictures(count=2)
    path = written(tmp_path / "m.mkv", expected, slices="9")
    with ThreadPoolExecutor(2) as pool:
        found = list(open_movie(path).on_demand(pool))
    for picture, whole in zip(found, expected, strict=True):
        picture.ask(0, 0, 3, 3)
        np.testing.assert_array_equal(picture.part(0, 0, SHAPE[1] - 1, SHAPE[0] - 1), whole)


@pytest.mark.parametrize("options", [{"g": "4", "slices": "4"}, {"slicecrc": "0", "slices": "4"}])
def test_frames_that_do_not_stand_alone_or_are_not_checked_are_decoded_whole(tmp_path: Path, options: dict) -> None:
    expected = pictures()
    path = written(tmp_path / "m.mkv", expected, **options)
    for picture, whole in zip(demanded(path), expected, strict=True):
        np.testing.assert_array_equal(picture, whole)


def test_colour_is_decoded_whole(tmp_path: Path) -> None:
    path = tmp_path / "m.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=25, options={"level": "3", "g": "1", "slicecrc": "1"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(np.full((72, 64), 90, np.uint8), format="yuv420p")))
        container.mux(stream.encode(None))
    assert isinstance(demanded(path)[0], np.ndarray)


def test_a_decoder_whose_slices_differ_from_whole_frames_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = pictures()
    path = written(tmp_path / "m.mkv", expected, slices="4")
    monkeypatch.setattr(SliceDecoder, "decoded", lambda self, slices, wanted: np.full(self.shape, 7, np.uint8))
    for picture, whole in zip(demanded(path), expected, strict=True):
        np.testing.assert_array_equal(picture, whole)


@pytest.mark.parametrize("at", [0.1, 0.9])
def test_a_frame_with_a_damaged_slice_is_unreadable_wherever_the_ball_is(tmp_path: Path, at: float) -> None:
    path = written(tmp_path / "m.mkv", pictures(), slices="4")
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    content = bytearray(path.read_bytes())
    place = content.index(packets[2]) + int(at * len(packets[2]))
    content[place] ^= 0xFF
    path.write_bytes(content)
    found = demanded(path)
    assert [picture is None for picture in found] == [False, False, True, False, False, False]
    assert [picture is None for picture in open_movie(path).readable()] == [picture is None for picture in found]


def test_equal_frames_are_known_by_their_packets(tmp_path: Path) -> None:
    one, other = pictures(count=2)
    nearly = one.copy()
    nearly[0, 0] ^= 1
    found = demanded(written(tmp_path / "m.mkv", [one, one, nearly, other], slices="4"))
    assert [b.equals(a) for a, b in pairwise(found)] == [True, False, False]
    assert not found[0].equals(None)


@pytest.mark.parametrize("first", [True, False])
def test_a_stub_is_a_slice_whose_check_sum_is_right(first: bool) -> None:
    assert split_slices(stub_slice(first)) == [stub_slice(first)]


@pytest.mark.parametrize("slices", ["4", "6", "24"])
def test_a_bright_ball_on_black_shows_where_the_slices_are(tmp_path: Path, slices: str) -> None:
    expected = pictures()
    expected[0][:] = 0
    expected[0][50:90, 60:100] = 200  # the others are bright everywhere
    found = demanded(written(tmp_path / "m.mkv", expected, slices=slices))
    for picture, whole in zip(found, expected, strict=True):
        assert isinstance(picture, OnDemand)
        np.testing.assert_array_equal(picture.part(0, 0, 1, 1), whole)


def test_movies_whose_first_picture_is_black_are_decoded_whole(tmp_path: Path) -> None:
    expected = pictures()
    expected[0][:] = 0
    for picture, whole in zip(demanded(written(tmp_path / "m.mkv", expected, slices="4")), expected, strict=True):
        np.testing.assert_array_equal(picture, whole)
