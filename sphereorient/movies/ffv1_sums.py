"""Check sums of FFV1: FFmpeg's decoder only logs where one is wrong, and hands out a picture all the same."""

from __future__ import annotations

import zlib

TRAILER = 8  # bytes after each slice: 3 its size, 1 a status, 4 the check sum
# The sum runs from the most significant bit on, zlib's from the least: on bytes turned round they are one.
TURNED_ROUND = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
INVERTED = 0xFFFFFFFF  # zlib inverts sums before and after


def sums_are_right(packet: bytes) -> bool:
    """Return whether a packet consists of slices whose check sums are all there and right.

    Args:
        packet: of FFV1 version 3 or later. One without check sums does not pass.

    Source: RFC 9043, sections 4.9 and 4.9.3.
    """
    end = len(packet)
    while end > 0:
        first = end - TRAILER - int.from_bytes(packet[end - TRAILER : end - TRAILER + 3], "big")
        if end < TRAILER or first < 0:
            return False
        turned = packet[first:end].translate(TURNED_ROUND)
        if zlib.crc32(turned, INVERTED) ^ INVERTED != 0:  # over a slice and its own sum it comes out as 0
            return False
        end = first
    return bool(packet)
