"""Does the map fit the pictures: as it is or in a mirror, and do two cameras tell one orientation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.cameras import Camera, R_cam_view
from sphereorient.experiment.stream import spread_frames
from sphereorient.preflight.finding import Finding, Severity
from sphereorient.preflight.look import Look
from sphereorient.search import GreySearch, crop_disk

FRAMES = 8  # of each camera
FITS, POOR = 0.7, 0.55  # share of the picture that the best view of the map explains
CLEARLY = 0.08  # by which the mirror image must fit better or worse
ONE_DEG = 5.0  # orientations from two cameras that differ by more are not of one ball


@dataclass(frozen=True, kw_only=True, eq=False)
class Match:
    """How the map fits one camera's pictures, n frames; made by `match_map`."""

    name: str
    camera: Camera
    centre_px: Tensor  # (n, 2)
    R_view_body: Tensor  # (n, 3, 3), the best; NaN where there is none
    score: Tensor  # (n,), 0 where there is none
    mirrored: Tensor  # (n,), of the pictures' mirror images


def match_map(search: GreySearch, looks: Sequence[Look]) -> list[Match]:
    """Search the map for some of the pictures in which every camera has the ball.

    Args:
        search: of the map.
        looks: of one or two cameras, the same frames.
    """
    seen = torch.stack([look.sightings.placed for look in looks]).all(0).nonzero()[:, 0].tolist()
    chosen = [seen[k] for k in spread_frames(range(len(seen)), FRAMES)]
    return [_matched(search, look, chosen) for look in looks] if chosen else []


def _matched(search: GreySearch, look: Look, chosen: Sequence[int]) -> Match:
    centre, radius = look.sightings.centre_px[list(chosen)], look.sightings.radius_px[list(chosen)]
    disks = []
    for k, (u, v), r in zip(chosen, centre.tolist(), radius.tolist(), strict=True):
        picture = look.picture[k]
        assert picture is not None  # there is an outline
        disks.append(torch.from_numpy(crop_disk(picture, u, v, r, search.size_px)))
    R, score = _best(search, torch.stack(disks))
    _, mirrored = _best(search, torch.stack(disks).flip(-1))
    return Match(name=look.name, camera=look.camera, centre_px=centre, R_view_body=R, score=score, mirrored=mirrored)


def _best(search: GreySearch, disks: Tensor) -> tuple[Tensor, Tensor]:
    """Best proposal of each disk (n, S, S): R_view_body (n, 3, 3) and score (n,)."""
    found = search.propose(disks)
    R, score = torch.full((len(disks), 3, 3), math.nan, dtype=torch.float64), torch.zeros(len(disks)).double()
    for k, first in enumerate(found.offset[:-1].tolist()):
        if found.offset[k + 1] > first:
            R[k], score[k] = found.R_view_body[first], found.score[first]
    return R, score


def map_fits(match: Match, others: Sequence[Match]) -> Finding:
    """Judge how the map explains one camera's pictures."""
    title = f"map in {match.name}"
    score, mirrored = float(match.score.median()), float(match.mirrored.median())
    measured = f"the best view explains {100 * score:.0f} % of the picture, its mirror image {100 * mirrored:.0f} %"
    if mirrored > score + CLEARLY and mirrored > POOR:
        every = all(float((other.mirrored - other.score).median()) > CLEARLY for other in others)
        if every and len(others) > 1:
            advice = "mirror the map left to right, or write flip: for both movies: all cameras see it in a mirror"
        else:
            advice = f"write flip: {{{match.name}: vertical}}, or horizontal: this movie shows the ball in a mirror"
        return Finding(title=title, severity=Severity.FAULT, measured=measured, advice=advice)
    if score < POOR:
        advice = "check sphere.texture: this map does not show what the movie shows"
        return Finding(title=title, severity=Severity.FAULT, measured=measured, advice=advice)
    if score < FITS or score < mirrored + CLEARLY:
        advice = "look at the light and at the map: reflections, worn paint and a map that is off all cost certainty"
        return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
    return Finding(title=title, severity=Severity.OK, measured=measured)


def one_ball(matches: Sequence[Match]) -> Finding:
    """Judge whether two cameras tell the same orientation."""
    title = "one orientation"
    first, second = matches
    off = _differ_deg(first, second, (first.camera, second.camera))
    measured = f"the orientations from {first.name} and {second.name} differ by {off:.1f} degrees (median)"
    if off <= ONE_DEG:
        return Finding(title=title, severity=Severity.OK, measured=measured)
    if math.isnan(off):
        measured, advice = "cannot tell: the map is not found in the pictures", "see what is said of the map"
        return Finding(title=title, severity=Severity.WARNING, measured=measured, advice=advice)
    swapped = _differ_deg(first, second, (second.camera, first.camera))
    if swapped <= ONE_DEG:
        advice = f"swap {first.name} and {second.name} in movies: (then they differ by {swapped:.1f} degrees)"
    else:
        advice = "check R of both cameras in cameras.yaml, flip:, and whether the movies are of one experiment"
    return Finding(title=title, severity=Severity.FAULT, measured=measured, advice=advice)


def _differ_deg(first: Match, second: Match, cameras: tuple[Camera, Camera]) -> float:
    """Median angle between the orientations in the lab, degrees; NaN where there are none in common."""
    lab = []
    for match, camera in zip((first, second), cameras, strict=True):
        direction_cam = camera.rays(match.centre_px).direction_lab @ camera.R_cam_lab.mT
        lab.append(camera.R_cam_lab.mT @ R_cam_view(direction_cam) @ match.R_view_body)
    return float(torch.rad2deg(so3.geodesic_distance(lab[0], lab[1])).nanmedian())
