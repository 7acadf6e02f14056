"""The iterations of mapping: first orientations, light and map separately, then poses and map together."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, vstack
from torch import Tensor

from sphereorient import so3
from sphereorient.files.threads import side_by_side
from sphereorient.mapping import grid
from sphereorient.mapping.disks import Crops, Disks, evenly_spread, pixels_of
from sphereorient.mapping.grid import NormalMatrix, SplineTable
from sphereorient.mapping.joint import Linearisation, joint_step, linear_system, linearise
from sphereorient.mapping.pairs import attitude_change_rad
from sphereorient.mapping.settings import MapSettings
from sphereorient.pose.camera_view import FIRST_BLUR_PX, CameraView, Optics, widest_px
from sphereorient.pose.fitter import Fitter, first_fitter
from sphereorient.pose.lights.disk import DiskLight, light_basis, light_columns, light_sums, no_glints, solved_light
from sphereorient.pose.lights.kinds import lit_in_the_lab
from sphereorient.pose.model import even_light
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.poses import POSE_PARTS, FittedPoses, PoseStart
from sphereorient.pose.residuals import noise_curves
from sphereorient.sphere.compare import fit_levels
from sphereorient.sphere.texture import map_directions, texel_areas
from sphereorient.sphere.texture_table import SIDE, texture_table

FIRST_SMOOTH = 0.02  # as the setting `smooth`, of the first map
CONTRAST = 0.3  # deviation of the first map about mid-grey
TEXEL_PX = 0.75  # at the centre of the widest disk
ROW, FINEST_ROWS = 32, 512  # the number of rows of the fitted map is a multiple of the first, at most the second
SEPARATE_ITERATIONS = 2  # with each instant alone: the map is still too blurred for joint steps
LIGHT_ITERATIONS = 8  # that estimate light, noise and blur
SMOOTHEST = 0.2  # weight of the map's squared slope over that of a typical texel, in the first iteration: orientations
# must not follow the map's noise
LAB_ITERATIONS, LAB_FRAMES = 3, 32  # that estimate one light in the lab, and its instants
# Share of the paint's expected smoothness while poses are sought: a smoother map shifts the position of a ball in one
# place (0.041 degrees with all of it, 0.016 with this), a rougher one lets poses follow noise.
LOOSE = 0.1
BLUR_FRAMES = 32  # instants from which the blur is estimated, evenly spread
BLUR_RATIO = 1.25  # between neighbouring trial blurs
BLUR_PX = (0.25, 3.0)  # narrowest and widest
BATCH = 24  # instants per batch
LONGEST_RAD = 0.05  # joint step
WHOLE = 0.999  # coverage of a pixel that the limb does not cross
BLACK, WHITE = 0.03, 0.97  # shares of the sphere that count as black and white
BEYOND = 0.2  # largest excess of the map over 0 .. 1 during iterations
NOISE_EVERY = 4  # each n-th pixel, for the noise
HELD = 1e12  # 1/mm^2, precision of a position that must not move
OUTLIER2 = 25.0  # largest squared residual over the expected noise


@dataclass(frozen=True, kw_only=True, eq=False)
class Iteration:
    """One iteration of orientations, light and map."""

    moved_rad: float  # rms move of the orientations
    misfit: float  # chi^2 per pixel, before the new map
    blur_px: float


@dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """The unknowns of an iteration: n instants of C cameras to which the map is fitted."""

    frames: Tensor  # (n,) int64
    pixels: Pixels  # of n * C disks
    use: Tensor  # (n, C) bool
    position_lab_mm: Tensor  # (n, 3)
    R_lab_body: Tensor  # (n, 3, 3)
    texture: Tensor  # (H, 2 H) float32, spline coefficients of the map as the pictures blur it
    blur_px: float
    fitter: Fitter  # for views and light; its own map is not used
    fixed: bool  # whether all instants share one position
    limb_share: float  # of the weight of pixels that the limb crosses
    weight: Tensor | None = None  # (H, 2 H) float64, of the texels in the map's last solution, see `map_weight`
    expected: Tensor | None = None  # (H, 2 H), paint without blur; the map's difference from it is penalised

    @property
    def blur_rad(self) -> float:
        """The blur of the pictures, rad of the sphere's directions at the middle of the widest disk."""
        return 2 * self.blur_px / widest_px(self.fitter.views)

    @property
    def tie(self) -> float:
        """The weight of the map's squared slope while poses are sought."""
        return (LOOSE if self.expected is None else 1.0) * grid.paint_tie(self.texture, self.blur_rad)

    def map_fitter(self) -> Fitter:
        """Return the fitter of poses to the present map."""
        return replace(self.fitter, optics=optics_of(self.texture, self.fitter.views, self.blur_px))

    def batches(self) -> "Iterator[State]":
        """Yield the instants, some at a time."""
        return (self.where(rows) for rows in torch.split(torch.arange(len(self.use)), BATCH))

    def where(self, rows: Tensor) -> "State":
        """Return some instants."""
        parts = {name: getattr(self, name)[rows] for name in ("frames", "use", "position_lab_mm", "R_lab_body")}
        cameras = torch.arange(self.use.shape[1])
        pixels = self.pixels.where((len(cameras) * rows[:, None] + cameras).reshape(-1))
        return replace(self, pixels=pixels, **parts)

    def start(self, precision: Tensor | None = None, held: bool = False) -> PoseStart:
        """Return the poses as the start of a fit; `precision` (3, 3): of all positions, 1/mm^2."""
        known = None if precision is None else precision.expand(len(self.use), 3, 3)
        return PoseStart(self.position_lab_mm, self.R_lab_body, self.use, known, held=held)

    def linearised(self) -> Iterator[Linearisation]:
        """Yield the linearisation of all disks in batches."""
        return side_by_side(lambda some: some.linearised_at(), self.batches())

    def linearised_at(self) -> Linearisation:
        """Linearise all disks at once; unseen ones have weight 0."""
        X, R, paint = self.position_lab_mm, self.R_lab_body, SplineTable(self.texture, 0.0)
        at = linearise(self.fitter, paint, self.pixels, X, R, self.blur_px)
        share = torch.where(at.view.coverage < WHOLE, self.limb_share, 1.0)
        return replace(at, weight=at.weight * share * self.use.reshape(-1, 1))


def map_height(views: Sequence[CameraView], settings: MapSettings) -> int:
    """Return the rows of the fitted map: texels slightly finer than pixels at the centre of the widest disk."""
    if settings.height is not None:
        return settings.height
    rows = math.pi / 2 / TEXEL_PX * widest_px(views)
    return min(FINEST_ROWS, max(2, round(rows / ROW)) * ROW)


def first_map(disks: Disks, R_lab_body: Tensor, height: int) -> Tensor:
    """Return a first map, (H, 2 H) float32, from normalised disks: relative grey about mid-grey."""
    texels = 2 * height * height
    matrix, right = csr_matrix((texels, texels)), np.zeros(texels)
    for c in range(disks.layers.shape[1]):
        normal, grey, weight = disks.sampled(slice(None), c, slant_power=2)
        body = (R_lab_body.mT.float() @ (disks.R_lab_view[:, c] @ normal)).mT
        more, sums = grid.map_sums(body.reshape(-1, 3), grey.reshape(-1), weight.reshape(-1), height)
        matrix, right = matrix + more, right + sums
    even = grid.solve_map(matrix, right, height, FIRST_SMOOTH * _typical(matrix.diagonal()))
    return (0.5 + CONTRAST * even / even.std()).clamp(0, 1).float()


def first_state(
    crops: Crops, frames: Tensor, R_lab_body: Tensor, texture: Tensor, settings: MapSettings, extra_px: float = 0.0
) -> State:
    """Return the initial state from orientations (n, 3, 3) of frames (n,) and a map; `extra_px`: added blur."""
    blur_px = math.hypot(settings.blur_px or FIRST_BLUR_PX, extra_px)
    table = optics_of(texture, crops.views, blur_px, grid.ROUGH_SIDE).fine.paint  # only for its blur, see `State`
    fitter = first_fitter(crops.views, crops.radius_mm, table, blur_px)
    pixels, use = pixels_of(crops, fitter, frames, settings.pixels, extra_px), crops.seen[frames]
    return State(
        frames=frames,
        pixels=pixels,
        use=use,
        position_lab_mm=crops.position_lab_mm[frames],
        R_lab_body=R_lab_body,
        texture=texture,
        blur_px=blur_px,
        fitter=fitter,
        fixed=crops.fixed,
        # The error of a fixed ball's limb is the same in all pictures: together they count as one.
        limb_share=1.0 / len(frames) if crops.fixed else 1.0,
    )


def iterate(state: State, settings: MapSettings, k: int) -> tuple[State, Iteration]:
    """Improve orientations, light and map once; k counts the iterations from 0."""
    before = state.R_lab_body
    smoothest = SMOOTHEST * 0.5**k
    if k < SEPARATE_ITERATIONS:
        state, _ = fitted(state, 3 if k == 0 else 2)
    if k < LIGHT_ITERATIONS:
        state = _with_light(state)
    elif k == LIGHT_ITERATIONS or (k < LIGHT_ITERATIONS + LAB_ITERATIONS and not state.fitter.light.linear):
        state = _lit_in_the_lab(state)
    if k >= SEPARATE_ITERATIONS:
        state = _with_joint_step(state, smoothest)
    state, chi2 = with_map(state, smoothest)
    if k < LIGHT_ITERATIONS + LAB_ITERATIONS:
        state = _rescaled(state)
    if SEPARATE_ITERATIONS <= k < LIGHT_ITERATIONS and settings.blur_px is None:
        state = replace(state, blur_px=_better_blur(state))
    moved_rad = attitude_change_rad(before, state.R_lab_body)
    return state, Iteration(moved_rad=moved_rad, misfit=chi2, blur_px=state.blur_px)


def optics_of(blurred: Tensor, views: Sequence[CameraView], blur_px: float, side: int = SIDE) -> Optics:
    """Return the optics of a map (H, 2 H) that has the blur of the pictures; `side` counts cells of its table."""
    widest = widest_px(views)
    return Optics(grid.map_table(blurred, 2 * blur_px / widest, side), blur_px, widest)


def fitted(state: State, iterations: int, crops: Crops | None = None) -> tuple[State, FittedPoses]:
    """Fit each instant's pose to the present map; with crops to all pixels, and a shared position stays fixed."""
    fitter = state.map_fitter()
    fine = fitter.optics.fine
    held = HELD * torch.eye(3, dtype=torch.float64) if state.fixed and crops is not None else None

    def one(some: State) -> FittedPoses:
        pixels = some.pixels
        if crops is not None:
            pixels = fitter.pixels(crops.pictures(some.frames), some.position_lab_mm, fine)
        return fitter.fit(pixels, some.start(held), fine, iterations)

    parts = list(side_by_side(one, state.batches()))
    fit = FittedPoses(**{name: torch.cat([getattr(part, name) for part in parts]) for name in POSE_PARTS})
    X = fit.position_lab_mm
    if state.fixed:
        X = state.position_lab_mm if crops is not None else X.median(0).values.expand(len(X), 3).clone()
    return replace(state, position_lab_mm=X, R_lab_body=fit.R_lab_body), fit


def _with_light(state: State) -> State:
    cameras, basis = state.use.shape[1], light_basis(torch.zeros(1, 2, 1)).shape[-2]
    normal = torch.zeros(cameras, 2 * basis, 2 * basis, dtype=torch.float64)
    right = torch.zeros(cameras, 2 * basis, dtype=torch.float64)
    greys: list[tuple[Tensor, ...]] = []
    some = slice(None, None, NOISE_EVERY)
    for batch, at in zip(state.batches(), state.linearised(), strict=True):
        pixels = batch.pixels
        more_normal, more_right = light_sums(light_columns(at.view), at.view, pixels, at.precision)
        normal += more_normal.reshape(-1, cameras, *normal.shape[1:]).sum(0)
        right += more_right.reshape(-1, cameras, 2 * basis).sum(0)
        inside = pixels.inside & ~pixels.clipped & batch.use.reshape(-1, 1)
        greys.append(tuple(part[:, some] for part in (pixels.grey - at.residual, at.residual, inside)))
    difference, black = solved_light(normal, right).chunk(2, dim=-1)
    model, residual, inside = (torch.cat(part) for part in zip(*greys, strict=True))
    noise = noise_curves(model, residual, inside, cameras)
    none = {"glints": no_glints(cameras), **even_light(cameras)}
    light = DiskLight(difference=difference, black=black, noise=noise, **none, known=True)
    return replace(state, fitter=replace(state.fitter, light=light))


def _lit_in_the_lab(state: State) -> State:
    """Return the state with one light in the lab for all cameras, unless it explains held-out instants less."""
    some, fitter = state.where(evenly_spread(torch.arange(len(state.use)), LAB_FRAMES)), state.map_fitter()
    fit = fitter.fit(some.pixels, some.start(), fitter.optics.fine, 1)
    if fitter.light.linear:
        lit = lit_in_the_lab(fitter, some.pixels, fit, some.use)[0]
    else:  # already tested
        lit = fitter.with_light_of(some.pixels, fit, some.use)
    return replace(state, fitter=replace(state.fitter, light=lit.light))


def _rescaled(state: State) -> State:
    """Scale the map to black 0 and white 1: pictures alone do not separate a dark light from a dark map."""
    values, order = state.texture.reshape(-1).sort()
    share = texel_areas(len(state.texture)).reshape(-1)[order].cumsum(0)
    low, high = (float(values[int((share < part * share[-1]).sum())]) for part in (BLACK, WHITE))
    step = max(high - low, 1e-3)
    light = state.fitter.light
    if light.known:  # the light takes the factor, so pictures do not change
        light = replace(light, difference=light.difference * step, black=light.black + light.difference * low)
    return replace(state, texture=(state.texture - low) / step, fitter=replace(state.fitter, light=light))


def _better_blur(state: State) -> float:
    """Return the blur, px, near the present one, that fits limb and slanted texture best."""
    some = state.where(evenly_spread(torch.arange(len(state.use)), BLUR_FRAMES))
    expected = some.linearised_at()
    tried = (replace(some, blur_px=some.blur_px * BLUR_RATIO**k).linearised_at() for k in (-1, 0, 1))
    squares = ((at.residual.square() / expected.variance).clamp_max(OUTLIER2) for at in tried)
    step = lowest(*(float((expected.weight * each).sum()) for each in squares))
    return float(np.clip(state.blur_px * BLUR_RATIO**step, *BLUR_PX))


def lowest(before: float, here: float, after: float) -> float:
    """Return the minimum of a parabola through values at -1, 0 and 1, within these."""
    bend = before - 2 * here + after
    shift = 0.5 * (before - after) / bend if bend > 0 else (1.0 if after < before else -1.0)
    return min(max(shift, -1.0), 1.0)


def _with_joint_step(state: State, smoothest: float) -> State:
    """Move all poses by one joint step; `with_map` then solves for the map exactly."""
    height = len(state.texture)
    parts = list(side_by_side(lambda some: linear_system(some.linearised_at(), height), state.batches()))
    weight = sum((grid.texel_sums(part.by_texel) for part in parts), np.zeros(2 * height * height))
    tie = max(smoothest * _typical(weight), state.tie)
    pose = joint_step(parts, state.use, _unexpected(state), tie, state.fitter.radius_mm, state.fixed)
    pose = pose * (LONGEST_RAD / pose[:, :3].norm(dim=1).max().clamp_min(1e-9)).clamp_max(1.0)
    R = so3.nearest_rotation(so3.exp(pose[:, :3]) @ state.R_lab_body)
    return replace(state, position_lab_mm=state.position_lab_mm + pose[:, 3:], R_lab_body=R)


def with_map(state: State, smoothest: float = 0.0) -> tuple[State, float]:
    """Return the state with its best map, and chi2 per pixel before; `smoothest`: least tie over a typical weight."""
    normal, right, chi2 = _map_equations(state)
    tie = max(smoothest * _typical(normal.diagonal()), state.tie)
    # Penalise the whole map, not the correction only: else noise grows with the iterations.
    right -= tie * (grid.stiffness(len(state.texture)) @ _unexpected(state).double().numpy().ravel())
    height = len(state.texture)
    # The next iteration corrects what conjugate gradients leave.
    texture = state.texture + grid.solve_map(normal, right, height, tie, 10).float()
    weight = torch.from_numpy(normal.diagonal().reshape(height, -1))
    return replace(state, texture=texture.clamp(-BEYOND, 1 + BEYOND), weight=weight), chi2


def sharp_map(state: State) -> Tensor:
    """Return the paint without the blur of the pictures, (H, 2 H) float64."""
    normal, right, _ = _map_equations(state)
    right += normal @ state.texture.double().numpy().ravel()
    tie = grid.paint_tie(state.texture, state.blur_rad)
    expected = torch.zeros_like(state.texture)
    if state.expected is not None:
        _, (gain, offset) = _as_filmed(state, state.expected)
        expected = gain * state.expected + offset
    return grid.sharpened(normal, right, state.blur_rad, tie, expected)


def _unexpected(state: State) -> Tensor:
    """Return the map minus the expected one, of the same blur and levels; the map if none is expected."""
    if state.expected is None:
        return state.texture
    filmed, (gain, offset) = _as_filmed(state, state.expected)
    return state.texture - (gain * filmed + offset)


def _as_filmed(state: State, paint: Tensor) -> tuple[Tensor, tuple[float, float]]:
    """Return the coefficients of paint (H, 2 H) with the pictures' blur, and gain and offset to the state's map."""
    height = len(paint)
    table = texture_table(paint, grid.coefficients_blur_rad(state.blur_rad, height))
    filmed = table.sample(map_directions(height).reshape(-1, 3).float().T[None])[0].reshape(paint.shape)
    return filmed, fit_levels(filmed, state.texture)


def _map_equations(state: State) -> tuple[NormalMatrix, NDArray[np.float64], float]:
    """Return the normal equations (T, T), (T,) of a change of the map, and chi2 per pixel before it."""
    height = len(state.texture)
    parts, right = [], np.zeros(2 * height * height)
    squares = expected = 0.0
    for at in state.linearised():
        parts.append(at.by_texel(height))
        right += parts[-1].T @ (at.residual * at.precision.sqrt()).reshape(-1).numpy()
        squares += float((at.precision * at.residual.square()).sum())
        expected += float((at.precision * at.variance).sum())
    return NormalMatrix(vstack(parts, format="csr")), right, squares / max(expected, 1e-9)


def map_weight(state: State) -> Tensor:
    """Return the sum of the pixels' weights at each texel, (H, 2 H) float64: its inverse variance by noise."""
    height = len(state.texture)
    total = sum((grid.texel_sums(at.by_texel(height)) for at in state.linearised()), np.zeros(2 * height * height))
    return torch.from_numpy(total.reshape(height, -1))


def _typical(weight: NDArray[np.float64]) -> float:
    return float(np.median(weight[weight > 0])) if (weight > 0).any() else 1.0
