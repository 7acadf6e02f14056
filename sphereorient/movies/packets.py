"""The table of a movie's packets: which frame is where, found without decoding."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

Packet = tuple[int | None, int | None, bool]  # presentation stamp, decoding stamp, whether a key frame


@dataclass(frozen=True)
class PacketIndex:
    """What demuxing alone tells: how many frames there are and where decoding may start."""

    count: int
    number_of: dict[int, int]  # presentation time stamp -> frame number; empty where stamps do not tell
    keys: tuple[tuple[int, int], ...]  # (frame number, stamp to seek to) of the key frames, increasing

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


def index_packets(packets: list[Packet], guessed: bool) -> PacketIndex:
    """Number the packets of a movie by their time stamps, if those are all there, differ, and are not guessed.

    Args:
        packets: in the order of the file.
        guessed: whether the presentation stamps are not the file's own.
    """
    stamps = sorted({pts for pts, _, _ in packets if pts is not None})
    if guessed or len(stamps) < len(packets):  # MKV counts whole ms, so above 1 kHz stamps repeat
        return PacketIndex(count=len(packets), number_of={}, keys=((0, 0),))
    number_of = {stamp: number for number, stamp in enumerate(stamps)}
    # Seeking to the decoding stamp lands on the key frame or before it, whichever of the two a container searches.
    keys = sorted((number_of[pts], pts if dts is None else dts) for pts, dts, key in packets if key and pts is not None)
    return PacketIndex(count=len(packets), number_of=number_of, keys=tuple(keys) or ((0, 0),))
