"""What a movie's pictures are like, learnt from a few of its frames before the others are measured."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import torch
from torch import Tensor

from sphereorient.cameras import triangulate
from sphereorient.errors import ExperimentError, refusal
from sphereorient.follow.initialise import Poses, initialise
from sphereorient.follow.light_and_blur import LEAST_LEFT, learn_light_and_blur
from sphereorient.locate import Frame, LocateSettings
from sphereorient.pose.defocus import FIRST_BLUR_PX, defocus_radii
from sphereorient.pose.fit import Fit
from sphereorient.pose.fitter import CameraView, Fitter, Optics, Picture, unknown_light, widest_px
from sphereorient.search.proposer import Proposer
from sphereorient.search.settings import RefineSettings
from sphereorient.sphere.texture_table import TextureTable
from sphereorient.trajectory import Reason

TRIED = 6  # frames
APART_GAIN = 1.5  # cameras that leave so many times more unexplained together than alone are followed one by one
APART_PX = 0.4  # where lines of sight miss each other by more, light is learnt from each camera alone
FAR_APART_PX = 1.5  # and by more than this, one pose for all cameras is none
FEWEST_BOTH = 4  # frames that tell what is usual between two cameras
TORN = (Reason.OUTLINE, Reason.LOW_SCORE)  # a camera that sees a ball, but not where the other does
NO_BETTER = 0.05  # poses that explain the pictures by less more than wrong ones do are wrong as well
TELLING = 2.0  # unless wrong ones leave so many times more unexplained, picture by picture; other maps: 1.6 at most
ENOUGH = 1400  # pixels of each disk that are looked at: more of them have told no more
WIDER = 1.02  # how much larger than in the frames looked at a disk may be in others
ALWAYS = 1.0  # score from which on outlines of blurred pictures are believed: the paint is asked where the ball is


@dataclass(frozen=True, kw_only=True, eq=False)
class Appearance:
    """Blur and light of the movies, and how well right and wrong poses explain them; made by `study`."""

    fitter: Fitter
    score_min: float  # between right and wrong poses
    right_score: float  # typical of right poses
    usual_apart_rad: float = math.inf  # typical angle between what two cameras by themselves say of one pose
    together: bool = True  # whether the cameras see one ball in one place, as they do unless they were bumped

    def of(self, camera: int) -> Appearance:
        """Return what was learnt of one camera."""
        return replace(self, fitter=self.fitter.of(camera))

    def on(self, device: torch.device) -> Appearance:
        """Return the same with fits that are computed on another device."""
        return replace(self, fitter=self.fitter.on(device))

    @property
    def clear_score(self) -> float:
        """Score of a pose that explains its pictures about as well as is typical; none does of soft ones."""
        optics = self.fitter.optics
        soft = defocus_radii(optics.blur_px, widest_px(self.fitter.views))
        return ALWAYS if soft else max(self.score_min, _clear_of(self.right_score))


def estimate_appearance(
    views: Sequence[CameraView],
    shots: Sequence[Sequence[Frame]],
    base: TextureTable,
    proposers: Mapping[str, Proposer],
    radius_mm: float,
    locating: LocateSettings,
    settings: RefineSettings,
    blur_px: float = FIRST_BLUR_PX,
) -> Appearance:
    """Learn blur and light.

    Args:
        views: C of them.
        shots: n times C frames, spread over the movie.
        base: finest table of the paint.
        proposers: by name of view.
        radius_mm: of the sphere.
        locating: how outlines are found.
        settings: blur, if given.
        blur_px: that is begun with otherwise.

    Raises:
        ExperimentError: no frame has a pose, or none that is better than wrong ones.
    """
    diameter_px = widest_px(views)
    blur_px = settings.blur_px or blur_px
    score_min = ALWAYS if defocus_radii(blur_px, diameter_px) else 0.0
    fitter = Fitter(
        views=views,
        radius_mm=radius_mm,
        optics=Optics(base, blur_px, diameter_px),
        light=unknown_light(views),
    )

    def search(seeing: Fitter, frames: Sequence[Sequence[Frame]]) -> list[Poses]:
        ask = partial(
            initialise, seeing, proposers, locating=locating, candidates=settings.candidates, score_min=score_min
        )
        with ThreadPoolExecutor(2) as pool:  # outlines and products of matrices leave the interpreter free
            return list(pool.map(ask, frames))

    found = search(fitter, shots)
    pictures = [[shot.picture for shot in frame] for frame in shots]
    if not _clear(found):
        raise _nothing(found)
    gain, gap_px = _apart(fitter, pictures, found)
    looked = found
    if gain > APART_GAIN or gap_px > APART_PX:
        # A pose between what the cameras see would teach a light that is nowhere.
        each = [search(fitter.of(k), [[frames[k]] for frames in shots]) for k in range(len(views))]
        frame, X, R, use = _seen_by_each(each)
        looked = [poses for of_camera in each for poses in of_camera]
    else:
        frame, X, R, use = _seen_by_all(found)
    pixels = fitter.pixels([pictures[k] for k in frame], X, fitter.optics.fine)
    pixels = pixels.thinned(max(1, round(pixels.grey.shape[1] / ENOUGH)))
    fit = fitter.fit(pixels, X, R, use, fitter.optics.fine, 4)
    fitter, fit = learn_light_and_blur(fitter, base, pixels, fit, use, given=settings.blur_px is not None)
    widest = WIDER * float(fitter.largest_px(fit.position_lab_mm).max())
    right = float(fit.score[use].median())
    best, highest = _scores(looked)
    if max(best, right) < highest + NO_BETTER and _times_better(looked) < TELLING:
        raise _unexplained(best)
    if right < highest + NO_BETTER:
        # Dirt or a rim that is hidden spoils the light that was learnt: all poses are explained worse than before.
        highest = right - (best - highest)
    fitter = replace(fitter, widest_px=widest)
    together = gain <= APART_GAIN and gap_px <= FAR_APART_PX
    score_min = 0.5 * (right + min(highest, right))
    if defocus_radii(fitter.optics.blur_px, diameter_px):  # wrong poses explain nearly as much, and right ones scatter
        score_min = min(score_min, _clear_of(right))
    apart_rad = _usual_apart(fit, use)
    return Appearance(
        fitter=fitter, score_min=score_min, right_score=right, usual_apart_rad=apart_rad, together=together
    )


def _usual_apart(fit: Fit, use: Tensor) -> float:
    """Return the median angle between the turns of two cameras that see the ball together; infinite without any."""
    angles = [
        (fit.own_turn[:, k] - fit.own_turn[:, m]).norm(dim=-1)[use[:, k] & use[:, m]]
        for k, m in combinations(range(use.shape[1]), 2)
    ]
    both = torch.cat([torch.zeros(0, dtype=torch.float64), *angles])
    return float(both.median()) if len(both) >= FEWEST_BOTH else math.inf


def _apart(fitter: Fitter, pictures: Sequence[Sequence[Picture]], found: Sequence[Poses]) -> tuple[float, float]:
    """Tell from a few frames whether the cameras see one ball in one place, as they do unless they were bumped.

    Returns:
        By how much more is left unexplained with all cameras than by each alone, and by how many pixels the lines of
        sight to what each sees alone miss each other; both in the worst quarter of the frames, for a bump may leave
        the cameras in accord in one part of the volume.
    """
    cameras = len(fitter.views)
    whole = [k for k, poses in enumerate(found) if len(poses) and bool(poses.use.all())]
    if cameras == 1:
        return 1.0, 0.0
    torn = [poses for poses in found if len(poses) and any(why in TORN for why in poses.reason)]
    if len(whole) < len(torn):
        return math.inf, math.inf  # outlines that miss each other already
    if not whole:
        return 1.0, 0.0
    tried = [whole[int(k)] for k in torch.linspace(0, len(whole) - 1, min(TRIED, len(whole))).round()]
    start = [torch.cat([getattr(found[k], name)[:1] for k in tried]) for name in ("position_lab_mm", "R_lab_body")]
    gains, rays = [], []
    for camera, view in enumerate(fitter.views):
        only = torch.zeros(len(tried), cameras, dtype=torch.bool)
        only[:, camera] = True
        X, R = start
        for level, step in ((fitter.optics.middle, 3), (fitter.optics.fine, 4)):
            pixels = fitter.pixels([pictures[k] for k in tried], X, level).thinned(step)
            fit = fitter.fit(pixels, X, R, only, level, 3)
            X, R = fit.position_lab_mm, fit.R_lab_body
        joint = torch.cat([found[k].score[:1, camera] for k in tried])
        gains.append((1 - joint) / (1 - fit.score[:, camera]).clamp_min(1e-6))
        rays.append(view.camera.rays(view.camera.project(X)))
    gap_mm = torch.stack([triangulate(one, other)[1] for one, other in combinations(rays, 2)]).amax(0)
    px_mm = widest_px(fitter.views) / (2 * fitter.radius_mm)
    return float(torch.stack(gains).amax(0).quantile(0.75)), float(gap_mm.quantile(0.75) * px_mm)


Rows = tuple[list[int], Tensor, Tensor, Tensor]  # frames, places (n, 3), rotations (n, 3, 3), cameras in use (n, C)


def _seen_by_all(found: Sequence[Poses]) -> Rows:
    """Return the clear poses that all cameras tell together."""
    chosen = _clear(found)
    X = torch.cat([found[k].position_lab_mm[:1] for k in chosen])
    R = torch.cat([found[k].R_lab_body[:1] for k in chosen])
    return chosen, X, R, torch.stack([found[k].use for k in chosen])


def _seen_by_each(each: Sequence[Sequence[Poses]]) -> Rows:
    """Return the clear poses that each camera tells for itself."""
    rows = [(k, camera) for camera, found in enumerate(each) for k in _clear(found)]
    X = torch.stack([each[camera][k].position_lab_mm[0] for k, camera in rows])
    R = torch.stack([each[camera][k].R_lab_body[0] for k, camera in rows])
    use = torch.nn.functional.one_hot(torch.tensor([camera for _, camera in rows]), len(each)).bool()
    return [k for k, _ in rows], X, R, use


def _scores(found: Sequence[Poses]) -> tuple[float, float]:
    """Return how well the best poses typically explain clear frames, and how well wrong ones do at their best."""
    clear = _clear(found)
    best = torch.cat([found[k].score[0][found[k].use] for k in clear])
    wrong = torch.cat([found[k].score[1:][:, found[k].use].reshape(-1) for k in clear])
    return float(best.median()), float(wrong.quantile(0.9)) if len(wrong) else 0.0


def _times_better(found: Sequence[Poses]) -> float:
    """Return how many times more of its pictures the second best pose of a clear frame typically leaves unexplained.

    Blurred pictures are mostly disk, and any pose explains most of one; nothing but the ratio then tells.
    """
    rows = [(found[k].score[:2], found[k].use) for k in _clear(found) if len(found[k]) > 1]
    if not rows:
        return math.inf
    left = torch.stack([(1 - score[:, use]).mean(1).clamp_min(LEAST_LEFT) for score, use in rows])
    return float((left[:, 1] / left[:, 0]).median())


def _nothing(found: Sequence[Poses]) -> ExperimentError:
    """Say what was missing in all frames: the ball, or a pose of the map that looks like it."""
    reasons = {str(why) for poses in found for why in poses.reason}
    got = f"none ({', '.join(sorted(reasons))})"
    if Reason.LOW_SCORE in reasons:
        expected, do = "frames that the map explains", "check sphere.texture, and the cameras: are they swapped?"
    else:
        expected, do = "the sphere in some frame", "check sphere.diameter and the cameras, or set locate.diameter_px"
    return ExperimentError(refusal("movies", expected=expected, got=got, do=do))


def _unexplained(score: float) -> ExperimentError:
    """Say that the best poses are no better than wrong ones: the pictures are not of this map."""
    do = "look with `sphereorient check`: another map, a mirrored movie (flip:) or swapped cameras look like this"
    got = f"poses that explain {100 * score:.0f} % of the pictures, as wrong ones do"
    return ExperimentError(refusal("movies", expected="frames that the map explains", got=got, do=do))


def _clear(found: Sequence[Poses]) -> list[int]:
    """Frames whose best pose explains the picture about as well as in the typical frame."""
    best = torch.tensor([float(poses.score[0, poses.use].min()) if len(poses) else torch.nan for poses in found])
    if torch.isnan(best).all():
        return []
    return [k for k, score in enumerate(best.tolist()) if score >= _clear_of(float(best.nanquantile(0.75)))]


def _clear_of(typical: float) -> float:
    """Return the score that leaves three times as much unexplained as a typical one."""
    return 1 - 3 * (1 - typical)
