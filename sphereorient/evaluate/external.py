"""Results of other programs, so that they can be scored on the same scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from sphereorient import so3
from sphereorient.errors import BenchError, refusal

Floats = NDArray[np.float64]

FICTRAC_FIRST, FICTRAC_TURN = 0, slice(8, 11)  # columns: frame counter, absolute rotation vector (camera axes)
ROUNDS, SETTLED = 200, 1e-12  # of the alignment
FICTRAC_COLUMNS = 23  # at least; newer versions have more


@dataclass(frozen=True, kw_only=True, eq=False)
class External:
    """Orientations that another program measured; read by `score_external`."""

    frame: NDArray[np.int64]  # (N,), of the movie, from 0
    R: Floats  # (N, 3, 3), body to camera axes (right, down, forward), up to constant rotations on both sides


def read_fictrac(path: Path) -> External:
    """Read a .dat file of FicTrac 2: the ball's orientation as the absolute rotation vector in camera axes.

    Its frame of reference is that of its first frame, and its sphere's axes are its own: score it with align "both".

    Args:
        path: the .dat file.

    Raises:
        BenchError: no such file, or not of this form.

    Source: FicTrac's doc/data_header.txt, columns 1 and 9 to 11; exp(vector) is the turn since its first frame.
    """
    do = "pass FicTrac's .dat file"
    try:
        rows = np.loadtxt(path, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        got = "no file" if isinstance(error, FileNotFoundError) else "something else"
        raise BenchError(refusal(str(path), expected="lines of numbers between commas", got=got, do=do)) from None
    if rows.shape[0] == 0 or rows.shape[1] < FICTRAC_COLUMNS:
        got = f"{rows.shape[0]} lines of {rows.shape[1]}"
        raise BenchError(refusal(str(path), expected=f"at least {FICTRAC_COLUMNS} columns", got=got, do=do))
    R = so3.exp(torch.from_numpy(np.ascontiguousarray(rows[:, FICTRAC_TURN]))).numpy()
    return External(frame=rows[:, FICTRAC_FIRST].astype(np.int64), R=R)


READERS: dict[str, Callable[[Path], External]] = {"fictrac": read_fictrac}


def aligned_errors_deg(R: Floats, R_true: Floats, align: str = "none") -> Floats:
    """Return the geodesic distances of orientations, (N,) degrees, after the best constant rotations.

    Args:
        R: (N, 3, 3), measured; NaN where there is none.
        R_true: (N, 3, 3).
        align: "none"; "body" finds B in R B, where the axes of the body are arbitrary; "both" A and B in A R B, where
            the frame of reference is, too.

    Returns:
        NaN where R is.

    Raises:
        BenchError: another word for align.
    """
    if align not in ("none", "body", "both"):
        raise BenchError(refusal("--align", expected="none, body or both", got=repr(align)[:40], do="choose one"))
    there = np.isfinite(R).all((1, 2))
    out = np.full(len(R), np.nan)
    if there.any():
        measured, true = torch.from_numpy(R[there]), torch.from_numpy(R_true[there])
        left, right = _alignment(measured, true, align)
        out[there] = np.rad2deg(so3.geodesic_distance(left @ measured @ right, true).numpy())
    return out


def _alignment(measured: torch.Tensor, true: torch.Tensor, align: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Return A and B of the least sum of squared chords, one after the other until nothing changes.

    B begins where the first frames agree: from anywhere else the two may settle far from the best.
    """
    left = right = torch.eye(3, dtype=measured.dtype)
    if align == "none":
        return left, right
    right = measured[0].mT @ true[0]
    for _ in range(ROUNDS if align == "both" else 1):
        if align == "both":
            left = so3.nearest_rotation((true @ (measured @ right).mT).sum(0))
        before, right = right, so3.nearest_rotation(((left @ measured).mT @ true).sum(0))
        if (right - before).abs().max() < SETTLED:
            break
    return left, right
