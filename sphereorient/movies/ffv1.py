"""FFV1: check sums of its slices, and separate decoding of the requested slices (RFC 9043)."""

import threading
import zlib
from collections.abc import Sequence
from concurrent.futures import Executor, Future
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import av
import numpy as np

from sphereorient.files.picture import OnDemand
from sphereorient.movies.movie import Grey

TRAILER = 8  # bytes after each slice: 3 its size, 1 a status, 4 the check sum
# FFV1 computes its CRC from the most significant bit on, zlib from the least: they agree on bit-reversed bytes.
REVERSED_BITS = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
INVERTED = 0xFFFFFFFF  # zlib inverts check sums before and after
MOST = 9  # bits of a number's exponent with their own state
STUB = 14  # bytes of a slice outside the picture


def split_slices(packet: bytes) -> list[bytes] | None:
    """Return the slices of an FFV1 packet, trailers included; None if sizes or check sums are wrong, which the decoder
    only logs. Source: RFC 9043, 4.9 and 4.9.3.
    """
    slices: list[bytes] = []
    end = len(packet)
    while end > 0:
        first = end - TRAILER - int.from_bytes(packet[end - TRAILER : end - TRAILER + 3], "big")
        if end < TRAILER or first < 0:
            return None
        slices.append(packet[first:end])
        if _crc(slices[-1]) != 0:  # the CRC of a slice with its sum is 0
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
        """Return whether the rectangles have a pixel in common."""
        across = self.left < other.right and other.left < self.right
        return across and self.top < other.bottom and other.top < self.bottom


class SliceDecoder:
    """Decodes some slices of the packets of a stream of key frames only; any thread may call it."""

    def __init__(self, context: av.VideoCodecContext, values: Any) -> None:
        self.shape, self.pixels = (context.height, context.width), context.pix_fmt
        self._record, self._values = bytes(context.extradata or b""), values
        self._own = threading.local()  # one decoder per thread
        self.dtype: np.dtype[Any] = np.dtype(np.uint8)
        self.places: tuple[Rectangle, ...] = ()

    def matches(self, packet: bytes, picture: Grey) -> bool:
        """Find the positions of the slices from one packet and its picture (H, W): on a grid, row by row, each slice
        alone gives its part of the picture and nothing else. Return False if no grid fits, or the picture is too dark
        for the test: then whole frames must be decoded.
        """
        slices = split_slices(packet)
        if slices is None or len(slices) < 2:
            return False
        self.dtype, count = picture.dtype, len(slices)
        grids = [_grid(self.shape, rows, count // rows) for rows in range(1, count + 1) if count % rows == 0]
        for number in range(count):
            self._own = threading.local()  # a new decoder leaves 0 beside its slice
            alone = self.decoded(slices, {number})
            grids = [] if alone is None else [one for one in grids if _holds(alone, picture, one[number])]
        if len(grids) != 1:
            return False
        (self.places,) = grids
        return True

    def decode(self, slices: Sequence[bytes], numbers: Sequence[int], into: Grey) -> None:
        """Decode slices of a packet, by number, into their parts of a picture (H, W)."""
        whole = self.decoded(slices, set(numbers))
        if whole is not None:  # else 0: no sphere
            for number in numbers:
                into[_pixels(self.places[number])] = whole[_pixels(self.places[number])]

    def decoded(self, slices: Sequence[bytes], wanted: set[int]) -> Grey | None:
        """Return a picture (H, W) with only these slices decoded; None if that fails."""
        some = [content if k in wanted else stub_slice(k == 0) for k, content in enumerate(slices)]
        frames = self._context.decode(av.Packet(b"".join(some)))
        if len(frames) != 1 or (frames[0].height, frames[0].width) != self.shape:
            return None
        found: Grey = self._values(frames[0])
        return found

    @property
    def _context(self) -> av.VideoCodecContext:
        context: av.VideoCodecContext | None = getattr(self._own, "context", None)
        if context is None:
            context = self._own.context = av.VideoCodecContext.create("ffv1", "r")
            context.extradata, context.pix_fmt = self._record, self.pixels
            context.height, context.width = self.shape
            context.thread_count = 1
        return context


def _grid(shape: tuple[int, int], rows: int, columns: int) -> tuple[Rectangle, ...]:
    """Return the slices of a grid, row by row. Source: RFC 9043, 4.6."""
    down, across = ([k * size // n for k in range(n + 1)] for size, n in zip(shape, (rows, columns), strict=True))
    return tuple(
        Rectangle(left, top, right, bottom) for top, bottom in pairwise(down) for left, right in pairwise(across)
    )


def _holds(alone: Grey, picture: Grey, place: Rectangle) -> bool:
    """Return whether a picture shows one part of another, and 0 elsewhere."""
    part = _pixels(place)
    return np.array_equal(alone[part], picture[part]) and np.count_nonzero(alone) == np.count_nonzero(alone[part])


def _pixels(place: Rectangle) -> tuple[slice, slice]:
    return slice(place.top, place.bottom), slice(place.left, place.right)


class SlicedPicture(OnDemand):
    """Picture whose slices are decoded when a part in them is requested, in another thread of `pool`."""

    def __init__(self, decoder: SliceDecoder, slices: Sequence[bytes], pool: Executor) -> None:
        self.shape = decoder.shape
        self._decoder, self._slices, self._pool = decoder, slices, pool
        self._asked: dict[int, Future[None]] = {}  # by number of the slice
        self.following: SlicedPicture | None = None  # the same parts of the next picture are decoded ahead

    @cached_property
    def _pixels(self) -> Grey:
        return np.zeros(self._decoder.shape, self._decoder.dtype)

    def equals(self, other: object) -> bool:
        """Return whether the slices are the same; independent frames have no other content."""
        return isinstance(other, SlicedPicture) and self._slices == other._slices

    def ask(self, left: int, top: int, right: int, bottom: int) -> None:
        """Start to decode a part, right and bottom included, of this picture and the next one."""
        wanted = Rectangle(left, top, right + 1, bottom + 1)
        self._ask(wanted)
        if self.following is not None:
            self.following._ask(wanted)

    def _ask(self, wanted: Rectangle) -> None:
        missing = [k for k, place in enumerate(self._decoder.places) if k not in self._asked and place.meets(wanted)]
        if missing:
            try:
                work = self._pool.submit(self._decoder.decode, self._slices, missing, self._pixels)
            except RuntimeError:  # the pool is closed, the picture is still used
                self._decoder.decode(self._slices, missing, self._pixels)
                work = Future()
                work.set_result(None)
            self._asked |= dict.fromkeys(missing, work)

    def part(self, left: int, top: int, right: int, bottom: int) -> Grey:
        """Return the picture (H, W), decoded at least in this part, right and bottom included."""
        wanted = Rectangle(left, top, right + 1, bottom + 1)
        self._ask(wanted)
        for work in {self._asked[k] for k, place in enumerate(self._decoder.places) if place.meets(wanted)}:
            work.result()
        return self._pixels


@lru_cache(maxsize=2)
def stub_slice(first: bool) -> bytes:
    """Return a slice outside every picture, which the decoder skips at once.
    All of its bits have probability one half: whether it is a key frame, if `first`, and a column beyond 1023.
    """
    ones = [True] * first + [False] + [True] * (MOST + 1)  # not 0, then as many ones as its logarithm
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
