"""Blur and light of the pictures, together: light estimated with a wrong blur favours that blur."""

from dataclasses import replace

from sphereorient.errors import ExperimentError, refusal
from sphereorient.follow.appearance.record import Studied, enough_of, soft
from sphereorient.pose.blur import FINER, FINEST, best_blur_px
from sphereorient.pose.camera_view import FINEST_PX, Optics, widest_px
from sphereorient.pose.fitter import Fitter
from sphereorient.pose.lasting import limb_wider_px
from sphereorient.pose.lights import kinds
from sphereorient.pose.lights.kinds import Rivals
from sphereorient.pose.occluders import USUALLY_HIDDEN

BLUR_ROUNDS = 4
BLUR_STAYS = 0.03  # relative change of the blur within which light and blur agree
LIMB_ROUNDS, LIMB_STAYS = 4, 0.005  # the same of the limb's blur
MOST_WIDER = 1.25  # ratio by which a round may change the limb's blur: the step is linear


def light_and_blur(studied: Studied, *, given: bool) -> Studied:
    """Estimate light, then blur unless it is `given`, then light again, until the blur stays.
    Where the first guess of the blur is far off, one round is not enough.
    """
    diameter_px = widest_px(studied.fitter.views)
    studied = studied.lit()
    slow = soft(studied.fitter)  # there each round moves the blur by little
    for done in range(1 if given else BLUR_ROUNDS):
        before_px = studied.fitter.optics.blur_px
        if not given:
            fitter, fits = studied.fitter, (studied.pixels, studied.fit, studied.use)
            blur_px = best_blur_px(fitter, studied.paint, *fits, FINEST if done else FINER)
            studied = replace(studied, fitter=replace(fitter, optics=Optics(studied.paint, blur_px, diameter_px)))
        studied = studied.lit()
        if not slow and abs(studied.fitter.optics.blur_px / before_px - 1) < BLUR_STAYS:
            break
    return _limb_blurred(studied)


def _limb_blurred(studied: Studied) -> Studied:
    """Estimate the blur of the limb: one that is too narrow moves the ball to its bright side."""
    for _ in range(LIMB_ROUNDS):
        fitter = studied.fitter
        before_px = fitter.optics.limb_blur_px
        wider_px = limb_wider_px(studied.pixels, studied.fit, studied.use, fitter.model())
        blur_px = min(max(before_px + wider_px, before_px / MOST_WIDER, FINEST_PX), before_px * MOST_WIDER)
        optics = fitter.optics.with_limb_blur(blur_px)
        studied = replace(studied, fitter=replace(fitter, optics=optics)).lit()
        if abs(blur_px / before_px - 1) < LIMB_STAYS:
            break
    return studied


def darkest_white(fitter: Fitter) -> str | None:
    """Return the camera that shows what the map calls white darkest, if it is darker than what it calls black."""
    contrast = fitter.light.tables.cells[:, 0].reshape(len(fitter.views), -1).mean(1)
    return fitter.views[int(contrast.argmin())].name if bool((contrast < 0).any()) else None


def check_white(fitter: Fitter) -> None:
    """Raise ExperimentError where a camera shows what the map calls white darker than what it calls black."""
    if (inverted := darkest_white(fitter)) is not None:
        got, do = f"white paint darker than black in {inverted}", "exchange black and white of the map"
        raise ExperimentError(refusal("sphere.texture", expected="a map whose white is bright", got=got, do=do))


def lit_in_the_lab(studied: Studied, *, preferred: bool) -> tuple[Studied, Rivals]:
    """Let light be a function of directions in the lab where that explains more, or, if `preferred`, about as much;
    return also the fits of two models that explain as much as each other.
    """
    fitter, fit, rivals = kinds.lit_in_the_lab(
        studied.fitter, studied.pixels, studied.fit, studied.use, preferred=preferred
    )
    return replace(studied, fitter=fitter, fit=fit), rivals


def without_occluders(studied: Studied) -> Studied:
    """Estimate light and poses without what covers the ball, or let the fitter look for nothing that does where most of
    the ball is hidden in most pictures.
    """
    fitter, fit, use = studied.fitter, studied.fit, studied.use
    free = enough_of(fitter.unoccluded(studied.whole, fit.position_lab_mm, fit.R_lab_body))
    hidden = 1.0 - free.inside.sum(-1) / studied.pixels.inside.sum(-1).clamp_min(1)
    if float(hidden[use.flatten()].median()) > USUALLY_HIDDEN:
        return replace(studied, fitter=replace(fitter, most_hidden=0.0))
    if not bool(hidden.any()):
        return studied
    fitter = fitter.with_light_of(free, fit, use)
    return replace(studied, fitter=fitter, fit=fitter.again(free, fit, use))
