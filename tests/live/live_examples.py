"""Frames and poses for the tests of `live`."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
from conftest import REPO

from sphereorient.live.feed import Arrival
from sphereorient.live.live import Measured
from sphereorient.pose.poses import no_pose
from sphereorient.trajectory import Reason, Trajectory

EXCERPT = REPO / "synthetic_data" / "excerpt"
LIMIT_S = 20.0


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
