"""Fits of poses and residuals by compiled code (refine.c) where it was built, on the CPU in float; otherwise by torch
(fit.py, residuals.py), which defines them and has gradients.
"""

import ctypes
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.cameras import in_air, sphere_disk_px
from sphereorient.cameras.fisheye import FisheyeCamera
from sphereorient.files.compiled import compiled, record
from sphereorient.files.threads import cores
from sphereorient.pose import fit as in_torch
from sphereorient.pose import residuals as residuals_in_torch
from sphereorient.pose.camera_view import CameraView, FrameDisks
from sphereorient.pose.model import IN_SIGHT, UNSEEN, SphereModel, SphereView
from sphereorient.pose.pixels import Pixels, Stencil, thinned_places, thinned_stencil
from sphereorient.pose.poses import POSE_PARTS, FittedPoses, PoseStart, pose_arrays
from sphereorient.pose.residuals import EDGE_PX, KNOWN, NOISE_MIN, OUTLIERS, TUKEY, Residuals
from sphereorient.pose.view import COVER_MIN, DEPTH_MIN, exposure_instants, limb_shape, rim_shape

EDGES, EDGE_MOST = 1537, 6.0  # of a table over the distance of the limb in standard deviations of the blur
EDGE_FAR = 4.0  # farther inside, coverage is 1; farther outside it is 0, and no paint is looked up
READABLE = {np.dtype(name) for name in ("uint8", "uint16", "float32")}  # pixels, in this machine's order of bytes
SOURCE = Path(__file__).with_name("refine")
_Table, _Task, _Stencil, _Scene, _Shot, Near = (
    record(SOURCE, name) for name in ("Table", "Task", "Stencil", "Scene", "Shot", "Near")
)
_RESULTS = [field[0] for field in _Task._fields_[-len(POSE_PARTS) :]]
# What `linearise` returns for each place, in this order, with the number of values.
COLUMNS = {"paint": 1, "coverage": 1, "across": 2, "aside": 1, "outward": 3, "paint_by_rotation": 3}
COLUMNS |= {"paint_by_position": 3, "coverage_by_position": 3, "count": 1, "difference": 1, "black": 1, "beside": 1}
COLUMNS |= {"residual": 1, "variance": 1, "lit": 1, "model": 1, "weight": 1}
OF_VIEW, OF_FIT = tuple(COLUMNS)[:8], ("residual", "model", "variance", "weight")


def refine_library() -> ctypes.CDLL | None:
    """Return the compiled code for this processor; None if there is none."""
    return compiled(SOURCE, Near)


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="refine")


def refine_compiled(
    pixels: Pixels, begin: PoseStart, model: SphereModel, iterations: int = 4, most_hidden: float = 0.0
) -> FittedPoses:
    """Fit poses as `fit.refine`, to less than 0.001 degrees."""
    return _refined(pixels, begin, model, iterations, most_hidden)[0]


def kept_compiled(pixels: Pixels, begin: PoseStart, model: SphereModel, most: float) -> Tensor:
    """Return the places that are used, as `fit.kept`."""
    return _refined(pixels, begin, model, 0, most)[1]


def _refined(
    pixels: Pixels, begin: PoseStart, model: SphereModel, iterations: int, most_hidden: float
) -> tuple[FittedPoses, Tensor]:
    """Fit poses, undefined without iterations; return also the places that are used."""
    kept = torch.empty_like(pixels.inside)
    task, _alive = _task_on(pixels, begin, model)
    task.iterations, task.most_hidden, task.kept = iterations, most_hidden, kept.data_ptr()
    fit = _into(task, begin.use)
    _run("refine", task, len(begin.use))
    return fit, kept


def residuals_compiled(
    pixels: Pixels, X: Tensor, R: Tensor, state: tuple[Tensor, Tensor] | None, model: SphereModel
) -> Residuals:
    """Linearise pictures as `residuals.residuals`, by compiled code where possible; it has no gradients."""
    cameras = len(model.light.noise)
    begin = PoseStart(X, R, torch.ones(len(X), cameras, dtype=torch.bool))
    if body_of(X) is IN_TORCH or pixels.grey.dtype != torch.float32:
        return residuals_in_torch.residuals(pixels, X, R, state, model)
    (L, P), counts = pixels.grey.shape, torch.empty_like(pixels.inside)
    task, at = _task_on(pixels, begin, model)
    columns = torch.empty(L, sum(COLUMNS.values()), P)
    coefficients = torch.empty(L, sum(model.shading.counts), dtype=torch.float64)
    deviation = torch.empty(L, dtype=torch.float64)
    task.kept, task.columns = counts.data_ptr(), columns.data_ptr()
    task.coefficients, task.deviation = coefficients.data_ptr(), deviation.data_ptr()
    if state is not None:
        task.expected, task.weight = at(state[0], torch.float32), at(state[1], torch.float32)
    _run("linearise", task, len(X))
    each = torch.split(columns, list(COLUMNS.values()), 1)
    parts = {name: part.squeeze(1) for name, part in zip(COLUMNS, each, strict=True)}
    distance = (X.repeat_interleave(cameras, 0) - pixels.origin[..., 0].double()).norm(dim=-1)
    blur = model.blur_px * (pixels.pitch_mm + pixels.pitch_rad * distance).float() / model.radius_mm
    hidden = pixels.inside & ~counts
    known = ~hidden if model.paint.unseen is not None or bool(hidden.any()) else None
    view = SphereView(**{name: parts[name] for name in OF_VIEW}, known=known, blur=blur[:, None])
    light = parts["difference"], parts["black"], parts["beside"]
    others = {name: parts[name] for name in OF_FIT} | {"deviation": deviation.float(), "inside": counts}
    own = residuals_in_torch.own_columns(view, *light[:2], model.shading), coefficients.float()
    return residuals_in_torch.with_design(view, light, own, model.shading, **others)


def fitted_residuals(pixels: Pixels, fit: FittedPoses, model: SphereModel) -> Residuals:
    """Linearise the pictures of B * C disks about fitted poses, with weights from the fitted pose."""
    at = residuals_compiled(pixels, fit.position_lab_mm, fit.R_lab_body, None, model)
    return residuals_compiled(pixels, fit.position_lab_mm, fit.R_lab_body, (at.model, at.weight), model)


def _task_on(pixels: Pixels, begin: PoseStart, model: SphereModel) -> tuple[ctypes.Structure, "_Addresses"]:
    """Return a record of disks' pixels, model and start."""
    L, P = pixels.grey.shape
    task, at = _task_of(begin, model, pixels.instants)
    task.disks, task.places, task.inner = L, P, pixels.inner
    task.tiles, task.origins = int(pixels.tile.max()) + 1 if P else 1, pixels.origin.shape[-1]
    for name in ("grey", "behind", "inside", "clipped", "direction", "origin", "axes", "pitch_rad", "pitch_mm"):
        setattr(task, name, at(getattr(pixels, name)))
    task.tile, task.place = at(pixels.tile), at(pixels.place)
    task.moved = at(pixels.moved, torch.float64) if pixels.instants > 1 else None
    return task, at


def _task_of(begin: PoseStart, model: SphereModel, instants: int) -> tuple[ctypes.Structure, "_Addresses"]:
    """Return a record of model, exposure and start of fits, and what it points to."""
    of_model, known = _of_model(model)
    at, (instant, share) = _Addresses(known), _quadrature(instants)
    task = _Task.from_buffer_copy(of_model)
    task.cameras, task.instants, task.instant, task.shares = begin.use.shape[1], instants, at(instant), at(share)
    task.start, task.start_rotation = at(begin.position_lab_mm, torch.float64), at(begin.R_lab_body, torch.float64)
    task.use, task.place_precision = at(begin.use), at(begin.place_precision, torch.float64)
    return task, at


def _into(task: ctypes.Structure, use: Tensor) -> FittedPoses:
    """Return the poses that a task writes: its last fields, in the order of `FittedPoses`."""
    parts = pose_arrays(use.shape[1], len(use))
    for name, part in zip(_RESULTS, parts.values(), strict=True):
        setattr(task, name, part.data_ptr())
    return FittedPoses(**parts)


def _run(name: str, task: ctypes.Structure, poses: int) -> None:
    """Run a function of compiled code on B poses, on all cores."""
    code = refine_library()
    assert code is not None  # as `body_of` asked
    work = getattr(code, name)
    threads = max(1, min(poses, cores()))
    ends = [poses * part // threads for part in range(threads + 1)]
    parts = [
        lambda begin=begin, end=end: work(ctypes.byref(task), ctypes.c_int64(begin), ctypes.c_int64(end))
        for begin, end in pairwise(ends)
    ]
    others = [_threads().submit(part) for part in parts[1:]]
    if any([parts[0](), *(other.result() for other in others)]):
        raise MemoryError


def disks_compiled(views: Sequence[CameraView], position_lab_mm: Tensor, radius_mm: float) -> tuple[Tensor, Tensor]:
    """Return middles (C, B, 2) and radii (C, B), px, of disks, as `fit.disks` to 0.02 px, from lines of sight."""
    code, at = refine_library(), _Addresses()
    assert code is not None  # as `body_of` asked
    found = torch.empty(len(views), len(position_lab_mm), 3, dtype=torch.float64)
    X, count = ctypes.c_void_p(at(position_lab_mm, torch.float64)), ctypes.c_int64(len(position_lab_mm))
    for view, to in zip(views, found, strict=True):
        if isinstance(in_air(view.camera), FisheyeCamera):  # this code measures along the camera's x
            to[:, :2], to[:, 2] = sphere_disk_px(view.camera, position_lab_mm, radius_mm)
            continue
        scene, _alive = _of_view(view)
        code.disks(ctypes.byref(scene), X, ctypes.c_double(radius_mm), ctypes.c_void_p(to.data_ptr()), count)
    return found[..., :2], found[..., 2]


def settle_compiled(
    disks: FrameDisks, begin: PoseStart, model: SphereModel, instants: int, most_hidden: float, first: bool
) -> tuple[FittedPoses, Tensor]:
    """Fit poses to whole frames, as `fit.settle`."""
    poses, cameras = begin.use.shape
    far, shot = torch.full((poses,), not first), (_Shot * (poses * cameras))()
    near, at, _alive = _near(disks.views, begin, model, disks.stencil, instants, most_hidden)
    near.held, near.far = begin.held, far.data_ptr()
    frames = [[part if part.dtype in READABLE else part.astype(np.float32) for part in row] for row in disks.frames]
    for c, middles in enumerate(disks.middle_px.nan_to_num().tolist()):
        for b, (u, v) in enumerate(middles):
            frame = frames[b][c]
            shot[b * cameras + c] = _Shot(frame.ctypes.data, *frame.strides, frame.itemsize, round(u), round(v))
    near.shot = ctypes.addressof(shot)
    axes = [view.sight.axes_at(middles) for view, middles in zip(disks.views, disks.middle_px, strict=True)]
    near.axes = at(torch.stack(axes, 1))
    near.moved = at(begin.moved, torch.float64) if instants > 1 else None
    if disks.hidden is not None:
        near.some_hidden = at(disks.hidden[:, thinned_places(disks.hidden.shape[1], in_torch.FIRST_EVERY)])
        near.all_hidden = at(disks.hidden)
    fit = _into(near.task, begin.use)
    _run("settle", near, poses)
    return fit, far


def settle_alone(
    views: Sequence[CameraView],
    frames: Sequence[NDArray[Any]],
    begin: PoseStart,
    model: SphereModel,
    stencil: Stencil,
    instants: int,
    most_hidden: float,
    radius_mm: float,
) -> FittedPoses:
    """Fit one pose to the frames of C cameras in one call, as `Fitter.settled`."""
    code, cameras = refine_library(), len(views)
    assert code is not None  # as `body_of` asked
    near, _alive = _alone(tuple(views), model, stencil, instants, most_hidden, radius_mm)
    near = Near.from_buffer_copy(near)
    known = begin.place_precision, begin.moved if instants > 1 else None
    position, rotation = begin.position_lab_mm.double().clone(), begin.R_lab_body.double().clone()
    precision, moved = (None if part is None else part.double().contiguous() for part in known)
    task, use, far = near.task, begin.use.contiguous(), ctypes.c_uint8()
    task.start, task.start_rotation, task.use = position.data_ptr(), rotation.data_ptr(), use.data_ptr()
    task.place_precision = None if precision is None else precision.data_ptr()
    near.moved = None if moved is None else moved.data_ptr()
    near.held, near.far = begin.held, ctypes.addressof(far)
    shown = [part if part.dtype in READABLE else part.astype(np.float32) for part in frames]
    shot = (_Shot * cameras)(*(_Shot(part.ctypes.data, *part.strides, part.itemsize, 0, 0) for part in shown))
    near.shot = ctypes.addressof(shot)
    fit = _into(task, begin.use)
    X, R = ctypes.c_void_p(task.start), ctypes.c_void_p(task.start_rotation)
    if code.settle_alone(ctypes.byref(near), X, R, shot):
        raise MemoryError
    return fit


@lru_cache(maxsize=16)
def _alone(
    views: tuple[CameraView, ...],
    model: SphereModel,
    stencil: Stencil,
    instants: int,
    most_hidden: float,
    radius_mm: float,
) -> tuple[ctypes.Structure, tuple[object, ...]]:
    """Return the record of `settle_alone` without pose and frames, and what it points to."""
    nowhere = PoseStart(torch.zeros(1, 3), torch.zeros(1, 3, 3), torch.zeros(1, len(views), dtype=torch.bool))
    near, at, alive = _near(views, nowhere, model, stencil, instants, most_hidden)
    near.radius_mm, near.hopeless, near.again = radius_mm, in_torch.HOPELESS, in_torch.AGAIN
    near.axes = at(torch.stack([view.sight.axes for view in views])[None])
    return near, (at, alive)


def _near(
    views: Sequence[CameraView], begin: PoseStart, model: SphereModel, stencil: Stencil, instants: int, hidden: float
) -> tuple[Any, "_Addresses", object]:
    """Return the record of fits without frames, the addresses to extend, and what else it points to."""
    task, at = _task_of(begin, model, instants)
    some, more = in_torch.further_steps(model)
    near = Near(task=task, some_more=some, all_more=more, near_rad=model.near_rad, most_hidden=hidden)
    stencils = thinned_stencil(stencil, in_torch.FIRST_EVERY), stencil
    near.some, near.all = (_of_stencil(one) for one in stencils)
    known = [_of_view(view) for view in views]
    scene = (_Scene * len(views))(*(one[0] for one in known))
    near.scene = ctypes.addressof(scene)
    return near, at, (known, scene, stencils)


class _Addresses:
    """Addresses of tensors for C; the tensors live as long as this object."""

    def __init__(self, *others: "_Addresses") -> None:
        # Hold the others too: another thread may remove them from the cache.
        self._others = others
        self._alive: list[Tensor] = []

    def __call__(self, part: Tensor | None, dtype: torch.dtype | None = None) -> int | None:
        """Return the address of a contiguous tensor; None for None."""
        if part is None:
            return None
        part = part if dtype is None or part.dtype == dtype else part.to(dtype)
        self._alive.append(part if part.is_contiguous() else part.contiguous())
        return self._alive[-1].data_ptr()


@lru_cache(maxsize=16)
def _of_view(view: CameraView) -> tuple[ctypes.Structure, _Addresses]:
    """Return the record of a camera, and what it points to."""
    at, sight, background = _Addresses(), view.sight, view.behind
    (width, height), shown = sight.size, background.shown
    pointers = {name: at(getattr(sight, name)) for name in ("direction", "origin", "axes", "pitch_rad", "pitch_mm")}
    pointers["behind"] = at(torch.from_numpy(np.ascontiguousarray(background.mean)))
    pointers["shown"] = None if shown is None else at(torch.from_numpy(np.ascontiguousarray(shown)))
    origins = 1 if sight.one_origin else width * height
    return _Scene(width=width, height=height, origins=origins, full_scale=background.full_scale, **pointers), at


@lru_cache(maxsize=64)
def _of_stencil(stencil: Stencil) -> ctypes.Structure:
    tiles = int(stencil.tile.max()) + 1
    place, tile = stencil.place.data_ptr(), stencil.tile.data_ptr()
    return _Stencil(places=len(stencil.tile), inner=stencil.inner, tiles=tiles, place=place, tile=tile)


@lru_cache(maxsize=16)
def _of_model(model: SphereModel) -> tuple[ctypes.Structure, _Addresses]:
    """Return a record of all that depends on the model alone, and what it points to."""
    at, lit, light, paint, unseen = _Addresses(), model.light, model.light.tables, model.paint, model.paint.unseen
    pointers = {"edge": _edge_table(), "light": light.cells, "cover": light.cover, "gain": light.gain}
    pointers |= {"noise": lit.noise, "stray": lit.stray, "limb_px": model.limb_px}
    pointers |= {"lean": lit.lean if bool(lit.lean.any()) else None, "dark": lit.dark}
    numbers = {"unseen_most": UNSEEN, "known_least": KNOWN, "cover_least": COVER_MIN, "noise_least": NOISE_MIN}
    numbers |= {"tukey2": TUKEY**2, "outliers": OUTLIERS, "edges": EDGES, "edge_most": EDGE_MOST}
    numbers |= {"edge_far": EDGE_FAR, "edge_px": EDGE_PX, "in_sight": IN_SIGHT}
    numbers |= {
        "covered": in_torch.COVERED,
        "most_each": in_torch.MOST_EACH,
        "least_of_window": in_torch.LEAST_OF_WINDOW,
        "margin": in_torch.MARGIN_PX,
    }
    n_difference, n_black = model.shading.counts
    task = _Task(
        radius_mm=model.radius_mm,
        blur_px=model.blur_px,
        paint=_Table(at(paint.rows), paint.side),
        unseen=_Table() if unseen is None else _Table(at(unseen.rows), unseen.side),
        sine_most=math.sqrt(1.0 - DEPTH_MIN**2),
        light_kind=light.kind,
        light_side=light.side,
        depths=0 if light.cover is None else len(light.cover),
        n_difference=n_difference,
        n_black=n_black,
        window=in_torch.WINDOW_PX // 2,
        **numbers,
        **{name: at(part, torch.float32) for name, part in pointers.items()},
    )
    return task, at


@cache
def _quadrature(instants: int) -> tuple[Tensor, Tensor]:
    """Return the instants of an exposure, float64, and their shares, float32."""
    at, shares = exposure_instants(instants)
    return torch.tensor(at, dtype=torch.float64), torch.tensor(shares, dtype=torch.float32)


@cache
def _edge_table() -> Tensor:
    """Return the limb's cut of an aperture at `EDGES` distances from -EDGE_MOST to EDGE_MOST, (n, 16) float32."""
    edge = torch.linspace(-EDGE_MOST, EDGE_MOST, EDGES, dtype=torch.float64)
    coverage, density, pull, variance = limb_shape(edge)
    z, moves = rim_shape(coverage[None], density[None])
    return torch.cat([torch.stack([coverage, density, pull, variance]), z, moves]).T.float().contiguous()


class Body(NamedTuple):
    """The functions of a fit, as in `fit`."""

    disks: Callable[[Sequence[CameraView], Tensor, float], tuple[Tensor, Tensor]]
    refine: Callable[[Pixels, PoseStart, SphereModel, int, float], FittedPoses]
    kept: Callable[[Pixels, PoseStart, SphereModel, float], Tensor]
    settle: Callable[[FrameDisks, PoseStart, SphereModel, int, float, bool], tuple[FittedPoses, Tensor]]


IN_TORCH = Body(in_torch.disks, in_torch.refine, in_torch.kept, in_torch.settle)
COMPILED = Body(disks_compiled, refine_compiled, kept_compiled, settle_compiled)


def body_of(position_lab_mm: Tensor) -> Body:
    """Return the functions for spheres at these positions."""
    X = position_lab_mm
    able = refine_library() is not None and X.device.type == "cpu" and not X.requires_grad
    return COMPILED if able else IN_TORCH
