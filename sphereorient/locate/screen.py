"""Pictures that cannot show the ball, whatever is in front of the camera: told before anyone looks for it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sphereorient.experiment.stream import EVERY, CameraStream, uniform
from sphereorient.locate.background import Background
from sphereorient.trajectory import Reason

Picture = NDArray[Any]

LIT_NOISES = 10.0  # a pixel of the empty scene that is lit stands this many noises above black
LIT_SHARE = 0.1  # of the pixels; a scene that is darker does not tell a lamp that failed
DARK_LEVEL = 0.3  # of the empty scene's grey level: darker is unlit
DARK_SHARE = 0.95  # of the lit pixels
WHITE_SHARE = 0.5  # of all pixels; no ball is read in front of such a glare


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot:
    """What one camera has of one instant; made by the pipeline, read by the tracker."""

    picture: Picture  # (H, W); zeros where there is none
    reason: Reason = Reason.OK  # why it cannot be used

    @property
    def usable(self) -> bool:
        """Whether the picture may show the ball."""
        return self.reason is Reason.OK


def screened(picture: Picture, before: Picture | None, background: Background) -> Shot:
    """Tell whether a picture may show the ball.

    Args:
        picture: (H, W), grey levels.
        before: (H, W), the same movie's last picture before, None where there is none.
        background: of the same movie.

    Returns:
        The picture with `DARK` (black, or a lit scene without light), `SATURATED` (white), `REPEATED` (the one before
        once more: noise never repeats), or `OK`.
    """
    some = picture[::EVERY, ::EVERY]
    empty = background.mean[::EVERY, ::EVERY]
    if uniform(picture):
        return Shot(picture=picture, reason=_uniform_reason(float(some[0, 0]), background))
    if np.mean(some >= background.full_scale) > max(WHITE_SHARE, 2 * float(np.mean(empty >= background.full_scale))):
        return Shot(picture=picture, reason=Reason.SATURATED)
    lit = empty > LIT_NOISES * background.typical_noise
    if lit.mean() > LIT_SHARE and np.mean(some[lit] < DARK_LEVEL * empty[lit]) > DARK_SHARE:
        return Shot(picture=picture, reason=Reason.DARK)
    if before is not None and np.array_equal(some, before[::EVERY, ::EVERY]) and np.array_equal(picture, before):
        return Shot(picture=picture, reason=Reason.REPEATED)
    return Shot(picture=picture)


def _uniform_reason(level: float, background: Background) -> Reason:
    return Reason.SATURATED if level > 0.5 * background.full_scale else Reason.DARK


def screened_frames(
    stream: CameraStream, background: Background, first: int = 0, last: int | None = None
) -> Iterator[Shot]:
    """Yield one camera's pictures of frames first .. last - 1, those that cannot show the ball marked.

    What is marked of a frame depends on it and the one before alone, whichever frame is the first.

    Args:
        stream: of the camera.
        background: of the same movie.
        first: counted from the first frame that is used.
        last: + 1; None: to the end.
    """
    lead = min(first, 1)
    blank = np.zeros(stream.movie.frame_shape, stream.movie.dtype)
    before: Picture | None = None
    for k, (picture, reason) in enumerate(stream.pictures(first - lead, last)):
        if k >= lead:
            yield Shot(picture=blank, reason=reason) if picture is None else screened(picture, before, background)
        before = picture
