"""Appearance of a movie (light, blur, noise), estimated from a few frames before tracking."""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.calibration.consistency import Seen, compare_cameras, limits_of, majority
from sphereorient.cameras import centre_lab_mm, triangulate
from sphereorient.errors import ExperimentError, refusal
from sphereorient.files.threads import side_by_side
from sphereorient.follow.initialise import Initialiser
from sphereorient.follow.poses import Poses, best_poses, pose_table, poses_of
from sphereorient.follow.settings import RefineSettings
from sphereorient.locate import Frame
from sphereorient.pose.blur import FINER, FINEST, best_blur_px
from sphereorient.pose.fit import FittedPoses
from sphereorient.pose.fitter import (
    FEWEST_LIT,
    FINEST_PX,
    LEAST_LEFT,
    CameraView,
    Fitter,
    Optics,
    Picture,
    defocus_radii,
    some_of,
    widest_px,
)
from sphereorient.pose.lasting import Lasting, lasting_errors
from sphereorient.pose.neighbours import Neighbours
from sphereorient.pose.occluders import USUALLY_HIDDEN
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.worn import CHANGED, without, worn_cells, worn_share
from sphereorient.sphere.texture_table import TextureTable
from sphereorient.trajectory import Reason

TRIED = 6  # frames
APART_GAIN = 1.5  # cameras that leave this many times more unexplained together than alone are followed one by one
APART_PX = 0.4  # a larger distance of lines of sight: estimate light from each camera alone
FAR_APART_PX = 1.5  # and by more than this, no pose fits all cameras
RIVALS = 0.1  # share of the frames with two claimants, two frames at least: there is a second ball
FEWEST_BOTH = 4  # frames of two cameras from which their usual disagreement is measured
TORN = (Reason.OUTLINE, Reason.LOW_SCORE)  # a camera that sees the sphere elsewhere than the other
BETTER = 0.1  # by which the score of a proven pose exceeds that of wrong ones
NO_BETTER = 0.05  # reject the map if its best score exceeds that of wrong poses by less than this
TELLING = 2.0  # unless wrong poses leave this many times more unexplained, picture by picture; other maps: 1.6 at most
ENOUGH = 1400  # pixels of each disk that are used: more of them changed nothing
WIDER = 1.02  # how much larger than in the frames looked at a disk may be in others
LOOK_ALIKE = "look with `sphereorient check`: another map, a mirrored movie (flip:) or swapped cameras look like this"
ALWAYS = 1.0  # score from which outlines of blurred pictures are trusted: the texture locates the sphere

BLUR_ROUNDS = 4
# By how much paint differs that is not used, round by round: while poses are wrong, so do the borders of right paint.
WORN_ROUNDS = (0.5, 0.5, 0.35, 0.35, 0.25, 0.25, 0.2, 0.2, CHANGED, CHANGED)
FITS = 3.0  # excess of a fit whose map is right once worn paint is not used: 1.1 to 2.7; of a warped map 4.2
# By which the logarithm of the variance left must fall where worn paint is not used: 1.3 to 2.8 in balls that have lost
# 2 to 45 % of their paint, up to 1.1 where the map is warped, and with highlights or a rod.
WORN_GAIN = 1.2
WORN_SEEN = 0.005  # share of the ball that differs at first sight, below which it is not looked for
MUCH_WORN = 0.2  # share of the ball: errors of what is left were 0.9 times those stated at 0.11, 3 times at 0.29
WORN_LEAST = 0.01  # share of the ball; less paint than this moves no pose by as much as its noise
BLUR_FAR_OFF = 0.1  # relative error of the first guess of the blur beyond which its poses are not used
CLEAR = 3.0  # times the variance that the typical right pose leaves
LITTLE_MOTION = 0.25  # share of the blur's variance that motion adds while the shutter is open; less counts as blur
MOST_KNOWN = 0.7  # of the studied frames, whose motion must be measured
FAINT = 0.3  # of the merit of the faintest blob that is proven to be the sphere: fainter ones are not looked at
MORE_LEFT = 0.05  # of the variance: by as much more is left where the exposure is certainly another one
APART_BLURS, MOST_INSTANTS = 3.0, 8  # between neighbouring instants of the exposure, and of these
BLUR_STAYS = 0.03  # relative change of the blur within which light and blur agree


@dataclass(frozen=True, kw_only=True, eq=False)
class Appearance:
    """Light, blur and noise of movies, and how well right and wrong poses explain them."""

    fitter: Fitter
    still: Fitter  # of frames whose motion is not known: the same, or with a blur that holds what motion adds
    lasting: Lasting  # errors of all poses alike
    score_min: float  # between right and wrong poses
    right_score: float  # typical of right poses
    usual_apart_rad: float = math.inf  # typical angle between the orientations that two cameras alone give
    together: bool = True  # whether the cameras see the sphere at one position
    majority: tuple[int, ...] = ()  # if not, the cameras that do, more than half of all; empty: none
    second_ball: bool = False  # whether another sphere with this texture is in view
    sharper: bool = False  # whether the pictures are clearly sharper than the exposure allows
    worn: Tensor | None = None  # where the paint differs from the map and is not used, see `worn_cells`; None: nowhere

    def of(self, *cameras: int) -> "Appearance":
        """Return the appearance in some cameras."""
        fitter, still, lasting = self.fitter.of(*cameras), self.still.of(*cameras), self.lasting.of(*cameras)
        return replace(self, fitter=fitter, still=still, lasting=lasting)

    def on(self, device: torch.device) -> "Appearance":
        """Return an appearance whose fits are computed on another device."""
        return replace(self, fitter=self.fitter.on(device), still=self.still.on(device))

    @property
    def clear_score(self) -> float:
        """Score from which a search ends; out of reach for blurred pictures."""
        return ALWAYS if self.soft else self.score_min

    @property
    def usual_score(self) -> float:
        """Score that right poses usually reach."""
        return max(self.poor_score, _clear_of(self.right_score))

    @property
    def poor_score(self) -> float:
        """Score halfway between the least and the usual one of a right pose."""
        return 0.5 * (self.score_min + self.right_score)

    @property
    def soft(self) -> bool:
        """Whether the pictures are out of focus; the model of blur then errs by more than noise, and is not stated."""
        return defocus_radii(self.fitter.optics.blur_px, widest_px(self.fitter.views)) > 0

    @property
    def in_doubt(self) -> bool:
        """Whether the model errs by more than its stated errors hold: soft pictures, or paint of which much is worn."""
        return self.soft or (self.worn is not None and worn_share(self.worn) > MUCH_WORN)


@dataclass(frozen=True, kw_only=True, eq=False)
class Following:
    """Frames beside those studied, from which the motion while the shutter is open is measured."""

    shots: Callable[[Sequence[int]], Sequence[Sequence[Frame]]]  # by index of the studied frame
    open_share: Tensor  # (n,), exposure over the time from each studied frame to that beside it; negative: it is before


@dataclass(frozen=True, kw_only=True, eq=False)
class Among:
    """Poses of n frames, found beforehand, of balls that others are beside; the same frame may stand for two balls."""

    found: Sequence[Poses]
    neighbours: Neighbours  # of the n poses


def estimate_appearance(
    first: Initialiser,
    frames: Sequence[Sequence[Frame]],
    base: TextureTable,
    settings: RefineSettings,
    following: Following | None = None,
    among: Among | None = None,
) -> Appearance:
    """Estimate light, blur (unless the settings give it) and noise from n x C frames spread over the movies.
    `first` finds poses with an assumed blur and light; `base` is the finest table of the texture. Without `following`
    the motion while the shutter is open counts as blur. `among`: of several balls, with poses that are known; then
    cameras that see another ball do not disagree, and one light in the lab counts where it explains about as much.

    Raises:
        ExperimentError: no frame has a pose, or none is better than wrong poses.
    """
    fitter = first.fitter
    diameter_px = widest_px(fitter.views)
    if defocus_radii(fitter.optics.blur_px, diameter_px):
        first = replace(first, score_min=ALWAYS)

    pictures = [[shot.picture for shot in frame] for frame in frames]
    if among is None:
        found = _poses_of_all(first, frames)
        if not proven(found) and first.score_min < ALWAYS:  # outlines that miss the ball: the texture locates it
            first = replace(first, score_min=ALWAYS)
            found = _poses_of_all(first, frames)
    else:
        found = list(among.found)
    rows = proven(found)
    if not rows and (among is not None or len(fitter.views) == 1):
        raise _nothing(found)
    gain, gap_px = _apart(fitter, pictures, found) if among is None else (1.0, 0.0)
    looked, seen, others = found, [], None
    if gain > APART_GAIN or gap_px > APART_PX:
        # A pose between those of disagreeing cameras would give a wrong light.
        alone = [replace(first, fitter=fitter.of(k)) for k in range(len(fitter.views))]
        each = [one.all_poses([[frame[k]] for frame in frames]) for k, one in enumerate(alone)]
        looked = [poses for of_camera in each for poses in of_camera]
        _check_cameras(fitter, each)
        seen = [(frame, camera) for camera, of_camera in enumerate(each) for frame in proven(of_camera)]
        if not seen or not rows:
            raise _nothing(found)
        X, R, _ = best_poses([each[camera][frame] for frame, camera in seen])
        use = torch.nn.functional.one_hot(torch.tensor([camera for _, camera in seen]), len(each)).bool()
        shown = [pictures[frame] for frame, _ in seen]
    else:
        X, R, use = best_poses([found[k] for k in rows])
        shown = [pictures[k] for k in rows]
        others = None if among is None else among.neighbours.of(rows)
    whole = fitter.pixels(shown, X, fitter.optics.fine, neighbours=others)
    thin = max(1, round(whole.grey.shape[1] / ENOUGH))
    pixels = whole.thinned(thin)
    fit = fitter.fit(pixels, X, R, use, fitter.optics.fine, 4)
    fitter, fit = _light_and_blur(fitter, base, pixels, fit, use, given=settings.blur_px is not None)
    blur_px = fitter.optics.blur_px
    far_off = settings.blur_px is None and abs(blur_px / first.fitter.optics.blur_px - 1) > BLUR_FAR_OFF
    if far_off and _darkest_white(fitter) is None:  # else the motion while the shutter is open is taken for blur
        # Poses found with a wrong blur and light learnt at them support each other: both anew, with the blur known.
        matched = replace(first, fitter=replace(first.fitter, optics=Optics(base, blur_px, diameter_px)))
        with suppress(ExperimentError):  # where that finds nothing, these poses may still be right
            settings = settings.model_copy(update={"blur_px": blur_px})
            return estimate_appearance(matched, frames, base, settings, following, among)
    # Light learnt at wrong poses explains them as well: what counts is what the map explained before.
    best, highest = _scores(looked)
    if best < highest + NO_BETTER and _times_better(looked) < TELLING:
        got = f"poses that explain {100 * best:.0f} % of the pictures, as wrong ones do"
        raise ExperimentError(refusal("movies", expected="frames that the map explains", got=got, do=LOOK_ALIKE))
    worn, paint = None, base
    if settings.learn_paint:
        fitter, fit, worn = _without_worn(fitter, pixels, fit, use)
        if worn is not None:  # the blur, too, was found with it
            given, paint = settings.blur_px is not None, without(base, worn)
            fitter, fit = _light_and_blur(fitter, paint, pixels, fit, use, given=given)
    blurred, moved, sharper, of_still = fitter.optics, None, False, float(fit.score[use].median())
    if following is not None and looked is found:
        open_, moved = _exposed(replace(first, fitter=fitter), paint, fit, use, rows, following, others)
    if moved is not None:
        smeared, known = open_.exposed(pixels, moved.nan_to_num()), use & moved.isfinite().all(1)[:, None]
        open_, there = _light_and_blur(open_, paint, smeared, fit, known, given=False)
        more = open_.left(smeared, there, known) - fitter.left(pixels, fit, known)
        if more < 0:
            fitter, fit, pixels, use = open_, there, smeared, known
        else:  # sharper than the exposure allows: it is not that of these pictures
            moved, sharper = None, more > MORE_LEFT
    if (inverted := _darkest_white(fitter)) is not None:
        got, do = f"white paint darker than black in {inverted}", "exchange black and white of the map"
        raise ExperimentError(refusal("sphere.texture", expected="a map whose white is bright", got=got, do=do))
    fitter, fit, rivals = fitter.lit_in_the_lab(pixels, fit, use, preferred=among is not None)
    whole = fitter.exposed(whole, None if moved is None else moved.nan_to_num())
    free = fitter.unoccluded(whole, fit.position_lab_mm, fit.R_lab_body).thinned(thin)
    hidden = 1.0 - free.inside.sum(-1) / pixels.inside.sum(-1).clamp_min(1)
    if float(hidden[use.flatten()].median()) > USUALLY_HIDDEN:
        fitter = replace(fitter, most_hidden=0.0)
    elif bool(hidden.any()):  # what covers the ball bends light and poses
        fitter = fitter.lit_again(free, fit, use)
        fit = fitter.again(free, fit, use)
    still = fitter if moved is None else replace(fitter, optics=blurred, instants=1)
    widest = WIDER * float(fitter.largest_px(fit.position_lab_mm).max())
    right = float(fit.score[use].median())
    if right < highest + NO_BETTER:
        # Dirt or a hidden rim spoils the estimated light: all poses are explained worse than before.
        highest = right - (best - highest)
    limb_px = _limb_px(fitter, fit, use)
    views = fitter.views
    if among is None and looked is found:
        views = _with_least_merit(first, [frames[k] for k in rows], torch.stack([found[k].use for k in rows]))
    fitter, still = (replace(one, views=views, widest_px=widest, limb_px=limb_px) for one in (fitter, still))
    together = gain <= APART_GAIN and gap_px <= FAR_APART_PX
    # Where the motion smears the paint, a pose without it explains less.
    least = right if moved is None else min(right, of_still)
    score_min = 0.5 * (least + min(highest, least))
    if defocus_radii(fitter.optics.blur_px, diameter_px):  # wrong poses explain nearly as much, and right ones scatter
        score_min = min(score_min, _clear_of(right))
    # Sought in all pixels: an occluder moves on, a highlight that the light lacks stays.
    lasting = lasting_errors(pixels, fit, use, fitter.model(fitter.optics.fine))
    sure = [] if among is not None else [frames[k] for k in rows]
    claimed = sum(count > 1 for count in side_by_side(first.claimants, sure))
    return Appearance(
        fitter=fitter,
        still=still,
        lasting=lasting if rivals is None else lasting.widened(*rivals),
        score_min=score_min,
        right_score=right,
        usual_apart_rad=_usual_apart(fit, use),
        together=together,
        majority=() if together else _agreeing(fitter, seen, fit),
        sharper=sharper,
        second_ball=claimed >= max(2, RIVALS * len(frames)),
        worn=worn,
    )


def _check_cameras(fitter: Fitter, alone: Sequence[Sequence[Poses]]) -> None:
    """Raise ExperimentError if the cameras contradict each other in a way that nothing can be measured, and no majority
    agrees; `alone`: poses by camera and frame.
    """
    parts = []
    for of_camera in alone:
        clear = torch.tensor([0 if k in proven(of_camera) else -1 for k in range(len(of_camera))])
        best = pose_table([of_camera], 1).rows(clear)
        parts.append((best["position_lab_mm"], best["R_lab_body"], best["covariance"][:, :3, :3]))
    X, R, covariance = (torch.stack(part, 1) for part in zip(*parts, strict=True))
    seen = _seen_alone(fitter, X, R)
    limits = limits_of(seen, covariance)
    found = compare_cameras(seen, limits)
    if found.deadly and not (len(alone) > 2 and majority(seen, limits)):
        expected = "cameras that agree"
        raise ExperimentError(refusal("movies", expected=expected, got=str(found), do=found.advice))


def _agreeing(fitter: Fitter, rows: Sequence[tuple[int, int]], fit: FittedPoses) -> tuple[int, ...]:
    """Return the cameras that agree where these are more than half of more than two; fits of frames and cameras (B)."""
    if len(fitter.views) < 3 or not rows:
        return ()
    frame, camera = torch.tensor(rows).unbind(1)
    parts = []
    for part in (fit.position_lab_mm, fit.R_lab_body, fit.covariance[:, :3, :3]):
        whole = part.new_full((int(frame.max()) + 1, len(fitter.views), *part.shape[1:]), torch.nan)
        whole[frame, camera] = part
        parts.append(whole)
    X, R, covariance = parts
    seen = _seen_alone(fitter, X, R)
    return majority(seen, limits_of(seen, covariance))


def _seen_alone(fitter: Fitter, position_lab_mm: Tensor, R_lab_body: Tensor) -> Seen:
    """Return poses (N, C, 3), (N, C, 3, 3) of each camera alone as what they say of the pictures."""
    views = list(enumerate(fitter.views))
    return Seen(
        cameras={view.name: view.camera for view in fitter.views},
        centre_px=torch.stack([view.camera.project(position_lab_mm[:, k]) for k, view in views], 1),
        radius_px=torch.stack([view.radius_px(position_lab_mm[:, k], fitter.radius_mm) for k, view in views], 1),
        R_lab_body=R_lab_body,
        diameter_mm=2 * fitter.radius_mm,
    )


def _usual_apart(fit: FittedPoses, use: Tensor) -> float:
    """Return the median angle between the rotations of two cameras that see the sphere together; inf without any."""
    angles = [
        (fit.own_turn[:, k] - fit.own_turn[:, m]).norm(dim=-1)[use[:, k] & use[:, m]]
        for k, m in combinations(range(use.shape[1]), 2)
    ]
    both = torch.cat([torch.zeros(0, dtype=torch.float64), *angles])
    return float(both.median()) if len(both) >= FEWEST_BOTH else math.inf


def _limb_px(fitter: Fitter, fit: FittedPoses, use: Tensor) -> Tensor:
    """Return by how much the limb lies outside of where all cameras together place it, (C,), px: the median of B poses.
    A wrong diameter, glare, or glass that the cameras' model lacks. 0 where fewer than `FEWEST_BOTH` poses tell.
    """
    found = torch.zeros(len(fitter.views), dtype=torch.float64)
    for k, view in enumerate(fitter.views):
        told = use[:, k] & (use.sum(1) > 1)
        to_centre = fit.position_lab_mm - centre_lab_mm(view.camera)
        nearer = -(fit.own_move[:, k] * to_centre).sum(-1) / to_centre.square().sum(-1)
        if int(told.sum()) >= FEWEST_BOTH:
            found[k] = (nearer * view.radius_px(fit.position_lab_mm, fitter.radius_mm))[told].median()
    return found


def _darkest_white(fitter: Fitter) -> str | None:
    """Return the camera that shows what the map calls white darkest, if it is darker than what it calls black."""
    contrast = fitter.light.tables.cells[:, 0].reshape(len(fitter.views), -1).mean(1)
    return fitter.views[int(contrast.argmin())].name if bool((contrast < 0).any()) else None


def _with_least_merit(search: Initialiser, frames: Sequence[Sequence[Frame]], use: Tensor) -> list[CameraView]:
    """Return the views with the least merit of a blob in which the sphere is looked for; `use` (n, C): which cameras
    show it in n frames.
    """
    views = []
    for camera, view in enumerate(search.fitter.views):
        seeing = zip(frames, use[:, camera].tolist(), strict=True)
        merits = [search.merit(frame[camera].picture, view) for frame, used in seeing if used]
        views.append(replace(view, merit_min=FAINT * min(merits) if merits else 0.0))
    return views


def _apart(fitter: Fitter, pictures: Sequence[Sequence[Picture]], found: Sequence[Poses]) -> tuple[float, float]:
    """Measure on a few frames whether the cameras see one sphere at one position.
    Return, for the worst quarter of frames, the unexplained variance of all cameras together over that of each alone,
    and the distance between the lines of sight, px. The first is 1 where the cameras differ by less than `APART_PX` in
    lines of sight, rotation and size, px of the picture: alone, each camera fits what its model lacks as well.
    Rotations that differ by less than their own errors do not count: a small disk shows little.
    """
    cameras = len(fitter.views)
    sure = proven(found)
    if not sure:  # wrong cameras spoil every pose of all pictures
        return math.inf, math.inf
    whole = [k for k in sure if bool(found[k].use.all())]
    if len(whole) < sum(_torn(fitter, found[k]) for k in sure):
        return math.inf, math.inf  # outlines that miss each other already
    if cameras == 1 or not whole:
        return 1.0, 0.0
    whole = [k for k in whole if _in_view(fitter, found[k].position_lab_mm[:1])] or whole
    tried = [whole[int(k)] for k in torch.linspace(0, len(whole) - 1, min(TRIED, len(whole))).round()]
    gains, rays, alone, covariance_rad2 = [], [], [], []
    for camera, view in enumerate(fitter.views):
        only = torch.zeros(len(tried), cameras, dtype=torch.bool)
        only[:, camera] = True
        X, R, _ = best_poses([found[k] for k in tried])
        steps = ((fitter.optics.middle, 3, 3), (fitter.optics.fine, 4, 3))
        fit = fitter.fit_through(steps, [pictures[k] for k in tried], X, R, only)
        X, R = fit.position_lab_mm, fit.R_lab_body
        joint = torch.cat([found[k].score[:1, camera] for k in tried])
        gains.append((1 - joint) / (1 - fit.score[:, camera]).clamp_min(1e-6))
        rays.append(view.camera.rays(view.camera.project(X)))
        alone.append((view.camera, X, R))
        covariance_rad2.append(so3.trace(fit.covariance[:, :3, :3]))
    gap_mm = torch.stack([triangulate(one, other)[1] for one, other in combinations(rays, 2)]).amax(0)
    radius_px = widest_px(fitter.views) / 2
    gap_px = gap_mm * (radius_px / fitter.radius_mm)
    others_px = []
    for k, m in combinations(range(cameras), 2):
        turn = so3.geodesic_distance(alone[k][2], alone[m][2])
        told = turn > (covariance_rad2[k] + covariance_rad2[m]).sqrt()
        others_px.append(turn * told * radius_px)
    for (one_camera, X, _), (_, Y, _) in permutations(alone, 2):
        centre = centre_lab_mm(one_camera)
        sight = torch.nn.functional.normalize(X - centre, dim=-1)
        # The other camera knows the distance by its line of sight; this one by the size of its picture.
        others_px.append((((Y - X) * sight).sum(-1) / (X - centre).norm(dim=-1)).abs() * radius_px)
    differ_px = float(torch.stack([gap_px, *others_px]).amax(0).quantile(0.75))
    gain = float(torch.stack(gains).amax(0).quantile(0.75)) if differ_px > APART_PX else 1.0
    return gain, float(gap_px.quantile(0.75))


def _torn(fitter: Fitter, poses: Poses) -> bool:
    """Return whether a camera that should show the whole sphere at the best pose sees it elsewhere, or nothing."""
    X = poses.position_lab_mm[:1]
    return any(
        why in TORN and bool(view.shows_whole(view.camera.project(X), view.radius_px(X, fitter.radius_mm)).all())
        for view, why in zip(fitter.views, poses.reason, strict=True)
    )


def _poses_of_all(search: Initialiser, frames: Sequence[Sequence[Frame]]) -> list[Poses]:
    """Find the poses of n frames, with cameras that see the sphere without an outline."""
    return [_seen_by_all(search.fitter, *one) for one in zip(frames, search.all_poses(frames), strict=True)]


def _seen_by_all(fitter: Fitter, shots: Sequence[Frame], poses: Poses) -> Poses:
    """Let cameras without an outline count too where one pose explains all pictures: black paint may hide a rim."""
    usable = torch.tensor([shot.usable for shot in shots])
    if not len(poses) or bool((poses.use == usable).all()):
        return poses
    pictures = [[shot.picture for shot in shots]] * len(poses)
    X, R, use = poses.position_lab_mm, poses.R_lab_body, usable.expand(len(poses), -1)
    fit = fitter.fit_through(fitter.optics.steps, pictures, X, R, use)
    order = fit.nll.argsort(stable=True)
    if float(fit.score[order[0], usable].min()) < _clear_of(float(poses.score[0, poses.use].min())):
        return poses
    return poses_of(fit, order, usable, [Reason.OK if shot.usable else shot.reason for shot in shots])


def _in_view(fitter: Fitter, position_lab_mm: Tensor) -> bool:
    """Return whether all cameras show the whole disk of a sphere at a position (1, 3), mm."""
    X, radius_mm = position_lab_mm, fitter.radius_mm
    return all(
        bool(view.shows_whole(view.camera.project(X), view.radius_px(X, radius_mm)).all()) for view in fitter.views
    )


def _exposed(
    search: Initialiser,
    paint: TextureTable,
    fit: FittedPoses,
    use: Tensor,
    rows: Sequence[int],
    following: Following,
    others: Neighbours | None,
) -> tuple[Fitter, Tensor | None]:
    """Return a fitter that renders as many instants of the exposure as B poses need, with the blur that is left of the
    `paint`, and their turn and move (B, 6) while the shutter is open, NaN where it is not known; None, and the same
    fitter, where it hardly blurs the pictures. `others`: of the B poses, about where they are in the frames beside.
    """
    fitter = search.fitter

    def measured(some: Tensor) -> Tensor:
        shots = following.shots([rows[k] for k in some.tolist()])
        usable = torch.tensor([[shot.usable for shot in frame] for frame in shots])
        before, seen = fit.of(some), use[some]
        share = following.open_share[[rows[k] for k in some.tolist()]]

        def from_poses(these: Tensor, X: Tensor, R: Tensor) -> Tensor:
            pictures = [[shot.picture for shot in shots[k]] for k in these.tolist()]
            known, shown, was = seen[these], usable[these], before.of(these)
            beside = None if others is None else others.of(some[these])
            there = fitter.fit_through(fitter.optics.steps, pictures, X, R, known & shown, neighbours=beside)
            right = ((1 - there.score <= CLEAR * (1 - was.score)) | ~known).all(1) & (shown | ~known).all(1)
            turn = so3.log(there.R_lab_body @ was.R_lab_body.mT)
            way = torch.cat([turn, there.position_lab_mm - was.position_lab_mm], dim=-1)
            return torch.where(right[:, None], share[these, None] * way, torch.nan)

        way = from_poses(torch.arange(len(some)), before.position_lab_mm, before.R_lab_body)
        # Of a ball that turns far between frames the next pose has to be searched for.
        lost = [k for k in torch.nonzero(way.isnan().any(1))[:, 0].tolist() if others is None and bool(usable[k].all())]
        found = dict(zip(lost, search.all_poses([shots[k] for k in lost]), strict=True))
        again = torch.tensor([k for k in lost if len(found[k])], dtype=torch.int64)
        if len(again):
            X, R, _ = best_poses([found[k] for k in again.tolist()])
            way[again] = from_poses(again, X, R)
        return way

    def smear_px(some: Tensor, moved: Tensor) -> Tensor:
        return (
            torch.stack([view.smear_px(fit.position_lab_mm[some], moved, fitter.radius_mm) for view in fitter.views])
            .square()
            .mean(0)
            .sqrt()
        )

    tried = torch.linspace(0, len(rows) - 1, min(TRIED, len(rows))).round().long()
    width_px = smear_px(tried, measured(tried))
    blur_px = fitter.optics.blur_px
    if not float(width_px.square().nanmean() / 12) > LITTLE_MOTION * blur_px**2:
        return fitter, None
    every = torch.arange(len(rows))
    moved = measured(every)
    width_px = smear_px(every, moved)
    if float(width_px.isfinite().double().mean()) < MOST_KNOWN:
        return fitter, None
    # What is left of the blur once the motion is taken out sets how far apart instants may be.
    left_px = math.sqrt(max(blur_px**2 - float(width_px.square().nanmean()) / 12, FINEST_PX**2))
    instants = 1 + math.ceil(float(width_px.nanquantile(0.9)) / (APART_BLURS * left_px))
    optics = Optics(paint, left_px, widest_px(fitter.views))
    return replace(fitter, optics=optics, instants=min(max(2, instants), MOST_INSTANTS)), moved


def _scores(found: Sequence[Poses]) -> tuple[float, float]:
    """Return the median score of the best poses of clear frames, and the highest typical score of wrong ones."""
    clear = proven(found)
    best = torch.cat([found[k].score[0][found[k].use] for k in clear])
    wrong = torch.cat([found[k].score[1:][:, found[k].use].reshape(-1) for k in clear])
    return float(best.median()), float(wrong.quantile(0.9)) if len(wrong) else 0.0


def _times_better(found: Sequence[Poses]) -> float:
    """Return the median ratio of the variances left by second and best pose; blurred pictures need the ratio."""
    rows = [(found[k].score[:2], found[k].use) for k in proven(found) if len(found[k]) > 1]
    if not rows:
        return math.inf
    left = torch.stack([(1 - score[:, use]).mean(1).clamp_min(LEAST_LEFT) for score, use in rows])
    return float((left[:, 1] / left[:, 0]).median())


def _nothing(found: Sequence[Poses]) -> ExperimentError:
    """Return the error of a movie without the sphere, or without a pose that fits."""
    reasons = {str(why) for poses in found for why in poses.reason} - {Reason.OK}
    why = f" ({', '.join(sorted(reasons))})" if reasons else ""
    got = f"none in {len(found)} frames looked at{why}"
    if Reason.LOW_SCORE in reasons or any(len(poses) for poses in found):
        expected, do = "frames that the map explains", LOOK_ALIKE
    else:
        expected, do = "the sphere in some frame", "check sphere.diameter and the cameras, or set locate.diameter_px"
    return ExperimentError(refusal("movies", expected=expected, got=got, do=do))


def proven(found: Sequence[Poses]) -> list[int]:
    """Return the frames whose best pose explains every picture in use better than wrong poses do, and about as well as
    in the typical frame of these.
    """
    best = torch.tensor([float(poses.score[0, poses.use].min()) if len(poses) else -1.0 for poses in found])
    wrong = torch.tensor([float(poses.score[1, poses.use].min()) for poses in found if len(poses) > 1])
    least = BETTER + (float(wrong.quantile(0.9)) if len(wrong) else 0.0)
    right = best[best >= least]
    if not len(right):
        return []
    least = max(least, _clear_of(float(right.quantile(0.75))))
    return [k for k, score in enumerate(best.tolist()) if score >= least]


def _clear_of(typical: float) -> float:
    return 1 - CLEAR * (1 - typical)


def _light_and_blur(
    fitter: Fitter, base: TextureTable, pixels: Pixels, fit: FittedPoses, use: Tensor, *, given: bool
) -> tuple[Fitter, FittedPoses]:
    """Estimate light, then blur, then light again, until the blur stays; return the fitter that has both, and its fit.
    Light estimated with a wrong blur favours that blur: where the first guess is far off, one round is not enough.
    """
    diameter_px = widest_px(fitter.views)
    fitter, fit = _with_light(fitter, pixels, fit, use)
    soft = defocus_radii(fitter.optics.blur_px, diameter_px) > 0  # there each round moves it by little
    for done in range(1 if given else BLUR_ROUNDS):
        before_px = fitter.optics.blur_px
        if not given:
            blur_px = best_blur_px(fitter, base, pixels, fit, use, FINEST if done else FINER)
            fitter = replace(fitter, optics=Optics(base, blur_px, diameter_px))
        fitter, fit = _with_light(fitter, pixels, fit, use)
        if not soft and abs(fitter.optics.blur_px / before_px - 1) < BLUR_STAYS:
            break
    return fitter, fit


def _with_light(fitter: Fitter, pixels: Pixels, fit: FittedPoses, use: Tensor) -> tuple[Fitter, FittedPoses]:
    fitter = fitter.with_light_of(pixels, fit, use)
    return fitter, fitter.again(pixels, fit, use)


def _without_worn(
    fitter: Fitter, pixels: Pixels, fit: FittedPoses, use: Tensor
) -> tuple[Fitter, FittedPoses, Tensor | None]:
    """Return a fitter that does not use paint that differs from the map, its fit, and where that is; None: nowhere.
    Found in one half of the movie, it must leave less in the other half: what differs there, too, turns with the ball.
    """
    if len(use) < FEWEST_LIT:  # too few views of each patch to tell paint from light
        return fitter, fit, None
    # Of a ball that turns little glints take the place of worn paint.
    bare = fitter.with_light_of(pixels, fit, use, glints=False)
    if worn_share(worn_cells(pixels, fit, use, bare.model(bare.optics.fine))) < WORN_SEEN:
        return fitter, fit, None

    def found(pixels: Pixels, fit: FittedPoses, use: Tensor) -> tuple[Fitter, FittedPoses, Tensor | None]:
        now, worn = bare, None
        for changed in WORN_ROUNDS:  # worn paint bends the light and the poses that it is found with
            worn = worn_cells(pixels, fit, use, now.model(now.optics.fine), changed)
            paint = without(fitter.optics.fine.paint, worn)  # blurred already
            optics = Optics(paint, fitter.optics.blur_px, widest_px(fitter.views))
            now = replace(now, optics=optics).with_light_of(pixels, fit, use, glints=False)
            fit = now.again(pixels, fit, use)
        return now, fit, worn

    every, middle = torch.arange(len(use)), len(use) // 2
    halves = [some_of(rows, pixels, fit, use) for rows in (every[:middle], every[middle:])]
    gain = [
        bare.with_light_of(*half, glints=False).left(*held) - found(*half)[0].left(*held)
        for half, held in permutations(halves, 2)
    ]
    if sum(gain) / 2 < WORN_GAIN:
        return fitter, fit, None
    lit, fitted, worn = found(pixels, fit, use)
    wrong = float(fitted.excess[use].median()) > FITS  # the paint that is left is not the map's either
    if wrong or worn is None or worn_share(worn) < WORN_LEAST:
        return fitter, fit, None
    return lit, fitted, worn
