"""The sums of the fit from compiled code, disk_sums.c; where that was not built, on a GPU and in double: from torch."""

import ctypes
import math
import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from sphereorient.files.compiled import compiled
from sphereorient.pose.model import (
    COVER_MIN,
    DEPTH_MIN,
    UNSEEN,
    SphereModel,
    during_exposure,
    limb_shape,
    rim_shape,
)
from sphereorient.pose.pixels import Pixels
from sphereorient.pose.residuals import (
    KNOWN,
    NOISE_MIN,
    TUKEY,
    DiskSums,
    Told,
    torch_sums,
    without_light,
)

EDGES, EDGE_MOST = 1537, 6.0  # of a table over the distance of the limb in standard deviations of the blur
SOURCE = Path(__file__).with_name("disk_sums")


class _Table(ctypes.Structure):
    _fields_ = [("rows", ctypes.c_void_p), ("side", ctypes.c_int64)]


class _Task(ctypes.Structure):
    """The record `Task` of disk_sums.c, field by field."""

    _fields_ = [
        *((name, ctypes.c_int64) for name in ("disks", "places", "inner", "cameras", "tiles", "instants", "origins")),
        *((name, ctypes.c_void_p) for name in ("grey", "behind", "inside", "clipped", "direction", "origin", "axes")),
        *((name, ctypes.c_void_p) for name in ("pitch_rad", "pitch_mm", "moved", "rotation", "shares", "tile")),
        *((name, ctypes.c_float) for name in ("radius_mm", "blur_px")),
        *((name, _Table) for name in ("paint", "unseen")),
        *(
            (name, ctypes.c_float)
            for name in ("unseen_most", "known_least", "cover_least", "sine_most", "noise_least", "tukey2")
        ),
        ("edge", ctypes.c_void_p),
        ("edges", ctypes.c_int64),
        ("edge_most", ctypes.c_float),
        ("lab", ctypes.c_int64),
        ("light", ctypes.c_void_p),
        ("light_side", ctypes.c_int64),
        ("cover", ctypes.c_void_p),
        ("depths", ctypes.c_int64),
        *((name, ctypes.c_void_p) for name in ("gain", "noise", "stray")),
        *((name, ctypes.c_int64) for name in ("n_difference", "n_black", "first", "last")),
        *((name, ctypes.c_void_p) for name in ("expected", "weight", "normal", "gradient", "scores", "told")),
    ]


def library() -> ctypes.CDLL | None:
    """Return the compiled code for this processor; None where there is none."""
    return compiled(SOURCE, _Task)


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="disk-sums")


def disk_sums(
    pixels: Pixels,
    X: Tensor,
    R: Tensor,
    state: tuple[Tensor, Tensor] | None,
    model: SphereModel,
    cameras: int,
    tell: bool,
) -> DiskSums:
    """Sum the linear problem of B * C disks, as `torch_sums`, with compiled code where that can."""
    code = library()
    if code is None or pixels.grey.device.type != "cpu" or pixels.grey.dtype != torch.float32 or X.requires_grad:
        return torch_sums(pixels, X, R, state, model, cameras, tell)
    L, P = pixels.grey.shape
    light = model.light.tables
    n_difference, n_black = model.shading.counts
    size, tiles = 6 + n_difference + n_black, int(pixels.tile.max()) + 1 if P else 1
    poses, shares = during_exposure(pixels, X.repeat_interleave(cameras, 0), R.repeat_interleave(cameras, 0))
    X, R = (torch.stack(parts) for parts in zip(*poses, strict=True))
    expected, weight = torch.empty(2, L, P) if state is None else state
    normal, gradient = torch.empty(L, size, size, dtype=torch.float64), torch.empty(L, size, dtype=torch.float64)
    scores, told = torch.empty(L, tiles if tell else 0, size, dtype=torch.float64), torch.empty(L, 3).double()
    threads = max(1, min(L, torch.get_num_threads()))
    kept: list[Tensor] = []

    def at(part: Tensor | None) -> int | None:
        if part is None:
            return None
        kept.append(part.contiguous())
        return kept[-1].data_ptr()

    paint, unseen = model.paint, model.paint.unseen
    task = _Task(
        disks=L,
        places=P,
        inner=pixels.inner,
        cameras=cameras,
        tiles=tiles,
        instants=pixels.instants,
        origins=pixels.origin.shape[-1],
        grey=at(pixels.grey),
        behind=at(pixels.behind),
        inside=at(pixels.inside),
        clipped=at(pixels.clipped),
        direction=at(pixels.direction),
        origin=at(pixels.origin),
        axes=at(pixels.axes),
        pitch_rad=at(pixels.pitch_rad),
        pitch_mm=at(pixels.pitch_mm),
        moved=at(X.double()),
        rotation=at(R.double()),
        shares=at(torch.tensor(shares, dtype=torch.float32)),
        tile=at(pixels.tile),
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
        first=int(state is None),
        last=int(tell),
        expected=at(expected),
        weight=at(weight),
        normal=at(normal),
        gradient=at(gradient),
        scores=at(scores),
        told=at(told),
    )
    ends = [L * part // threads for part in range(threads + 1)]
    work = [
        lambda begin=begin, end=end: code.disk_sums(ctypes.byref(task), ctypes.c_int64(begin), ctypes.c_int64(end))
        for begin, end in pairwise(ends)
    ]
    others = [_threads().submit(part) for part in work[1:]]
    if any([work[0](), *(other.result() for other in others)]):
        raise MemoryError
    information, pull, mixed = without_light(normal, gradient)
    said = None
    if tell:
        share, loss, step = told.unbind(1)
        said = Told(scores=(scores[..., :6] - scores[..., 6:] @ mixed).mT, share=share, loss=loss, step=step)
    return DiskSums(state=(expected, weight), information=information, pull=pull, told=said)


@cache
def _edge_table() -> Tensor:
    """Return how the limb cuts an aperture at `EDGES` distances from -EDGE_MOST to EDGE_MOST, (n, 12) float32."""
    edge = torch.linspace(-EDGE_MOST, EDGE_MOST, EDGES, dtype=torch.float64)
    coverage, density, pull, variance = limb_shape(edge)
    z, moves = rim_shape(coverage[None], density[None])
    return torch.cat([torch.stack([coverage, density, pull, variance]), z, moves]).T.float().contiguous()
