"""Checks of the texture map: contrast and patches, views that look alike, and its match with the pictures."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.experiment.recording import spread_frames
from sphereorient.preflight.finding import FAULT, WARNING, Finding, judged, warning
from sphereorient.preflight.sample import MovieSample
from sphereorient.search import GreySearch, crop_disk
from sphereorient.search.normalisation import LocalNormalisation
from sphereorient.search.refine_rotation import detail_level, refine_rotation
from sphereorient.search.settings import GreySearchSettings
from sphereorient.sphere import orthographic_view, reduced_texture, sample_texture, unseen_share
from sphereorient.sphere.texture import fibonacci_directions, map_directions, texel_areas
from sphereorient.sphere.texture_table import texture_table

ROWS = 32  # of the reduced map on which views are averaged: 5.6 degrees
ONE_COLOUR, FAINT = 0.02, 0.12  # standard deviation of the map, 0 black .. 1 white
LOPSIDED = (0.1, 0.9)  # limits of a view's brightness
FINE_PX, COARSE_DEG = 5.0, 70.0  # smaller patches are not resolved; larger ones leave many views without a border
DRAWS = 4000  # random points that are compared with their neighbourhood
STEP_DEG = 15.0  # of the grid of rotations with which views are compared
VIEWS = 300  # directions of view, 8 degrees apart; rotation of the picture makes no new view
APART_DEG = 20.0  # nearer rotations show the same view
REFINED = 40  # pairs whose rotation is refined
BATCH = 64  # views that are normalised at once
ALIKE, SAME = 0.85, 0.97  # share of one view explained by another: above, single frames are doubtful, useless
FRAMES = 8  # spread over the movies, compared with the map
FITS, POOR = 0.7, 0.55  # share of the picture that the best view of the map explains
CLEARLY = 0.08  # difference of this share between the picture and its mirror image


@dataclass(frozen=True, kw_only=True, eq=False)
class TextureMeasures:
    """Measures of a texture map; made by `measure_texture`, read by the check and the figure."""

    contrast: float  # standard deviation over the sphere, 0 black .. 1 white
    view_brightness: Tensor  # (ROWS, 2 ROWS), mean brightness of the hemisphere seen from each direction, as a map
    patch_rad: float  # typical width of a patch


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewPair:
    """Two similar views; made by `most_similar_views`, read by the check and the figure."""

    score: float  # share of one view that the other explains under any smooth light, as the search scores
    angle_rad: float  # between the two orientations
    pictures: Tensor  # (2, S, S), 0 black .. 1 white, NaN beyond the disk
    R_view_body: Tensor  # (2, 3, 3)


@dataclass(frozen=True, kw_only=True, eq=False)
class TextureMatch:
    """The match of the map with n pictures of one camera; made by `match_texture`."""

    name: str
    score: Tensor  # (n,), 0: none found
    mirrored: Tensor  # (n,), score of the mirrored pictures


def measure_texture(texture: Tensor) -> TextureMeasures:
    """Measure a map, (H, 2 H), 0 black .. 1 white."""
    small = reduced_texture(texture.double(), 2 * ROWS / math.pi)
    direction, area = map_directions(len(small)).reshape(-1, 3), texel_areas(len(small))
    mean = (small * area).sum() / area.sum()
    fine = reduced_texture(texture, 200.0).double()
    share = texel_areas(len(fine)) / (4 * math.pi)
    deviation = ((fine - (fine * share).sum()).square() * share).sum()
    weight = (map_directions(ROWS).reshape(-1, 3) @ direction.T).clamp_min(0) * area.reshape(-1)
    brightness = ((weight @ small.reshape(-1)) / weight.sum(1)).reshape(ROWS, 2 * ROWS)
    patch_rad = _patch_rad(fine.float(), float(mean))
    return TextureMeasures(contrast=float(deviation.sqrt()), view_brightness=brightness, patch_rad=patch_rad)


def unknown_paint(unseen: Tensor) -> Finding:
    """Report unseen paint, texels (H, 2 H) bool."""
    measured = f"{100 * unseen_share(unseen):.0f} % of the ball is unseen: it has no weight"
    return warning("unseen paint", measured, "learn the map from movies that show all of it, with `sphereorient map`")


def _patch_rad(texture: Tensor, mean: float) -> float:
    rng = torch.Generator().manual_seed(0)
    at, side = torch.nn.functional.normalize(torch.randn(2, DRAWS, 3, generator=rng), dim=-1)
    side = torch.nn.functional.normalize(side - (side * at).sum(-1, keepdim=True) * at, dim=-1)
    angle = torch.deg2rad(torch.cat([torch.arange(0, 10, 0.5), torch.arange(10, 91, 2.0)]))
    here = sample_texture(texture, at) - mean
    there = sample_texture(texture, at * angle.cos()[:, None, None] + side * angle.sin()[:, None, None]) - mean
    correlation = (here * there).mean(1) / here.square().mean().clamp_min(1e-12)
    below = torch.nonzero(correlation < 0.5)
    k = int(below[0, 0]) if len(below) else 0
    if k == 0:
        return 0.0 if len(below) else math.pi
    share = float((correlation[k - 1] - 0.5) / (correlation[k - 1] - correlation[k]).clamp_min(1e-9))
    # The correlation of stripes falls to a half at a quarter of their width.
    return 4 * float(angle[k - 1] + share * (angle[k] - angle[k - 1]))


def judge_contrast(measures: TextureMeasures, radius_px: float) -> Finding:
    """Judge contrast, balance and patches of a map, for a ball of this radius in the pictures."""
    patch_deg, patch_px = math.degrees(measures.patch_rad), measures.patch_rad * radius_px
    low, high = float(measures.view_brightness.min()), float(measures.view_brightness.max())
    measured = f"views are {100 * low:.0f} to {100 * high:.0f} % bright; patches of about {patch_deg:.0f} degrees, "
    measured += f"{patch_px:.0f} px; contrast {measures.contrast:.2f}"
    lopsided = low < LOPSIDED[0] or high > LOPSIDED[1]
    faint = "paint with more contrast, or check that the map was exported from black to white"
    fine = "paint larger patches, or film the ball larger: the blur removes such detail"
    return judged(
        "paint",
        measured,
        (measures.contrast < ONE_COLOUR, FAULT, "check the map: it has one colour, which shows no orientation"),
        (measures.contrast < FAINT, WARNING, faint),
        (patch_px < FINE_PX, WARNING, fine),
        (patch_deg > COARSE_DEG, WARNING, "paint smaller patches: many views show hardly any border"),
        (lopsided, WARNING, "balance black and white: some views are nearly of one colour"),
    )


def most_similar_views(texture: Tensor, settings: GreySearchSettings) -> ViewPair:
    """Find two distant views of a map (H, 2 H), 0 black .. 1 white, one of which explains most of the other."""
    size = settings.size_px
    view = orthographic_view(size)
    normal = view.normal_view.T.contiguous()
    table = texture_table(texture, min(2.0 / size, settings.detail), 192)
    normalise = LocalNormalisation(size, detail=settings.detail, window=settings.window, clip=settings.clip)

    def pictures(R: Tensor, beyond: float = 0.0) -> Tensor:
        return view.picture(table.sample(R.mT @ normal)[0], beyond)

    def normalised(R: Tensor) -> Tensor:
        return torch.cat([normalise(pictures(some)) for some in torch.split(R, BATCH)])

    seen = views_towards(fibonacci_directions(VIEWS)).float()
    grid = so3.lattman_grid(math.radians(STEP_DEG)).float()
    cosine = (seen.reshape(-1, 9) @ grid.reshape(-1, 9).T - 1) / 2
    likeness = normalised(seen) @ normalised(grid).T
    best = likeness.masked_fill(cosine > math.cos(math.radians(APART_DEG)), -1.0).max(1)
    rough, fine = detail_level(view, table, settings.detail, 2), detail_level(view, table, 2.0 / size, 1)
    found = ViewPair(score=0.0, angle_rad=math.pi, pictures=pictures(seen[:1]).expand(2, -1, -1), R_view_body=seen[:2])
    for k in best.values.argsort(descending=True)[:REFINED].tolist():
        disk = pictures(seen[k : k + 1])[0]
        R, _ = refine_rotation(rough, disk, grid[best.indices[k]][None], settings.rough_steps)
        R, score = refine_rotation(fine, disk, R, settings.fine_steps)
        angle = float(so3.geodesic_distance(seen[k].double(), R[0].double()))
        if float(score) > found.score and angle > math.radians(APART_DEG):
            pair = torch.stack([seen[k], R[0]])
            found = ViewPair(score=float(score), angle_rad=angle, pictures=pictures(pair, math.nan), R_view_body=pair)
    return found


def views_towards(direction_body: Tensor) -> Tensor:
    """Return R_view_body (n, 3, 3) that rotate body directions (n, 3) to the viewer, -z of the view."""
    back = -direction_body
    helper = torch.eye(3, dtype=back.dtype)[back.abs().argmin(-1)]
    right = torch.nn.functional.normalize(torch.linalg.cross(helper, back), dim=-1)
    return torch.stack([right, torch.linalg.cross(back, right), back], dim=-2)


def look_alikes(pair: ViewPair) -> Finding:
    """Judge the two most similar views."""
    measured = f"the worst pair, {math.degrees(pair.angle_rad):.0f} degrees apart: one explains "
    measured += f"{100 * pair.score:.0f} % of the other"
    measured += ": single frames are unambiguous" if pair.score < ALIKE else ""
    same = "break the paint's symmetry: add a patch that exists only once; these two views are indistinguishable"
    alike = "add a patch where the two views are alike: single frames of them are ambiguous"
    complaints = (pair.score >= SAME, FAULT, same), (pair.score >= ALIKE, WARNING, alike)
    return judged("views that look alike", measured, *complaints)


def match_texture(search: GreySearch, samples: Sequence[MovieSample]) -> list[TextureMatch]:
    """Search the map in some frames that show the ball in every camera, whole if possible."""
    placed = torch.stack([sample.sightings.placed for sample in samples]).all(0)
    whole = torch.stack([sample.whole for sample in samples]).all(0)
    seen = (whole if bool(whole.any()) else placed).nonzero()[:, 0].tolist()
    chosen = [seen[k] for k in spread_frames(range(len(seen)), FRAMES)]
    return [_matched(search, sample, chosen) for sample in samples] if chosen else []


def _matched(search: GreySearch, sample: MovieSample, chosen: list[int]) -> TextureMatch:
    crops = []
    for k in chosen:
        picture, outline = sample.picture[k], sample.found[k][0]
        assert picture is not None
        assert outline is not None
        crops.append(crop_disk(picture, *outline.circle, search.size_px))
    disks = torch.from_numpy(np.stack(crops))
    score, mirrored = (search.propose(each).best_score for each in (disks, disks.flip(-1)))
    return TextureMatch(name=sample.name, score=score, mirrored=mirrored)


def shows_no_map(match: TextureMatch) -> bool:
    """Return whether the search by outlines finds the map neither in the pictures nor in their mirror images."""
    return bool(max(np.median(match.score), np.median(match.mirrored)) < POOR)


def map_fits(match: TextureMatch, matches: Sequence[TextureMatch], fitted: bool) -> Finding:
    """Judge the match of the map with one camera's pictures; `fitted`: the tracker fits it nevertheless."""
    score, mirrored = np.median(match.score), np.median(match.mirrored)
    measured = f"the best view explains {100 * score:.0f} % of the picture, its mirror image {100 * mirrored:.0f} %"
    flip = f"write flip: {{{match.name}: vertical}}, or horizontal: this movie is mirrored"
    if len(matches) > 1 and all(np.median(one.mirrored - one.score) > CLEARLY for one in matches):
        flip = "mirror the map left to right, or write flip: for both movies: all pictures are mirrored"
    unsure = "check light and map: reflections, worn paint and errors of the map reduce the certainty"
    return judged(
        f"map in {match.name}",
        measured,
        (mirrored > score + CLEARLY and mirrored > POOR, FAULT, flip),
        (score < POOR and not fitted, FAULT, "check sphere.texture: the movie does not show this map"),
        (score < FITS or score < mirrored + CLEARLY, WARNING, unsure),
    )
