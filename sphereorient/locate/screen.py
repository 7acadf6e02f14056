"""Screening of frames: unreadable, dark, saturated or repeated pictures."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.experiment.stream import EVERY, CameraStream, uniform
from sphereorient.locate.background import Background
from sphereorient.trajectory import Reason

Picture = NDArray[Any]

LIT_NOISES = 10.0  # a lit background pixel is this many noise sigmas above black
LIT_SHARE = 0.1  # least share of lit pixels; in a darker scene a failed lamp is invisible
DARK_LEVEL = 0.3  # darker than this share of the background is unlit
DARK_SHARE = 0.95  # share of the lit pixels
WHITE_SHARE = 0.5  # share of all pixels


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """Picture of one camera at one instant; made by `screened_frames`."""

    picture: Picture  # (H, W); zeros if missing
    reason: Reason = Reason.OK  # OK, or why it cannot be used

    @property
    def usable(self) -> bool:
        """Whether the picture may show the sphere."""
        return self.reason is Reason.OK


def screened(picture: Picture, before: Picture | None, background: Background) -> Frame:
    """Return the picture (H, W) with `OK`, `DARK` (no light), `SATURATED` (white) or `REPEATED` (equal to `before`)."""
    some = picture[::EVERY, ::EVERY]
    empty = background.mean[::EVERY, ::EVERY]
    if uniform(picture):
        white = float(some[0, 0]) > 0.5 * background.full_scale
        return Frame(picture=picture, reason=Reason.SATURATED if white else Reason.DARK)
    if np.mean(some >= background.full_scale) > max(WHITE_SHARE, 2 * float(np.mean(empty >= background.full_scale))):
        return Frame(picture=picture, reason=Reason.SATURATED)
    lit = empty > LIT_NOISES * background.typical_noise
    if lit.mean() > LIT_SHARE and np.mean(some[lit] < DARK_LEVEL * empty[lit]) > DARK_SHARE:
        return Frame(picture=picture, reason=Reason.DARK)
    if before is not None and np.array_equal(some, before[::EVERY, ::EVERY]) and np.array_equal(picture, before):
        return Frame(picture=picture, reason=Reason.REPEATED)
    return Frame(picture=picture)


def screened_frames(
    stream: CameraStream, background: Background, first: int = 0, last: int | None = None
) -> Iterator[Frame]:
    """Yield frames first .. last - 1 from the first in use; reasons depend on this and the previous frame only."""
    lead = min(first, 1)
    blank = np.zeros(stream.movie.frame_shape, stream.movie.dtype)
    before: Picture | None = None
    for k, (picture, reason) in enumerate(stream.pictures(first - lead, last)):
        if k >= lead:
            yield Frame(picture=blank, reason=reason) if picture is None else screened(picture, before, background)
        before = picture
