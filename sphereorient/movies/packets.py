"""The table of a movie's packets: which frame is where, and what hangs on what, found without decoding."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple


class Packet(NamedTuple):
    """What demuxing tells of one packet."""

    pts: int | None  # presentation stamp
    dts: int | None  # decoding stamp
    key: bool
    pos: int | None = None  # its place in the file, bytes


@dataclass(frozen=True)
class PacketIndex:
    """What demuxing alone tells: how many frames there are, their numbers, and where decoding may start."""

    count: int
    by_place: bool  # whether `number_of` takes the packets' places in the file, else their presentation stamps
    number_of: dict[int, int]  # stamp or place -> frame number; empty where neither tells
    keys: tuple[tuple[int, int], ...]  # (frame number, stamp to seek to) of the key frames, increasing
    order: tuple[int, ...] = ()  # frame numbers in the order of decoding
    groups: tuple[int, ...] = ()  # places in `order` where a key frame begins a group

    @property
    def each_alone(self) -> bool:
        """Whether every frame is a key frame, predicted from no other."""
        return len(self.groups) == self.count

    def number(self, pts: int | None, pos: int | None) -> int | None:
        """Return the frame number of a packet, None where the table does not tell."""
        mark = pos if self.by_place else pts
        return None if mark is None else self.number_of.get(mark)

    def key_before(self, number: int) -> tuple[int, int]:
        """Return number and stamp of the last key frame at or before frame `number`."""
        return self.keys[max(bisect_right(self.keys, number, key=lambda key: key[0]) - 1, 0)]

    def runs(self, numbers: list[int]) -> list[list[int]]:
        """Cut increasing frame numbers where a seek saves decoding: where a key frame lies in a gap."""
        runs: list[list[int]] = []
        for number in numbers:
            if runs and self.key_before(number)[0] <= runs[-1][-1] + 1:
                runs[-1].append(number)
            else:
                runs.append([number])
        return runs

    def spoilt_by(self, number: int) -> Sequence[int]:
        """Return the frames that cannot be trusted once frame `number` is damaged, itself among them.

        Those are the ones decoded after it up to the next key frame, and those decoded after that key frame but shown
        before it, which lean on both sides. Where frames have no numbers, all that follow.
        """
        if not self.order:
            return range(number, self.count)
        if self.each_alone:
            return (number,)
        place = self.order.index(number)
        ends = [*self.groups[bisect_right(self.groups, place) :], self.count, self.count][:2]
        following = self.order[ends[0] : ends[1]]
        return (*self.order[place : ends[0]], *(leading for leading in following[1:] if leading < following[0]))


def index_packets(packets: list[Packet], guessed: bool) -> PacketIndex:
    """Number the packets of a movie by their time stamps, or by their place in the file where stamps do not tell.

    Args:
        packets: in the order of the file.
        guessed: whether the presentation stamps are not the file's own.
    """
    stamps = sorted({packet.pts for packet in packets if packet.pts is not None})
    if not guessed and len(stamps) == len(packets):
        return _by_stamps(packets, stamps)
    places = [packet.pos for packet in packets if packet.pos is not None and packet.pos >= 0]
    if all(packet.key for packet in packets) and len(set(places)) == len(packets):
        return _by_places(packets, places)
    return PacketIndex(count=len(packets), by_place=False, number_of={}, keys=((0, 0),))


def _by_stamps(packets: list[Packet], stamps: list[int]) -> PacketIndex:
    number_of = {stamp: number for number, stamp in enumerate(stamps)}
    order = tuple(number_of[packet.pts] for packet in packets if packet.pts is not None)
    # Seeking to the decoding stamp lands on the key frame or before it, whichever of the two a container searches.
    keys = sorted(
        (number, stamps[number] if packet.dts is None else packet.dts)
        for number, packet in zip(order, packets, strict=True)
        if packet.key
    )
    groups = tuple(place for place, packet in enumerate(packets) if packet.key)
    return PacketIndex(len(packets), False, number_of, tuple(keys) or ((0, 0),), order, groups)


def _by_places(packets: list[Packet], places: list[int]) -> PacketIndex:
    """Number frames that are all key frames as they come: MKV counts whole ms, so above 1 kHz stamps repeat."""
    every = tuple(range(len(packets)))
    # Which of the packets of one stamp a seek finds is not told: to be before them, seek to the stamp before.
    keys = [(0, 0)]
    for number, (before, here) in enumerate(pairwise(packets), start=1):
        if before.pts is not None and here.pts is not None and before.pts < here.pts:
            keys.append((number, before.pts))
    number_of = {place: number for number, place in enumerate(places)}
    return PacketIndex(len(packets), True, number_of, tuple(keys), every, every)
