"""The linear problem of the fit: residuals of L disks at given poses, their sums and scores, and the estimates of stray
light beside the sphere and of each camera's noise.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from sphereorient.pose.model import (
    EVERY,
    IN_SIGHT,
    Shading,
    SphereModel,
    SphereView,
    leaning,
    scene_beside,
    stray_basis,
)
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.view import sphere_view
from sphereorient.so3 import solve_damped
from sphereorient.sphere.view import polynomials

TUKEY = 14.0  # standard deviations beyond which a pixel is not used; a displaced edge is still used, a bubble is not
KNOWN = 0.3  # least share of a disk that shows known paint
EDGE_PX = 0.005  # possible radial error of the model's limb: no blur is known better
SMOOTH = 4  # order of light and reflections on a disk without paint, as in a first fit
OUTLIERS = 4.0  # limit of a square, in variances of the disk
NOISE_MIN = 0.25  # grey levels^2; rounding to whole levels alone gives 1/12
NO_SPHERE = 0.01  # share of a pixel; below it the sphere is not visible
STRAY_ROUNDS, STRAY_TUKEY, FEWEST_BESIDE = 5, 6.0, 200  # rounds, standard deviations, pixels
STRAY_LEAST = 0.05  # coefficients, summed, of the step from black to white paint: clean pictures 0.01, glare 0.13


@dataclass(frozen=True, kw_only=True, eq=False)
class Residuals:
    """The linear problem at one pose, of L disks; made by `residuals`."""

    view: SphereView
    design: Tensor  # (L, 6 + K, P), derivatives by pose and light coefficients
    residual: Tensor  # (L, P), grey levels
    model: Tensor  # (L, P), grey levels
    variance: Tensor  # (L, P), expected
    weight: Tensor  # (L, P), robust and inside, 0 .. 1
    inside: Tensor  # (L, P) bool, pixels used: of known paint
    deviation: Tensor  # (L,), robust standard deviation of the residuals over the noise expected
    lit: Tensor  # (L, P), grey levels from black to white paint, the frame's own light included, coverage too
    over: Tensor  # (L, P), grey levels of the sphere above the background
    beside: Tensor  # (L, P), grey levels of the scene without the sphere


def disk_sums(at: Residuals) -> tuple[Tensor, Tensor, Tensor]:
    """Return the problem as sums, float64, without light coefficients (`without_light`); of delta (rad) and mm."""
    weighted = at.design * (at.weight / at.variance)[:, None]
    return without_light((weighted @ at.design.mT).double(), (weighted @ at.residual[..., None])[..., 0].double())


def residuals(
    pixels: Pixels, X: Tensor, R: Tensor, state: tuple[Tensor, Tensor] | None, model: SphereModel
) -> Residuals:
    """Linearise the pictures of B * C disks about poses X (B, 3), mm, R_lab_body R (B, 3, 3), at the best light.
    `state`: expected grey levels and weights of an earlier call, (L, P) each; None: from the picture itself.
    """
    cameras = len(model.light.noise)
    view = sphere_view(pixels, X.repeat_interleave(cameras, 0), R.repeat_interleave(cameras, 0), model)
    view = leaning(view, pixels, model)
    difference, black = model.light.at(view, pixels)  # as learnt
    shadow = (difference < model.light.dark.to(difference).repeat(len(X))[:, None]) & (view.coverage < IN_SIGHT)
    if bool(shadow.any()):
        view = replace(view, known=~shadow if view.known is None else view.known & ~shadow)
    columns = own_columns(view, difference, black, model.shading)
    beside = scene_beside(view, pixels, model.light.stray)
    beyond = (1.0 - view.coverage) * beside
    noise = model.light.noise.repeat(len(X), 1)
    inside = pixels.inside if view.known is None else pixels.inside & view.known
    target = pixels.grey - beyond
    # The first weights come from the picture itself, with bubbles; the second ones from the model.
    rounds = (pixels.grey, (inside & ~pixels.clipped).to(columns.dtype)) if state is None else state
    for _ in range(1 if state is not None else 2):
        expected, weight = rounds
        weighted = columns * (weight / noise_variance(expected, noise))[:, None]
        coefficients = solve_damped(
            (weighted @ columns.mT).double(), (weighted @ target[..., None])[..., 0].double(), ridge=1e-7
        ).to(columns.dtype)
        painted = (coefficients[:, None] @ columns)[:, 0]
        grey, residual = painted + beyond, target - painted
        # The true grey level of a saturated pixel is at least this one.
        silent = pixels.clipped & (residual <= 0)
        residual = residual.masked_fill(silent, 0.0)
        variance = noise_variance(grey, noise)
        deviation = robust_deviation(residual, variance, inside)
        variance = variance * deviation.clamp_min(1.0)[:, None] ** 2
        weight = (1.0 - residual.square() / (TUKEY**2 * variance)).clamp_min(0.0).square() * (inside & ~silent)
        rounds = grey, weight
    parts = {"residual": residual, "model": grey, "variance": variance, "weight": weight, "deviation": deviation}
    light, own = (difference, black, beside), (columns, coefficients)
    return with_design(view, light, own, model.shading, inside=inside, **parts)


def with_design(
    view: SphereView,
    light: tuple[Tensor, Tensor, Tensor],
    own: tuple[Tensor, Tensor],
    shading: Shading,
    **others: Tensor,
) -> Residuals:
    """Return the linear problem with its derivatives. `light`: difference, black, and what is beside the sphere, grey
    levels (L, P); `own`: `own_columns` and their coefficients (L, K); `others`: the rest of `Residuals`.
    """
    (difference, black, beside), (columns, coefficients), (n, n_black) = light, own, shading.counts
    tints = polynomials(view.across, max(shading.difference, shading.black))
    gain = (coefficients[:, None, :n] @ tints[:, :n])[:, 0]
    offset = (coefficients[:, None, n:] @ tints[:, :n_black])[:, 0]
    step, ground = difference * gain, black * gain + offset
    lit = view.coverage * step
    over = view.paint * step + ground - beside
    design = torch.cat([grey_by_pose(view, lit, over), columns], dim=1)
    return Residuals(view=view, design=design, lit=lit, over=over, beside=beside, **others)


def own_columns(view: SphereView, difference: Tensor, black: Tensor, shading: Shading) -> Tensor:
    """Return what each coefficient of a frame's own light adds to L disks, (L, K, P), grey levels."""
    tints, (n, n_black) = polynomials(view.across, max(shading.difference, shading.black)), shading.counts
    learnt = (view.coverage * (view.paint * difference + black))[:, None]
    return torch.cat([learnt * tints[:, :n], view.coverage[:, None] * tints[:, :n_black]], dim=1)


def grey_by_pose(view: SphereView, lit: Tensor, over: Tensor) -> Tensor:
    """Return the derivatives (L, 6, P) of grey by delta (rad) and position (mm); `lit`, `over` as in `Residuals`."""
    paint, limb = lit[:, None], over[:, None]
    return torch.cat(
        [paint * view.paint_by_rotation, paint * view.paint_by_position + limb * view.coverage_by_position], dim=1
    )


def without_light(normal: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Eliminate the light's coefficients: information (L, 6, 6), gradient (L, 6), coupling to the pose."""
    light = normal[:, 6:, 6:]
    light = light + 1e-7 * torch.diag_embed(light.diagonal(dim1=-2, dim2=-1) + 1e-12)
    mixed = torch.linalg.solve(light, normal[:, 6:, :6])
    information = normal[:, :6, :6] - normal[:, :6, 6:] @ mixed
    return information, gradient[:, :6] - (mixed.mT @ gradient[:, 6:, None])[..., 0], mixed


def tile_scores(at: Residuals, mixed: Tensor, tile: Tensor) -> Tensor:
    """Sum the scores of the pose, the light eliminated, over tiles (P,), (L, 6, T) float64; `mixed` as `disk_sums`."""
    by_pose = at.design[:, :6] - mixed.mT.to(at.design.dtype) @ at.design[:, 6:]
    score = by_pose * (at.weight / at.variance * at.residual)[:, None]
    tiles = score.new_zeros(*score.shape[:2], int(tile.max()) + 1 if len(tile) else 1)
    return tiles.index_add(2, tile, score).double()


def noise_variance(grey: Tensor, noise: Tensor) -> Tensor:
    """Return the noise variance at grey levels (L, P) by the curves (L, 4)."""
    grey = grey.clamp_min(0.0)
    a, b, c, d = noise[..., None].unbind(1)
    variance: Tensor = a + grey * (b + grey * (c + grey * d))
    return variance.clamp_min(NOISE_MIN)


def robust_deviation(residual: Tensor, variance: Tensor, inside: Tensor) -> Tensor:
    """Return the robust standard deviation of residuals over the expected noise, (L,), at least 1."""
    residual, variance, inside = (part[:, ::EVERY] for part in (residual, variance, inside))
    scaled = torch.where(inside, residual.abs() * variance.rsqrt(), torch.nan)
    return 1.4826 * torch.nan_to_num(scaled.nanmedian(-1).values)


def loss_of(at: Residuals, inside: Tensor) -> Tensor:
    """Return Tukey's loss (L,) with the normalisation of its scale, nats; unknown paint may have any grey level."""
    share = (at.residual.square() / (TUKEY**2 * at.variance)).clamp_max(1.0)
    loss = (TUKEY**2 / 6.0) * (1.0 - (1.0 - share) ** 3) + at.deviation.clamp_min(1.0).log()[:, None]
    if at.view.known is not None:
        loss = torch.where(at.view.known, loss, (at.lit / (2 * math.pi * at.variance).sqrt()).clamp_min(1.0).log())
    return (loss * inside).sum(-1).double()


def scores_of(at: Residuals, pixels: Pixels) -> Tensor:
    """Return the explained variance of L disks by the painted sphere, relative to models without paint, (L,), -1 .. 1.
    1 - painted / min(smooth, scene), from mean squared residuals of three models in every fourth pixel: the sphere at
    this pose; a disk whose grey level is a polynomial of order `SMOOTH`; the empty scene. Squares of outliers are
    limited; a saturated pixel that a model expects brighter has residual 0. 0 for a disk with hardly any known paint.
    """
    cover, counted = at.view.coverage, at.inside
    known = (cover * counted).sum(-1) > KNOWN * cover.sum(-1)
    some = slice(None, None, EVERY)
    cover, share, residual = cover[:, some], (cover * counted)[:, some], at.residual[:, some]
    share = share / share.sum(-1, keepdim=True).clamp_min(1e-6)
    grey, clipped = pixels.grey[:, some], pixels.clipped[:, some]
    disk, beside = grey - (1.0 - cover) * at.beside[:, some], at.beside[:, some]
    columns = cover[:, None] * polynomials(at.view.across[..., some], SMOOTH)
    weighted = columns * share[:, None]
    normal, right = (weighted @ columns.mT).double(), (weighted @ disk[..., None])[..., 0].double()
    smooth = (solve_damped(normal, right, ridge=1e-7).to(columns.dtype)[:, None] @ columns)[:, 0]
    spread = (share * (grey - (share * grey).sum(-1, keepdim=True)).square()).sum(-1)
    without = torch.stack([disk - smooth, grey - beside])
    models = torch.cat([residual[None], torch.where(clipped, without.clamp_min(0.0), without)])
    painted, *others = (share * torch.minimum(models.square(), OUTLIERS * spread[:, None])).sum(-1)
    score = 1.0 - painted / torch.minimum(*others).clamp_min(1e-9)
    return torch.where((spread > 1e-6) & known, score.clamp_min(-1.0), torch.zeros_like(score))


def learn_stray(at: Residuals, pixels: Pixels, use: Tensor, known: Tensor) -> Tensor:
    """Estimate the stray light (C, K) from pixels outside all spheres in B * C disks, those in `use` (B, C) bool.
    `known` (C, K): the stray light in the residuals' model. The estimate is robust against passing bubbles. Stray light
    below the model error of the limb is set to 0.
    """
    beside = at.inside & ~pixels.clipped & (at.view.coverage < NO_SPHERE) & use.reshape(-1, 1)
    beside[:, : pixels.inner] = False
    cameras = use.shape[1]
    found = torch.zeros_like(known)
    stray_known = scene_beside(at.view, pixels, known) - pixels.behind  # less the sphere's part at its edge
    for camera in range(cameras):
        own = slice(camera, None, cameras)
        basis = stray_basis(at.view.across[own]).mT[beside[own]].double()
        more = (at.residual + stray_known)[own][beside[own]].double()
        weight = torch.ones_like(more)
        for _ in range(STRAY_ROUNDS if len(more) >= FEWEST_BESIDE else 0):
            weighted = basis * weight[:, None]
            coefficients = torch.linalg.solve(weighted.mT @ basis + torch.eye(basis.shape[1]), weighted.mT @ more)
            left = more - basis @ coefficients
            scale = (1.4826 * left.abs().median()).clamp_min(math.sqrt(NOISE_MIN))
            weight = (1.0 - (left / (STRAY_TUKEY * scale)).square()).clamp_min(0.0).square()
            found[camera] = coefficients.float()
        step = at.lit[own, : pixels.inner][use[:, camera]].median() if bool(use[:, camera].any()) else math.inf
        if found[camera].abs().sum() < STRAY_LEAST * step:
            found[camera] = 0.0
    return found


def noise_curves(model: Tensor, residual: Tensor, inside: Tensor, cameras: int) -> Tensor:
    """Return the noise curve of each camera, (C, 4), from B * C disks (L, P); see `noise_curve`."""
    disks = [slice(camera, None, cameras) for camera in range(cameras)]
    return torch.stack([noise_curve(model[own], residual[own], inside[own]) for own in disks])


def noise_curve(model: Tensor, residual: Tensor, inside: Tensor) -> Tensor:
    """Return the coefficients (4,), not negative, of the noise variance in the grey level, from pixels (N,) inside."""
    model, residual = model[inside].clamp_min(0).double(), residual[inside].double()
    order = model.argsort(stable=True)
    groups = [group for group in order.tensor_split(24) if len(group) >= 50]
    if len(groups) < 3:
        return torch.tensor([float(residual.square().mean()) if len(residual) else 1.0, 0.0, 0.0, 0.0])
    at = torch.stack([model[group].mean() for group in groups])
    # Robust: residuals at the paint's borders are not noise.
    seen = torch.stack([(1.4826 * residual[group].abs().median()).square() for group in groups]).clamp_min(0.1)
    design = torch.stack([at**power for power in range(4)], dim=-1) / seen[:, None]
    return torch.from_numpy(nnls(design.numpy(), np.ones(len(groups)))[0]).float()
