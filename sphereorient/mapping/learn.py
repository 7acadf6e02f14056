"""Texture map, orientations and light from movies or photographs: start without a map, iterate, finish."""

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import h5py
import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient import so3
from sphereorient.cameras import perspective_centre_lab_mm
from sphereorient.files.hdf5 import DAMAGE, whole_hdf5
from sphereorient.files.threads import Progress, counted
from sphereorient.files.whole_file import writing
from sphereorient.mapping import iterations
from sphereorient.mapping.chain import PairwiseAttitudes, find_chain
from sphereorient.mapping.disks import Crops, Disks, disks_of, evenly_spread, normalised_disks
from sphereorient.mapping.grid import look_up
from sphereorient.mapping.iterations import Iteration, State
from sphereorient.mapping.pairs import Closure
from sphereorient.mapping.photographs import find_photographs, finer_settings
from sphereorient.mapping.settings import MapSettings
from sphereorient.pose.camera_view import FIRST_BLUR_PX, CameraView, widest_px
from sphereorient.pose.lights.kinds import light_of
from sphereorient.pose.model import Light
from sphereorient.pose.poses import FittedPoses
from sphereorient.sphere.compare import compare_maps, turned_map, weighted_correlation
from sphereorient.sphere.texture import map_directions, texel_areas
from sphereorient.sphere.view import perspective_view

# Least cosine of the slant at which a picture shows a texel (displacement rms: 0.74 degrees from 0.2, 0.15 from 0.4).
SHOWN_MIN = 0.4
FINER = 2  # ratio of rows, sharpened over fitted map
RECOVERY_AFTER = (3, 6)  # iterations after which ill-fitting instants are searched again
GOOD_SHARE = 0.85  # of the median score; above, an instant fits
POSITION_ITERATIONS = 4  # for the position of a fixed ball
FEW_PIXELS = 250_000  # of all photographs
PIXELS_A_TEXEL = 3.0  # pixels per texel, for few photographs
# Blur (radii) and number of the first iterations of photographs. Errors: 0.8 degrees before, 0.06 after, 0.05 at the
# end (12 pictures of 200 px); without them 0.09 after twice as many others.
COARSE, COARSE_ITERATIONS = 0.015, 5
HELD_EVERY = 5  # each n-th instant is compared with the map of the others
SEEN_MIN = 0.99  # least share of a compared pixel on texels that other pictures show
JUMP_RAD, JUMPS = math.radians(3.0), 10.0  # least difference from neighbouring rotations, and over the usual one
WINDOW = 5  # rotations of the median
SCHEMA = "sphereorient-unfinished-map/1"  # of the file of an unfinished map
STATE_PARTS = ("position_lab_mm", "R_lab_body", "texture")  # kept


@dataclass(frozen=True, kw_only=True, eq=False)
class LearntMap:
    """A texture map learnt from movies or photographs; the body frame is the lab at the first known orientation.
    A movie through a mirror gives a mirrored map, which one camera or parallel ones cannot detect: set `flip:`.
    """

    texture: Tensor  # (H, 2 H) float32, 0 black .. 1 white; NaN where never seen
    seen: Tensor  # (H, 2 H) int64, pictures that show each texel
    sigma: Tensor  # (H, 2 H) float32, standard deviation of the texture by noise alone; infinite where never seen
    R_lab_body: Tensor  # (N, 3, 3) float64, NaN where the sphere was not found
    position_lab_mm: Tensor  # (N, 3) float64, NaN likewise
    valid: Tensor  # (N,) bool, frames with an orientation
    fitted: Tensor  # (N,) bool, frames that the map was fitted to; the others follow them
    score: Tensor  # (N, C), share of each picture's variance that the map explains; NaN where not fitted
    paint: Tensor  # (N, C), correlation with the paint in pictures held out of the map for it; NaN elsewhere
    jumps: Tensor  # (J,) int64, frames with a rotation unlike those before and after
    views: Sequence[CameraView]  # with backgrounds
    light: Light
    blur_px: float  # estimated with the map
    closure: Closure
    rounds: tuple[Iteration, ...]
    arrived: bool  # whether the last iteration moved orientations by less than the setting `arrived_deg`

    @property
    def seen_share(self) -> float:
        """Return the share of the sphere that was seen at all."""
        areas = texel_areas(len(self.texture))
        return float((areas * (self.seen > 0)).sum() / areas.sum())


def fit_map(
    crops: Crops, settings: MapSettings, progress: Progress, kept: Path | None = None, old: Tensor | None = None
) -> LearntMap:
    """Learn the texture map, all orientations and the light from the crops of opened movies.
    `kept`: file of the state after each iteration, from which an interrupted run continues to the same result.
    `old`: an earlier map (h, 2 h) of the ball, to which noise ties the new one; its body frame is not used.
    Raises PaintError (too few frames, no rotation, no common patch, or different spheres), OutputError (for `kept`).
    Source: direct alignment (Lucas and Kanade 1981), a pose graph, bundle adjustment on grey values.
    """
    before = None if kept is None else read_kept(kept)
    if before is None:
        start = (_start_from_photographs if settings.unordered else _start_from_movie)(crops, settings, progress)
        state, done = start.state, list[Iteration]()
    else:
        start, state, done = _resumed(crops, before, settings)
    chain = start.chain.R_lab_body[start.rows]
    arrived_rad = math.radians(settings.arrived_deg)
    least = iterations.LIGHT_ITERATIONS
    while len(done) < settings.rounds and not (len(done) > least and done[-1].moved_rad < arrived_rad):
        if kept is not None:
            write_kept(kept, _parts(start, state, done))
        progress("map", len(done), 0)  # it may end at any, so without a time left
        state, iteration = iterations.iterate(state, settings, len(done))
        if len(done) in RECOVERY_AFTER:
            state = recovered(start.crops, state, chain)
        done.append(iteration)
    progress("map", len(done), len(done))
    if old is not None:
        R_now_old = compare_maps(iterations.sharp_map(state).float(), old).R_other_reference
        prior = turned_map(old.float(), R_now_old.mT, len(state.texture))
        state = replace(state, expected=torch.where(prior.isfinite(), prior, 0.5))  # grey where unknown
        for k in range(settings.rounds):
            progress("map, with the old one", k, 0)
            state, iteration = iterations.iterate(state, settings, least + k)
            done.append(iteration)
            if k >= iterations.LAB_ITERATIONS and iteration.moved_rad < arrived_rad:
                break
        progress("map, with the old one", k + 1, k + 1)
    return _finished(start, state, settings, tuple(done), arrived=done[-1].moved_rad < arrived_rad)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Start:
    crops: Crops  # with the estimated position of a fixed ball
    frames: Tensor  # (M,) int64, crops with an orientation
    rows: Tensor  # (n,) int64, those of them used for the map
    chain: PairwiseAttitudes  # of the M frames
    state: State  # of the n


def _parts(start: _Start, state: State, done: Sequence[Iteration]) -> dict[str, Tensor]:
    """Return the input of `_resumed` except the crops."""
    chain, light = start.chain, state.fitter.light
    closure, rounds = astuple(chain.closure), [astuple(one) for one in done]
    numbers = {"closure": closure, "blur_px": state.blur_px, "done": rounds}
    parts = {"place": start.crops.position_lab_mm, "frames": start.frames, "rows": start.rows, "known": light.known}
    parts |= {"chain_rows": chain.rows, "chain": chain.R_lab_body, "first_map": start.state.texture}
    parts |= {name: getattr(state, name) for name in STATE_PARTS} | light.parts()
    parts |= {name: torch.tensor(value, dtype=torch.float64) for name, value in numbers.items()}
    return {name: torch.as_tensor(part) for name, part in parts.items()}


def _resumed(crops: Crops, kept: dict[str, Tensor], settings: MapSettings) -> tuple[_Start, State, list[Iteration]]:
    """Return start, state and iterations of an interrupted run."""
    crops = replace(crops, position_lab_mm=kept["place"])
    frames, rows = kept["frames"], kept["rows"]
    *counts, before, after, moved = kept["closure"].tolist()
    closure = Closure(**dict(zip(Closure.__dataclass_fields__, [*map(int, counts), before, after, moved], strict=True)))
    chain = PairwiseAttitudes(rows=kept["chain_rows"], R_lab_body=kept["chain"], closure=closure)
    few = _settings_of_few(settings, crops, frames) if settings.unordered else settings
    first = iterations.first_state(crops, frames[rows], chain.R_lab_body[rows], kept["first_map"], few)
    fitter = replace(first.fitter, light=light_of(kept, bool(kept["known"])))
    X, R, texture = (kept[name] for name in STATE_PARTS)
    state = replace(first, position_lab_mm=X, R_lab_body=R, texture=texture, fitter=fitter)
    state = replace(state, blur_px=float(kept["blur_px"]))
    done = [Iteration(**dict(zip(Iteration.__dataclass_fields__, row, strict=True))) for row in kept["done"].tolist()]
    return _Start(crops=crops, frames=frames, rows=rows, chain=chain, state=first), state, done


def _start_from_movie(crops: Crops, settings: MapSettings, progress: Progress) -> _Start:
    start = _from_chain(crops, settings, progress)
    if not crops.fixed:
        return start
    # The outline of changes errs by 1 to 2 px, and so do rotations: correct the position, restart the chain.
    state = start.state
    for k in counted("place", range(POSITION_ITERATIONS), POSITION_ITERATIONS, progress):
        state, _ = iterations.iterate(state, settings, k)
    known = torch.isfinite(crops.position_lab_mm).all(1)[:, None]
    X = torch.where(known, state.position_lab_mm[0], torch.nan)
    return _from_chain(replace(crops, position_lab_mm=X), settings, progress)


def _from_chain(crops: Crops, settings: MapSettings, progress: Progress) -> _Start:
    progress("chain", 0, 1)
    frames = crops.frames_with_ball()
    rows = evenly_spread(torch.arange(len(frames)), settings.frames_max)
    disks = disks_of(crops, frames, settings)
    chain = find_chain(disks, settings)
    progress("chain", 1, 1)
    first = iterations.first_map(disks, chain.R_lab_body, iterations.map_height(crops.views, settings))
    state = iterations.first_state(crops, frames[rows], chain.R_lab_body[rows], first, settings)
    return _Start(crops=crops, frames=frames, rows=rows, chain=chain, state=state)


def _start_from_photographs(crops: Crops, settings: MapSettings, progress: Progress) -> _Start:
    """Find orientations of unordered pictures, at most `frames_max` evenly spread ones, and a first map."""
    progress("photographs", 0, 1)
    frames = evenly_spread(crops.frames_with_ball(), settings.frames_max)
    disks = disks_of(crops, frames, finer_settings(settings, widest_px(crops.views)))
    chain = find_photographs(disks_of(crops, frames, settings), disks, settings)
    progress("photographs", 1, 1)
    frames, disks = frames[chain.rows], disks.where(chain.rows)
    few = _settings_of_few(settings, crops, frames)
    R, X = _coarse(crops, frames, disks, chain.R_lab_body, few, progress)
    crops = replace(crops, position_lab_mm=crops.position_lab_mm.index_put((frames,), X))
    first = iterations.first_map(disks, R, iterations.map_height(crops.views, few))
    rows, state = torch.arange(len(frames)), iterations.first_state(crops, frames, R, first, few)
    return _Start(crops=crops, frames=frames, rows=rows, chain=replace(chain, R_lab_body=R), state=state)


def _settings_of_few(settings: MapSettings, crops: Crops, frames: Tensor) -> MapSettings:
    """Return settings for few pictures: more pixels, fewer texels, else the map fits any orientation."""
    disks = int(crops.seen[frames].sum())
    pixels = max(settings.pixels, FEW_PIXELS // disks)
    seen = disks * min(pixels, math.pi / 4 * widest_px(crops.views) ** 2)
    rows = int(math.sqrt(seen / PIXELS_A_TEXEL / 2)) // iterations.ROW * iterations.ROW
    height = settings.height or min(iterations.map_height(crops.views, settings), max(iterations.ROW, rows))
    return settings.model_copy(update={"pixels": pixels, "height": height})


def _coarse(
    crops: Crops, frames: Tensor, disks: Disks, R_lab_body: Tensor, settings: MapSettings, progress: Progress
) -> tuple[Tensor, Tensor]:
    """Return orientations (M, 3, 3) and positions (M, 3), mm, refined in blurred pictures."""
    extra_px = COARSE * widest_px(crops.views) / 2
    whole_px = math.hypot(settings.blur_px or FIRST_BLUR_PX, extra_px)
    rows = max(iterations.ROW, iterations.map_height(crops.views, settings) // 2)
    coarse = settings.model_copy(update={"blur_px": whole_px, "height": rows})
    first = iterations.first_map(disks, R_lab_body, rows)
    state = iterations.first_state(crops, frames, R_lab_body, first, settings, extra_px)
    for k in counted("coarse map", range(COARSE_ITERATIONS), COARSE_ITERATIONS, progress):
        state, _ = iterations.iterate(state, coarse, k)
    return state.R_lab_body, state.position_lab_mm


def _finished(
    start: _Start, state: State, settings: MapSettings, done: tuple[Iteration, ...], arrived: bool
) -> LearntMap:
    """Fit the final poses, and express all in the body frame of the first orientation."""
    crops, frames, rows, chain = start.crops, start.frames, start.rows, start.chain
    state, fit = iterations.fitted(state, 2, crops)  # each pose alone, by the final map
    state = replace(state, R_lab_body=so3.nearest_rotation(state.R_lab_body))
    all_R = interpolated(chain.R_lab_body, rows, state.R_lab_body)
    Q = all_R[0].clone()  # R_new = R Q^T, and new directions are Q times the old
    texture, seen, sigma = final_map(state, Q)

    def spread(values: Tensor, at: Tensor) -> Tensor:
        whole = torch.full((len(crops), *values.shape[1:]), torch.nan, dtype=torch.float64)
        return whole.index_put((at,), values)

    attitudes = spread(so3.nearest_rotation(all_R @ Q.mT), frames)
    used, numbers = frames[rows], torch.arange(len(crops))
    found = crops.frames_with_ball()  # photographs without an orientation also have a position
    return LearntMap(
        texture=texture,
        seen=seen,
        sigma=sigma,
        R_lab_body=attitudes,
        position_lab_mm=spread(crops.position_lab_mm[found], found).index_put((used,), state.position_lab_mm),
        valid=torch.isin(numbers, frames),
        fitted=torch.isin(numbers, used),
        score=spread(torch.where(state.use, fit.score, torch.nan), used),
        paint=spread(paint_correlation(crops, state, settings), used),
        jumps=torch.empty(0).long() if settings.unordered else jumps(attitudes),
        views=crops.views,
        light=state.fitter.light,
        blur_px=state.blur_px,
        closure=chain.closure,
        rounds=done,
        arrived=arrived,
    )


def interpolated(chain: Tensor, rows: Tensor, known: Tensor) -> Tensor:
    """Return all orientations (M, 3, 3): of `rows` (n,) as `known`, of the others by the corrected chain."""
    off = so3.log(known @ chain[rows].mT)
    at = torch.arange(len(chain)).clamp(int(rows[0]), int(rows[-1]))
    upper = torch.searchsorted(rows, at).clamp(0, len(rows) - 1)
    lower = (upper - 1).clamp_min(0)
    span = (rows[upper] - rows[lower]).clamp_min(1)
    share = ((at - rows[lower]).double() / span).clamp(0, 1)[:, None]
    R = so3.exp(off[lower] * (1 - share) + off[upper] * share) @ chain
    R[rows] = known
    return R


def recovered(crops: Crops, state: State, chain: Tensor) -> State:
    """Restart ill-fitting instants from the chain (n, 3, 3), corrected like their neighbours."""
    score = _scores(iterations.fitted(state, 1)[1], state.use)
    good = score >= GOOD_SHARE * score.nanmedian()
    if good.all() or not good.any():
        return state
    lost = torch.nonzero(~good)[:, 0]
    R = interpolated(chain, torch.nonzero(good)[:, 0], state.R_lab_body[good])[lost]
    again, fitter = replace(state.where(lost), R_lab_body=R), state.map_fitter()
    optics = fitter.optics
    steps = [(level, 1, 5) for level in (optics.coarse, optics.middle, optics.fine)]  # at each pyramid level
    fit = fitter.fit_through(steps, crops.pictures(again.frames), again.start(held=state.fixed))
    better = _scores(fit, again.use) > score[lost]
    rows, X = (lost[better],), again.position_lab_mm if state.fixed else fit.position_lab_mm
    R, X = state.R_lab_body.index_put(rows, fit.R_lab_body[better]), state.position_lab_mm.index_put(rows, X[better])
    return replace(state, R_lab_body=R, position_lab_mm=X)


def _scores(fit: FittedPoses, use: Tensor) -> Tensor:
    return torch.where(use, fit.score, torch.nan).nanmean(1)


def final_map(state: State, Q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Sharpen the map and rotate it by Q: texture, counts and sigma, (H, 2 H) each."""
    height = FINER * len(state.texture)
    direction = map_directions(height) @ Q  # Q^T d: direction of the new texel in the fitted map
    texture = look_up(iterations.sharp_map(state), direction).clamp(0, 1)
    weight = look_up(iterations.map_weight(state), direction)
    seen = times_seen(state, direction)
    unknown = (seen == 0) | (weight <= 0)
    sigma = torch.where(unknown, torch.inf, weight.clamp_min(1e-30).rsqrt())
    return torch.where(unknown, torch.nan, texture).float(), torch.where(unknown, 0, seen), sigma.float()


def paint_correlation(crops: Crops, state: State, settings: MapSettings) -> Tensor:
    """Return correlations (n, C) of pictures with a map to which they were not fitted; NaN where not compared.
    Both are normalised as for pairs of pictures, to remove shading.
    """
    rows = torch.arange(HELD_EVERY // 2, len(state.use), HELD_EVERY)
    found = torch.full(state.use.shape, torch.nan, dtype=torch.float64)
    if not len(rows):
        return found
    others, _ = iterations.with_map(replace(state, use=state.use.index_fill(0, rows, False)))
    known = (iterations.map_weight(others) > 0).float()
    one, _ = iterations.fitted(replace(others, use=state.use).where(rows), 2, crops)  # poses held out, by that map
    X = crops.position_lab_mm.index_put((one.frames,), one.position_lab_mm)
    filmed = disks_of(replace(crops, position_lab_mm=X), one.frames, settings)
    for c in range(found.shape[1]):
        view = perspective_view(settings.disk_px, float(filmed.distance_radii[:, c].median()))
        body = view.normal_view.double() @ filmed.R_lab_view[:, c].mT.double() @ one.R_lab_body
        pictures, seen = (view.picture(look_up(each, body)) for each in (others.texture, known))
        at = filmed.where(slice(None), slice(c, c + 1))
        model = normalised_disks(pictures[:, None], at.R_lab_view, at.distance_radii, at.seen, settings, at.shown)
        a, b = (disks.layers[:, 0, 0].flatten(1) for disks in (at, model))
        weight = filmed.share.flatten() * filmed.weight(slice(None), c) * (seen > SEEN_MIN).flatten(1)
        found[rows, c] = weighted_correlation(a, b, weight).double()
    return found


def jumps(R_lab_body: Tensor) -> Tensor:
    """Return the frames (J,) with a rotation unlike those before and after, from orientations (N, 3, 3); NaN: unknown.
    A rotation is compared with the median of its neighbours'; a lasting change of rate is no jump.
    """
    turn = so3.log((R_lab_body[1:] @ R_lab_body[:-1].mT).nan_to_num())
    turn = torch.where(R_lab_body.isfinite().flatten(1).all(1).unfold(0, 2, 1).all(1)[:, None], turn, torch.nan)
    near = F.pad(turn.T[None], (WINDOW // 2, WINDOW // 2), value=torch.nan)[0].unfold(1, WINDOW, 1)
    off = (turn - near.nanmedian(2).values.T).norm(dim=1)
    usual = off[off.isfinite()].median() if off.isfinite().any() else off.new_zeros(())
    return torch.nonzero(off > (JUMPS * usual).clamp_min(JUMP_RAD))[:, 0]


def times_seen(state: State, direction_body: Tensor) -> Tensor:
    """Count the pictures that show each direction (..., 3) of the body at a small enough slant."""
    seen = torch.zeros(direction_body.shape[:-1], dtype=torch.int64)
    radius_mm = state.fitter.radius_mm
    for k, R in enumerate(state.R_lab_body):
        for c, view in enumerate(state.fitter.views):
            if not bool(state.use[k, c]):
                continue
            middle = perspective_centre_lab_mm(view.camera, X := state.position_lab_mm[k]) - X
            far = float(middle.norm())
            towards = (direction_body @ (R.mT @ (middle / far))).float()
            # Cosine of the slant where the line of sight meets the ball: (D n.e - r) / |D e - r n|.
            away = (far**2 + radius_mm**2 - 2 * far * radius_mm * towards).sqrt()
            visible = (far * towards - radius_mm) / away > SHOWN_MIN
            if view.background.shown is not None:
                shown, place = view.background.shown, state.position_lab_mm[k] + radius_mm * (direction_body @ R.mT)
                u, v = view.camera.project(place).nan_to_num().round().long().unbind(-1)
                visible &= torch.from_numpy(shown)[v.clamp(0, shown.shape[0] - 1), u.clamp(0, shown.shape[1] - 1)]
            seen += visible
    return seen


def write_kept(path: Path, parts: dict[str, Tensor]) -> None:
    """Write tensors by name, also over a damaged file, as the folder is the run's own; may raise OutputError."""
    with writing(force=True), whole_hdf5(path, "check the space left, then run again with --resume") as file:
        file.attrs["schema"] = SCHEMA
        for name, part in parts.items():
            file.create_dataset(name, data=part.numpy(), fletcher32=bool(part.numel() and part.ndim), track_times=False)


def read_kept(path: Path) -> dict[str, Tensor] | None:
    """Return the tensors of `write_kept`; None if the file is missing or damaged: the run restarts."""
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("schema") != SCHEMA:
                return None
            return {name: torch.as_tensor(file[name][()]) for name in file}
    except DAMAGE:
        return None
