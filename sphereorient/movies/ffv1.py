"""FFV1: check sums of its slices, and slices decoded alone, those that hold what is asked for (RFC 9043)."""

import threading
import zlib
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import av
import numpy as np

from sphereorient.movies.movie import Grey, OnDemand

TRAILER = 8  # bytes after each slice: 3 its size, 1 a status, 4 the check sum
# FFV1 computes its CRC from the most significant bit on, zlib from the least: they agree on bit-reversed bytes.
REVERSED_BITS = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
INVERTED = 0xFFFFFFFF  # zlib inverts check sums before and after
VERSION = 3
FRESH = 128  # state of the range coder that nothing has been coded with: a probability of one half
STATES = 32  # of the numbers in a header
EXPONENT, MANTISSA, SIGN, MOST = 1, 22, 11, 9  # first states of a number's parts, and the last exponent of its own
TABLES = 2  # coder type from which the header holds a table of transitions
STUB = 14  # bytes of a slice that says it lies outside of the picture


def split_slices(packet: bytes) -> list[bytes] | None:
    """Return the slices of an FFV1 packet, trailers included; None where sizes or check sums are wrong.
    The decoder only logs a wrong one. Source: RFC 9043, 4.9 and 4.9.3.
    """
    slices: list[bytes] = []
    end = len(packet)
    while end > 0:
        first = end - TRAILER - int.from_bytes(packet[end - TRAILER : end - TRAILER + 3], "big")
        if end < TRAILER or first < 0:
            return None
        slices.append(packet[first:end])
        if _crc(slices[-1]) != 0:  # 0 for a slice followed by its own sum
            return None
        end = first
    return slices[::-1] or None


def _crc(content: bytes) -> int:
    return zlib.crc32(content.translate(REVERSED_BITS), INVERTED) ^ INVERTED


class Rectangle(NamedTuple):
    """Part of a picture, px; right and bottom are the first column and row beyond."""

    left: int
    top: int
    right: int
    bottom: int

    def meets(self, other: "Rectangle") -> bool:
        """Return whether they share a pixel."""
        across = self.left < other.right and other.left < self.right
        return across and self.top < other.bottom and other.top < self.bottom


class SliceDecoder:
    """Decodes some slices of the packets of a stream whose frames are all key frames; any thread may call it."""

    def __init__(self, context: av.VideoCodecContext, values: Any) -> None:
        self.shape, self.pixels = (context.height, context.width), context.pix_fmt
        self._record, self._values = bytes(context.extradata or b""), values
        self._own = threading.local()  # a decoder for each thread
        self.dtype: np.dtype[Any] = np.dtype(np.uint8)
        self.places: tuple[Rectangle, ...] = ()

    def matches(self, packet: bytes, picture: Grey) -> bool:
        """Learn from one packet and its picture (H, W) where slices lie; return whether each one alone gives its part.
        Where it does not, this stream or this decoder must decode whole frames.
        """
        slices = split_slices(packet)
        header = _header(self._record)
        if slices is None or header is None or len(slices) < 2:
            return False
        self.dtype = picture.dtype
        columns, rows = (
            [k * size // count for k in range(count + 1)]
            for size, count in zip(self.shape[::-1], (header.columns, header.rows), strict=True)
        )
        places = [
            _slice_at(content, first=number == 0, transitions=header.transitions)
            for number, content in enumerate(slices)
        ]
        cells = [(across, down) for down in range(header.rows) for across in range(header.columns)]
        if sorted(places) != sorted((*cell, 0, 0) for cell in cells):
            return False
        self.places = tuple(
            Rectangle(columns[across], rows[down], columns[across + 1], rows[down + 1]) for across, down, *_ in places
        )
        for number, place in enumerate(self.places):
            part = np.zeros(self.shape, self.dtype)
            self.decode(slices, [number], part)
            if not np.array_equal(part[_pixels(place)], picture[_pixels(place)]):
                return False
        return True

    def decode(self, slices: Sequence[bytes], numbers: Sequence[int], into: Grey) -> None:
        """Decode slices of a packet, by number, into their places of a picture (H, W)."""
        wanted = set(numbers)
        some = [content if k in wanted else _stub(k == 0) for k, content in enumerate(slices)]
        frames = self._context.decode(av.Packet(b"".join(some)))
        if len(frames) != 1 or (frames[0].height, frames[0].width) != self.shape:
            return  # 0 shows no sphere
        whole = self._values(frames[0])
        for number in wanted:
            into[_pixels(self.places[number])] = whole[_pixels(self.places[number])]

    @property
    def _context(self) -> av.VideoCodecContext:
        context: av.VideoCodecContext | None = getattr(self._own, "context", None)
        if context is None:
            context = self._own.context = av.VideoCodecContext.create("ffv1", "r")
            context.extradata, context.pix_fmt = self._record, self.pixels
            context.height, context.width = self.shape
            context.thread_count = 1
        return context


def _pixels(place: Rectangle) -> tuple[slice, slice]:
    return slice(place.top, place.bottom), slice(place.left, place.right)


class SlicedPicture(OnDemand):
    """Picture of which slices are decoded when a part that they hold is asked for, in another thread of `pool`."""

    def __init__(self, decoder: SliceDecoder, slices: Sequence[bytes], pool: Executor) -> None:
        self.shape = decoder.shape
        self._decoder, self._slices, self._pool = decoder, slices, pool
        self._asked: dict[int, Future[None]] = {}  # by number of the slice
        self.following: SlicedPicture | None = None  # what is asked of this picture is decoded ahead of the next one

    @cached_property
    def _pixels(self) -> Grey:
        return np.zeros(self._decoder.shape, self._decoder.dtype)

    def equals(self, other: object) -> bool:
        """Return whether the slices are the same: a frame that stands alone has no other content."""
        return isinstance(other, SlicedPicture) and self._slices == other._slices

    def ask(self, left: int, top: int, right: int, bottom: int) -> None:
        """Begin to decode a part, right and bottom included, of this picture, and of the next one."""
        wanted = Rectangle(left, top, right + 1, bottom + 1)
        self._ask(wanted)
        if self.following is not None:
            self.following._ask(wanted)

    def _ask(self, wanted: Rectangle) -> None:
        missing = [k for k, place in enumerate(self._decoder.places) if k not in self._asked and place.meets(wanted)]
        if missing:
            try:
                work = self._pool.submit(self._decoder.decode, self._slices, missing, self._pixels)
            except RuntimeError:  # the pool is closed, the picture is not
                self._decoder.decode(self._slices, missing, self._pixels)
                work = Future()
                work.set_result(None)
            self._asked |= dict.fromkeys(missing, work)

    def part(self, left: int, top: int, right: int, bottom: int) -> Grey:
        """Return the picture (H, W), decoded at least where asked for, right and bottom included."""
        wanted = Rectangle(left, top, right + 1, bottom + 1)
        self._ask(wanted)
        for work in {self._asked[k] for k, place in enumerate(self._decoder.places) if place.meets(wanted)}:
            work.result()
        return self._pixels


@dataclass(frozen=True)
class _Header:
    """What the configuration record says that slices need."""

    transitions: tuple[int, ...]  # state after a one, by state
    columns: int  # of slices
    rows: int


def _header(record: bytes) -> _Header | None:
    """Read a configuration record; None for other versions and for more than grey. Source: RFC 9043, 4.2."""
    if len(record) < TRAILER:
        return None
    usual = _usual_transitions()
    coder, state = _RangeDecoder(record, usual), [FRESH] * STATES
    version, _, kind = (coder.number(state) for _ in range(3))
    transitions = usual
    if kind >= TABLES:
        transitions = (0, *((usual[k] + coder.signed(state)) & 0xFF for k in range(1, 256)))
    colours, _ = coder.number(state), coder.number(state)
    chroma = coder.bit(state, 0)
    coder.number(state), coder.number(state)  # how much coarser colours are
    alpha = coder.bit(state, 0)
    columns, rows = coder.number(state) + 1, coder.number(state) + 1
    if version != VERSION or colours or chroma or alpha:
        return None
    return _Header(transitions=transitions, columns=columns, rows=rows)


def _slice_at(content: bytes, first: bool, transitions: Sequence[int]) -> tuple[int, int, int, int]:
    """Return column, row, and how many more columns and rows a slice has, by its header. Source: RFC 9043, 4.6."""
    coder, state = _RangeDecoder(content, transitions), [FRESH] * STATES
    if first:
        coder.bit([FRESH], 0)  # a key frame
    return coder.number(state), coder.number(state), coder.number(state), coder.number(state)


@lru_cache(maxsize=2)
def _stub(first: bool) -> bytes:
    """Return a slice that says it lies outside of every picture, so that the decoder leaves it out at once.
    All of its bits have a probability of one half: whether it is a key frame, if `first`, and a column beyond 1023.
    """
    ones = [True] * first + [False] + [True] * (MOST + 1)  # not 0; as many more ones as its logarithm
    low, width, count = 0, 0xFF00, 2
    for one in ones:
        half = width >> 1
        width -= half
        if one:
            low, width = low + width, half
        if width < 0x100:
            low, width, count = low << 8, width << 8, count + 1
    content = low.to_bytes(count, "big").ljust(STUB, b"\xff") + STUB.to_bytes(3, "big") + b"\0"
    return content + _crc(content).to_bytes(4, "little").translate(REVERSED_BITS)


class _RangeDecoder:
    """Decodes bits of adaptive probability. Source: RFC 9043, 3.8.1."""

    def __init__(self, content: bytes, transitions: Sequence[int]) -> None:
        self._rest = iter(content[2:])
        self._low, self._width = int.from_bytes(content[:2], "big"), 0xFF00
        self._after_one = transitions

    def bit(self, state: list[int], k: int) -> bool:
        """Decode a bit by the state k, and change that."""
        part = (self._width * state[k]) >> 8
        self._width -= part
        one = self._low >= self._width
        if one:
            self._low, self._width = self._low - self._width, part
            state[k] = self._after_one[state[k]]
        else:
            state[k] = 256 - self._after_one[256 - state[k]]
        if self._width < 0x100:
            self._low, self._width = (self._low << 8) + next(self._rest, 0), self._width << 8
        return one

    def number(self, state: list[int]) -> int:
        """Decode a number that is not negative."""
        return self._magnitude(state)[0]

    def signed(self, state: list[int]) -> int:
        """Decode a number."""
        value, exponent = self._magnitude(state)
        return -value if value and self.bit(state, SIGN + min(exponent, MOST + 1)) else value

    def _magnitude(self, state: list[int]) -> tuple[int, int]:
        if self.bit(state, 0):
            return 0, 0
        exponent = 0
        while exponent < STATES and self.bit(state, EXPONENT + min(exponent, MOST)):
            exponent += 1
        value = 1
        for k in reversed(range(exponent)):
            value = 2 * value + self.bit(state, MANTISSA + min(k, MOST))
        return value, exponent


@lru_cache(maxsize=1)
def _usual_transitions() -> tuple[int, ...]:
    """Return the state after a one by state, where no table is given. Source: RFC 9043, 3.8.1.5, by its formula."""
    one, rate, most = 1 << 32, int(0.05 * (1 << 32)), 248
    after = [0] * 256
    chance = one // 2
    chain: list[int] = []
    for _ in range(128):
        chain.append(max((256 * chance + one // 2) >> 32, chain[-1] + 1 if chain else 0))
        chance += ((one - chance) * rate + one // 2) >> 32
    for state, following in pairwise(chain):
        if following <= most:
            after[state] = following
    for state in range(256 - most, most + 1):
        if not after[state]:
            chance = (state * one + 128) >> 8
            chance += ((one - chance) * rate + one // 2) >> 32
            after[state] = min(max((256 * chance + one // 2) >> 32, state + 1), most)
    return tuple(after)
