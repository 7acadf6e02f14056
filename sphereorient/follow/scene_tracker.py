"""Poses of several balls: each frame of all of them together, each ball fitted with the others where they are."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import torch
from torch import Tensor

from sphereorient.files.threads import side_by_side
from sphereorient.follow.initialise import Initialiser
from sphereorient.follow.poses import Poses, no_pose
from sphereorient.follow.scene_start import SceneStart
from sphereorient.follow.tracker import ChunkTracker, _Chunk, _Expected
from sphereorient.locate import Frame
from sphereorient.pose.neighbours import Neighbours, joined
from sphereorient.trajectory import Reason


@dataclass(frozen=True, eq=False)
class _Place:
    """Where a ball is in a frame."""

    position_lab_mm: Tensor  # (3,)
    move_mm: Tensor  # (3,), while the shutter is open


class SceneTracker:
    """Tracks several balls through chunks of frames in lock step: all are predicted, and each is fitted past the others
    where they are expected. See `ChunkTracker`, which tracks each of them.
    """

    def __init__(self, balls: Mapping[str, ChunkTracker], start: SceneStart) -> None:
        self.balls = dict(balls)
        self.start = start

    def batches(self, frames: range) -> list[list[int]]:
        """Return the lengths of the chunks of each batch; see `ChunkTracker`."""
        return next(iter(self.balls.values())).batches(frames)

    def track(
        self, shots: Sequence[Sequence[Frame]], batch: Sequence[int], time_s: Sequence[float]
    ) -> Iterator[dict[str, Poses]]:
        """Yield the poses of each ball in a batch's frames; see `ChunkTracker.track`."""
        firsts = list(accumulate([0, *batch[:-1]]))
        chunks = {
            name: [_Chunk(first, first + length, time_s) for first, length in zip(firsts, batch, strict=True)]
            for name in self.balls
        }
        found: dict[int, dict[str, Poses]] = {}
        for k in range(max(batch)):
            now = [n for n, length in enumerate(batch) if k < length]
            frames = [[movie[firsts[n] + k] for movie in shots] for n in now]
            here = self._step({name: [of_ball[n] for n in now] for name, of_ball in chunks.items()}, k, frames)
            for name, tracker in self.balls.items():
                own = [chunks[name][n] for n in now]
                poses = [row[name] for row in here]
                for chunk, one, turn in zip(own, poses, tracker.turns(own, poses), strict=True):
                    chunk.saw(chunk.first + k, one, turn)
            found |= {firsts[n] + k: row for n, row in zip(now, here, strict=True)}
        yield from (found[k] for k in range(sum(batch)))

    def _step(
        self, chunks: Mapping[str, Sequence[_Chunk]], k: int, frames: Sequence[Sequence[Frame]]
    ) -> list[dict[str, Poses]]:
        """Measure one frame of each chunk."""
        ahead = {
            name: [tracker.ahead(chunk, chunk.first + k) for chunk in chunks[name]]
            for name, tracker in self.balls.items()
        }
        known = [
            {name: _expected_place(one) for name, of_ball in ahead.items() if (one := of_ball[n]) is not None}
            for n in range(len(frames))
        ]
        rough = [any(one is not None and one.rough for one in row) for row in zip(*ahead.values(), strict=True)]
        # Where a motion is not known yet, the others are looked past once all are found.
        first = [{} if unsure else row for unsure, row in zip(rough, known, strict=True)]
        found = self._followed(ahead, first, frames, [True] * len(frames))
        if any(rough):
            at = [
                {name: _found_place(poses, row[name]) for name, poses in there.items() if poses is not None}
                for row, there in zip(known, found, strict=True)
            ]
            again = self._followed(ahead, at, frames, rough)
            found = [again[n] if unsure else row for n, (unsure, row) in enumerate(zip(rough, found, strict=True))]
        rows = list(zip(found, known, frames, strict=True))
        whole = all(poses is not None for row in found for poses in row.values())
        return [*map(self._completed, rows)] if whole else list(side_by_side(self._completed, rows))

    def _followed(
        self,
        ahead: Mapping[str, Sequence[_Expected | None]],
        places: Sequence[Mapping[str, _Place]],
        frames: Sequence[Sequence[Frame]],
        wanted: Sequence[bool],
    ) -> list[dict[str, Poses | None]]:
        """Fit the predicted balls of each frame that is wanted, past the others at their places."""
        found: list[dict[str, Poses | None]] = [dict.fromkeys(self.balls) for _ in frames]
        for name, tracker in self.balls.items():
            rows = {n: one for n, one in enumerate(ahead[name]) if one is not None and wanted[n]}
            expected = [replace(one, among=self._among(name, places[n])) for n, one in rows.items()]
            for n, poses in zip(rows, tracker.follow(expected, [frames[n] for n in rows]), strict=True):
                found[n][name] = poses
        return found

    def _completed(
        self, frame: tuple[Mapping[str, Poses | None], Mapping[str, _Place], Sequence[Frame]]
    ) -> dict[str, Poses]:
        """Return the poses of all balls of a frame: those followed, and those that a search finds."""
        followed, known, shots = frame
        done = {name: poses for name, poses in followed.items() if poses is not None}
        lost = [name for name in self.balls if name not in done]
        if not lost:
            return {name: self.balls[name].stated(poses) for name, poses in done.items()}
        places = {name: _found_place(poses, known.get(name)) for name, poses in done.items()}
        there = self.start(shots, lost, {name: place.position_lab_mm for name, place in places.items()})
        places |= {name: _found_place(poses, None) for name, poses in there.items() if len(poses)}
        for name in lost:
            poses = there.get(name)
            if poses is None or not len(poses):
                reason = [Reason.NOT_FOUND if shot.usable else shot.reason for shot in shots]
                done[name] = no_pose(len(shots), reason)
            else:
                among = self._among(name, places)
                done[name] = poses if among is None else self.balls[name].looked_past(poses, shots, among)
        return {name: self.balls[name].stated(done[name]) for name in self.balls}

    def _among(self, name: str, places: Mapping[str, _Place]) -> Neighbours | None:
        """Return the neighbours of one ball in one frame; None where there is one ball."""
        radii = {other: tracker.fitter.radius_mm for other, tracker in self.balls.items() if other != name}
        return _neighbours(radii, places) if radii else None


def among_found(rows: Sequence[tuple[str, Mapping[str, Poses]]], balls: Mapping[str, Initialiser]) -> Neighbours:
    """Return the neighbours of balls, each given by its name and the poses of its frame, as if at rest."""
    each = []
    for name, there in rows:
        places = {other: _found_place(poses, None) for other, poses in there.items() if len(poses)}
        radii = {other: one.fitter.radius_mm for other, one in balls.items() if other != name}
        each.append(_neighbours(radii, places))
    found = joined(each)
    assert found is not None
    return found


def _neighbours(radius_mm: Mapping[str, float], places: Mapping[str, _Place]) -> Neighbours:
    """Return the neighbours, by name, of one pose."""
    nowhere = _Place(torch.full((3,), torch.nan, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    there = [places.get(name, nowhere) for name in radius_mm]
    return Neighbours(
        position_lab_mm=torch.stack([one.position_lab_mm for one in there])[None],
        radius_mm=torch.tensor([list(radius_mm.values())], dtype=torch.float64),
        move_mm=torch.stack([one.move_mm for one in there])[None],
    )


def _expected_place(one: _Expected) -> _Place:
    return _Place(torch.from_numpy(one.position_lab_mm), torch.from_numpy(one.moved[3:]))


def _found_place(poses: Poses, before: _Place | None) -> _Place:
    """Return the place of a frame's best pose, with the motion that was expected of it."""
    still = torch.zeros(3, dtype=torch.float64)
    return _Place(poses.position_lab_mm[0], still if before is None else before.move_mm)
