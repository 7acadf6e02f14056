"""What a movie's pictures are like, learnt from a few of its frames before the others are measured."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.errors import ExperimentError, refusal
from sphereorient.locate import LocateSettings
from sphereorient.orient.cold import Poses, cold_start, cold_start_apart
from sphereorient.orient.eye import FINEST_PX, Eye, Fitter, Optics, Picture, level_of
from sphereorient.orient.light import Light
from sphereorient.orient.pixels import Pixels
from sphereorient.orient.proposer import Proposer
from sphereorient.orient.refine import Fit, learn_light
from sphereorient.orient.settings import RefineSettings
from sphereorient.sphere.paint_table import PaintTable
from sphereorient.trajectory import Reason

BLURS = tuple(FINEST_PX * 1.25**k for k in range(8))  # px; what is tried where the blur is not given
TRIED, APART = 4, 1.5  # frames; and by how much more cameras that do not fit together leave unexplained
ENOUGH = 1400  # pixels of each disk that are looked at: more of them have told no more
WIDER = 1.03  # how much larger than in the frames looked at a disk may be in others
FIRST_BLUR = 0.625  # px: a pixel's own width and a good lens


@dataclass(frozen=True, kw_only=True, eq=False)
class Study:
    """Blur and light of the movies, and how well right and wrong poses explain them; made by `study`."""

    fitter: Fitter
    score_min: float  # between right and wrong poses
    right_score: float  # typical of right poses

    @property
    def clear_score(self) -> float:
        """Score of a pose that explains its pictures about as well as is typical."""
        return max(self.score_min, _clear_of(self.right_score))


def study(
    eyes: Sequence[Eye],
    pictures: Sequence[Sequence[Picture]],
    base: PaintTable,
    proposers: Mapping[str, Proposer],
    radius_mm: float,
    locating: LocateSettings,
    settings: RefineSettings,
) -> Study:
    """Learn blur and light.

    Args:
        eyes: C of them.
        pictures: n times C frames, spread over the movie.
        base: finest table of the paint.
        proposers: by name of eye.
        radius_mm: of the sphere.
        locating: how outlines are found.
        settings: blur, if given.

    Raises:
        ExperimentError: no frame has a pose.
    """
    diameter_px = max(eye.diameter_px for eye in eyes)
    blur_px = settings.blur_px or FIRST_BLUR
    noise = torch.tensor([[eye.background.typical_noise**2, 0.02, 0.001, 0.0] for eye in eyes])
    light = Light.unknown(len(eyes), noise)
    fitter = Fitter(
        eyes=eyes,
        radius_mm=radius_mm,
        optics=Optics(base, blur_px, diameter_px),
        light=light,
    )

    def search(how: Callable[..., Poses]) -> list[Poses]:
        ask = partial(how, fitter, proposers, locating=locating, candidates=settings.candidates)
        with ThreadPoolExecutor(2) as pool:  # outlines and products of matrices leave the interpreter free
            return list(pool.map(ask, pictures))

    found = search(cold_start)
    together = _fit_together(fitter, pictures, found)
    if not together:
        found = search(cold_start_apart)
    chosen = _clear(found)
    if not chosen:
        raise _nothing(found)
    frame, X, R, use = _seen_by_all(found, chosen) if together else _seen_by_each(found, chosen)
    pixels = fitter.pixels([pictures[k] for k in frame], X, fitter.optics.fine)
    pixels = pixels.thinned(max(1, round(pixels.grey.shape[1] / ENOUGH)))
    fit = fitter.fit(pixels, X, R, use, fitter.optics.fine, 4)
    fitter, fit = _with_light(fitter, pixels, fit, use, 2)
    if settings.blur_px is None:
        blur_px = _best_blur(fitter, base, pixels, fit, use)
        optics = Optics(base, blur_px, diameter_px)
        fitter = Fitter(eyes=eyes, radius_mm=radius_mm, optics=optics, light=fitter.light)
    fitter, fit = _with_light(fitter, pixels, fit, use, 2)
    widest = WIDER * float(fitter.largest_px(fit.position_lab_mm).max())
    right = float(fit.score[use].median())
    wrong = torch.cat([found[k].score[1:][:, found[k].use].reshape(-1) for k in chosen])
    highest = float(wrong.quantile(0.9)) if len(wrong) else 0.0
    fitter = replace(fitter, widest_px=widest)
    return Study(fitter=fitter, score_min=0.5 * (right + min(highest, right)), right_score=right)


def _fit_together(fitter: Fitter, pictures: Sequence[Sequence[Picture]], found: Sequence[Poses]) -> bool:
    """Tell from a few frames whether the cameras see one ball in one place: bumped ones each explain more alone."""
    if len(fitter.eyes) == 1:
        return True
    whole = [k for k, poses in enumerate(found) if len(poses) and bool(poses.use.all())]
    apart = sum(Reason.CONTRADICTS in poses.reason for poses in found)
    if apart > len(whole):
        return False
    tried = sorted(whole, key=lambda k: -float(found[k].score[0].min()))[:TRIED]
    if not tried:
        return True
    X, R = (torch.cat([getattr(found[k], name)[:1] for k in tried]) for name in ("position_lab_mm", "R_lab_body"))
    gains = []
    for camera in range(len(fitter.eyes)):
        only = torch.zeros(len(tried), len(fitter.eyes), dtype=torch.bool)
        only[:, camera] = True
        X_own, R_own = X, R
        for level, step in ((fitter.optics.middle, 3), (fitter.optics.fine, 4)):
            pixels = fitter.pixels([pictures[k] for k in tried], X_own, level).thinned(step)
            fit = fitter.fit(pixels, X_own, R_own, only, level, 3)
            X_own, R_own = fit.position_lab_mm, fit.R_lab_body
        joint = torch.cat([found[k].score[:1, camera] for k in tried])
        gains.append((1 - joint) / (1 - fit.score[:, camera]).clamp_min(1e-6))
    return float(torch.stack(gains).amax(0).median()) < APART


def _seen_by_all(found: Sequence[Poses], chosen: Sequence[int]) -> tuple[list[int], Tensor, Tensor, Tensor]:
    """Return frames, places, rotations and cameras in use of poses that all cameras tell."""
    X = torch.cat([found[k].position_lab_mm[:1] for k in chosen])
    R = torch.cat([found[k].R_lab_body[:1] for k in chosen])
    return list(chosen), X, R, torch.stack([found[k].use for k in chosen])


def _seen_by_each(found: Sequence[Poses], chosen: Sequence[int]) -> tuple[list[int], Tensor, Tensor, Tensor]:
    """Return the same of poses that each camera tells for itself."""
    rows = [
        (k, camera)
        for k in chosen
        for camera, why in enumerate(found[k].reason)
        if why in (Reason.OK, Reason.CONTRADICTS)
    ]
    X = torch.stack([found[k].position_lab_mm[0] + found[k].own_move[0, c] * (not found[k].use[c]) for k, c in rows])
    turn = torch.stack([found[k].own_turn[0, c] * (not found[k].use[c]) for k, c in rows])
    R = so3.exp(turn) @ torch.stack([found[k].R_lab_body[0] for k, _ in rows])
    use = torch.nn.functional.one_hot(torch.tensor([c for _, c in rows]), found[0].use.shape[0]).bool()
    return [k for k, _ in rows], X, R, use


def _nothing(found: Sequence[Poses]) -> ExperimentError:
    """Say what was missing in all frames: the ball, or a pose of the map that looks like it."""
    reasons = {str(why) for poses in found for why in poses.reason}
    got = f"none ({', '.join(sorted(reasons))})"
    if Reason.LOW_SCORE in reasons:
        expected, do = "frames that the map explains", "check sphere.texture, and the cameras: are they swapped?"
    else:
        expected, do = "the sphere in some frame", "check sphere.diameter and the cameras, or set locate.diameter_px"
    return ExperimentError(refusal("movies", expected=expected, got=got, do=do))


def _clear(found: Sequence[Poses]) -> list[int]:
    """Frames whose best pose explains the picture about as well as in the typical frame."""
    best = torch.tensor([float(poses.score[0, poses.use].min()) if len(poses) else torch.nan for poses in found])
    if torch.isnan(best).all():
        return []
    return [k for k, score in enumerate(best.tolist()) if score >= _clear_of(float(best.nanquantile(0.75)))]


def _clear_of(typical: float) -> float:
    """Return the score that leaves three times as much unexplained as a typical one."""
    return 1 - 3 * (1 - typical)


def _with_light(fitter: Fitter, pixels: Pixels, fit: Fit, use: Tensor, rounds: int) -> tuple[Fitter, Fit]:
    """Learn the light and fit again, some times."""
    fine = fitter.optics.fine
    for _ in range(rounds):
        light = learn_light(
            pixels,
            fit,
            use,
            radius_mm=fitter.radius_mm,
            paint=fine.paint,
            blur_px=fine.blur_px,
            light=fitter.light,
            shading=fitter.shading,
        )
        fitter = Fitter(eyes=fitter.eyes, radius_mm=fitter.radius_mm, optics=fitter.optics, light=light)
        fit = fitter.fit(pixels, fit.position_lab_mm, fit.R_lab_body, use, fine, 3)
    return fitter, fit


def _best_blur(fitter: Fitter, base: PaintTable, pixels: Pixels, fit: Fit, use: Tensor) -> float:
    """Return the blur that leaves the least of the pictures unexplained, between the tried ones by a parabola."""
    radius_px = max(eye.diameter_px for eye in fitter.eyes) / 2
    left: dict[int, float] = {}

    def unexplained(k: int) -> float:
        if k not in left:
            level = level_of(base, BLURS[k], 0.0, radius_px)
            tried = fitter.fit(pixels, fit.position_lab_mm, fit.R_lab_body, use, level, 2)
            left[k] = float((1.0 - tried.score)[use].median())
        return left[k]

    # Downhill from the first guess: each table of the paint costs a tenth of a second.
    k = min(range(len(BLURS)), key=lambda k: abs(BLURS[k] - fitter.optics.blur_px))
    while True:
        near = [n for n in (k - 1, k, k + 1) if 0 <= n < len(BLURS)]
        best = min(near, key=unexplained)
        if best == k:
            break
        k = best
    if k in (0, len(BLURS) - 1):
        return BLURS[k]
    bend = left[k - 1] - 2 * left[k] + left[k + 1]
    shift = 0.5 * (left[k - 1] - left[k + 1]) / bend if bend > 0 else 0.0
    return float(BLURS[k] * (BLURS[1] / BLURS[0]) ** shift)
