import math
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import REPO
from overlay_examples import true_track

from sphereorient import so3
from sphereorient.live.feed import Arrival
from sphereorient.live.live import Measured, measured
from sphereorient.live.loop import LiveSetup, open_live
from sphereorient.methods.method import Learnt, save_learnt
from sphereorient.methods.settings import Settings
from sphereorient.pose.poses import no_pose
from sphereorient.trajectory import Reason, Trajectory

EXCERPT = REPO / "synthetic_data" / "excerpt"
LIMIT_S = 20.0
_KNOWN: list[Path] = []


def known(places: pytest.TempPathFactory) -> Path:
    """The appearance that `live` learns of the excerpt, learnt once for all files of tests."""
    if not _KNOWN:
        path = places.mktemp("known") / "learnt.h5"
        with open_live(EXCERPT / "experiment.yaml", Settings(), None, None) as opened:
            save_learnt({"": Learnt.of(opened.tracker.appearances[""])}, path)
        _KNOWN.append(path)
    return _KNOWN[0]


@contextmanager
def excerpt_opened(places: pytest.TempPathFactory) -> Iterator[LiveSetup]:
    with open_live(EXCERPT / "experiment.yaml", Settings(), None, known(places)) as opened:
        yield opened


def off_deg(now: Measured, k: int) -> float:
    """The error of an orientation against that of the excerpt's frame k."""
    R, truth = torch.from_numpy(now.R_lab_body), torch.from_numpy(true_track().orientation[k])
    return math.degrees(float(so3.geodesic_distance(R, truth)))


def followed(opened: LiveSetup, frames: Iterable[Arrival]) -> list[Measured]:
    return list(measured(opened.tracker, opened.tracker.appearances[""].fitter.views, frames))


def arrivals(count: int) -> Iterator[Arrival]:
    for number in range(count):
        picture = np.full((2, 3), number, np.uint8)
        yield Arrival(number=number, time_s=0.1 * number, pictures=[picture], arrived_s=time.perf_counter())


def until(true: object, limit_s: float = LIMIT_S) -> None:
    end = time.monotonic() + limit_s
    while not true():
        assert time.monotonic() < end
        time.sleep(0.01)


def rows(track: Trajectory) -> Iterator[Measured]:
    for k, R in enumerate(track.orientation):
        known = np.isfinite(R).all()
        yield Measured(
            ball="",
            number=k,
            time_s=float(track.time[k]),
            position_lab_mm=np.zeros(3) if known else np.full(3, np.nan),
            R_lab_body=R,
            covariance=np.zeros((6, 6)) + 1e-6 * np.eye(6) if known else np.full((6, 6), np.nan),
            reason=(Reason.OK if known else Reason.NOT_FOUND,),
            lasting=np.zeros((6, 6)),
            poses=no_pose(1, (Reason.NOT_FOUND,)),
            flags=0,
            found=k == 0,
            dropped=0,
            map_number=1,
            latency_s=0.001,
        )
