"""Reading on after damage: lost frames are None, the others are unchanged and keep their numbers."""

from fractions import Fraction

import av
import numpy as np
import pytest
from movie_examples import FRAMES, encode, pictures, smooth

from sphereorient.errors import MovieError
from sphereorient.movies import open_movie, write_ffv1
from sphereorient.movies.packets import Packet, index_packets


def packet_places(path) -> list[tuple[int, int]]:
    """Place and size of each packet's bytes in the file, in the file's order."""
    content = path.read_bytes()
    with av.open(str(path)) as container:
        parts = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    return [(content.index(part), len(part)) for part in parts]


def damage(path, numbers) -> None:
    """Overwrite a few bytes in the middle of packets."""
    content = bytearray(path.read_bytes())
    for at, size in [packet_places(path)[number] for number in numbers]:
        content[at + size // 2 : at + size // 2 + 4] = b"\xff" * 4
    path.write_bytes(content)


def blank(path, number) -> None:
    """Overwrite all of a packet: codecs without check sums do not detect less."""
    content = bytearray(path.read_bytes())
    at, size = packet_places(path)[number]
    content[at : at + size] = bytes(size)
    path.write_bytes(content)


@pytest.mark.parametrize("frame_rate_hz", [25.0, 600.0, 7000.0])
def test_a_damaged_frame_of_ffv1_is_the_only_one_lost(tmp_path, frame_rate_hz):
    path = tmp_path / "movie.mkv"
    write_ffv1(path, pictures(), frame_rate_hz)
    damage(path, [0, 7, 8, 29])
    movie = open_movie(path)
    assert len(movie) == FRAMES
    read = list(movie.readable())
    assert [number for number, frame in enumerate(read) if frame is None] == [0, 7, 8, 29]
    assert all(frame is None or np.array_equal(frame, pictures()[number]) for number, frame in enumerate(read))
    assert [frame is None for frame in movie.readable(6, 10)] == [False, True, True, False]
    assert np.array_equal(movie.sample([28, 9, 1]), pictures()[[28, 9, 1]])
    with pytest.raises(MovieError, match=r"movie.mkv, frame 7"):
        list(movie.frames(1))


def test_a_packet_that_is_gone_leaves_its_number_behind(tmp_path):
    """The head of a block overwritten: Matroska skips it, and the stamps show that one is missing."""
    path = tmp_path / "movie.mkv"
    write_ffv1(path, pictures(), 600.0)
    at, _ = packet_places(path)[12]
    content = bytearray(path.read_bytes())
    content[at - 6 : at] = bytes(6)
    path.write_bytes(content)
    movie = open_movie(path)
    assert len(movie) == FRAMES
    read = list(movie.readable())
    lost = [number for number, frame in enumerate(read) if frame is None]
    assert 12 in lost
    assert len(lost) < 10
    assert all(frame is None or np.array_equal(frame, pictures()[number]) for number, frame in enumerate(read))
    assert "time stamps" in movie.remarks[0]


REORDERED = {"bf": "2", "b_strategy": "0", "sc_threshold": "0", "g": "8", "qp": "4"}


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("movie.mp4", REORDERED | {"bf": "0"}),
        ("movie.mp4", REORDERED),
        ("movie.mkv", REORDERED),
        ("movie.mp4", REORDERED | {"x264opts": "open-gop=1"}),
        ("movie.avi", REORDERED),
    ],
    ids=["in order", "reordered", "mkv", "open groups", "avi"],
)
def test_frames_that_lean_on_a_damaged_one_are_lost_with_it_and_no_others_change(tmp_path, name, options):
    if "libx264" not in av.codecs_available:
        pytest.skip("this FFmpeg has no libx264")
    path = encode(tmp_path / name, smooth(), "libx264", "yuv420p", options)
    clean = list(open_movie(path).frames())
    blank(path, 18)
    movie = open_movie(path)
    for first in (0, 5, 30):
        read = list(movie.readable(first))
        assert len(read) == len(clean) - first
        for frame, expected in zip(read, clean[first:], strict=True):
            assert frame is None or np.array_equal(frame, expected)
        lost = sum(frame is None for frame in read)
        if name != "movie.avi":  # its frames cannot be numbered once one is lost
            assert lost <= 16
            assert first == 30 or lost > 0


def test_movies_above_one_khz_are_entered_anywhere(tmp_path):
    """Matroska counts milliseconds: seven frames share a stamp, and still every one is found."""
    path = tmp_path / "movie.mkv"
    write_ffv1(path, smooth(), 7000.0)
    movie = open_movie(path)
    for number in range(40):
        assert np.array_equal(movie.sample([number])[0], smooth()[number])
        assert np.array_equal(next(movie.frames(number)), smooth()[number])


def packets(order: str) -> list[Packet]:
    """Letters are key frames (capital) or not, in the order of decoding; their place in the alphabet is the stamp."""
    return [Packet(ord(letter.lower()) - ord("a"), None, letter.isupper()) for letter in order]


@pytest.mark.parametrize(
    ("order", "damaged", "spoilt"),
    [
        ("AbcDef", "b", "bc"),
        ("AbcDef", "d", "def"),
        ("AdbcEhfg", "d", "dbc"),
        ("AdbcEhfg", "b", "bc"),
        ("AdbcGefjhi", "d", "dbcef"),  # e and f are shown before the key frame G and lean on d as well
        ("ABCD", "b", "b"),
    ],
)
def test_frames_after_a_damaged_one_are_spoilt_up_to_the_next_key_frame(order, damaged, spoilt):
    index = index_packets(packets(order), guessed=False)
    numbers = {ord(letter) - ord("a") for letter in spoilt}
    assert set(index.spoilt_by(ord(damaged) - ord("a"))) == numbers


@pytest.mark.parametrize(
    ("stamps", "step", "numbers"),
    [
        ([0, 2, 3, 5, 7, 8], "5/3", [0, 1, 2, 3, 4, 5]),  # 600 Hz in whole ms
        ([0, 2, 7, 8], "5/3", [0, 1, 4, 5]),  # two were lost
        ([0, 40, 80, 160], "20", [0, 1, 2, 4]),  # a header that counts fields
        ([0, 40, 95, 160], "40", [0, 1, 2, 3]),  # stamps that keep to no step only count
        ([5, 45, 10**9], "40", [0, 1, 2]),  # too many to be lost
    ],
)
def test_gaps_in_even_stamps_are_lost_frames(stamps, step, numbers):
    index = index_packets([Packet(stamp, stamp, True) for stamp in stamps], guessed=False, step=Fraction(step))
    assert [index.number(stamp, None) for stamp in stamps] == numbers
    assert index.count == numbers[-1] + 1
    assert index.missing == sorted(set(range(index.count)) - set(numbers))
    assert [index.key_before(number)[1] for number in numbers] == stamps
