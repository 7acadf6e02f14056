"""Several spheres. Disks of every frame are assigned to them by predicted position, because no map exists yet. Maps of
the same paint, also an old and a new one, are put into one body frame.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import Camera
from sphereorient.errors import PaintError, refusal
from sphereorient.experiment.recording import Recording
from sphereorient.files.threads import Progress
from sphereorient.locate import LocateSettings, screened_frames
from sphereorient.locate.disks import find_disks
from sphereorient.locate.outline import Outline
from sphereorient.locate.position import Match, assigned, match_disks, places_of
from sphereorient.locate.scene import CameraScene, find_scenes
from sphereorient.mapping.disks import Crop, Crops, cut_crop, take_crops
from sphereorient.mapping.learn import LearntMap
from sphereorient.mapping.settings import MapSettings
from sphereorient.pose.camera_view import CameraView
from sphereorient.sphere.compare import MapComparison, compare_maps, fit_levels, turned_map
from sphereorient.sphere.texture import map_directions, texel_areas, texture_coordinates

FREE = 1.1  # sums of two radii; nearer disks are not used
AWAY = 0.1  # of the radius, per frame since it was seen: error of the predicted position
SIZE_SIGMA = 0.08  # relative error of a disk's radius
FARTHEST = 9.0  # largest chi2 of an assignment
FORGOTTEN = 20  # frames after which the motion is unknown

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Instant:
    """The disks of all cameras in one frame."""

    crops: Sequence[Sequence[Crop]]  # of the disks of C cameras
    matches: Sequence[Match]
    position_lab_mm: Floats  # (M, 3), of the matches


def crops_of_balls(
    recording: Recording, settings: MapSettings, locating: LocateSettings, progress: Progress
) -> dict[str, Crops]:
    """Crop each sphere in every frame, by name: a single one as `take_crops`, or several moving ones. Spheres of one
    size get names at random, which then follow predicted positions. Only isolated disks are used.
    Raises ExperimentError (a sphere without a diameter, or a fixed one), PaintError (no frame shows all spheres,
    isolated).
    """
    names, streams = recording.experiment.names, recording.streams
    if recording.experiment.alone:
        return {names[0]: take_crops(recording, settings, locating, progress)}
    scenes = [find_scenes(recording, stream, settings.background_frames, locating) for stream in streams]
    sizes_px = [[scene[name].diameter_px for name in names] for scene in scenes]
    radius_mm = {name: recording.of(name).experiment.radius_mm for name in names}
    each = list(zip(streams, scenes, strict=True))
    movies = [screened_frames(stream, scene[names[0]].background) for stream, scene in each]
    instants = []
    for k, frames in enumerate(zip(*movies, strict=True)):
        disks: list[list[Outline]] = []
        crops: list[list[Crop]] = []
        for shot, size_px in zip(frames, sizes_px, strict=True):
            usable = shot.usable and shot.background is not None
            disks.append(find_disks(shot.picture, shot.background, size_px, locating) if usable else [])
            crops.append([cut_crop(shot.picture, *one.circle) for one in disks[-1]])
        instants.append(matched_instant(disks, crops, recording.cameras, 2 * min(radius_mm.values())))
        progress("balls", k + 1, 0)
    chosen = linked_matches(instants, scenes, radius_mm)
    places = [linked_places(chosen[:, n], instants) for n in range(len(names))]
    found = {}
    for n, name in enumerate(names):
        views = [CameraView.of(one.name, one.camera, scene[name]) for one, scene in each]
        own_first = [places[n], *(place for m, place in enumerate(places) if m != n)]
        found[name] = crops_of_ball(name, chosen[:, n], instants, views, radius_mm, own_first)
    return found


def matched_instant(
    disks: Sequence[Sequence[Outline]],
    crops: Sequence[Sequence[Crop]],
    cameras: Mapping[str, Camera],
    diameter_mm: float,
) -> Instant:
    """Match the disks (px) of C cameras in one frame, with their crops; `diameter_mm`: of the smallest ball."""
    least = min(2, len(cameras))  # distance by the size of one disk is too uncertain for identity
    matches = [one for one in match_disks(disks, list(cameras.values())) if one.number >= least]
    X = places_of(matches, cameras, diameter_mm).position_lab_mm.numpy() if matches else np.zeros((0, 3))
    return Instant(crops=crops, matches=matches, position_lab_mm=X)


def linked_matches(
    instants: Sequence[Instant], scenes: Sequence[Mapping[str, CameraScene]], radius_mm: Mapping[str, float]
) -> NDArray[np.int64]:
    """Return the match of each sphere in each frame, (N, K), by index; -1: none."""
    names = list(radius_mm)
    sizes = np.array([[scene[name].diameter_px / 2 for scene in scenes] for name in names])
    begin = _first(instants, len(names))
    chosen = np.full((len(instants), len(names)), -1)
    for frames in (range(begin, len(instants)), range(begin, -1, -1)):
        past: list[list[tuple[int, Floats]]] = [[] for _ in names]
        for k in frames:
            at = instants[k]
            cost = _misfit(at, k, past, sizes, np.array(list(radius_mm.values())))
            chosen[k] = -1
            for n, match in assigned(cost - FARTHEST, at.matches):
                chosen[k, n] = match
                past[n] = [*past[n][-1:], (k, at.position_lab_mm[match])]
    return chosen


def _first(instants: Sequence[Instant], count: int) -> int:
    """Return the frame in which most cameras see all named spheres, with the fewest other matches."""
    ranks = {}
    for k, at in enumerate(instants):
        apart: list[Match] = []
        for one in at.matches:  # matches of most cameras come first
            if not any(one.shares(other) for other in apart):
                apart.append(one)
        if len(apart) < count:
            continue
        least = apart[count - 1].number
        others = sum(one.number >= least for one in at.matches) - count
        ranks[k] = sum(one.number for one in apart[:count]), -others
    if not ranks:
        do = "name as many balls as the movies show, or learn each map from a movie of one ball"
        raise PaintError(refusal("movies", expected=f"{count} balls in a frame", got="none", do=do))
    return max(ranks, key=lambda k: ranks[k])


def _misfit(
    at: Instant, frame: int, past: Sequence[Sequence[tuple[int, Floats]]], sizes: Floats, radius_mm: Floats
) -> Floats:
    """Return chi2 (K, M) of position and size of each sphere at each match."""
    cost = np.zeros((len(past), len(at.matches)))
    for m, match in enumerate(at.matches):
        for c, one in enumerate(match.disks):
            if one is not None:
                cost[:, m] += ((one.radius_px / sizes[:, c] - 1) / SIZE_SIGMA) ** 2 / match.number
    for n, seen in enumerate(past):
        if not seen or (gap := abs(frame - seen[-1][0])) > FORGOTTEN:
            continue
        X = seen[-1][1]
        for (before, X_before), (now, X_now) in pairwise(seen):
            X = X_now + (frame - now) / (now - before) * (X_now - X_before)
        sigma = AWAY * radius_mm[n] * gap * (1 if len(seen) > 1 else 3)
        cost[n] += np.square((at.position_lab_mm - X) / sigma).sum(1)
    # Of two matches of one sphere, prefer that of more cameras.
    cost += np.array([len(one.chosen) - one.number + one.chi2 / max(2 * one.number - 3, 1) for one in at.matches])
    return cost


def linked_places(chosen: NDArray[np.int64], instants: Sequence[Instant]) -> Floats:
    """Return the position of a sphere in each frame, (N, 3), mm, linearly interpolated between sightings."""
    seen = np.flatnonzero(chosen >= 0)
    X = np.array([instants[k].position_lab_mm[chosen[k]] for k in seen.tolist()]).reshape(-1, 3)
    every = np.arange(len(instants))
    return np.stack([np.interp(every, seen, X[:, axis]) if len(seen) else every * np.nan for axis in range(3)], axis=1)


def crops_of_ball(
    name: str,
    chosen: NDArray[np.int64],
    instants: Sequence[Instant],
    views: Sequence[CameraView],
    radius_mm: Mapping[str, float],
    places: Sequence[Floats],
) -> Crops:
    """Return the crops of a sphere; `places` (N, 3), mm: its positions, then the others'."""
    count = len(instants)
    crops: list[list[Crop | None]] = [[None] * count for _ in views]
    X = torch.full((count, 3), torch.nan, dtype=torch.float64)
    seen = torch.zeros(count, len(views), dtype=torch.bool)
    radii = [radius_mm[name], *(radius for other, radius in radius_mm.items() if other != name)]
    free = torch.stack([_free(view, [torch.from_numpy(place) for place in places], radii) for view in views], dim=1)
    for k, match in enumerate(chosen.tolist()):
        if match < 0:
            continue
        at = instants[k]
        X[k] = torch.from_numpy(at.position_lab_mm[match])
        for c, disk in enumerate(at.matches[match].chosen):
            if disk >= 0 and free[k, c]:
                crops[c][k], seen[k, c] = at.crops[c][disk], True
    if not bool(seen.any()):
        do = "learn its map from a movie of this ball alone"
        raise PaintError(refusal(f"ball {name}", expected="frames in which it is isolated", got="none", do=do))
    return Crops(views=views, crops=crops, position_lab_mm=X, seen=seen, radius_mm=radii[0], fixed=False)


def _free(view: CameraView, places: Sequence[Tensor], radii_mm: Sequence[float]) -> Tensor:
    """Return the frames in which the disk of the first sphere is whole and isolated."""
    (middle, radius), *others = (
        (view.camera.project(place), view.radius_px(place, size)) for place, size in zip(places, radii_mm, strict=True)
    )
    free: Tensor = view.shows_whole(middle, radius)
    for other, size in others:
        free = free & ((middle - other).norm(dim=-1) > FREE * (radius + size))
    return free


@dataclass(frozen=True, kw_only=True, eq=False)
class SharedMap:
    """A ball's map, and the ball that defines its body frame (another one if both have the same paint)."""

    learnt: LearntMap
    first: str
    correlation: float  # with the map of `first`; 1 for itself


def shared_maps(learnt: Mapping[str, LearntMap], progress: Progress) -> dict[str, SharedMap]:
    """Return the maps of balls, by name; maps of the same paint are joined, in the frame of the first."""
    found: dict[str, SharedMap] = {}
    for name, one in learnt.items():
        found[name] = SharedMap(learnt=one, first=name, correlation=1.0)
        for first in [other for other in found if found[other].first == other != name]:
            progress("balls of one paint", len(found), len(learnt))
            try:
                compared = compare_maps(one.texture, learnt[first].texture)
            except PaintError:
                continue
            R = compared.R_other_reference
            joined = _joined(found[first].learnt, one, R)
            own = replace(one, R_lab_body=one.R_lab_body @ R)
            found[name] = SharedMap(learnt=own, first=first, correlation=compared.correlation)
            for same, its in found.items():
                if its.first == first:
                    own = replace(its.learnt, texture=joined.texture, seen=joined.seen, sigma=joined.sigma)
                    found[same] = replace(its, learnt=own)
            break
    return found


def _joined(first: LearntMap, other: LearntMap, R_other_first: Tensor) -> LearntMap:
    """Return the mean of two maps, weighted by 1 / sigma^2, in the frame of the first."""
    known = torch.where(torch.isfinite(other.sigma), other.sigma.double(), torch.nan)
    parts = (other.texture.double(), known, other.seen.double())
    grey, sigma, seen = (turned_map(part, R_other_first, len(first.texture)) for part in parts)
    gain, offset = fit_levels(grey, first.texture.double())
    own, added = first.sigma.double().square().reciprocal(), (gain * sigma).square().reciprocal().nan_to_num()
    sums = own * first.texture.nan_to_num() + added * (gain * grey + offset).nan_to_num()
    texture, count = (sums / (own + added)).float(), first.seen + seen.nan_to_num().round().long()
    return replace(first, texture=texture, sigma=(own + added).rsqrt().float(), seen=count)


def corrected(learnt: LearntMap, old: Tensor) -> tuple[LearntMap, MapComparison, float]:
    """Express a learnt map in the frame of an old one (h, 2 h), used where unseen; raise PaintError on a mismatch.
    Return also the displacement against the old map, and the share of the sphere with the old map's texture.
    """
    comparison = compare_maps(learnt.texture, old)
    Q = comparison.R_other_reference
    height = max(len(old), len(learnt.texture))
    texture = turned_map(learnt.texture, Q, height)
    known = torch.isfinite(texture)
    before = old.to(texture) if len(old) == height else turned_map(old.to(texture), torch.eye(3), height)
    gain, offset = fit_levels(before, texture)
    new = replace(
        learnt,
        texture=torch.where(known, texture, (gain * before + offset).clamp(0, 1)),
        seen=torch.where(known, nearest_texels(learnt.seen, Q, height), 0),
        sigma=torch.where(known, nearest_texels(learnt.sigma, Q, height), torch.inf),
        R_lab_body=learnt.R_lab_body @ Q,
    )
    kept = ~known & torch.isfinite(before)
    return new, comparison, float((texel_areas(height) * kept).sum() / texel_areas(height).sum())


def nearest_texels(values: Tensor, R_map_new: Tensor, height: int) -> Tensor:
    """Return a map's values in another body frame by the nearest texel, (height, 2 height)."""
    rows = len(values)
    longitude, latitude = texture_coordinates(map_directions(height) @ R_map_new.double().mT)
    column = ((longitude / torch.pi + 1) * rows).long() % (2 * rows)
    row = ((0.5 - latitude / torch.pi) * rows).long().clamp(0, rows - 1)
    return values[row, column]
