"""The response of cameras that the experiment does not give, from paint, light and limb together."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from sphereorient.follow.appearance.light import light_and_blur
from sphereorient.follow.appearance.record import Studied
from sphereorient.movies.response import Response
from sphereorient.pose.camera_view import Optics, widest_px
from sphereorient.pose.lasting import response_exponents
from sphereorient.pose.model import SphereModel
from sphereorient.pose.residuals import fitted_residuals

ROUNDS, STAYS = 6, 0.01  # rounds of estimation; change of ln gamma from which they end
MOST = math.log(2.0)  # by which a round may change ln gamma: the step is linear
MORE = 1.02  # ratio of a blur that is a little more
SURE = 3.0  # standard deviations, and
CODED = 0.1  # ln gamma from which a response is not linear: what else is not modelled looks like less
UNSURE = 0.05  # standard deviation of ln gamma beyond which pictures of a linear camera would tell more
USUAL = math.log(2.2)  # ln gamma of photographs


def with_response(studied: Studied, *, given: bool) -> Studied:
    """Estimate gamma of the cameras whose response is not known, with blur and light; those of linear pictures stay as
    they are. Where a few pictures hardly tell, the estimate begins at the gamma of photographs as well.
    """
    asked = torch.tensor([view.response is None for view in studied.fitter.views])
    if not bool(asked.any()):
        return studied
    _, sigma = _step(studied)
    begins = (0.0, USUAL) if bool((sigma[asked] > UNSURE).any()) else (0.0,)
    found = [_from(studied, torch.where(asked, begin, 0.0).double(), given=given) for begin in begins]
    return min(found, key=_left) if len(found) > 1 else found[0]


def with_more_blur(studied: Studied) -> SphereModel:
    """Return the model of paint that is blurred a little more."""
    optics = studied.fitter.optics
    more = Optics(studied.paint, MORE * optics.blur_px, widest_px(studied.fitter.views), optics.limb_blur_px)
    return replace(studied.fitter, optics=more).model()


def _step(studied: Studied) -> tuple[Tensor, Tensor]:
    """Return the change of ln gamma, (C,), and its standard deviation."""
    fits = studied.pixels, studied.fit, studied.use
    return response_exponents(*fits, studied.fitter.model(), with_more_blur(studied))


def _from(studied: Studied, begin: Tensor, *, given: bool) -> Studied:
    """Estimate from ln gamma (C,); those of which that is 0 and stays so are linear."""
    asked = torch.tensor([view.response is None for view in studied.fitter.views])
    gamma, learnt = begin, studied
    for k in range(ROUNDS):
        if bool(gamma.any()):
            learnt = light_and_blur(_responding(studied, gamma), given=given)
        change, sigma = _step(learnt)
        change = torch.where(asked, change.clamp(-MOST, MOST), 0.0)
        if k == 0 and not bool(begin.any()) and not bool((change.abs() > (SURE * sigma).clamp_min(CODED)).any()):
            return studied
        gamma = gamma + change
        if bool((change.abs() < STAYS).all()):
            break
    gamma = torch.where(gamma.abs() > (SURE * sigma).clamp_min(CODED), gamma, 0.0)
    return light_and_blur(_responding(studied, gamma), given=given) if bool(gamma.any()) else studied


def _left(studied: Studied) -> float:
    """Return what poses typically leave of the pictures, grey levels of these, not of their light."""
    at = fitted_residuals(studied.pixels, studied.fit, studied.fitter.model())
    views = studied.fitter.views
    full = torch.tensor([view.background.full_scale for view in views]).repeat(len(studied.use))[:, None]
    gamma = torch.tensor([view.response.gamma if view.response else 1.0 for view in views])
    gamma = gamma.repeat(len(studied.use))[:, None]
    by_grey = gamma * (at.model / full).clamp(1e-3, 1.0) ** ((gamma - 1) / gamma)
    counted = at.inside & studied.use.reshape(-1, 1)
    return float((at.residual.abs() / by_grey)[counted].median())


def _responding(studied: Studied, gamma: Tensor) -> Studied:
    """Return the same with the light of linear pictures for which cameras have ln gamma (C,)."""
    views = [
        view if power == 1.0 else replace(view, response=Response(gamma=power))
        for view, power in zip(studied.fitter.views, gamma.exp().tolist(), strict=True)
    ]
    full = torch.tensor([view.background.full_scale for view in views]).repeat(len(studied.use))[:, None]
    power = gamma.exp().float().repeat(len(studied.use))[:, None]

    def light(grey: Tensor) -> Tensor:
        return full * (grey / full).clamp_min(0.0) ** power

    whole, pixels = (
        replace(part, grey=light(part.grey), behind=light(part.behind)) for part in (studied.whole, studied.pixels)
    )
    return replace(studied, fitter=replace(studied.fitter, views=views), whole=whole, pixels=pixels)
