"""Poses of all balls in all frames: a search at the first frame of a chunk, then prediction from frame to frame."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise

import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.files.threads import side_by_side
from sphereorient.follow.ball import BallTracker
from sphereorient.follow.chunk import MOVE_SHARE, Ahead, Chunk, Expected, mirrored, regained
from sphereorient.follow.initialise import DISTINCT_RAD, Initialiser
from sphereorient.follow.scene_start import SceneStart
from sphereorient.locate import Frame
from sphereorient.pose.neighbours import Neighbours, joined_neighbours
from sphereorient.pose.poses import Poses, supported

Start = Callable[[Sequence[Frame], Sequence[str], Mapping[str, Tensor], Mapping[str, Ahead]], dict[str, Poses]]


class Tracker:
    """Tracks balls through chunks of frames, each chunk independently from a search without history, all balls of a
    frame together: each is fitted with the others at their predicted positions. Chunks begin at fixed frame numbers: no
    batch, worker or restart changes a result, and a wrong pose does not outlive its chunk.
    """

    def __init__(self, balls: Mapping[str, BallTracker]) -> None:
        self.balls = dict(balls)
        first, *others = self.balls.values()
        searches = {name: ball.search for name, ball in self.balls.items()}
        self.start: Start = SceneStart(searches) if others else first.start
        radius_mm = {name: ball.fitter.radius_mm for name, ball in self.balls.items()}
        self._others = {
            name: {other: size for other, size in radius_mm.items() if other != name} for name in self.balls
        }

    def batches(self, frames: range) -> list[list[int]]:
        """Return the lengths of the chunks of each batch; chunks begin at multiples of `chunk_frames`."""
        settings = next(iter(self.balls.values())).settings
        length = settings.chunk_frames
        firsts = [frames.start, *range((frames.start // length + 1) * length, frames.stop, length)] if frames else []
        lengths = [last - first for first, last in pairwise([*firsts, frames.stop])]
        return [lengths[k : k + settings.chunks] for k in range(0, len(lengths), settings.chunks)]

    def track(
        self, movies: Sequence[Sequence[Frame]], batch: Sequence[int], time_s: Sequence[float]
    ) -> Iterator[dict[str, Poses]]:
        """Yield the poses of each ball in a batch's frames: movies of each view, lengths of chunks, times."""
        firsts = list(accumulate([0, *batch[:-1]]))
        chunks = {name: [Chunk(first, time_s) for first in firsts] for name in self.balls}
        found: dict[int, dict[str, Poses]] = {}
        for k in range(max(batch)):
            now = [n for n, length in enumerate(batch) if k < length]
            frames = [[movie[firsts[n] + k] for movie in movies] for n in now]
            here = self.step({name: [of_ball[n] for n in now] for name, of_ball in chunks.items()}, k, frames)
            for name, tracker in self.balls.items():
                own = [chunks[name][n] for n in now]
                poses = [row[name] for row in here]
                for chunk, one, turn in zip(own, poses, tracker.turns(own, poses), strict=True):
                    chunk.saw(chunk.first + k, one, turn)
            found |= {firsts[n] + k: row for n, row in zip(now, here, strict=True)}
        self._follow_back(
            movies, [range(k, k + length) for k, length in zip(firsts, batch, strict=True)], time_s, found
        )
        yield from (found[k] for k in range(sum(batch)))

    def _follow_back(
        self,
        movies: Sequence[Sequence[Frame]],
        spans: Sequence[range],
        time_s: Sequence[float],
        found: dict[int, dict[str, Poses]],
    ) -> None:
        """Follow each ball of a chunk that was lost and found again backwards from there, and put its poses into
        `found`. If it does not arrive at the pose from which it was lost, two balls may have been confused: then a
        frame between them gets no pose.
        """
        spans = [
            span for span in spans if any(regained([supported(found[k][name]) for k in span]) for name in self.balls)
        ]
        chunks = {name: mirrored(spans, time_s) for name in self.balls}
        lost: dict[tuple[str, int], Poses] = {}  # first results that were replaced
        for k in range(max(map(len, spans), default=0)):
            now = [n for n, span in enumerate(spans) if k < len(span)]
            numbers = [spans[n].stop - 1 - k for n in now]
            ahead = {
                name: [tracker.ahead(chunks[name][n], -number) for n, number in zip(now, numbers, strict=True)]
                for name, tracker in self.balls.items()
            }
            places = []
            for number, due in zip(numbers, zip(*ahead.values(), strict=True), strict=True):
                known = {name: _expected_place(one) for name, one in zip(ahead, due, strict=True) if one is not None}
                seen = {name: poses for name, poses in found[number].items() if supported(poses)}
                places.append(known | {name: _found_place(poses, known.get(name)) for name, poses in seen.items()})
            wanted = {
                name: [
                    one if not supported(found[number][name]) or (name, number + 1) in lost else None
                    for one, number in zip(of_ball, numbers, strict=True)
                ]
                for name, of_ball in ahead.items()
            }
            frames = [[movie[number] for movie in movies] for number in numbers]
            followed = self._followed(wanted, places, frames)
            for name, tracker in self.balls.items():
                for n, number, row in zip(now, numbers, followed, strict=True):
                    poses, was, chunk = row[name], found[number][name], chunks[name][n]
                    if supported(was):
                        if (name, number + 1) in lost and not (poses is not None and _same(poses, was, tracker)):
                            found[number + 1] |= {name: lost[name, number + 1]}
                            chunk.forget()
                    elif poses is not None:
                        lost[name, number] = was
                        found[number] |= {name: poses}
                own = [chunks[name][n] for n in now]
                here = [found[number][name] for number in numbers]
                for chunk, number, one, turn in zip(own, numbers, here, tracker.turns(own, here), strict=True):
                    chunk.saw(-number, one, turn)

    def step(
        self, chunks: Mapping[str, Sequence[Chunk]], k: int, frames: Sequence[Sequence[Frame]]
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
        # Balls of unknown motion are fitted with their neighbours after all are found.
        first = [{} if no else row for no, row in zip(rough, known, strict=True)]
        found = self._followed(ahead, first, frames)
        if any(rough) and any(self._others.values()):
            at = [
                {name: _found_place(poses, row[name]) for name, poses in there.items() if poses is not None}
                for row, there in zip(known, found, strict=True)
            ]
            unsure = {
                name: [one if no else None for one, no in zip(row, rough, strict=True)] for name, row in ahead.items()
            }
            again = self._followed(unsure, at, frames)
            found = [new if no else row for new, no, row in zip(again, rough, found, strict=True)]
        done = [{name: poses for name, poses in row.items() if poses is not None} for row in found]
        if all(len(row) == len(self.balls) for row in done):
            return done
        past = [
            {
                name: before
                for name, of_ball in chunks.items()
                if name not in row and (before := of_ball[n].extrapolated(of_ball[n].first + k)) is not None
            }
            for n, row in enumerate(done)
        ]
        return list(side_by_side(self._completed, zip(done, known, frames, past, strict=True)))

    def _followed(
        self,
        ahead: Mapping[str, Sequence[Expected | None]],
        places: Sequence[Mapping[str, Tensor]],
        frames: Sequence[Sequence[Frame]],
    ) -> list[dict[str, Poses | None]]:
        """Fit the predicted balls of each frame, with the others at their places."""
        found: list[dict[str, Poses | None]] = [dict.fromkeys(self.balls) for _ in frames]
        for name, tracker in self.balls.items():
            rows = {n: one for n, one in enumerate(ahead[name]) if one is not None}
            expected = [replace(one, among=self._among(name, places[n])) for n, one in rows.items()]
            for n, poses in zip(rows, tracker.follow(expected, [frames[n] for n in rows]), strict=True):
                found[n][name] = poses
        return found

    def _completed(
        self,
        frame: tuple[dict[str, Poses], Mapping[str, Tensor], Sequence[Frame], Mapping[str, Ahead]],
    ) -> dict[str, Poses]:
        """Return the poses of all balls of a frame: the followed ones, and those found by a search."""
        done, known, frames, past = frame
        lost = [name for name in self.balls if name not in done]
        if not lost:
            return done
        places = {name: _found_place(poses, known.get(name)) for name, poses in done.items()}
        there = self.start(frames, lost, {name: place[0] for name, place in places.items()}, past)
        places |= {name: _found_place(poses, None) for name, poses in there.items() if len(poses)}
        for name in lost:
            among = self._among(name, places) if len(there[name]) else None
            done[name] = there[name] if among is None else self.balls[name].looked_past(there[name], frames, among)
        return {name: done[name] for name in self.balls}

    def _among(self, name: str, places: Mapping[str, Tensor]) -> Neighbours | None:
        """Return the neighbours of one ball in one frame; None if there are none."""
        others = self._others[name]
        return _neighbours(others, places) if others else None


def among_found(rows: Sequence[tuple[str, Mapping[str, Poses]]], balls: Mapping[str, Initialiser]) -> Neighbours:
    """Return the neighbours of balls, each given by its name and the poses of its frame, all at rest."""
    each = []
    for name, there in rows:
        places = {other: _found_place(poses, None) for other, poses in there.items() if len(poses)}
        radii = {other: one.fitter.radius_mm for other, one in balls.items() if other != name}
        each.append(_neighbours(radii, places))
    found = joined_neighbours(each)
    assert found is not None
    return found


def _neighbours(radius_mm: Mapping[str, float], places: Mapping[str, Tensor]) -> Neighbours:
    """Return the neighbours, by name, of one pose; a place (2, 3): position and displacement in the exposure, mm."""
    nowhere = torch.tensor([[torch.nan] * 3, [0.0] * 3], dtype=torch.float64)
    position, move = torch.stack([places.get(name, nowhere) for name in radius_mm], 1)[:, None]
    radii = torch.tensor([list(radius_mm.values())], dtype=torch.float64)
    return Neighbours(position_lab_mm=position, radius_mm=radii, move_mm=move)


def _same(one: Poses, other: Poses, tracker: BallTracker) -> bool:
    """Return whether the best poses of a frame are the same within their errors."""
    turn = so3.geodesic_distance(one.R_lab_body[0], other.R_lab_body[0])
    move = (one.position_lab_mm[0] - other.position_lab_mm[0]).norm()
    return bool(turn < DISTINCT_RAD) and bool(move < MOVE_SHARE * tracker.fitter.radius_mm)


def _expected_place(one: Expected) -> Tensor:
    return torch.from_numpy(np.stack([one.position_lab_mm, one.moved[3:]]))


def _found_place(poses: Poses, before: Tensor | None) -> Tensor:
    """Return the place of a frame's best pose, with its predicted motion."""
    X = poses.position_lab_mm[0]
    return torch.stack([X, torch.zeros_like(X) if before is None else before[1]])
