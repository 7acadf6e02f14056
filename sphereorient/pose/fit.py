"""Pose to hundredths of a degree: Gauss-Newton on rotation and place, all cameras at once, light solved inside."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sphereorient import so3
from sphereorient.pose.light import Light, light_maps, light_sums, noise_curve, polynomials
from sphereorient.pose.model import View, sphere_view
from sphereorient.pose.pixels import Pixels
from sphereorient.sphere.texture_table import TextureTable

TUKEY = 14.0  # standard deviations beyond which a pixel does not count; a misfit edge must still pull, a bubble not
EDGE_PX = 0.005  # by how much the model's limb may lie off in all directions alike: no blur is known any better
NOISE_MIN = 0.25  # grey levels^2; rounding to whole levels alone makes 1/12


@dataclass(frozen=True, kw_only=True, eq=False)
class Shading:
    """Orders of the polynomials by which a frame's light may differ from the learnt; made by settings."""

    difference: int
    black: int


FIRST = Shading(difference=4, black=2)  # nothing is known of the light yet
LATER = Shading(difference=2, black=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """B poses fitted to the pictures of C cameras; made by `refine`, read by the tracker."""

    position_lab_mm: Tensor  # (B, 3) float64
    R_lab_body: Tensor  # (B, 3, 3) float64
    covariance: Tensor  # (B, 6, 6) float64, of delta (rad) and position (mm), lab
    own_turn: Tensor  # (B, C, 3), rad: how each camera alone would turn the pose, its place held
    own_covariance: Tensor  # (B, C, 3, 3), rad^2
    own_move: Tensor  # (B, C, 3), mm, lab: how each camera alone would move the sphere, distance by size included
    deviation: Tensor  # (B, C), robust standard deviation of the residuals over the noise expected
    score: Tensor  # (B, C), 1 less the share of the picture's variance that is left
    nll: Tensor  # (B,), negative log-likelihood of all pixels, as if they were independent
    step: Tensor  # (B, 6), the last one

    def to(self, device: torch.device) -> Fit:
        """Return the same on another device."""
        return Fit(**{name: getattr(self, name).to(device) for name in self.__dataclass_fields__})


@dataclass(frozen=True, kw_only=True, eq=False)
class Residuals:
    """The linear problem at one pose; L disks. Made by `residuals`."""

    view: View
    design: Tensor  # (L, 6 + K, P), derivatives by pose and by the light's coefficients
    residual: Tensor  # (L, P), grey levels
    model: Tensor  # (L, P), grey levels
    variance: Tensor  # (L, P), expected
    weight: Tensor  # (L, P), robust and inside, 0 .. 1
    deviation: Tensor  # (L,), robust standard deviation of the residuals over the noise expected
    lit: Tensor  # (L, P), grey levels from black to white paint, the frame's own light included, coverage too
    over: Tensor  # (L, P), grey levels by which the ball is brighter than what is behind it


def light_columns(view: View, light: Light, shading: Shading) -> tuple[Tensor, Tensor, Tensor]:
    """Return what the light's coefficients multiply, (L, K, P), and the learnt maps of difference and black (L, P)."""
    difference, black = light.at(view.across)
    tints = polynomials(view.across, max(shading.difference, shading.black))
    n_difference, n_black = ((order + 1) * (order + 2) // 2 for order in (shading.difference, shading.black))
    lit = (view.coverage * (view.paint * difference + black))[:, None]
    columns = torch.cat([lit * tints[:, :n_difference], view.coverage[:, None] * tints[:, :n_black]], dim=1)
    return columns, difference, black


def refine(
    pixels: Pixels,
    position_lab_mm: Tensor,
    R_lab_body: Tensor,
    use: Tensor,
    *,
    radius_mm: float,
    paint: TextureTable,
    blur_px: float,
    light: Light,
    shading: Shading = LATER,
    iterations: int = 4,
    place_precision: Tensor | None = None,
) -> Fit:
    """Fit poses to pictures: robust Gauss-Newton, the light's coefficients eliminated in every step.

    Args:
        pixels: of B * C disks, the cameras of a pose next to each other.
        position_lab_mm: (B, 3), start.
        R_lab_body: (B, 3, 3), start.
        use: (B, C) bool, the cameras that see the ball; a pose without any stays where it is.
        radius_mm: of the sphere.
        paint: blurred by `blur_px`.
        blur_px: standard deviation of optics, pixel and whatever was laid over the frame, px.
        light: of the C cameras.
        shading: how far a frame's light may differ from it.
        iterations: steps, at least 1, the same for all poses, so that none depends on its neighbours in the batch.
        place_precision: (B, 3, 3), 1/mm^2: what is known of the place, `position_lab_mm`, beforehand.

    Returns:
        The fit, its covariance that of the robust estimate with errors shared within tiles of the picture. All but
        the pose is as it was before the last step, which `step` holds: a fit that has arrived does not move any more.

    Source: variable projection, Golub and Pereyra 1973; covariance of an M-estimate from clustered scores, Liang and
    Zeger 1986.
    """
    cameras = use.shape[1]
    start, X, R = position_lab_mm.double(), position_lab_mm.double(), R_lab_body.double()
    origin = _by_pose(pixels.origin[..., 0].double(), cameras)
    seen = use.to(X.dtype)
    state: tuple[Tensor, Tensor] | None = None
    for _ in range(iterations):
        at = residuals(pixels, X, R, state, radius_mm, paint, blur_px, light, cameras, shading)
        state = at.model, at.weight
        precision = at.weight / at.variance
        weighted = at.design * precision[:, None]
        normal = (weighted @ at.design.mT).double()
        gradient = (weighted @ at.residual[..., None])[..., 0].double()
        information, pull, mixed = _without_light(normal, gradient)
        information, pull = (_by_pose(part, cameras) for part in (information, pull))
        whole = (information * seen[..., None, None]).sum(1)
        force = (pull * seen[..., None]).sum(1)
        if place_precision is not None:
            whole[:, 3:, 3:] += place_precision
            force[:, 3:] -= (place_precision @ (X - start)[..., None])[..., 0]
        step = _bounded(_solved(whole, force), X[:, None] - origin, seen, radius_mm)
        R = so3.exp(step[:, :3]) @ R
        X = X + step[:, 3:]
    # Where each camera would go from where the last step began, less that step.
    own = _solved(
        information[..., :3, :3], pull[..., :3] - (information[..., :3, 3:] @ step[:, None, 3:, None])[..., 0]
    )
    own = own - step[:, None, :3]
    freed = _solved(information, pull) - step[:, None]
    shared = _by_pose(_shared_scores(at, precision, mixed, pixels.tile), cameras)
    meat = (shared * seen[..., None, None]).sum(1)
    if place_precision is not None:  # what was known before has an error of its own
        meat[:, 3:, 3:] += place_precision
    bread = _inverse(whole)
    own_bread = _inverse(information[..., :3, :3])
    edge = _edge_errors(pixels, X[:, None] - origin, cameras, radius_mm) * seen[..., None]
    lured = (bread[:, None] @ information[..., 3:] @ edge[..., None])[..., 0]
    covariance = bread @ meat @ bread + lured.mT @ lured
    told = (whole.diagonal(dim1=-2, dim2=-1) > 0).all(-1)  # no picture, no knowledge: the inverse of nothing is huge
    covariance = torch.where(told[:, None, None], 0.5 * (covariance + covariance.mT), bread)
    loss = _by_pose(_loss(at, pixels.inside), cameras)
    return Fit(
        position_lab_mm=X,
        R_lab_body=R,
        covariance=covariance,
        own_turn=own,
        own_move=_bounded_alone(freed, X[:, None] - origin, radius_mm),
        own_covariance=own_bread @ shared[..., :3, :3] @ own_bread,
        deviation=_by_pose(at.deviation.double(), cameras),
        score=_by_pose(_score(at, pixels.inside).double(), cameras),
        nll=(loss * seen).sum(1),
        step=step,
    )


def residuals(
    pixels: Pixels,
    X: Tensor,
    R: Tensor,
    state: tuple[Tensor, Tensor] | None,
    radius_mm: float,
    paint: TextureTable,
    blur_px: float,
    light: Light,
    cameras: int,
    shading: Shading,
) -> Residuals:
    """Linearise the pictures about poses, the light's coefficients at their best.

    Args:
        pixels: of B * C disks.
        X: (B, 3), places of the centre in the lab, mm.
        R: (B, 3, 3), R_lab_body.
        state: model and weights of an earlier look, (L, P) each; None: from the picture itself.
        radius_mm: of the sphere.
        paint: blurred by `blur_px`.
        blur_px: as in `refine`.
        light: of the C cameras.
        cameras: C.
        shading: how far a frame's light may differ from it.
    """
    view = sphere_view(
        pixels, X.repeat_interleave(cameras, 0), R.repeat_interleave(cameras, 0), radius_mm, paint, blur_px
    )
    columns, difference, black = light_columns(view, light, shading)
    beyond = (1.0 - view.coverage) * pixels.behind
    noise = light.noise.repeat(len(X), 1)
    target = pixels.grey - beyond
    # The first weights come from the picture itself, which a bubble is part of: a second round does without it.
    rounds = (pixels.grey, pixels.inside.to(columns.dtype)) if state is None else state
    for _ in range(1 if state is not None else 2):
        expected, weight = rounds
        weighted = columns * (weight / _variance(expected, noise))[:, None]
        coefficients = _solved(
            (weighted @ columns.mT).double(), (weighted @ target[..., None])[..., 0].double(), ridge=1e-7
        ).to(columns.dtype)
        painted = (coefficients[:, None] @ columns)[:, 0]
        model, residual = painted + beyond, target - painted
        variance = _variance(model, noise)
        deviation = _deviation(residual, variance, pixels.inside)
        variance = variance * deviation.clamp_min(1.0)[:, None] ** 2
        weight = (1.0 - residual.square() / (TUKEY**2 * variance)).clamp_min(0.0).square() * pixels.inside
        rounds = model, weight
    tints = polynomials(view.across, max(shading.difference, shading.black))
    n = (shading.difference + 1) * (shading.difference + 2) // 2
    gain = (coefficients[:, None, :n] @ tints[:, :n])[:, 0]
    offset = (coefficients[:, None, n:] @ tints[:, : columns.shape[1] - n])[:, 0]
    step, ground = difference * gain, black * gain + offset
    lit = view.coverage * step
    over = view.paint * step + ground - pixels.behind
    return Residuals(
        view=view,
        design=torch.cat([grey_by_pose(view, lit, over), columns], dim=1),
        residual=residual,
        model=model,
        variance=variance,
        weight=weight,
        deviation=deviation,
        lit=lit,
        over=over,
    )


def grey_by_pose(view: View, lit: Tensor, over: Tensor) -> Tensor:
    """Return how grey changes with delta (rad) and place (mm), (L, 6, P); `lit` and `over` as in `Residuals`."""
    paint, limb = lit[:, None], over[:, None]
    return torch.cat(
        [paint * view.paint_by_rotation, paint * view.paint_by_position + limb * view.coverage_by_position], dim=1
    )


def _by_pose(disks: Tensor, cameras: int) -> Tensor:
    """Return (B * C, ...) as (B, C, ...)."""
    return disks.reshape(-1, cameras, *disks.shape[1:])


def _variance(grey: Tensor, noise: Tensor) -> Tensor:
    """Noise expected at grey levels (L, P) by the curves (L, 4)."""
    grey = grey.clamp_min(0.0)
    a, b, c, d = noise[..., None].unbind(1)
    variance: Tensor = a + grey * (b + grey * (c + grey * d))
    return variance.clamp_min(NOISE_MIN)


def _deviation(residual: Tensor, variance: Tensor, inside: Tensor) -> Tensor:
    """Robust standard deviation of residuals over the noise expected, (L,); 1 where the noise explains them."""
    # A quarter of the places tells as much: they are in order of distance from the middle.
    residual, variance, inside = residual[:, ::4], variance[:, ::4], inside[:, ::4]
    scaled = torch.where(inside, residual.abs() * variance.rsqrt(), torch.nan)
    return 1.4826 * torch.nan_to_num(scaled.nanmedian(-1).values)


def _without_light(normal: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Eliminate the light's coefficients: information (L, 6, 6), gradient (L, 6), what the pose takes from them."""
    light = normal[:, 6:, 6:]
    light = light + 1e-7 * torch.diag_embed(light.diagonal(dim1=-2, dim2=-1) + 1e-12)
    mixed = torch.linalg.solve(light, normal[:, 6:, :6])
    information = normal[:, :6, :6] - normal[:, :6, 6:] @ mixed
    return information, gradient[:, :6] - (mixed.mT @ gradient[:, 6:, None])[..., 0], mixed


def _solved(matrix: Tensor, right: Tensor, ridge: float = 1e-9) -> Tensor:
    """Solve small symmetric systems; a direction that nothing determines gets no step."""
    size = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(0)
    floor = ridge * size + 1e-12
    solution: Tensor = torch.linalg.solve_ex(matrix + torch.diag_embed(floor), right[..., None]).result
    return solution[..., 0]


def _inverse(matrix: Tensor) -> Tensor:
    size = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(0)
    inverse: Tensor = torch.linalg.inv_ex(matrix + torch.diag_embed(1e-9 * size + 1e-12)).inverse
    return inverse


def _bounded(step: Tensor, to_centre: Tensor, seen: Tensor, radius_mm: float) -> Tensor:
    """Shorten steps that change a picture by over 0.1 radii, pose by pose: beyond, the slopes say nothing.

    Along a line of sight the picture only grows: there a step may be as long as its share of the distance allows.

    Args:
        step: (B, 6), rad and mm.
        to_centre: (B, C, 3), from where each camera looks to the sphere, mm.
        seen: (B, C), 1 for the cameras in use.
        radius_mm: of the sphere.
    """
    distance = to_centre.norm(dim=-1, keepdim=True).clamp_min(radius_mm)
    move, sight = step[:, None, 3:], to_centre / distance
    along = (move * sight).sum(-1, keepdim=True)
    across = (move - along * sight).norm(dim=-1) / radius_mm
    seen_change = torch.hypot(across, (along / distance)[..., 0]) * seen
    size = torch.maximum(step[:, :3].norm(dim=-1), seen_change.amax(1))
    return step * (0.1 / size.clamp_min(0.1))[:, None]


def _edge_errors(pixels: Pixels, to_centre: Tensor, cameras: int, radius_mm: float) -> Tensor:
    """Return by how much (B, C, 3), mm, an edge that is EDGE_PX off moves the sphere along each line of sight."""
    distance = to_centre.norm(dim=-1, keepdim=True)
    px_mm = _by_pose(pixels.pitch_mm, cameras)[..., None] + _by_pose(pixels.pitch_rad, cameras)[..., None] * distance
    off: Tensor = to_centre * (EDGE_PX * px_mm / radius_mm)
    return off


def _bounded_alone(freed: Tensor, to_centre: Tensor, radius_mm: float) -> Tensor:
    """Return the moves (B, C, 3) of steps (B, C, 6) that each camera would take alone."""
    count = freed.shape[0] * freed.shape[1]
    alone = torch.ones(count, 1, dtype=freed.dtype, device=freed.device)
    step = _bounded(freed.reshape(count, 6), to_centre.reshape(count, 1, 3), alone, radius_mm)
    return step.reshape(freed.shape)[..., 3:]


def _shared_scores(at: Residuals, precision: Tensor, mixed: Tensor, tile: Tensor) -> Tensor:
    """Sum over tiles of the outer products of their scores, (L, 6, 6): neighbours' errors are not independent."""
    by_pose = at.design[:, :6] - mixed.mT.to(at.design.dtype) @ at.design[:, 6:]
    score = by_pose * (precision * at.residual)[:, None]
    tiles = score.new_zeros(*score.shape[:2], int(tile.max()) + 1 if len(tile) else 1)
    tiles = tiles.index_add(2, tile, score).double()
    count, fitted = tiles.shape[2], at.design.shape[1]
    # Residuals of a fit are smaller than errors: the correction for few clusters (Cameron and Miller 2015, CR1).
    few = count / max(count - fitted, 1)
    return few * (tiles @ tiles.mT)


def _loss(at: Residuals, inside: Tensor) -> Tensor:
    """Tukey's loss with its scale's own term (L,), natural units: what a wider scatter gains, it pays for."""
    share = (at.residual.square() / (TUKEY**2 * at.variance)).clamp_max(1.0)
    loss = (TUKEY**2 / 6.0) * (1.0 - (1.0 - share) ** 3) + at.deviation.clamp_min(1.0).log()[:, None]
    return (loss * inside).sum(-1).double()


def _score(at: Residuals, inside: Tensor) -> Tensor:
    """Share of the disk's variance that the model explains, (L,).

    Every pixel of the ball counts: those that do not fit are what tells a wrong pose. A bubble counts as dark or
    bright as paint is, however much brighter it shines.
    """
    share = at.view.coverage * inside
    share = share / share.sum(-1, keepdim=True).clamp_min(1e-6)
    grey = at.model + at.residual
    spread = (share * (grey - (share * grey).sum(-1, keepdim=True)).square()).sum(-1)
    left = (share * torch.minimum(at.residual.square(), 4.0 * spread[:, None])).sum(-1)
    explained = 1.0 - left / spread.clamp_min(1e-9)
    # Where no pixel is ball, nothing is explained.
    return torch.where(spread > 1e-6, explained, torch.zeros_like(explained))


def learn_light(
    pixels: Pixels,
    fit: Fit,
    use: Tensor,
    *,
    radius_mm: float,
    paint: TextureTable,
    blur_px: float,
    light: Light,
    shading: Shading,
) -> Light:
    """Learn the light and the noise of a movie from fitted poses.

    Args:
        pixels: of B * C disks.
        fit: of them.
        use: (B, C) bool, disks to learn from.
        radius_mm: as in `refine`, like the following ones.
        paint: as there.
        blur_px: as there.
        light: with which the poses were fitted.
        shading: with which the poses were fitted.
    """
    cameras = use.shape[1]
    X, R = fit.position_lab_mm, fit.R_lab_body
    at = residuals(pixels, X, R, None, radius_mm, paint, blur_px, light, cameras, shading)
    at = residuals(pixels, X, R, (at.model, at.weight), radius_mm, paint, blur_px, light, cameras, shading)
    normal, right = light_sums(at.view, pixels, at.weight / at.variance * use.reshape(-1, 1))
    difference, black = light_maps(_by_pose(normal, cameras).sum(0), _by_pose(right, cameras).sum(0))
    counted = pixels.inside & use.reshape(-1, 1)
    noise = torch.stack(
        [noise_curve(at.model[c::cameras], at.residual[c::cameras], counted[c::cameras]) for c in range(cameras)]
    )
    return Light(difference=difference, black=black, noise=noise, known=True)
