"""The response of cameras that the experiment does not give, from paint, light and limb together."""

from dataclasses import replace

import torch
from torch import Tensor

from sphereorient.follow.appearance.light import light_and_blur
from sphereorient.follow.appearance.record import Studied
from sphereorient.movies.response import Response
from sphereorient.pose.camera_view import Optics, widest_px
from sphereorient.pose.lasting import response_exponents
from sphereorient.pose.model import SphereModel

ROUNDS, STAYS = 8, 0.01  # rounds of estimation; relative change of gamma from which they end
MOST = 2.0  # ratio by which a round may change gamma: the step is linear
MORE = 1.02  # ratio of a blur that is a little more
SURE = 3.0  # standard deviations, and
CODED = 0.1  # logarithm of gamma from which a response is not linear: what else is not modelled looks like less


def with_response(studied: Studied, *, given: bool) -> Studied:
    """Estimate gamma of the cameras whose response is not known, with blur and light; those of linear pictures stay as
    they are.
    """
    asked = torch.tensor([view.response is None for view in studied.fitter.views])
    gamma, learnt = torch.zeros(len(asked), dtype=torch.float64), studied
    for _ in range(ROUNDS if bool(asked.any()) else 0):
        fits = learnt.pixels, learnt.fit, learnt.use
        change, sigma = response_exponents(*fits, learnt.fitter.model(), with_more_blur(learnt))
        change = torch.where(asked, change.clamp(-torch.tensor(MOST).log(), torch.tensor(MOST).log()), 0.0)
        if not bool(((gamma + change).abs() > SURE * sigma).any()):
            break
        gamma = gamma + change
        learnt = light_and_blur(_responding(studied, gamma.exp()), given=given)
        if bool((change.abs() < STAYS).all()):
            break
    gamma = torch.where(gamma.abs() > CODED, gamma, 0.0)
    if not bool(gamma.any()):
        return studied
    return light_and_blur(_responding(studied, gamma.exp()), given=given)


def with_more_blur(studied: Studied) -> SphereModel:
    """Return the model of paint that is blurred a little more."""
    optics = studied.fitter.optics
    more = Optics(studied.paint, MORE * optics.blur_px, widest_px(studied.fitter.views), optics.limb_blur_px)
    return replace(studied.fitter, optics=more).model()


def _responding(studied: Studied, gamma: Tensor) -> Studied:
    """Return the same with the light of linear pictures for which cameras have responses gamma (C,)."""
    views = [
        view if power == 1.0 else replace(view, response=Response(gamma=power))
        for view, power in zip(studied.fitter.views, gamma.tolist(), strict=True)
    ]
    full = torch.tensor([view.background.full_scale for view in views]).repeat(len(studied.use))[:, None]
    power = gamma.float().repeat(len(studied.use))[:, None]

    def light(grey: Tensor) -> Tensor:
        return full * (grey / full).clamp_min(0.0) ** power

    whole, pixels = (
        replace(part, grey=light(part.grey), behind=light(part.behind)) for part in (studied.whole, studied.pixels)
    )
    return replace(studied, fitter=replace(studied.fitter, views=views), whole=whole, pixels=pixels)
