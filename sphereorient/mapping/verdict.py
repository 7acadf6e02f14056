"""Whether a learnt map is to be believed: pictures held out of it, rates that jump."""

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from sphereorient import so3
from sphereorient.mapping.compare import weighted_correlation
from sphereorient.mapping.disks import Crops, disks_of, normalised_disks
from sphereorient.mapping.grid import look_up
from sphereorient.mapping.iterations import State, fitted, map_weight, with_map
from sphereorient.mapping.settings import MapSettings
from sphereorient.sphere.view import perspective_view

HELD_EVERY = 5  # instants; the map of the others is compared with this one
SEEN_MIN = 0.99  # share of a pixel on texels that other pictures show, below which it is not compared
ITERATIONS = 2  # of the held poses with that map
JUMP_RAD, JUMPS = math.radians(3.0), 10.0  # rotations so far off their neighbours', and so many times the usual
WINDOW = 5  # rotations whose median is usual


def paint_correlation(crops: Crops, state: State, settings: MapSettings) -> Tensor:
    """Return correlations (n, C) of pictures with a map to which they were not fitted; NaN where not compared.
    Both are normalised as for pairs of pictures, so that shading counts for nothing.
    """
    rows = torch.arange(HELD_EVERY // 2, len(state.use), HELD_EVERY)
    found = torch.full(state.use.shape, torch.nan, dtype=torch.float64)
    if not len(rows):
        return found
    others, _ = with_map(replace(state, use=state.use.index_fill(0, rows, False)))
    known = (map_weight(others) > 0).float()
    one, _ = fitted(replace(others, use=state.use).where(rows), ITERATIONS, crops)
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
    """Return the frames (J,) from which a ball with orientations (N, 3, 3) turns unlike before and after; NaN: unknown.
    A rotation is compared with the median of its neighbours': a lasting change of the rate is none.
    """
    turn = so3.log((R_lab_body[1:] @ R_lab_body[:-1].mT).nan_to_num())
    turn = torch.where(R_lab_body.isfinite().flatten(1).all(1).unfold(0, 2, 1).all(1)[:, None], turn, torch.nan)
    near = F.pad(turn.T[None], (WINDOW // 2, WINDOW // 2), value=torch.nan)[0].unfold(1, WINDOW, 1)
    off = (turn - near.nanmedian(2).values.T).norm(dim=1)
    usual = off[off.isfinite()].median() if off.isfinite().any() else off.new_zeros(())
    return torch.nonzero(off > (JUMPS * usual).clamp_min(JUMP_RAD))[:, 0]
