"""How large a picture claims to be, by its first bytes, before anything is allocated for it."""

from __future__ import annotations

import re

PNG, BMP, JPEG = b"\x89PNG\r\n\x1a\n", b"BM", b"\xff\xd8"
FRAME_MARKERS = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # markers of JPEG that carry the size


def claimed_bytes(content: bytes) -> int:
    """Return the pixels that a picture claims to have, in bytes of 8-bit grey; 0 where its format is not known.

    Args:
        content: the file: PNG, BMP, JPEG or PNM.
    """
    if content.startswith(PNG):
        return int.from_bytes(content[16:20], "big") * int.from_bytes(content[20:24], "big")
    if content.startswith(BMP):
        width = int.from_bytes(content[18:22], "little", signed=True)
        height = int.from_bytes(content[22:26], "little", signed=True)
        return abs(width * height)
    if content.startswith(JPEG):
        return _jpeg(content)
    numbers = re.match(rb"P[1-7]\s+(?:#[^\n]*\n\s*)*(\d{1,10})\s+(\d{1,10})", content[:4096])
    return int(numbers[1]) * int(numbers[2]) if numbers else 0


def _jpeg(content: bytes) -> int:
    at = 2
    while at + 9 <= len(content) and content[at] == 0xFF:
        if content[at + 1] in FRAME_MARKERS:
            return int.from_bytes(content[at + 5 : at + 7], "big") * int.from_bytes(content[at + 7 : at + 9], "big")
        at += 2 + max(2, int.from_bytes(content[at + 2 : at + 4], "big"))
    return 0
