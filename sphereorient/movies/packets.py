"""The packet table of a video: frame numbers and dependencies, found without decoding."""

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from itertools import pairwise
from math import gcd
from typing import NamedTuple

MOST_MISSING = 10  # times the packets in the file: with more missing, the time stamps are not evenly spaced
OFF_GRID = 0.45  # of the frame period: a larger deviation means unevenly spaced frames


class Packet(NamedTuple):
    """The container's entries for one packet."""

    pts: int | None  # presentation stamp
    dts: int | None  # decoding stamp
    key: bool
    pos: int | None = None  # byte offset in the file


@dataclass(frozen=True)
class PacketIndex:
    """Number of frames, their packets, and where decoding may start."""

    count: int  # frames, including those without a packet
    by_place: bool = False  # keys of `number_of` are byte offsets, else presentation stamps
    number_of: dict[int, int] | None = None  # stamp or offset -> frame number; None: frames can only be counted
    keys: tuple[tuple[int, int], ...] = ((0, 0),)  # (frame number, stamp to seek to) of key frames, increasing
    order: tuple[int, ...] = ()  # frame numbers in decoding order
    groups: tuple[int, ...] = ()  # indices into `order` of key frames that begin a group

    @property
    def each_alone(self) -> bool:
        """Whether every frame is a key frame."""
        return len(self.groups) == len(self.order)

    @property
    def missing(self) -> list[int]:
        """Frames without a packet, by the time stamps."""
        return sorted(set(range(self.count)) - set(self.order)) if len(self.order) not in (0, self.count) else []

    def number(self, pts: int | None, pos: int | None) -> int | None:
        """Return the frame number of a packet, None if unknown."""
        mark = pos if self.by_place else pts
        return None if mark is None or self.number_of is None else self.number_of.get(mark)

    def key_before(self, number: int) -> tuple[int, int]:
        """Return number and stamp of the last key frame at or before frame `number`."""
        return self.keys[max(bisect_right(self.keys, number, key=lambda key: key[0]) - 1, 0)]

    def runs(self, numbers: Sequence[int]) -> list[list[int]]:
        """Split increasing frame numbers at gaps with a key frame, where a seek saves decoding."""
        runs: list[list[int]] = []
        for number in numbers:
            if runs and self.key_before(number)[0] <= runs[-1][-1] + 1:
                runs[-1].append(number)
            else:
                runs.append([number])
        return runs

    def spoilt_by(self, number: int) -> Sequence[int]:
        """Return the frames that damage in frame `number` may affect, itself included; all later ones if unknown."""
        if not self.order:
            return range(number, self.count)
        if self.each_alone or number not in self.order:
            return (number,)
        place, end = self.order.index(number), len(self.order)
        ends = [*self.groups[bisect_right(self.groups, place) :], end, end][:2]
        following = self.order[ends[0] : ends[1]]
        return (*self.order[place : ends[0]], *(leading for leading in following[1:] if leading < following[0]))


def index_packets(packets: list[Packet], guessed: bool, step: Fraction | None = None) -> PacketIndex:
    """Number packets, in file order, by their time stamps, or by byte offsets if stamps are ambiguous or `guessed`.
    A gap between stamps spaced by `step` (frame period by the header, in stamp units) is a lost frame.
    """
    stamps = sorted({packet.pts for packet in packets if packet.pts is not None})
    if not guessed and len(stamps) == len(packets):
        return _by_stamps(packets, stamps, step)
    places = [packet.pos for packet in packets if packet.pos is not None and packet.pos >= 0]
    if all(packet.key for packet in packets) and len(set(places)) == len(packets):
        return _by_places(packets, places)
    return PacketIndex(count=len(packets))


def _by_stamps(packets: list[Packet], stamps: list[int], step: Fraction | None) -> PacketIndex:
    numbers = (_on_grid(stamps, step) if step and stamps else None) or range(len(stamps))
    number_of = dict(zip(stamps, numbers, strict=True))
    order = tuple(number_of[packet.pts] for packet in packets if packet.pts is not None)
    # Containers search by either stamp: a seek to the decoding stamp ends at the key frame or before it.
    keys = sorted(
        (number, packet.pts if packet.dts is None else packet.dts)
        for number, packet in zip(order, packets, strict=True)
        if packet.key and packet.pts is not None
    )
    groups = tuple(place for place, packet in enumerate(packets) if packet.key)
    return PacketIndex(max(order, default=-1) + 1, False, number_of, tuple(keys) or ((0, 0),), order, groups)


def _on_grid(stamps: list[int], step: Fraction) -> list[int] | None:
    """Return the frame numbers of increasing stamps, None if they are not evenly spaced."""
    numbers = [round((stamp - stamps[0]) / step) for stamp in stamps]
    off = max(abs(stamp - stamps[0] - number * step) for stamp, number in zip(stamps, numbers, strict=True))
    if off > min(1, OFF_GRID * step) or numbers[-1] > MOST_MISSING * len(stamps) or len(set(numbers)) < len(stamps):
        return None
    every = reduce(gcd, numbers, 0) or 1  # headers that count fields state two per frame
    return [number // every for number in numbers]


def _by_places(packets: list[Packet], places: list[int]) -> PacketIndex:
    """Number key frames in file order; MKV has stamps in whole ms, which repeat above 1 kHz."""
    every = tuple(range(len(packets)))
    # A seek finds any packet of a repeated stamp: seek to the stamp before.
    keys = [(0, 0)]
    for number, (before, here) in enumerate(pairwise(packets), start=1):
        if before.pts is not None and here.pts is not None and before.pts < here.pts:
            keys.append((number, before.pts))
    number_of = {place: number for number, place in enumerate(places)}
    return PacketIndex(len(packets), True, number_of, tuple(keys), every, every)
