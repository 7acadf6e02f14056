"""No map at the start: orientations by a map that grows with each frame; meanwhile place and map are adjusted."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor

from torch import Tensor

from sphereorient.experiment.recording import TextureMap
from sphereorient.follow.appearance import Appearance
from sphereorient.locate import Frame
from sphereorient.mapping.disks import Crops
from sphereorient.mapping.first_pass import ADJUSTED_ERROR, TURNED_RAD, CoarserPictures, FirstPass, KeptFrames
from sphereorient.pose.camera_view import FIRST_BLUR_PX
from sphereorient.pose.fitter import first_fitter
from sphereorient.pose.lasting import Lasting
from sphereorient.pose.poses import Poses, supported

FIRST, MORE = 24, 1.5  # frames of the first adjustment, and by how many times more of the next one
SINCE = 16  # of the frames that came meanwhile, evenly spread, that are added to its map: it must not take long


class LearningTracker:
    """Follows a ball without a map: by one that grows with each frame. The body frame is the lab at the first one.
    Place and map are adjusted in a thread of its own. `number` is that of the map: another one after each adjustment.
    """

    def __init__(self, place: Crops) -> None:
        self.number = 1
        self._coarse = CoarserPictures.of(place)
        self._pass, self._kept = FirstPass(self._coarse.place), KeptFrames(self._coarse.place)
        self.appearance = _unknown(place, self._pass)
        self._now: tuple[Sequence[Frame], Poses] | None = None
        self._due = float(FIRST)
        self._aside = ThreadPoolExecutor(1, "adjustment")
        self._adjusting: tuple[KeptFrames, Future[tuple[Tensor, FirstPass]]] | None = None

    def next(self, time_s: float, shots: Sequence[Frame]) -> tuple[Poses, bool]:
        """Return the poses of a frame, and whether they were searched for; see `OnlineTracker`."""
        frames = self._coarse.frames(shots)
        poses, searched = self._pass.next(time_s, frames)
        self._now = (frames, poses) if supported(poses) else None
        return poses, searched

    def between(self) -> None:
        """Keep the frame, and go over to what was adjusted meanwhile."""
        if self._now is not None:
            self._kept.add(*self._now)
        if self._adjusting is not None and self._adjusting[1].done():
            R_lab_body, moved = self._adjusting[1].result()
            correction, since = self._kept.corrected(self._adjusting[0], R_lab_body)
            moved.shown(*since.crops(SINCE)).follow(self._pass, correction)
            self._pass, self._adjusting, self.number = moved, None, self.number + 1
        if self._adjusting is None and self._kept.count >= self._due and self._kept.turned_rad > TURNED_RAD:
            self._due, frames = MORE * self._kept.count, self._kept.so_far()
            self._adjusting = frames, self._aside.submit(_adjusted, frames)

    def texture(self) -> TextureMap:
        """Return the map of the frames so far; this takes some seconds. PaintError: the ball has not turned."""
        return self._kept.adjusted().texture()

    def close(self) -> None:
        """End the thread, after what it does."""
        self._aside.shutdown(cancel_futures=True)


def _adjusted(kept: KeptFrames) -> tuple[Tensor, FirstPass]:
    """Return orientations and a pass at the place found."""
    found = kept.adjusted()
    return found.R_lab_body, FirstPass(found.crops, ADJUSTED_ERROR).shown(found.crops, found.R_lab_body)


def _unknown(place: Crops, follower: FirstPass) -> Appearance:
    """Return what is known of a ball without a map: where it is seen."""
    fitter = first_fitter(place.views, place.radius_mm, follower.cells.table, FIRST_BLUR_PX)
    lasting = Lasting.none(len(place.views))
    return Appearance(fitter=fitter, still=fitter, lasting=lasting, score_min=0.0, right_score=1.0)
