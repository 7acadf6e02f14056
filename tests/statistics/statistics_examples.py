from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from sphereorient.statistics.bootstrap import Interval
from sphereorient.statistics.segments import UNITS, Ensemble
from sphereorient.trajectory import Trajectory

STEP_S = 1 / 600


def ensemble(frames: list[int], *, error: str = "added", sigma: float = 0.0, **values: np.ndarray) -> Ensemble:
    """Segments of these lengths; quantities that are not given are normal numbers."""
    rng = np.random.default_rng(5)
    count = sum(frames)
    segment = np.repeat(np.arange(len(frames)), frames)
    frame = np.concatenate([np.arange(n) for n in frames])
    everything = {name: rng.standard_normal((count, 3)) for name in UNITS} | values
    return Ensemble(
        time_s=frame * STEP_S + 10.0 * segment,
        frame=frame,
        segment=segment,
        track=np.zeros(len(frames), dtype=np.int64),
        span_s=np.array(frames) * STEP_S,
        step_s=STEP_S,
        R_lab_body=Rotation.random(count, rng).as_matrix(),
        values=everything,
        sigmas={name: np.full((count, 3), sigma) for name in UNITS},
        error=error,
    )


def holds(interval: Interval, truth: float | np.ndarray) -> np.ndarray:
    """Which intervals contain the truth."""
    return np.asarray((interval.low <= truth) & (truth <= interval.high))


def without(whole: Ensemble, kept: np.ndarray) -> Ensemble:
    """The same with some samples lost."""
    return replace(
        whole,
        **{name: getattr(whole, name)[kept] for name in ("time_s", "frame", "segment", "R_lab_body")},
        values={name: x[kept] for name, x in whole.values.items()},
        sigmas={name: x[kept] for name, x in whole.sigmas.items()},
    )


def track(frames: list[int], method: str = "precise", **parts: np.ndarray) -> Trajectory:
    """A track with segments of these lengths, two frames apart, everything measured."""
    segment = np.concatenate([[*([k] * n), -1, -1] for k, n in enumerate(frames)])
    count = len(segment)
    rng = np.random.default_rng(6)
    blank = Trajectory.empty(np.arange(count) * STEP_S, frame_rate=600.0, method=method)
    everything = {name: rng.standard_normal((count, 3)) for name in UNITS}
    everything |= {f"{name}_sigma": np.full((count, 3), 0.1) for name in UNITS}
    everything |= {"position": np.zeros((count, 3)), "position_smooth": np.zeros((count, 3))}
    everything |= {name: np.tile(np.eye(3), (count, 1, 1)) for name in ("orientation", "orientation_smooth")}
    return replace(blank, segment=segment, valid=segment >= 0, **(everything | parts))
