"""Two cameras that contradict each other: which is right, and what the other one then saw."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble.path import Graph
from sphereorient.assemble.settings import AssembleSettings

Pair = tuple["Track", "Track"]


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """One camera's orientations in N frames, NaN where it has none; made by the fusion, repaired here."""

    R_lab_body: Tensor  # (N, 3, 3)
    score: Tensor  # (N,)

    @property
    def present(self) -> Tensor:
        """Frames with an orientation, (N,) bool."""
        return torch.isfinite(self.score)

    def part(self, frames: Tensor) -> Track:
        """Return some frames of the track."""
        return Track(R_lab_body=self.R_lab_body[frames], score=self.score[frames])

    def with_part(self, frames: Tensor, other: Track) -> Track:
        """Return the track with some frames from another one."""
        return Track(
            R_lab_body=self.R_lab_body.index_copy(0, frames, other.R_lab_body),
            score=self.score.index_copy(0, frames, other.score),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Repair:
    """Both cameras' tracks after the repair; made here, read by the fusion."""

    tracks: Pair
    repaired: Tensor  # (2, N) bool, the camera's orientation was taken from its candidates near the other's
    ambiguous: Tensor  # (N,) bool, which camera was right is a guess


def repair(tracks: Pair, graphs: tuple[Graph, Graph], settings: AssembleSettings) -> Repair:
    """Repair each stretch in which the cameras contradict each other, the better supported one leading.

    Nothing tells beforehand which camera is right (A7). Each in turn is supposed to be: the other then takes, in
    every frame, its candidate nearest to that orientation, if there is one within `repair_deg`; else it has none and
    counts as T = 0. The supposition under which the mean T of both cameras over the stretch is larger holds. Where
    the two differ by less than `repair_margin`, or neither finds any candidate (T of different cameras cannot be
    compared), the leader with the smaller largest turn into, within and out of the stretch holds, marked ambiguous.

    Args:
        tracks: of both cameras.
        graphs: of both cameras, candidates that may be chosen.
        settings: of the room.

    Source: the paper's two cameras, which says that a segment is repaired and not from which; ERRATA A7.
    """
    limit = math.radians(settings.repair_deg)
    first, second = tracks
    both = first.present & second.present
    apart = torch.where(both, so3.geodesic_distance(first.R_lab_body, second.R_lab_body), 0.0)
    wrong = apart > limit
    agreed = torch.nonzero(both & ~wrong)[:, 0]
    result, repaired, ambiguous = [first, second], torch.zeros_like(torch.stack([both, both])), torch.zeros_like(both)
    for frames in _stretches(wrong, both, settings.gap_frames_max):
        followers = [_follow(tracks[leader], graphs[1 - leader], frames, limit) for leader in (0, 1)]
        merits = [_merit(tracks[leader].part(frames), followers[leader]) for leader in (0, 1)]
        matched = any(bool(follower.present.any()) for follower in followers)
        guess = not matched or abs(merits[0] - merits[1]) < settings.repair_margin
        if guess:
            frames_beside = _beside(frames, agreed, settings.gap_frames_max)
            rough = [_roughest_turn(track, frames_beside) for track in tracks]
            leader = int(rough[1] < rough[0])
        else:
            leader = int(merits[1] > merits[0])
        loser = 1 - leader
        result[loser] = result[loser].with_part(frames, followers[leader])
        repaired[loser, frames] = followers[leader].present
        ambiguous[frames] = guess
    return Repair(tracks=(result[0], result[1]), repaired=repaired, ambiguous=ambiguous)


def _stretches(wrong: Tensor, both: Tensor, gap_frames_max: int) -> list[Tensor]:
    """Runs of wrong frames, as frame numbers; a short hole in which a camera saw nothing does not end a run."""
    seen = torch.nonzero(both)[:, 0]
    place = torch.nonzero(wrong[seen])[:, 0]
    frame = seen[place]
    ends = (place.diff() > 1) | (frame.diff() > gap_frames_max + 1)
    lengths = torch.nonzero(ends)[:, 0] + 1
    return [run for run in torch.tensor_split(frame, lengths.cpu()) if len(run)]


def _follow(leader: Track, graph: Graph, frames: Tensor, limit: float) -> Track:
    """A camera's candidates nearest to the leader's orientations in some frames; NaN where none is within the limit."""
    R_all, score_all, mask = (part[frames] for part in graph)
    distance = so3.geodesic_distance(leader.R_lab_body[frames][:, None], R_all)
    near, which = torch.where(mask, distance, torch.inf).min(-1)
    row = torch.arange(len(frames), device=frames.device)
    found = near <= limit
    return Track(
        R_lab_body=torch.where(found[:, None, None], R_all[row, which], torch.nan),
        score=torch.where(found, score_all[row, which], torch.nan),
    )


def _merit(leader: Track, follower: Track) -> float:
    """Mean T over both cameras and all frames of a stretch."""
    return float((leader.score + follower.score.nan_to_num(0.0)).mean() / 2)


def _beside(frames: Tensor, agreed: Tensor, gap_frames_max: int) -> Tensor:
    """A stretch with the frames on either side in which the cameras agree, where these are near."""
    reach = gap_frames_max + 1
    before = agreed[(agreed < frames[0]) & (agreed >= frames[0] - reach)][-1:]
    after = agreed[(agreed > frames[-1]) & (agreed <= frames[-1] + reach)][:1]
    return torch.cat([before, frames, after])


def _roughest_turn(track: Track, frames: Tensor) -> float:
    """Largest turn per frame of a track between successive ones of some frames, rad."""
    R = track.R_lab_body[frames]
    turn = so3.geodesic_distance(R[:-1], R[1:]) / frames.diff()
    return float(turn.max()) if len(turn) else 0.0
