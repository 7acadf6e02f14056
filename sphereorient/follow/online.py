"""Poses of frames as they come: each from those before it."""

import math
from collections.abc import Sequence

from sphereorient.follow.appearance import Appearance
from sphereorient.follow.ball import BallTracker
from sphereorient.follow.chunk import Chunk
from sphereorient.follow.poses import Poses
from sphereorient.locate import Frame


class OnlineTracker:
    """Follows frames one after the other, none ahead: each from those before it, else from a search without history.
    `tracker` has one chunk at a time (setting `refine.chunks`). Memory does not grow.
    """

    number = 1  # of the map in use; 0: none yet

    def __init__(self, tracker: BallTracker, appearance: Appearance) -> None:
        self.appearance = appearance
        self._tracker = tracker
        self._time_s: dict[int, float] = {}  # of the last frames
        self._chunk = Chunk(0, 0, self._time_s)
        self._number = 0
        self._last: Poses | None = None  # of the last frame, before it is remembered

    def resume(self, seen: Sequence[tuple[float, Poses]]) -> None:
        """Take the poses of the last frames, with their times, s, from who followed the ball before."""
        for time_s, poses in seen:
            self._time_s[self._number] = time_s
            self._last = poses
            self.between()

    def followed(self, time_s: float, shots: Sequence[Frame]) -> Poses | None:
        """Return the poses of the frame of a time as the frames before predict them; None where they say nothing of it,
        or another thing. `shots`: a frame of each view. Where time does not go on, nothing is known from before.
        """
        self.between()
        if not time_s > self._time_s.get(self._number - 1, -math.inf):
            self._chunk.forget()
        self._time_s[self._number] = time_s
        tracker, ahead = self._tracker, self._tracker.ahead(self._chunk, self._number)
        (followed,) = [None] if ahead is None else tracker.follow([ahead], [shots])
        if followed is None:
            return None
        self._last = tracker.stated(followed)
        return self._last

    def next(self, time_s: float, shots: Sequence[Frame]) -> tuple[Poses, bool]:
        """Return the poses of the frame of a time, and whether they were searched for; see `followed`."""
        followed = self.followed(time_s, shots)
        if followed is not None:
            return followed, False
        poses = self._tracker.stated(self._tracker.searched(shots))
        self._chunk.forget()  # what was before says nothing of the motion from here
        self._last = poses
        return poses, True

    def between(self) -> None:
        """Remember the last frame: what can wait until it was told."""
        if self._last is not None:
            turn = self._tracker.turns([self._chunk], [self._last])[0]
            self._chunk.saw(self._number, self._last, turn)
            self._number += 1
            self._time_s.pop(self._number - 4, None)
            self._last = None
