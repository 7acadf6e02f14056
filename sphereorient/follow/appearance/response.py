"""The response of cameras that the experiment does not give, from paint, light and limb together."""

from dataclasses import replace

import torch
from torch import Tensor

from sphereorient.follow.appearance.record import Studied
from sphereorient.movies.response import Response
from sphereorient.pose.lasting import response_exponents

ROUNDS, STAYS = 8, 0.01  # rounds of estimation; relative change of gamma from which they end
MOST = 1.5  # ratio by which a round may change gamma: the step is linear
SURE = 3.0  # standard deviations, and
CODED = 0.1  # logarithm of gamma from which a response is not linear: what else is not modelled looks like less


def with_response(studied: Studied) -> Studied:
    """Estimate gamma of the cameras whose response is not known; those of linear pictures stay as they are."""
    asked = torch.tensor([view.response is None for view in studied.fitter.views])
    gamma, learnt = torch.zeros(len(asked), dtype=torch.float64), studied
    for _ in range(ROUNDS if bool(asked.any()) else 0):
        change, sigma = response_exponents(learnt.pixels, learnt.fit, learnt.use, learnt.fitter.model())
        change = torch.where(asked, change.clamp(-torch.tensor(MOST).log(), torch.tensor(MOST).log()), 0.0)
        if not bool(((gamma + change).abs() > SURE * sigma).any()):
            break
        gamma = gamma + change
        learnt = _responding(studied, gamma.exp()).lit()
        if bool((change.abs() < STAYS).all()):
            break
    gamma = torch.where(gamma.abs() > CODED, gamma, 0.0)
    if not bool(gamma.any()):
        return studied
    learnt = _responding(studied, gamma.exp()).lit()
    return learnt if learnt.right_score > studied.right_score else studied


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
