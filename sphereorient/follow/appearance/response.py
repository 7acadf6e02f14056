"""The response of cameras, where the experiment does not give it, from paint, light and limb together."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from sphereorient.cameras.response import Response
from sphereorient.follow.appearance.light import light_and_blur
from sphereorient.follow.appearance.record import Studied
from sphereorient.pose.lasting import response_exponents
from sphereorient.pose.model import SphereModel

ROUNDS, STAYS = 6, 0.01  # rounds of estimation; change of ln gamma at convergence
MOST = math.log(2.0)  # largest change of ln gamma in a round, as the step is linear
MORE = 1.02  # ratio of a slightly wider blur
CODED = 0.2  # ln gamma from which a response is not linear; unmodelled gloss looks like 0.08
SURE = 0.05  # greatest standard deviation of a usable ln gamma; one photograph gives 0.2
MOST_CLIPPED = 0.05  # share of a disk's pixels; clipped white looks like a gamma of 0.7


def with_response(studied: Studied, *, given: bool) -> tuple[Studied, bool]:
    """Estimate gamma of the cameras of unknown response, with blur and light. Cameras with linear pictures, or of
    uncertain gamma, stay unchanged. Return also whether one was learnt. `given`: as in `light_and_blur`.
    """
    asked = torch.tensor([view.response is None for view in studied.fitter.views]) & ~_clipped(studied)
    gamma, learnt = torch.zeros(len(asked), dtype=torch.float64), studied
    for _ in range(ROUNDS if bool(asked.any()) else 0):
        fits = learnt.pixels, learnt.fit, learnt.use
        change, sigma = response_exponents(*fits, learnt.fitter.model(), with_more_blur(learnt))
        asked &= (sigma < SURE) & ((gamma + change).abs() > CODED)
        if not bool(asked.any()):
            return studied, False
        change = torch.where(asked, change.clamp(-MOST, MOST), 0.0)
        gamma = torch.where(asked, gamma + change, 0.0)
        learnt = light_and_blur(_responding(studied, gamma), given=given)
        if bool((change.abs() < STAYS).all()):
            break
    return learnt, learnt is not studied


def _clipped(studied: Studied) -> Tensor:
    """Return the cameras, (C,) bool, with many clipped pixels on their disks."""
    shares = (studied.pixels.clipped & studied.pixels.inside).float().mean(1).reshape(studied.use.shape)
    found: Tensor = (shares * studied.use).sum(0) > MOST_CLIPPED * studied.use.sum(0)
    return found


def with_more_blur(studied: Studied) -> SphereModel:
    """Return the model with slightly more blur of the paint."""
    optics = studied.fitter.optics
    return studied.fitter.with_blur(studied.paint, MORE * optics.blur_px, optics.limb_blur_px).model()


def _responding(studied: Studied, gamma: Tensor) -> Studied:
    """Return the estimate with the light of responses ln gamma (C,), instead of linear cameras."""
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
