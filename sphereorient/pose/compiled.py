"""The fit of poses by compiled code, refine.c; none where that was not built, on a GPU and in double."""

import ctypes
import math
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sphereorient.files.compiled import compiled, record
from sphereorient.files.threads import cores
from sphereorient.locate import Background
from sphereorient.pose.model import COVER_MIN, DEPTH_MIN, UNSEEN, SphereModel, exposure_instants, limb_shape, rim_shape
from sphereorient.pose.occluders import COVERED, LEAST_OF_WINDOW, MARGIN_PX, MOST_EACH, WINDOW_PX
from sphereorient.pose.pixels import LinesOfSight, Pixels, Stencil
from sphereorient.pose.residuals import EDGE_PX, KNOWN, NOISE_MIN, OUTLIERS, TUKEY
from sphereorient.pose.start import NearStart

EDGES, EDGE_MOST = 1537, 6.0  # of a table over the distance of the limb in standard deviations of the blur
RESULTS = {
    "position_lab_mm": (3,),
    "R_lab_body": (3, 3),
    "covariance": (6, 6),
    "own_turn": (-1, 3),  # -1: of each camera
    "own_covariance": (-1, 3, 3),
    "own_move": (-1, 3),
    "own_sigma_mm": (-1,),
    "excess": (-1,),
    "score": (-1,),
    "nll": (),
    "step": (6,),
}  # parts of `FittedPoses`, in the order of the record
READABLE = {np.dtype(name) for name in ("uint8", "uint16", "float32")}  # pixels, in this machine's order of bytes
SOURCE = Path(__file__).with_name("refine")
_Table, _Task, _Stencil, _Scene, _Shot, _Near = (
    record(SOURCE, name) for name in ("Table", "Task", "Stencil", "Scene", "Shot", "Near")
)


def pose_arrays(cameras: int, *shape: int) -> dict[str, Tensor]:
    """Return the arrays of `FittedPoses` of a leading shape, zeros."""
    return {
        name: torch.zeros(*shape, *(cameras if n < 0 else n for n in tail), dtype=torch.float64)
        for name, tail in RESULTS.items()
    }


def library() -> ctypes.CDLL | None:
    """Return the compiled code for this processor; None where there is none."""
    return compiled(SOURCE, _Near)


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="refine")


def refined(
    pixels: Pixels,
    X: Tensor,
    R: Tensor,
    model: SphereModel,
    use: Tensor,
    place_precision: Tensor | None = None,
    iterations: int = 0,
    most_hidden: float = 0.0,
) -> tuple[Tensor, dict[str, Tensor]] | None:
    """Fit B poses, X (B, 3), mm, and R_lab_body R (B, 3, 3), to B * C disks, those of `use` (B, C) bool.
    Return which places are inside and not hidden by an occluder, (B * C, P) bool, and the parts of `FittedPoses`,
    without meaning where there are no iterations; None where compiled code cannot do it. `place_precision` as in
    `PoseStart`, `most_hidden` as in `occluded`.
    """
    code = library()
    if code is None or pixels.grey.device.type != "cpu" or pixels.grey.dtype != torch.float32 or X.requires_grad:
        return None
    L, P = pixels.grey.shape
    poses, cameras = use.shape
    kept = torch.empty(L, P, dtype=torch.bool)
    parts = pose_arrays(cameras, poses)
    instant, share = _quadrature(pixels.instants)
    of_model, known = _of_model(model)
    at = _Addresses(known)
    task = _Task.from_buffer_copy(of_model)
    task.disks, task.places, task.inner, task.cameras = L, P, pixels.inner, cameras
    task.tiles = int(pixels.tile.max()) + 1 if P else 1
    task.instants, task.origins = pixels.instants, pixels.origin.shape[-1]
    for name in ("grey", "behind", "inside", "clipped", "direction", "origin", "axes", "pitch_rad", "pitch_mm"):
        setattr(task, name, at(getattr(pixels, name)))
    task.tile, task.place = at(pixels.tile), at(pixels.place)
    task.moved = at(pixels.moved, torch.float64) if pixels.instants > 1 else None
    task.instant, task.shares = at(instant), at(share)
    task.start, task.start_rotation = at(X, torch.float64), at(R, torch.float64)
    task.use, task.place_precision = at(use), at(place_precision, torch.float64)
    task.iterations, task.most_hidden = iterations, most_hidden
    task.kept = kept.data_ptr()
    _into(task, parts)
    _run(code.refine, task, poses)
    return kept, parts


def _into(task: ctypes.Structure, parts: Mapping[str, Tensor]) -> None:
    """Let the results of a task go into the parts of `FittedPoses`: the last fields, in the order of `RESULTS`."""
    for field, part in zip(_Task._fields_[-len(RESULTS) :], parts.values(), strict=True):
        setattr(task, field[0], part.data_ptr())


def _run(work: Callable[..., int], task: ctypes.Structure, poses: int) -> None:
    """Let compiled code do the work of B poses, on all cores."""
    threads = max(1, min(poses, cores()))
    ends = [poses * part // threads for part in range(threads + 1)]
    parts = [
        lambda begin=begin, end=end: work(ctypes.byref(task), ctypes.c_int64(begin), ctypes.c_int64(end))
        for begin, end in pairwise(ends)
    ]
    others = [_threads().submit(part) for part in parts[1:]]
    if any([parts[0](), *(other.result() for other in others)]):
        raise MemoryError


def settled(
    frames: Sequence[Sequence[NDArray[np.generic]]],
    scenes: Sequence[tuple[LinesOfSight, Background]],
    middle_px: Tensor,
    stencils: tuple[Stencil, Stencil],
    hidden: tuple[Tensor, Tensor] | None,
    begin: NearStart,
    model: SphereModel,
    *,
    instants: int,
    more: tuple[int, int],
    near_rad: float,
    most_hidden: float,
    first: bool,
) -> tuple[dict[str, Tensor], Tensor] | None:
    """Fit B poses to the frames of C cameras as `settled` of settle.py does: with the first of two stencils, where that
    is `first`, then with the second. Disks lie about `middle_px` (C, B, 2); `hidden`: places (B * C, P) bool of each
    stencil that do not count, None: all count. Return the parts of `FittedPoses`, and which poses the first stencil
    moved, (B,) bool: nothing else was done there. None where compiled code cannot do it.
    """
    code = library()
    kinds = {frame.dtype for row in frames for frame in row}
    if code is None or not kinds <= READABLE:
        return None
    poses, cameras = begin.use.shape
    parts = pose_arrays(cameras, poses)
    far = torch.full((poses,), not first)
    of_model, of = _of_model(model)
    at = _Addresses(of)
    near = _Near(task=of_model, some_more=more[0], all_more=more[1], near_rad=near_rad)
    near.most_hidden, near.held, near.far = most_hidden, begin.held, far.data_ptr()
    near.some, near.all = (_of_stencil(one) for one in stencils)
    known = [_of_scene(*one) for one in scenes]
    scene, shot = (_Scene * cameras)(*(one[0] for one in known)), (_Shot * (poses * cameras))()
    for c, middles in enumerate(middle_px.nan_to_num().tolist()):
        for b, (u, v) in enumerate(middles):
            frame = frames[b][c]
            shot[b * cameras + c] = _Shot(frame.ctypes.data, *frame.strides, frame.itemsize, round(u), round(v))
    near.scene, near.shot = ctypes.addressof(scene), ctypes.addressof(shot)
    near.moved = at(begin.moved, torch.float64) if instants > 1 else None
    near.some_hidden, near.all_hidden = (at(one) for one in hidden or (None, None))
    instant, share = _quadrature(instants)
    task = near.task
    task.cameras, task.instants, task.instant, task.shares = cameras, instants, at(instant), at(share)
    task.start, task.start_rotation = at(begin.position_lab_mm, torch.float64), at(begin.R_lab_body, torch.float64)
    task.use, task.place_precision = at(begin.use), at(begin.place_precision, torch.float64)
    _into(task, parts)
    _run(code.settle, near, poses)
    return parts, far


@lru_cache(maxsize=16)
def _of_scene(sight: LinesOfSight, background: Background) -> tuple[ctypes.Structure, list[Tensor]]:
    """Return the record of a camera, and what it points to."""
    alive = [torch.from_numpy(np.ascontiguousarray(background.mean)), sight.direction]
    alive += [sight.origin.contiguous(), sight.axes.contiguous(), sight.pitch_rad, sight.pitch_mm]
    behind, direction, origin, axes, pitch_rad, pitch_mm = (part.data_ptr() for part in alive)
    if background.shown is not None:
        alive.append(torch.from_numpy(np.ascontiguousarray(background.shown)))
    width, height = sight.size
    scene = _Scene(
        width=width,
        height=height,
        origins=1 if sight.one_origin else width * height,
        behind=behind,
        shown=None if background.shown is None else alive[-1].data_ptr(),
        direction=direction,
        origin=origin,
        axes=axes,
        pitch_rad=pitch_rad,
        pitch_mm=pitch_mm,
        full_scale=background.full_scale,
    )
    return scene, alive


@lru_cache(maxsize=64)
def _of_stencil(stencil: Stencil) -> ctypes.Structure:
    tiles = int(stencil.tile.max()) + 1
    place, tile = stencil.place.data_ptr(), stencil.tile.data_ptr()
    return _Stencil(places=len(stencil.tile), inner=stencil.inner, tiles=tiles, place=place, tile=tile)


class _Addresses:
    """Addresses of tensors as C reads them; each lives as long as this."""

    def __init__(self, *others: "_Addresses") -> None:
        # The others too: another thread may push them out of the cache that holds them.
        self._others = others
        self._alive: list[Tensor] = []

    def __call__(self, part: Tensor | None, dtype: torch.dtype | None = None) -> int | None:
        """Return where the numbers of a tensor lie, in their order; None of None."""
        if part is None:
            return None
        part = part if dtype is None or part.dtype == dtype else part.to(dtype)
        self._alive.append(part if part.is_contiguous() else part.contiguous())
        return self._alive[-1].data_ptr()


@lru_cache(maxsize=16)
def _of_model(model: SphereModel) -> tuple[ctypes.Structure, _Addresses]:
    """Return a record with all that depends on the model alone, and what it points to."""
    at = _Addresses()
    light, paint, unseen = model.light.tables, model.paint, model.paint.unseen
    n_difference, n_black = model.shading.counts
    task = _Task(
        radius_mm=model.radius_mm,
        blur_px=model.blur_px,
        paint=_Table(at(paint.rows), paint.side),
        unseen=_Table(None if unseen is None else at(unseen.rows), 0 if unseen is None else unseen.side),
        unseen_most=UNSEEN,
        known_least=KNOWN,
        cover_least=COVER_MIN,
        sine_most=math.sqrt(1.0 - DEPTH_MIN**2),
        noise_least=NOISE_MIN,
        tukey2=TUKEY**2,
        outliers=OUTLIERS,
        edge=at(_edge_table()),
        edges=EDGES,
        edge_most=EDGE_MOST,
        lab=int(light.cover is not None),
        light=at(light.cells),
        light_side=light.side,
        cover=at(light.cover),
        depths=0 if light.cover is None else len(light.cover),
        gain=at(light.gain),
        noise=at(model.light.noise),
        stray=at(model.light.stray),
        n_difference=n_difference,
        n_black=n_black,
        limb_px=at(model.limb_px, torch.float32),
        edge_px=EDGE_PX,
        covered=COVERED,
        most_each=MOST_EACH,
        least_of_window=LEAST_OF_WINDOW,
        window=WINDOW_PX // 2,
        margin=MARGIN_PX,
    )
    return task, at


@cache
def _quadrature(instants: int) -> tuple[Tensor, Tensor]:
    """Return the instants of an exposure, float64, and their shares, float32."""
    at, shares = exposure_instants(instants)
    return torch.tensor(at, dtype=torch.float64), torch.tensor(shares, dtype=torch.float32)


@cache
def _edge_table() -> Tensor:
    """Return how the limb cuts an aperture at `EDGES` distances from -EDGE_MOST to EDGE_MOST, (n, 12) float32."""
    edge = torch.linspace(-EDGE_MOST, EDGE_MOST, EDGES, dtype=torch.float64)
    coverage, density, pull, variance = limb_shape(edge)
    z, moves = rim_shape(coverage[None], density[None])
    return torch.cat([torch.stack([coverage, density, pull, variance]), z, moves]).T.float().contiguous()
