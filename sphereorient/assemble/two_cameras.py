"""The paper's paths: of one camera, by `PathLayer` of first order; of several cameras of one sphere, with repair of
frames in which they disagree, and the weighted mean on SO(3).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.assemble.layer import PathLayer
from sphereorient.assemble.segments import find_spikes, flags_where, links, moving, number_segments
from sphereorient.assemble.settings import AssembleSettings
from sphereorient.errors import ExperimentError, Flag, ShapeError, refusal
from sphereorient.search import Candidates

Graph = Sequence[Tensor]  # R (N, C, 3, 3), score (N, C), mask (N, C)
CHI2_3_MEDIAN = 2.366  # median of a sum of three squared standard normals
LINKS_MIN = 3  # least links in the window; fewer give no usable variance
VARIANCE_RANGE = 10.0  # limits the weight of a camera with a quiet stretch of xi
CAMERAS_RATIO_MAX = 100.0  # of typical variances: limits the weight of a track with constant xi


@dataclass(frozen=True, kw_only=True, eq=False)
class Track:
    """Orientations of one camera in N frames, NaN if it has none."""

    R_lab_body: Tensor  # (N, 3, 3)
    score: Tensor  # (N,)

    @property
    def present(self) -> Tensor:
        """Frames with an orientation, (N,) bool."""
        return torch.isfinite(self.score)

    def part(self, frames: Tensor) -> "Track":
        """Return some frames of the track."""
        return Track(R_lab_body=self.R_lab_body[frames], score=self.score[frames])

    def with_part(self, frames: Tensor, other: "Track") -> "Track":
        """Return the track with some frames of another one."""
        R = self.R_lab_body.index_copy(0, frames, other.R_lab_body)
        return Track(R_lab_body=R, score=self.score.index_copy(0, frames, other.score))


@dataclass(frozen=True, kw_only=True, eq=False)
class Path(Track):
    """Chosen orientations of one camera in N frames; xi and spike of a link belong to the frame that it enters."""

    choice: Tensor  # (N,) int64, row within the frame's candidates; -1 without any
    xi: Tensor  # (N,), rad/s, angle over time of the link that enters the frame; NaN without a link
    spike: Tensor  # (N,) bool, whether that link is a spike
    segment: Tensor  # (N,) int64, -1 outside any


def assemble_paths(candidates: Mapping[str, Candidates], time_s: Tensor, settings: AssembleSettings) -> dict[str, Path]:
    """Return the path of each camera by `assemble_path`."""
    return {name: assemble_path(each, time_s, settings, name) for name, each in candidates.items()}


def assemble_path(candidates: Candidates, time_s: Tensor, settings: AssembleSettings, name: str = "") -> Path:
    """Choose one candidate of each frame of a camera, by the least cost over the whole movie; time_s (N,) increases.
    Frames without candidates of `quality_min` are skipped: the cost of the link over them is divided by its time.
    Raises ShapeError (numbers of frames and times differ).
    Source: the paper's assembly of III (directed graph between direct neighbours); docs/errata.md A6.
    """
    if len(candidates) != len(time_s):
        expected, got, do = f"{len(time_s)} frames", f"{len(candidates)}", "give every camera the experiment's frames"
        raise ShapeError(refusal(f"candidates of {name!r}", expected=expected, got=got, do=do))
    R_all, score_all, mask = graph_of(candidates, settings.quality_min)
    choice = PathLayer(1, settings=settings)(R_all, score_all, time_s, mask=mask).choice
    there = choice >= 0
    R = torch.full((len(choice), 3, 3), torch.nan).to(R_all)
    score = torch.full((len(choice),), torch.nan).to(score_all)
    R[there], score[there] = R_all[there, choice[there]], score_all[there, choice[there]]
    xi, turn = links(R, time_s)
    spike = find_spikes(xi, turn, settings)
    segment = number_segments(there, spike, settings.gap_frames_max)
    return Path(choice=choice, R_lab_body=R, score=score, xi=xi, spike=spike, segment=segment)


def graph_of(candidates: Candidates, quality_min: float) -> Graph:
    """Return the usable candidates of one camera: R (N, C, 3, 3), score (N, C) and mask (N, C)."""
    R, score, mask = candidates.padded()
    return R, score, mask & (score >= quality_min)


@dataclass(frozen=True, kw_only=True, eq=False)
class Fused:
    """The orientation of the sphere in N frames from all cameras."""

    R_lab_body: Tensor  # (N, 3, 3), NaN if no camera has one
    sigma_rad: Tensor  # (N,), standard deviation per axis; NaN if not measurable
    segment: Tensor  # (N,) int64, -1 outside any
    flags: Tensor  # (N,) int64, bits of trajectory.Flag
    weight: Mapping[str, Tensor]  # (N,) of each camera, its share in the mean, sum 1; 0 without any orientation
    repaired: Mapping[str, Tensor]  # (N,) bool of each camera
    R_lab_body_of: Mapping[str, Tensor]  # (N, 3, 3) of each camera after the repair, NaN if missing


def fuse(
    paths: Mapping[str, Path], candidates: Mapping[str, Candidates], time_s: Tensor, settings: AssembleSettings
) -> Fused:
    """Fuse the paths of the cameras, in the lab frame, into one; `time_s` (N,).
    Stretches that differ by more than `repair_deg` are repaired, for more than two cameras by majority if there is one.
    Then each frame is the mean of all, weighted by the inverse moving variance of xi. Their differences give the sigma;
    a single camera has none. Flags: `ONE_CAMERA`, and `AMBIGUOUS` for an undecided repair. Raises ExperimentError (no
    camera), ShapeError (paths, candidates and times differ in cameras or frames).
    Source: the paper's two cameras; docs/errata.md A7 (which camera is right), A8 (xi contains the motion's variance).
    """
    _check(paths, candidates, time_s)
    graphs = [graph_of(candidates[name], settings.quality_min) for name in paths]
    mended = repair_all(list(paths.values()), graphs, settings)
    tracks = mended.tracks
    present = torch.stack([track.present for track in tracks])
    linked = [links(track.R_lab_body, time_s) for track in tracks]
    variance = relative_variance([xi for xi, _ in linked], settings)
    spikes = [moving(find_spikes(xi, turn, settings).to(xi), settings.weight_window_frames) for xi, turn in linked]
    calm = torch.stack([window.nansum(-1) == 0 for window in spikes]).all(0)  # without spikes, which raise the variance
    weight = torch.where(present, 1 / variance, 0.0)
    total = weight.sum(0)
    share = weight / torch.where(total > 0, total, 1.0)
    R = _mean(tracks, share)
    spike = find_spikes(*links(R, time_s), settings)
    alone = present.sum(0) == 1 if len(tracks) > 1 else torch.ones_like(present[0])
    bits = {Flag.ONE_CAMERA: alone, Flag.REPAIRED_FROM_OTHER_CAMERA: mended.repaired.any(0)}
    bits |= {Flag.AMBIGUOUS: mended.ambiguous, Flag.SPIKE: spike}
    return Fused(
        R_lab_body=R,
        sigma_rad=_sigma(variance, share, tracks, calm),
        segment=number_segments(present.any(0), spike, settings.gap_frames_max),
        flags=flags_where(bits),
        weight=dict(zip(paths, share, strict=True)),
        repaired=dict(zip(paths, mended.repaired, strict=True)),
        R_lab_body_of={name: track.R_lab_body for name, track in zip(paths, tracks, strict=True)},
    )


def relative_variance(xi: Sequence[Tensor], settings: AssembleSettings) -> Tensor:
    """Return the moving variance (K, N) of each camera's xi (N,), above 0, meaningful only as ratios between cameras.
    It is clamped about the camera's median, which replaces it if fewer than `LINKS_MIN` links are near.
    """
    windows = [moving(each, settings.weight_window_frames) for each in xi]
    count = torch.stack([torch.isfinite(window).sum(-1) for window in windows])
    squares = torch.stack([(window - window.nanmean(-1, keepdim=True)).square().nansum(-1) for window in windows])
    variance = torch.where(count >= LINKS_MIN, squares / (count - 1).clamp_min(1), torch.nan)
    typical = variance.nanmedian(-1, keepdim=True).values if variance.shape[1] else variance.new_ones(len(xi), 1)
    largest = typical.nan_to_num(0.0).max()
    # All cameras at rest or without links: equal weights.
    typical = torch.where(typical.isnan() | (largest == 0), torch.where(largest > 0, largest, 1.0), typical)
    typical = typical.clamp_min(typical.max() / CAMERAS_RATIO_MAX)
    within = torch.minimum(torch.maximum(variance, typical / VARIANCE_RANGE), typical * VARIANCE_RANGE)
    return torch.where(variance.isnan(), typical, within)


def _mean(tracks: Sequence[Track], share: Tensor) -> Tensor:
    """Return the weighted mean (N, 3, 3) of the cameras; of one camera exactly its orientation; NaN without any."""
    present = torch.stack([track.present for track in tracks])[..., None, None]
    R = torch.stack([track.R_lab_body for track in tracks])
    view = torch.eye(3, dtype=R.dtype, device=R.device)
    several = present.sum(0) > 1
    share = torch.where(several[..., 0, 0], share, 1.0)
    mean = so3.weighted_mean(torch.where(several, R, view).movedim(0, -3), share.movedim(0, -1))
    alone = torch.where(present, R, 0.0).sum(0)
    return torch.where(several, mean, torch.where(present.any(0), alone, torch.nan))


def _apart(first: Track, second: Track) -> Tensor:
    """Return the angle (N,), rad, between two cameras' orientations; NaN if one is missing."""
    apart = so3.geodesic_distance(first.R_lab_body, second.R_lab_body)
    return torch.where(first.present & second.present, apart, torch.nan)


def _sigma(variance: Tensor, share: Tensor, tracks: Sequence[Track], calm: Tensor) -> Tensor:
    """Return the standard deviation per axis of the mean, (N,), rad.
    With errors of variance s^2 variance_i per axis, d^2 / (s^2 (variance_1 + variance_2)) is chi-squared with three
    degrees of freedom; its median over all pairs gives s^2 robustly, without frames of spikes, which raise variance_i.
    """
    if len(tracks) < 2 or not len(calm):
        return torch.full_like(tracks[0].score, torch.nan)
    pairs = combinations(range(len(tracks)), 2)
    ratio = torch.stack([_apart(tracks[k], tracks[m]).square() / (variance[k] + variance[m]) for k, m in pairs])
    quiet = torch.where(calm, ratio, torch.nan)
    scale = (quiet if torch.isfinite(quiet).any() else ratio).nanmedian() / CHI2_3_MEDIAN
    relative = (share.square() * variance).sum(0)
    return torch.where(share.sum(0) > 0, (scale * relative).sqrt(), torch.nan)


def _check(paths: Mapping[str, Path], candidates: Mapping[str, Candidates], time_s: Tensor) -> None:
    if not paths:
        raise ExperimentError(refusal("paths", expected="one camera or more", got="0", do="name a camera"))
    for name, path in paths.items():
        frames = len(candidates[name]) if name in candidates else 0
        if not len(path.choice) == frames == len(time_s):
            expected, got = f"{len(time_s)} frames", f"{len(path.choice)} in the path, {frames} in the candidates"
            do = "pass the input and output of assemble_paths"
            raise ShapeError(refusal(f"camera {name!r}", expected=expected, got=got, do=do))


@dataclass(frozen=True, kw_only=True, eq=False)
class Repair:
    """Tracks of C cameras after the repair."""

    tracks: tuple[Track, ...]
    repaired: Tensor  # (C, N) bool, replaced by the candidate nearest to another camera
    ambiguous: Tensor  # (N,) bool, T did not decide which camera is right


def repair_all(paths: Sequence[Path], graphs: Sequence[Graph], settings: AssembleSettings) -> Repair:
    """Repair the frames in which cameras disagree. If more than half of three or more agree with one of them, the
    others take their candidates nearest to it, none (T = 0) beyond `repair_deg`. Else: see `repair`.
    """
    if len(paths) == 2:
        return repair((paths[0], paths[1]), (graphs[0], graphs[1]), settings)
    limit, frames = math.radians(settings.repair_deg), torch.arange(len(paths[0].score))
    tracks: list[Track] = list(paths)
    there = torch.stack([path.present for path in paths])
    near = torch.stack([torch.stack([_apart(one, other) <= limit for other in paths]) for one in paths])
    score = torch.stack([path.score.nan_to_num(0.0) for path in paths])
    leader = (near.sum(1) + 0.5 * score.clamp(0, 1)).argmax(0)  # with most agreement; of equals the better one
    sided = near[leader, :, frames].T  # (C, N)
    decided = (there.sum(0) > 2) & (2 * sided.sum(0) > there.sum(0))
    repaired, ambiguous = torch.zeros_like(there), torch.zeros_like(decided)
    for k, m in permutations(range(len(paths)), 2):
        wrong = torch.nonzero(decided & (leader == k) & there[m] & ~sided[m])[:, 0]
        follower = _follow(paths[k], graphs[m], wrong, limit)
        tracks[m], repaired[m, wrong] = tracks[m].with_part(wrong, follower), follower.present
    left = torch.nonzero(~decided)[:, 0]
    for k, m in combinations(range(len(paths)), 2):
        both = [_only(paths[c], tracks[c], ~decided) for c in (k, m)]
        mended = repair((both[0], both[1]), (graphs[k], graphs[m]), settings)
        for place, c in enumerate((k, m)):
            tracks[c] = tracks[c].with_part(left, mended.tracks[place].part(left))
            repaired[c] |= mended.repaired[place]
        ambiguous |= mended.ambiguous
    return Repair(tracks=tuple(tracks), repaired=repaired, ambiguous=ambiguous)


def _only(path: Path, track: Track, where: Tensor) -> Path:
    """Return a path with the orientations of a track in the frames `where` (N,) bool, and none elsewhere."""
    R = torch.where(where[:, None, None], track.R_lab_body, torch.nan)
    return replace(path, R_lab_body=R, score=torch.where(where, track.score, torch.nan))


def repair(paths: tuple[Path, Path], graphs: tuple[Graph, Graph], settings: AssembleSettings) -> Repair:
    """Repair each stretch (`_stretches`) in which the cameras disagree; the better supported camera leads.
    Each camera in turn is assumed right; the other takes its nearest candidates, none (T = 0) beyond `repair_deg`. The
    larger mean T of both cameras decides. Within `repair_margin`, or without such candidates, the camera with the
    smaller largest rotation leads, and the frames are ambiguous. A segment of the loser that the leader contradicts
    wherever it sees the sphere is dropped where the leader does not see it.
    Source: the paper's two cameras, which does not state which camera is right; docs/errata.md A7.
    """
    limit = math.radians(settings.repair_deg)
    apart, segment = _apart(*paths), torch.stack([path.segment for path in paths])
    agreed = apart <= limit
    result: list[Track] = list(paths)
    decided = [*result]  # the loser of a stretch has the leader's orientations
    repaired, ambiguous = torch.zeros_like(segment, dtype=torch.bool), torch.zeros_like(agreed)
    for frames in _stretches(apart, segment, limit):
        followers = [_follow(paths[k], graphs[1 - k], frames, limit) for k in (0, 1)]
        merits = [float((paths[k].score[frames] + followers[k].score.nan_to_num(0.0)).mean() / 2) for k in (0, 1)]
        matched = any(bool(follower.present.any()) for follower in followers)
        guess = not matched or abs(merits[0] - merits[1]) < settings.repair_margin
        if guess:
            beside = _beside(frames, torch.nonzero(agreed)[:, 0], settings.gap_frames_max)
            merits = [-roughest_turn(track, beside) for track in decided]
        leader = int(merits[1] > merits[0])
        loser = 1 - leader
        agreed[frames], ambiguous[frames] = True, guess
        decided[loser] = decided[loser].with_part(frames, paths[leader].part(frames))
        own = segment[loser] == segment[loser, frames[0]]
        if not guess and apart[own].nanmedian() > limit:
            frames = torch.cat([frames, torch.nonzero(own & ~paths[leader].present)[:, 0]])
        follower = _follow(paths[leader], graphs[loser], frames, limit)
        moved = (follower.R_lab_body != paths[loser].R_lab_body[frames]).flatten(1).any(1)
        result[loser] = result[loser].with_part(frames, follower)
        repaired[loser, frames] = follower.present & moved
    return Repair(tracks=(result[0], result[1]), repaired=repaired, ambiguous=ambiguous)


def _stretches(apart: Tensor, segment: Tensor, limit: float) -> list[Tensor]:
    """Return the frames of each stretch in which the cameras disagree; segment (2, N) of each camera alone.
    A piece lies between spikes or gaps of either camera. It is one stretch if its median distance exceeds the limit, as
    after a spike the whole path may be false. In other pieces each run of frames beyond the limit is a stretch.
    """
    seen = torch.nonzero(torch.isfinite(apart))[:, 0]
    borders = torch.nonzero((segment[:, seen].diff() != 0).any(0))[:, 0] + 1
    stretches: list[Tensor] = []
    for piece in torch.tensor_split(seen, borders.cpu()) if len(seen) else ():
        wrong = apart[piece] > limit
        whole = bool(apart[piece].median() > limit)
        runs = torch.tensor_split(piece, torch.nonzero(wrong.diff())[:, 0].cpu() + 1)
        stretches += [piece] if whole else [run for run in runs if apart[run[0]] > limit]
    return stretches


def _follow(leader: Track, graph: Graph, frames: Tensor, limit: float) -> Track:
    """Return the candidates nearest to the leader's orientations in some frames; NaN beyond the limit."""
    R_all, score_all, mask = (part[frames] for part in graph)
    distance = so3.geodesic_distance(leader.R_lab_body[frames][:, None], R_all)
    near, which = torch.where(mask, distance, torch.inf).min(-1)
    row = torch.arange(len(frames), device=frames.device)
    found = near <= limit
    R = torch.where(found[:, None, None], R_all[row, which], torch.nan)
    return Track(R_lab_body=R, score=torch.where(found, score_all[row, which], torch.nan))


def _beside(frames: Tensor, agreed: Tensor, gap_frames_max: int) -> Tensor:
    """Return a stretch with the nearest frames on either side in which the cameras agree."""
    reach = gap_frames_max + 1
    before = agreed[(agreed < frames[0]) & (agreed >= frames[0] - reach)][-1:]
    after = agreed[(agreed > frames[-1]) & (agreed <= frames[-1] + reach)][:1]
    return torch.cat([before, frames, after])


def roughest_turn(track: Track, frames: Tensor) -> float:
    """Return the largest rotation per frame, rad, of a track between successive ones of some frames."""
    R = track.R_lab_body[frames]
    turn = so3.geodesic_distance(R[:-1], R[1:]) / frames.diff()
    return float(turn.max()) if len(turn) else 0.0
